#!/usr/bin/env bash
# OpenCV 4 samples images at multiples of 1/32 px, also where all coordinates are float.
#
# Guess: cv2.remap with float maps and a float image samples where the maps say. Its documentation
#   offers the conversion of such maps to fixed point "for speed".
# What happens: all coordinates are rounded to 1/32 px first, in cv2.remap, warpAffine and
#   warpPerspective, by linear, cubic and Lanczos interpolation: a ramp is off by up to 0.0156 px,
#   and a shift of 0.01 px does nothing. OpenCV 5.0.0 is right for INTER_LINEAR; INTER_LANCZOS4 of
#   remap still rounds.
# Source: opencv-python-headless 4.12.0.88 and 5.0.0.93; modules/imgproc/src/imgwarp.cpp, INTER_BITS
#   = 5; issues 12700, 25937 and 26361 of opencv/opencv.
# Why it matters: rectification by these functions moves each pixel of both images by up to 1/64 px,
#   in steps. Disparities between them are off by up to 1/32 px, in bands across the image, from truth
#   that has no such steps, and every matcher is charged with it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > sample.py <<'PYTHON'
import sys

import cv2
import numpy as np

ramp = np.tile(np.arange(64, dtype=np.float32), (8, 1))
columns = np.tile(np.linspace(20, 21, 641, dtype=np.float32), (4, 1))
rows = np.full_like(columns, 3)
print("OpenCV", cv2.__version__)
print("  remap, linear:", end=" ")
linear = cv2.remap(ramp, columns, rows, cv2.INTER_LINEAR)[0]
error_px = np.abs(linear - columns[0]).max()
print(f"{np.unique(linear).size} values for 641 columns, off by up to {error_px:.4f} px")
lanczos = np.unique(cv2.remap(ramp, columns, rows, cv2.INTER_LANCZOS4)[0]).size
print(f"  remap, Lanczos: {lanczos} values")
shift = np.array([[1, 0, 0.01], [0, 1, 0]], np.float32)
homography = np.vstack([shift, [[0, 0, 1]]])
moved_px = []
for name, moved in (
    ("warpAffine", cv2.warpAffine(ramp, shift, (64, 8), flags=cv2.INTER_LINEAR)),
    ("warpPerspective", cv2.warpPerspective(ramp, homography, (64, 8), flags=cv2.INTER_LINEAR)),
):
    moved_px.append((ramp - moved)[3, 30])
    print(f"  {name} by 0.01 px: {moved_px[-1]:.4f} px")
if sys.argv[1] == "4":
    cubic = np.unique(cv2.remap(ramp, columns, rows, cv2.INTER_CUBIC)[0]).size
    assert np.unique(linear).size == cubic == 33
    assert 0.015 < error_px < 0.0157 and moved_px == [0, 0]
else:
    assert error_px < 1e-5 and np.allclose(moved_px, 0.01, atol=1e-4)
assert lanczos == 33
PYTHON
for version in 4.12.0.88 5.0.0.93; do
    python3 -m venv --clear venv
    venv/bin/pip install --quiet --disable-pip-version-check \
        opencv-python-headless==$version numpy==2.2.6
    venv/bin/python sample.py ${version%%.*}
done
