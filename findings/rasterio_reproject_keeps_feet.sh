#!/usr/bin/env bash
# rasterio.warp.reproject gives a surface model another vertical system and leaves its heights as they were.
#
# Guess: between two systems that differ in their heights (NAVD88 in US survey feet, NAVD88 in metres),
#   reproject converts the heights, as rasterio.warp.transform does for points and gdalwarp for
#   rasters, or refuses. No grid of a geoid is needed.
# What happens: points are converted, rasters are not: reproject and WarpedVRT write 100 ft as 100 m,
#   under the new system's name, without a word. gdalwarp adds the shift of heights itself, outside of
#   the warper that rasterio (and through it rioxarray and odc-geo) calls.
# Source: rasterio 1.4.4 with GDAL 3.10.3; GDAL's documentation of gdalwarp, -novshift.
# Why it matters: surface models and geoid heights of surveys come in feet and over geoids. A model
#   "reprojected to EPSG:4979" that way places the ground hundreds of pixels off in an RPC image, or
#   by a geoid's 30 m, and all tags say that it is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import numpy as np
import rasterio
from rasterio.transform import from_origin
from rasterio.vrt import WarpedVRT
from rasterio.warp import reproject, transform

FEET, METRES = "EPSG:26910+6360", "EPSG:26910+5703"  # UTM 10 N with NAVD88, in ftUS and in m
print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
place = from_origin(500000.0, 4400000.0, 10.0, 10.0)
heights = np.full((20, 20), 100.0, np.float32)
(point,) = transform(FEET, METRES, [500055.0], [4399945.0], [100.0])[2]
raster = np.full_like(heights, np.nan)
reproject(heights, raster, src_transform=place, src_crs=FEET, dst_transform=place, dst_crs=METRES)
shape = {"width": 20, "height": 20, "count": 1, "dtype": "float32"}
with rasterio.open("feet.tif", "w", driver="GTiff", crs=FEET, transform=place, **shape) as file:
    file.write(heights, 1)
with rasterio.open("feet.tif") as file, WarpedVRT(file, crs=METRES) as warped:
    assert "foot" in file.crs.to_wkt() and "foot" not in warped.crs.to_wkt()
    lazily = warped.read(1)
print(f"100 ft: of a point {point:.3f} m, by reproject {raster[10, 10]:.3f}, by WarpedVRT {lazily[10, 10]:.3f}")
assert abs(point - 30.48006) < 1e-4
assert raster[10, 10] == lazily[10, 10] == 100.0
PYTHON
