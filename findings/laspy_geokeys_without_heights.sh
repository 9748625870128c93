#!/usr/bin/env bash
# laspy and rasterio leave out the vertical system that GeoTIFF keys name, and its feet with it.
#
# Guess: of keys that say Georgia West in US survey feet (3072: 2240) and heights over NAVD88 in US
#   survey feet (4096: 6360), header.parse_crs() of a LAS file gives both, and so does rasterio of a
#   surface model with the same keys.
# What happens: laspy looks at the keys 3072 and 2048 only: the system in plan. rasterio gives the same
#   where the keys are of version 1.0 (the first three numbers are 1, 1, 0), and both systems where they
#   are of version 1.1 or with rasterio.Env(GTIFF_REPORT_COMPD_CS=True). Nothing is said.
# Source: laspy 2.7.0, vlrs/known.py: GeoKeyDirectoryVlr.parse_crs; rasterio 1.4.4 with GDAL 3.10.3,
#   driver GTiff, GTIFF_REPORT_COMPD_CS; OGC GeoTIFF 1.1 (19-008r4), VerticalGeoKey.
# Why it matters: older LiDAR of counties and states is in LAS 1.2, and its surface models have keys of
#   version 1.0. Heights in feet are taken for metres, or over a geoid for ellipsoidal ones: hundreds of
#   pixels, or the 20 to 50 m of a geoid, which a fit to control points hides. The files are not to blame.
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

print("laspy", laspy.__version__, "rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
KEYS = (1024, 1), (3072, 2240), (4096, 6360)


def directory(version):
    return np.array([*version, len(KEYS), *(n for key, value in KEYS for n in (key, 0, 1, value))], "<u2")


def by_laspy(keys):
    header = laspy.LasHeader(point_format=3, version="1.2")
    vlr = GeoKeyDirectoryVlr()
    vlr.parse_record_data(keys.tobytes())
    header.vlrs.append(vlr)
    laspy.LasData(header).write("keys.las")
    return laspy.read("keys.las").header.parse_crs()


def by_rasterio(keys, **options):
    place = [(33550, "d", 3, (1.0, 1.0, 0.0), True), (33922, "d", 6, (0.0, 0.0, 0.0, 7e5, 4e5, 0.0), True)]
    tags = [*place, (34735, "H", len(keys), tuple(keys.tolist()), True)]
    tifffile.imwrite("keys.tif", np.zeros((4, 4), np.float32), extratags=tags, metadata=None)
    with rasterio.Env(**options), rasterio.open("keys.tif") as file:
        return file.crs


for version in ((1, 1, 0), (1, 1, 1)):
    keys = directory(version)
    systems = {
        "laspy": by_laspy(keys),
        "rasterio": by_rasterio(keys),
        "rasterio, GTIFF_REPORT_COMPD_CS": by_rasterio(keys, GTIFF_REPORT_COMPD_CS=True),
    }
    found = {name: "NAVD88" in system.to_wkt() for name, system in systems.items()}
    print("keys", version, "| with a vertical system:", found)
    assert list(found.values()) == [False, version[2] == 1, True]
PYTHON
