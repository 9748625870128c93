#!/usr/bin/env bash
# GDAL writes half floats (NBITS=16) whose nodata value matches no pixel, and cuts all disparities.
#
# Guess: nodata=-9999 still hides its pixels when values are kept in 16 bits: GDAL rounds both alike,
#   or refuses a value that a half float cannot hold. Values are rounded to the nearest.
# What happens: the pixels become -9992, the nodata value stays -9999, and the mask calls all pixels
#   valid. Values are cut towards zero: at 64 to 128 px, disparities are 0.031 px too small in the
#   mean and 0.062 px at most; rounding, as by numpy, has a mean of 0 and half that maximum.
# Source: rasterio 1.4.4 with GDAL 3.10.3, driver GTiff; port/cpl_float.cpp, CPLFloatToHalf, shifts
#   the mantissa by 13 bits. The driver's page says "half-precision floating point values" only.
#   rasterio 1.5.2 with GDAL 3.12.2 rounds, to -10000, and calls these pixels valid as well.
# Why it matters: half floats halve the size of disparity maps. Scores by such truth have a bias of
#   0.03 px, against every method, and pixels without a label count as disparities of -9992 px.
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

disparity = np.random.default_rng(0).uniform(64.0, 128.0, (100, 1000)).astype(np.float32)
disparity[0, :10] = -9999.0
given, shape = disparity > -9999.0, {"height": 100, "width": 1000, "count": 1, "dtype": "float32"}
place = from_origin(500000.0, 4000000.0, 0.5, 0.5)
read, hidden = {}, {}
for bits in (32, 16):
    options = {"nbits": 16} if bits == 16 else {}
    with rasterio.open(
        "map.tif", "w", driver="GTiff", nodata=-9999.0, transform=place, **shape, **options
    ) as file:
        file.write(disparity, 1)
    with rasterio.open("map.tif") as file:
        nodata, read[bits], hidden[bits] = file.nodata, file.read(1), file.read_masks(1) == 0
print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
read["numpy"] = disparity.astype(np.float16).astype(np.float32)
off = {}
for name, values in read.items():
    error = values[given] - disparity[given]
    off[name] = error.mean()
    text = f"mean {error.mean():+.4f} px, at most {abs(error).max():.4f} px"
    print(f"{name}: {text}; -9999 is {values[0, 0]:g}")
print("nodata", nodata, "hides:", {bits: int(pixels.sum()) for bits, pixels in hidden.items()})
assert nodata == -9999.0 and hidden[32].sum() == 10 and hidden[16].sum() == 0
assert np.all(read[16][0, :10] == -9992.0)
assert abs(off["numpy"]) < 1e-3 and -0.033 < off[16] < -0.029
assert np.all(read[16][given] <= disparity[given])
PYTHON
