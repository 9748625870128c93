"""Files and stores that are whole or absent, and what they were made of.

In: arrays, records. Out: files, folders, Zarr grids. It knows no stage.
"""
