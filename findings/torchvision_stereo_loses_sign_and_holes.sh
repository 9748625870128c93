#!/usr/bin/env bash
# torchvision's stereo datasets take negative disparities for positive ones, and holes for disparity 0.
#
# Guess: Kitti2015Stereo, which gives a tuple of four with a mask at its end, marks there which pixels of the
#   PNG have a measurement (0 has none); the datasets of PFM files give the files' values, of either sign.
# What happens: Kitti2012Stereo and Kitti2015Stereo give None for the mask, and disparity 0.0 for pixels
#   without a value: valid numbers to a loss. SceneFlowStereo (and Middlebury2014Stereo, ETH3DStereo and
#   CarlaStereo) give the absolute value of all disparities: -12.5 px is 12.5 px. Nothing is said.
# Source: torchvision 0.29.1, datasets/_stereo_matching.py: _read_disparity. The documentation says that the
#   mask is "implicitly None". Its installation takes 6 GB for a while.
# Why it matters: disparities of satellite pairs have both signs, around the height of the grid, and half
#   of a city is hidden. Who gives such truth the layout of these sets, to train what reads them, has
#   valleys as high as hills, and walls that fall to 0 in every shadow.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-cache-dir --disable-pip-version-check torchvision==0.29.1 torch==2.14.1 numpy==2.4.6
venv/bin/python - <<'PYTHON'
from pathlib import Path

import numpy as np
import torchvision
from PIL import Image
from torchvision.datasets import Kitti2015Stereo, SceneFlowStereo

print("torchvision", torchvision.__version__)
COLOUR = Image.fromarray(np.zeros((2, 4, 3), np.uint8))


def saved(image, path):
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    image.save(path)


measured = np.array([[0, 0, 20 * 256, 20 * 256]] * 2, np.uint16)  # 0: no measurement
for name in ("image_2", "image_3"):
    saved(COLOUR, f"Kitti2015/training/{name}/000000_10.png")
for name in ("disp_occ_0", "disp_occ_1"):
    saved(Image.fromarray(measured), f"Kitti2015/training/{name}/000000_10.png")
_, _, disparity, mask = Kitti2015Stereo(".")[0]
print("KITTI: disparity", disparity[0, 0].tolist(), "mask", mask)
assert mask is None and disparity[0, 0].tolist() == [0.0, 0.0, 20.0, 20.0]

signed = np.array([[-12.5, -3.0, 3.0, 12.5]] * 2, "<f4")
for side in ("left", "right"):
    saved(COLOUR, f"SceneFlow/Monkaa/frames_cleanpass/scene/{side}/0000.png")
    file = Path(f"SceneFlow/Monkaa/disparity/scene/{side}/0000.pfm")
    file.parent.mkdir(parents=True)
    file.write_bytes(b"Pf\n4 2\n-1.0\n" + signed.tobytes())
disparity = SceneFlowStereo(".", variant="Monkaa", pass_name="clean")[0][2]
print("PFM: written", signed[0].tolist(), "read", disparity[0, 0].tolist())
assert disparity[0, 0].tolist() == [12.5, 3.0, 3.0, 12.5]
PYTHON
