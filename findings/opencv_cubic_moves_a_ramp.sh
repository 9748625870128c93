#!/usr/bin/env bash
# OpenCV's cubic interpolation gives a ramp other values than its own.
#
# Guess: cv2.INTER_CUBIC, "bicubic interpolation", is the finer choice for images and disparity maps:
#   what is linear stays so, as by INTER_LINEAR and by the cubic interpolation of others.
# What happens: 0.25 px between two pixels of a ramp it gives the value at 0.297 px, at 0.75 px that
#   at 0.703 px: up to 0.048 px off, by remap, warpAffine and resize alike. It takes -0.75 for the
#   parameter of Keys's kernel, of which only -0.5 keeps a ramp. Pillow's BICUBIC takes -0.5.
# Source: opencv-python-headless 5.0.0.93 (4.12.0.88 as well), modules/imgproc: interpolateCubic,
#   A = -0.75; issue 17720 of opencv/opencv. Keys 1981, "Cubic convolution interpolation".
# Why it matters: in images that are rectified by it, slopes of grey values lie up to 0.05 px beside
#   their place, to one side or the other by the fraction of the pixel: a pattern in all disparities
#   between them. A disparity map that is enlarged by it is off by up to 0.05 times its slope.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    opencv-python-headless==5.0.0.93 pillow==13.0.0 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import cv2
import numpy as np
import PIL
from PIL import Image

ramp = np.tile(np.arange(64, dtype=np.float32), (8, 1))
print("OpenCV", cv2.__version__, "Pillow", PIL.__version__)
columns = np.linspace(30, 31, 101, dtype=np.float32)[None]
rows = np.full_like(columns, 3)
linear, cubic = (cv2.remap(ramp, columns, rows, how) for how in (cv2.INTER_LINEAR, cv2.INTER_CUBIC))
for name, values in (("linear", linear), ("cubic", cubic)):
    off = abs(values - columns).max()
    print(f"remap, {name}: at 30.25 {values[0, 25]:.4f}, off by up to {off:.4f}")
place = (np.arange(60, 68, dtype=np.float32) + 0.5) / 2 - 0.5
by_opencv = cv2.resize(ramp, (128, 8), interpolation=cv2.INTER_CUBIC)[4, 60:68]
by_pillow = np.array(Image.fromarray(ramp).resize((128, 8), Image.Resampling.BICUBIC))[4, 60:68]
print("enlarged twice, right: ", place[:4].tolist())
print("enlarged twice, OpenCV:", by_opencv[:4].tolist())
print("enlarged twice, Pillow:", by_pillow[:4].tolist())
assert abs(linear - columns).max() < 1e-5 and abs(by_pillow - place).max() < 1e-5
assert abs(cubic[0, 25] - 30.296875) < 1e-4 and 0.047 < abs(cubic - columns).max() < 0.049
assert np.allclose(abs(by_opencv - place), 0.046875, atol=1e-5)
PYTHON
