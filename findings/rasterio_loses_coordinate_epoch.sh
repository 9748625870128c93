#!/usr/bin/env bash
# rasterio loses the epoch of coordinates, when it reads a system and when it writes a GeoTIFF.
#
# Guess: COORDINATEMETADATA[ITRF2014 ..., EPOCH[2016.4]] (WKT2:2019) is kept or refused, as the
#   GeoTIFF key 5120 (CoordinateEpoch) is there for it.
# What happens: rasterio takes the text as ITRF2014 without an epoch, writes a GeoTIFF without the
#   key 5120, and says nothing. pyproj 3.7 refuses the same text: "Input is not a CRS".
# Source: rasterio 1.4.4 (GDAL 3.10.3), pyproj 3.7.2 (PROJ 9.5.1).
# Why it matters: without its epoch a place in ITRF2014 is known to 2 to 7 cm a year only.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 pyproj==3.7.2 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import struct

import numpy as np
import pyproj
import rasterio
from rasterio.transform import from_origin

print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
text = f"COORDINATEMETADATA[{pyproj.CRS(9000).to_wkt()},EPOCH[2016.4]]"
try:
    pyproj.CRS.from_wkt(text)
    refused = False
except pyproj.exceptions.CRSError as error:
    print("pyproj:", str(error)[:20])
    refused = True
system = rasterio.crs.CRS.from_wkt(text)
print("rasterio:", system.to_string(), "2016.4" in system.to_wkt(version="WKT2_2019"))
place = from_origin(151.0, -33.0, 1e-3, 1e-3)
shape = {"width": 8, "height": 8, "count": 1, "dtype": "float32"}
with rasterio.open("a.tif", "w", driver="GTiff", crs=system, transform=place, **shape) as raster:
    raster.write(np.ones((1, 8, 8), np.float32))
data = open("a.tif", "rb").read()
(start,) = struct.unpack_from("<I", data, 4)
keys = []
for k in range(struct.unpack_from("<H", data, start)[0]):
    tag, _, count, where = struct.unpack_from("<HHII", data, start + 2 + 12 * k)
    if tag == 34735:
        keys = np.frombuffer(data, "<u2", count, where).reshape(-1, 4)[1:, 0].tolist()
print("keys of the GeoTIFF:", keys)
assert refused and "2016.4" not in system.to_wkt(version="WKT2_2019") and 5120 not in keys
PYTHON
