#!/usr/bin/env bash
# rasterio.merge moves tiles whose grids do not agree by up to a whole pixel, bilinear or not.
#
# Guess: of two tiles of one surface, whose pixels lie a fraction of a pixel apart, the second is
#   interpolated at the pixels of the first, at least by resampling=bilinear; by nearest it is half a
#   pixel off at most.
# What happens: the window is rounded to whole pixels of the mosaic before the tile is read. By nearest
#   the whole tile lies 0.8 px off its place where the grids are 0.8 px apart. Bilinear does the same
#   there. Where they are 0.4 px apart, bilinear stretches the tile: 0.4 px off at its one end, right at
#   the other.
# Source: rasterio 1.4.4, rasterio.merge.merge.
# Why it matters: mosaics of surface models made tile by tile, each with a grid of its own, have a
#   step at each seam. A steep roof or slope in such a mosaic is off by nearly a pixel on the ground, as
#   much as several pixels of disparity, and differences between two mosaics look like change.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import numpy as np
import rasterio
from rasterio.enums import Resampling
from rasterio.merge import merge
from rasterio.transform import from_origin

print("rasterio", rasterio.__version__)


def tile(name, west):
    """30 pixels of 1 m of a plane whose height is the easting: an error in m is one in pixels."""
    with rasterio.open(
        name, "w", driver="GTiff", width=30, height=20, count=1, dtype="float64", nodata=-999.0,
        crs="EPSG:32633", transform=from_origin(west, 20.0, 1.0, 1.0),
    ) as file:
        file.write(np.tile(west + np.arange(30) + 0.5, (20, 1)), 1)
    return name


first = tile("first.tif", 0.0)
off = {}
for apart in (0.4, 0.8):
    second = tile("second.tif", 25.0 + apart)
    for how in (Resampling.nearest, Resampling.bilinear):
        mosaic, place = merge([first, second], resampling=how)
        error = (mosaic[0, 10] - (place.c + np.arange(mosaic.shape[2]) + 0.5))[32:54]
        off[apart, how.name] = error
        print(f"{apart} px apart, {how.name}: off by {error[0]:.2f} px at 32.5 m, {error[-1]:.2f} px at 53.5 m")
for apart in (0.4, 0.8):
    assert np.allclose(off[apart, "nearest"], apart)
assert np.allclose(off[0.8, "bilinear"], 0.8)
assert 0.25 < off[0.4, "bilinear"][0] < 0.4 and abs(off[0.4, "bilinear"][-1]) < 0.05
PYTHON
