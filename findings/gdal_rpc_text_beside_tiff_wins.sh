#!/usr/bin/env bash
# An _RPC.TXT beside a GeoTIFF hides the RPC that stands in the file.
#
# Guess: the tag of the file itself (RPCCoefficientTag, 50844) decides, and a text beside the file
#   serves those that have no tag.
# What happens: the text wins. A file whose tag was rewritten with a corrected RPC is read with the
#   delivered one, as long as the old text lies beside it; nothing is said.
# Source: rasterio 1.4.4 with GDAL 3.10.3, driver GTiff.
# Why it matters: corrected RPCs are written into copies of the images or into the images themselves.
#   Where the delivery's text is copied along, every reader by GDAL goes on with the old geometry,
#   pixels off, while tools that read the tag by themselves have the new one.
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
shape = {"driver": "GTiff", "width": 8, "height": 8, "count": 1, "dtype": "uint8"}
with rasterio.open("image.tif", "w", **shape, rpcs=rpc(500.0)) as file:
    file.write(np.zeros((1, 8, 8), np.uint8))


def read():
    with rasterio.open("image.tif") as file:
        return file.rpcs.line_off


alone, names = read(), ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
old = rpc(777.0)
text = [f"{n}_{w.upper()}: {getattr(old, f'{n.lower()}_{w}')}" for w in ("off", "scale") for n in names]
for n in ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN"):
    values = getattr(old, f"{n.lower()}_coeff")
    text += [f"{n}_COEFF_{k}: {value}" for k, value in enumerate(values, 1)]
with open("image_RPC.TXT", "w") as file:
    file.write("\n".join(text) + "\n")
beside = read()
print(f"LINE_OFF of the tag 500, of the text 777: read {alone:g} alone, {beside:g} with the text beside")
assert (alone, beside) == (500.0, 777.0)
PYTHON
