"""One city's scenes to its benchmark tiles."""
