#!/usr/bin/env bash
# WebDataset clips 16-bit images and disparity maps to 255 when it decodes them.
#
# Guess: .decode("pil") gives a PNG as Pillow opens it, 16 bits as 16 bits; "l" and "rgb", floats from 0 to
#   1, are divided by the greatest value of the type, 65535.
# What happens: a PNG of 16 bits is converted to RGB of 8 bits by any of the decoders, by clipping:
#   all above 255 becomes 255 or 1.0. Disparities of KITTI's form (256 steps a pixel) are all 1 px. Of a
#   colour PNG of 16 bits, the upper 8 bits stay. Nothing is said. Arrays (.npy) come back as they are.
# Source: webdataset 1.0.2, autodecode.py: ImageHandler, img.convert("RGB"); Pillow 12.0.0, whose
#   conversion of I;16 clips.
# Why it matters: satellite images have 11 to 16 bits, disparity truth in PNG 16. A network is trained on
#   white images, or learns a disparity of 1 px, and the loss falls well.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check webdataset==1.0.2 pillow==12.0.0 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import io

import numpy as np
import PIL
import webdataset
from PIL import Image

print("webdataset", webdataset.__version__, "Pillow", PIL.__version__)
disparity = np.array([[0, 64, 128, 255, 256, 5 * 256, 40 * 256, 200 * 256]], np.uint16).repeat(4, axis=0)
stream, array = io.BytesIO(), io.BytesIO()
Image.fromarray(disparity).save(stream, "PNG")
np.save(array, disparity)
assert np.array_equal(np.asarray(Image.open(stream)), disparity)
with webdataset.TarWriter("tiles.tar") as tar:
    tar.write({"__key__": "tile", "disp.png": stream.getvalue(), "disp.npy": array.getvalue()})
for decoder in ("pil", "pill", "rgb8", "l8", "rgb", "l"):
    [sample] = webdataset.WebDataset("tiles.tar", shardshuffle=False).decode(decoder)
    values = np.asarray(sample["disp.png"])
    row = (values[0, :, 0] if values.ndim == 3 else values[0]).tolist()
    print(f"{decoder}: {values.dtype} {np.round(row, 3).tolist()}")
    white = 255 if values.dtype == np.uint8 else 1.0
    assert row[3:] == [white] * 5 and row[1] < row[2] < white
    assert np.array_equal(sample["disp.npy"], disparity)
PYTHON
