#!/usr/bin/env bash
# kornia's remap with the maps of the identity moves an image by up to half a pixel.
#
# Guess: kornia.geometry.transform.remap, "equivalent of cv2.remap" with maps in pixels, gives the image
#   back where the maps say of each pixel that it stays.
# What happens: at the left and upper edge the value of 0.5 px to the outside is read, at the right and
#   lower edge likewise, and in between the image is stretched: by 0.5 px - x / (width - 1). The maps are normalised by
#   width - 1, grid_sample's convention of align_corners=True, and align_corners=None means False. With
#   align_corners=True all is right; warp_affine and warp_perspective have that as their default.
# Source: kornia 0.9.0, geometry/transform/imgwarp.py: remap, normalize_pixel_coordinates; torch 2.14.1,
#   torch.nn.functional.grid_sample; issue 4504 of kornia/kornia. Its installation takes 6 GB for a while.
# Why it matters: right images are warped by a disparity map to the left one for losses without truth,
#   and to look at truth. Each disparity seems off by up to 0.5 px, by its column: a network learns the
#   stretch, and a right map is thought to be wrong at both sides.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-cache-dir --disable-pip-version-check kornia==0.9.0 torch==2.14.1 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import kornia
import torch
from kornia.geometry.transform import remap

WIDTH, HEIGHT = 101, 9
print("kornia", kornia.__version__, "torch", torch.__version__)
rows, cols = torch.meshgrid(torch.arange(float(HEIGHT)), torch.arange(float(WIDTH)), indexing="ij")
image = cols[None, None]  # each pixel has its own column as its value
for align in (None, True):
    moved = remap(image, cols[None], rows[None], padding_mode="border", align_corners=align) - image
    line = moved[0, 0, HEIGHT // 2]
    print(f"align_corners={align}: moved by", [round(float(line[x]), 3) for x in (1, 25, 50, 75, 99)], "px")
    wanted = torch.zeros(WIDTH) if align else cols[0] / (WIDTH - 1) - 0.5
    assert (line - wanted)[1:-1].abs().max() < 1e-3
PYTHON
