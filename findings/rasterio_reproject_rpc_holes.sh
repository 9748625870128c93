#!/usr/bin/env bash
# An ortho image by RPC and terrain has holes where towers near its edge lean out of the window.
#
# Guess: rasterio.warp.reproject with an RPC and RPC_DEM fills each pixel of the result whose ground the
#   image shows; the image reaches far beyond the result here.
# What happens: the whole roof of a tower of 80 m, 5 m inside of the edge, has no value, and nothing is
#   said. What is read of the image is told from ground along the edge of the result, and a few px
#   around that: a roof within leans further. SAMPLE_GRID=YES changes nothing. 100 px more of result,
#   or SOURCE_EXTRA=100, and all is there. Right values are right to 1e-4 px.
# Source: rasterio 1.4.4 with GDAL 3.10.3 (1.5.2 with GDAL 3.12.2 as well); GDALWarpOperation,
#   ComputeSourceWindow; documentation of GDALWarpOptions, SOURCE_EXTRA and SAMPLE_GRID.
# Why it matters: ortho images are made tile by tile. Roofs and cliffs at the tiles' edges are missing
#   in the one and whole in the next, and a comparison of left and right ortho images calls them
#   hidden: the highest disparities of a city are the ones that go.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import numpy as np
import rasterio
from rasterio.rpc import RPC
from rasterio.transform import from_origin
from rasterio.warp import Resampling, reproject

print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
LON, LAT, SIZE = 10.0, 45.0, 1200
STEP = 0.5 / 111_132  # degrees: pixels of 0.5 m, of image, terrain model and result
GRID = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": "EPSG:4326"}


def coefficients(**values):
    return [values.get(f"c{number}", 0.0) for number in range(20)]


# sample = 1000 + (longitude - LON) / STEP + height - 100
rpc = RPC(
    height_off=100.0, height_scale=500.0, lat_off=LAT, lat_scale=2000 * STEP, long_off=LON,
    long_scale=2000 * STEP, line_off=1000.0, line_scale=2000.0, samp_off=1000.0, samp_scale=2000.0,
    line_num_coeff=coefficients(c2=-1.0), line_den_coeff=coefficients(c0=1.0),
    samp_num_coeff=coefficients(c1=1.0, c3=0.25), samp_den_coeff=coefficients(c0=1.0),
)  # fmt: skip
image = np.tile(np.arange(2000, dtype=np.float32), (2000, 1))  # its own column
heights = np.full((SIZE, SIZE), 100.0, np.float32)
heights[470:490, 970:990] = 180.0  # a tower of 10 x 10 m
corner = from_origin(LON - SIZE / 2 * STEP, LAT + SIZE / 2 * STEP, STEP, STEP)
with rasterio.open("dem.tif", "w", width=SIZE, height=SIZE, transform=corner, **GRID) as file:
    file.write(heights, 1)
for last, options, holes_wanted in (
    (1000, {}, 400), (1000, {"SAMPLE_GRID": "YES"}, 400), (1000, {"SOURCE_EXTRA": 100}, 0), (1100, {}, 0),
):  # fmt: skip
    ortho = np.full((800, last - 200), np.nan, np.float32)
    reproject(
        image, ortho, rpcs=rpc, RPC_DEM="dem.tif", src_crs="EPSG:4326", dst_crs="EPSG:4326",
        dst_transform=corner * corner.translation(200, 200), dst_nodata=np.nan,
        resampling=Resampling.bilinear, **options,
    )  # fmt: skip
    wanted = 900 + np.arange(200, last) + 0.5 - SIZE / 2 + heights[200:1000, 200:last]
    holes = int(np.isnan(ortho).sum())
    print(f"columns 200 to {last}, {options}: {holes} holes; columns of the image up to {wanted.max():.0f} of 2000")
    assert holes == holes_wanted and np.nanmax(np.abs(ortho - wanted)) < 1e-3
PYTHON
