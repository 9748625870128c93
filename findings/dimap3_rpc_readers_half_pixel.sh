#!/usr/bin/env bash
# shareloc places a Pléiades Neo image half a pixel apart by its RPC's XML and by its TIFF.
#
# Guess: the RPC_*.XML of a DIMAP 3 delivery (Pléiades Neo) is the same RPC whether shareloc is given
#   that file or the image beside it, as with DIMAP 2 (Pléiades, SPOT 6 and 7), which counts from 1.
# What happens: by the XML, line and sample are 0.5 px smaller than by the image. GDAL, which reads
#   the image, takes the centre of the first pixel for 0 where the profile is PNEO_SENSOR, and for 1
#   elsewhere; shareloc takes it for 0.5 in DIMAP 3. By DIMAP 2 both ways give the same.
# Source: shareloc 0.3.0, rpc_reader_dimap_v23; rasterio 1.4.4 with GDAL 3.10.3, reader_pleiades.cpp;
#   issue 5716 of OSGeo/gdal, by which the supplier's support says 0 for the centre of the first
#   pixel; its sample has FIRST_COL 0, LAST_COL 11728, SAMP_OFF 5864. rpcm 1.4.10 takes 0 as well.
# Why it matters: CARS and other chains on shareloc are given either file. Control points, labels and
#   corrections made by the one and used by the other are off by 0.5 px along and across; in a pair
#   of which one image is read by its XML, so is the disparity.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 shareloc==0.3.0 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import warnings
from importlib.metadata import version

import numpy as np
import rasterio
from shareloc.geomodels import GeoModel

warnings.simplefilter("ignore")
numerator, denominator = {"SAMP": [0.0] * 20, "LINE": [0.0] * 20}, [1.0, 1e-3] + [0.0] * 18
numerator["SAMP"][1], numerator["SAMP"][3] = 1.0, -0.2
numerator["LINE"][2], numerator["LINE"][3] = -1.0, 0.1
VALIDITY = {
    "LONG_SCALE": 0.1, "LONG_OFF": 5.0, "LAT_SCALE": 0.1, "LAT_OFF": 45.0, "HEIGHT_SCALE": 500.0,
    "HEIGHT_OFF": 100.0, "SAMP_SCALE": 500.0, "LINE_SCALE": 500.0,
}


def tags(values):
    return "".join(f"<{name}>{value}</{name}>" for name, value in values.items())


def coefficients(names):
    return "".join(
        tags({f"{name}_{kind}_COEFF_{k}": value for k, value in enumerate(values, 1)})
        for name, key in names.items()
        for kind, values in (("NUM", numerator[key]), ("DEN", denominator))
    )


def delivery(name, dimap, first, ground, image, names):
    """An image of 1000 x 1000 px with its RPC, whose offsets are the image's middle."""
    middle = {"SAMP_OFF": 499.5 + first, "LINE_OFF": 499.5 + first}
    pixels = {"FIRST_ROW": first, "FIRST_COL": first, "LAST_ROW": 999 + first, "LAST_COL": 999 + first}
    domain = image.replace("_Values", "") + "_Validity_Domain"
    inverse = coefficients({"SAMP": "SAMP", "LINE": "LINE"})
    with open(f"RPC_{name}.XML", "w") as file:
        file.write(
            f'<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="{dimap}">DIMAP'
            f"</METADATA_FORMAT><METADATA_PROFILE>{name[:-2]}_SENSOR</METADATA_PROFILE>"
            "</Metadata_Identification><Rational_Function_Model><Global_RFM>"
            f"<{image}>{coefficients(names)}</{image}><{ground}>{inverse}</{ground}><RFM_Validity>"
            f"<{domain}>{tags(pixels)}</{domain}>{tags(VALIDITY | middle)}</RFM_Validity>"
            "</Global_RFM></Rational_Function_Model></Dimap_Document>"
        )
    shape = {"driver": "GTiff", "width": 1000, "height": 1000, "count": 1, "dtype": "uint8"}
    with rasterio.open(f"IMG_{name}_R1C1.TIF", "w", **shape) as file:
        file.write(np.zeros((1, 1000, 1000), np.uint8))


plain = {"SAMP": "SAMP", "LINE": "LINE"}
delivery("PHR1A", "2.15", 1, "Inverse_Model", "Direct_Model", plain)
delivery("PNEO03", "3.0", 0, "GroundtoImage_Values", "ImagetoGround_Values", {"LON": "SAMP", "LAT": "LINE"})
place = [np.array([value]) for value in (5.0, 45.0, 100.0)]  # in the middle of the image
print("shareloc", version("shareloc"), "rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__)
found = {}
for name in ("PHR1A", "PNEO03"):
    for file in (f"IMG_{name}_R1C1.TIF", f"RPC_{name}.XML"):
        row, col = (float(value[0]) for value in GeoModel(file).inverse_loc(*place)[:2])
        print(f"{file}: row {row:.3f}, col {col:.3f}")
        found[file] = row, col
assert found["IMG_PHR1A_R1C1.TIF"] == found["RPC_PHR1A.XML"] == (500.0, 500.0)
assert found["IMG_PNEO03_R1C1.TIF"] == (500.0, 500.0) and found["RPC_PNEO03.XML"] == (499.5, 499.5)
PYTHON
