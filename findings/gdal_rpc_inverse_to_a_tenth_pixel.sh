#!/usr/bin/env bash
# GDAL finds the ground of an image point by an RPC to 0.1 px only.
#
# Guess: the ground point that belongs to image position and height is found by iteration to the
#   precision of the numbers, so that projecting it again gives the position that was asked for.
# What happens: the iteration stops once it is nearer than 0.1 px (RPC_PIXEL_ERROR_THRESHOLD of
#   GDALCreateRPCTransformer), and rasterio has no argument for it: positions come back up to 0.1 px
#   off along and across.
# Source: rasterio 1.4.4 with GDAL 3.10.3, RPCTransformer.xy; GDAL's documentation of
#   GDALCreateRPCTransformerV2.
# Why it matters: rays, footprints and epipolar lines by rasterio or gdaltransform carry 0.1 px, ten
#   times the error of a good disparity label, as a pattern that is no noise.
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
from rasterio.transform import RPCTransformer

line, samp, denominator = ([0.0] * 20 for _ in range(3))
line[2], line[3], line[7], line[11] = -1.0, 0.1, 1e-3, 3e-4
samp[1], samp[3], samp[4], samp[8] = 1.0, -0.2, 5e-4, 2e-3
denominator[0], denominator[1] = 1.0, 1e-3


def rpc(line_off):
    return RPC(
        height_off=100.0, height_scale=500.0, lat_off=45.0, lat_scale=0.1, long_off=5.0,
        long_scale=0.1, line_off=line_off, line_scale=500.0, samp_off=500.0, samp_scale=500.0,
        line_num_coeff=line, line_den_coeff=denominator, samp_num_coeff=samp,
        samp_den_coeff=denominator, err_bias=None, err_rand=None,
    )


def project(lon, lat, height):
    """Column and row by the polynomials of RPC00B."""
    p, l, h = (lat - 45.0) / 0.1, (lon - 5.0) / 0.1, (height - 100.0) / 500.0
    terms = np.array([
        1.0 + 0.0 * p, l, p, h, l * p, l * h, p * h, l * l, p * p, h * h, p * l * h, l**3, l * p * p,
        l * h * h, l * l * p, p**3, p * h * h, l * l * h, p * p * h, h**3,
    ])
    below = np.dot(denominator, terms)
    return 500.0 + 500.0 * np.dot(samp, terms) / below, 500.0 + 500.0 * np.dot(line, terms) / below


print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
transform = RPCTransformer(rpc(500.0))
rng = np.random.default_rng(0)
row, col = rng.uniform(0.0, 1000.0, (2, 500))
height = rng.uniform(-200.0, 500.0, 500)
lon, lat = (np.array(v) for v in transform.xy(row, col, height, offset="center"))
again_col, again_row = project(lon, lat, height)
off = np.maximum(np.abs(again_col - col), np.abs(again_row - row))
print(f"projected again, off by {off.max():.3f} px at most, {np.median(off):.3f} px in the median")
assert 0.05 < off.max() < 0.15
PYTHON
