#!/usr/bin/env bash
# GDAL takes a terrain model's heights over EGM96 for ellipsoidal ones where PROJ's grid is missing.
#
# Guess: RPC_DEM with a vertical system (EPSG:4326+5773, heights over EGM96) is converted, as GDAL's
#   documentation says (RPC_DEM_APPLY_VDATUM_SHIFT is on by default); where the conversion cannot be
#   made there is an error, or at least a warning.
# What happens: with the grid us_nga_egm96_15.tif among PROJ's data the image point moves by what 51 m
#   of height are (76.5 px of this RPC). Without it, as after `pip install rasterio`, whose wheels have no
#   geoid grids, the heights are taken as they are: the same image point as by a model without
#   any vertical system, and neither exception nor warning nor a word in GDAL's log.
# Source: rasterio 1.4.4 with GDAL 3.10.3, alg/gdal_rpc.cpp; documentation of
#   GDALCreateRPCTransformerV2, RPC_DEM_APPLY_VDATUM_SHIFT.
# Why it matters: two machines orthorectify or localise one image 30 to 50 m of height apart from the
#   same files, by what happens to be installed: tens of pixels, and of the size of an RPC's own
#   errors, so that a fit to control points hides it. A geoid that was named is not a geoid applied.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.2.6
cat > place.py <<'PYTHON'
"""The column at which a place lies, by an RPC and a level terrain model of 300 m."""
import sys
import warnings

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer, from_origin

warnings.simplefilter("error", UserWarning)


def polynomial(**terms):
    coefficients = [0.0] * 20
    for term, value in terms.items():
        coefficients[int(term[1:])] = value
    return coefficients


# Line: latitude; column: longitude and 0.3 of the height, each divided by its scale.
rpc = RPC(
    err_bias=0.0, err_rand=0.0, height_off=0.0, height_scale=1000.0, lat_off=45.0, lat_scale=0.1,
    line_off=5000.0, line_scale=5000.0, long_off=5.0, long_scale=0.1, samp_off=5000.0,
    samp_scale=5000.0, line_num_coeff=polynomial(c2=-1.0), line_den_coeff=polynomial(c0=1.0),
    samp_num_coeff=polynomial(c1=1.0, c3=0.3), samp_den_coeff=polynomial(c0=1.0),
)
form = dict(driver="GTiff", width=200, height=200, count=1, dtype="float32")
form |= dict(crs=CRS.from_user_input(sys.argv[1]), transform=from_origin(4.9, 45.1, 0.001, 0.001))
with rasterio.open("terrain.tif", "w", **form) as file:
    file.write(np.full((200, 200), 300, np.float32), 1)
with RPCTransformer(rpc, rpc_dem="terrain.tif") as transformer:
    print(transformer.rowcol([5.0], [45.0], op=float)[1][0])
PYTHON
cat > grid.py <<'PYTHON'
"""PROJ's data with a grid of EGM96, here 51 m everywhere."""
import shutil
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

shutil.copytree(Path(rasterio.__file__).parent / "proj_data", "data")
form = dict(driver="GTiff", width=1440, height=721, count=1, dtype="float32", crs="EPSG:4326")
form |= dict(transform=from_origin(-180.125, 90.125, 0.25, 0.25))
with rasterio.open("data/us_nga_egm96_15.tif", "w", **form) as file:
    file.write(np.full((721, 1440), 51, np.float32), 1)
    file.set_band_description(1, "geoid_undulation")
    file.update_tags(
        TYPE="VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", target_crs_epsg_code="5773", AREA_OR_POINT="Point"
    )
PYTHON
venv/bin/python -c 'import rasterio; print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)'
venv/bin/python grid.py
none=$(venv/bin/python place.py EPSG:4326)
missing=$(venv/bin/python place.py EPSG:4326+5773)
there=$(PROJ_DATA=$PWD/data PROJ_LIB=$PWD/data venv/bin/python place.py EPSG:4326+5773)
echo "column, no vertical system:         $none"
echo "column, EGM96, no grid installed:   $missing"
echo "column, EGM96, grid installed:      $there"
venv/bin/python - "$none" "$missing" "$there" <<'PYTHON'
import sys

none, missing, there = map(float, sys.argv[1:])
assert none == missing and abs(there - none - 76.5) < 0.6
PYTHON
