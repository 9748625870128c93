#!/usr/bin/env bash
# GDAL reads neither RPC nor date of a Vantor image whose XML has a namespace.
#
# Guess: the .XML of a WorldView image (ISD with IMD and RPB) says the same to GDAL whether its root is
#   <isd> or, as in deliveries since 2026, <isd xmlns="...">; or GDAL warns of what it cannot read.
# What happens: with the namespace the image has no RPC, no satellite and no date, and nothing is said.
#   GDAL looks for the letters "<isd>" in the head of the file.
# Source: rasterio 1.4.4 with GDAL 3.10.3 (3.12.2 as well), reader_digital_globe.cpp,
#   HasRequiredFiles; namespaces: pull request 115 of PolarGeospatialCenter/imagery_utils.
# Why it matters: the same image is a sensor image with one delivery, and one without geometry with
#   the next. Of a level that has a projection as well, readers fall back on that, metres off, and
#   pairs are told apart by date and sun no more.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import warnings

import numpy as np
import rasterio

warnings.simplefilter("ignore")
SCALARS = {
    "LINEOFFSET": 812, "SAMPOFFSET": 850, "LATOFFSET": 41.9, "LONGOFFSET": 12.6, "HEIGHTOFFSET": 95,
    "LINESCALE": 938, "SAMPSCALE": 1152, "LATSCALE": 0.015, "LONGSCALE": 0.0225, "HEIGHTSCALE": 501,
}
fields = "".join(f"<{name}>{value}</{name}>" for name, value in SCALARS.items())
for kind in ("LINENUMCOEF", "LINEDENCOEF", "SAMPNUMCOEF", "SAMPDENCOEF"):
    values = " ".join(["1.0", "0.5"] + ["0.0"] * 18)
    fields += f"<{kind}List><{kind}>{values}</{kind}></{kind}List>"
shape = {"driver": "GTiff", "width": 10, "height": 10, "count": 1, "dtype": "uint8"}
with rasterio.open("image.tif", "w", **shape) as file:
    file.write(np.zeros((1, 10, 10), np.uint8))
print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
told = {}
for root in ("<isd>", '<isd xmlns="urn:example:isd">'):
    with open("image.XML", "w") as file:
        file.write(
            f'<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n{root}<IMD><IMAGE><SATID>WV03'
            "</SATID><FIRSTLINETIME>2026-05-01T13:00:00.000000Z</FIRSTLINETIME></IMAGE></IMD>"
            f"<RPB><SPECID>RPC00B</SPECID><IMAGE>{fields}</IMAGE></RPB></isd>"
        )
    with rasterio.open("image.tif") as file:
        line = file.tags(ns="RPC").get("LINE_OFF")
        told[root] = line, file.tags(ns="IMAGERY").get("ACQUISITIONDATETIME")
    print(f"{root}: line offset {told[root][0]}, date {told[root][1]}")
assert list(told.values()) == [("812", "2026-05-01 13:00:00"), (None, None)]
PYTHON
