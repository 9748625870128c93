#!/usr/bin/env bash
# A LAS file in feet, written by laspy with its compound system, is one in metres to GDAL's reader of keys.
#
# Guess: header.add_crs("EPSG:2240+6360"), Georgia West with heights over NAVD88, all in US survey feet, writes
#   the keys 3072 (2240) and 4096 (6360) into a file of point formats 0 to 5, which all readers know.
# What happens: laspy writes the number of the compound system, 8729, into key 3072, where only
#   projected systems may stand. laspy reads it again as it was. GDAL finds the right names, and "unknown" for
#   the unit, of 1 metre, in plan as in height. Compound systems without a number, such as UTM with a
#   geoid, are refused: "Projected CRS without epsg is not supported".
# Source: laspy 2.7.0, header.py (add_crs), vlrs/known.py; OGC GeoTIFF 1.1 (19-008r4), ProjectedCRSGeoKey;
#   rasterio 1.4.4 with GDAL 3.10.3, given the same keys in a TIFF.
# Why it matters: LiDAR that was cut or filtered by laspy and written with its system goes to other programs
#   with the places of feet and the unit of metres: 3.28 times off in height and in plan, with the right
#   name in the file. Formats 6 to 10 have WKT, and are right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    laspy==2.7.0 pyproj==3.7.2 rasterio==1.4.4 tifffile==2025.5.10 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import laspy
import numpy as np
import rasterio
import tifffile
from laspy.vlrs.known import GeoKeyDirectoryVlr
from pyproj import CRS

print("laspy", laspy.__version__, "rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)


def units_by_gdal(*keys):
    """Metres of the units in plan and in height."""
    shorts = [1, 1, 0, len(keys), *(n for key, value in keys for n in (key, 0, 1, value))]
    tags = [(33550, "d", 3, (1.0, 1.0, 0.0), True), (33922, "d", 6, (0.0, 0.0, 0.0, 7e5, 4e5, 0.0), True),
            (34735, "H", len(shorts), tuple(shorts), True)]  # fmt: skip
    tifffile.imwrite("keys.tif", np.zeros((4, 4), np.float32), extratags=tags, metadata=None)
    with rasterio.Env(GTIFF_REPORT_COMPD_CS=True), rasterio.open("keys.tif") as file:
        system = CRS(file.crs.to_wkt())
    print(keys, "by GDAL:", system.name, [(axis.unit_name, axis.unit_conversion_factor) for axis in system.axis_info])
    return {round(axis.unit_conversion_factor, 6) for axis in system.axis_info}


header = laspy.LasHeader(point_format=3, version="1.2")
header.add_crs(CRS("EPSG:2240+6360"))
laspy.LasData(header).write("points.las")
header = laspy.read("points.las").header
[vlr] = [vlr for vlr in header.vlrs if isinstance(vlr, GeoKeyDirectoryVlr)]
written = {key.id: key.value_offset for key in vlr.geo_keys}
print("written by laspy:", written, "read again:", header.parse_crs().name)
assert written[3072] == 8729 and 4096 not in written
assert units_by_gdal((1024, 1), (3072, written[3072])) == {1.0}
assert units_by_gdal((1024, 1), (3072, 2240), (4096, 6360)) == {0.304801}
try:
    header.add_crs(CRS("EPSG:32633+5773"))
except RuntimeError as error:
    print("EPSG:32633+5773:", error)
else:
    raise AssertionError("taken")
PYTHON
