"""The names of the layers of rectified images in colour."""

COLOURS = ("red", "green", "blue")
