#!/usr/bin/env bash
# rasterio and shareloc place an RPC's image point half a pixel from where RPC00B has it.
#
# Guess: the image coordinates of a library that reads RPCs are those of the RPC: 0 is the centre of
#   the first pixel, as the specification (STDI-0002, RPC00B) has it.
# What happens: both count from the corner of the first pixel and add 0.5 to line and sample; and
#   rasterio's rowcol cuts the result to whole numbers unless it is told not to.
# Source: rasterio 1.4.4 with GDAL 3.10.3 (RPCTransformer.rowcol), shareloc 0.3.0 (inverse_loc).
# Why it matters: who corrects an RPC with one library and projects with another, or measures control
#   points in one and fits in the other, is off by 0.5 px in both directions. In both images of a pair
#   it cancels in the disparity, but not in the place, and not where one image is rotated.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 shareloc==0.3.0 numpy==2.4.6
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
import warnings

warnings.simplefilter("ignore")
from importlib.metadata import version

from shareloc.geomodels import GeoModel

place = 5.03, 45.02, 140.0
shape = {"driver": "GTiff", "width": 1000, "height": 1000, "count": 1, "dtype": "uint8"}
with rasterio.open("image.tif", "w", **shape, rpcs=rpc(500.0)) as file:
    file.write(np.zeros((1, 1000, 1000), np.uint8))
col, row = project(*place)
print(f"RPC00B:            row {row:.4f}, col {col:.4f}")
given = [[v] for v in place]
exact = [float(v[0]) for v in RPCTransformer(rpc(500.0)).rowcol(*given, op=lambda value: value)]
whole = [int(v[0]) for v in RPCTransformer(rpc(500.0)).rowcol(*given)]
print(f"rasterio:          row {exact[0]:.4f}, col {exact[1]:.4f}; by default {whole}")
found = GeoModel("image.tif").inverse_loc(*(np.array(v) for v in given))
other = [float(v[0]) for v in found[:2]]
print(f"shareloc {version('shareloc')}:    row {other[0]:.4f}, col {other[1]:.4f}")
assert np.allclose(np.array(exact) - (row, col), 0.5, atol=1e-6) and whole == [404, 642]
assert np.allclose(np.array(other) - (row, col), 0.5, atol=1e-6)
PYTHON
