#!/usr/bin/env bash
# OpenCV's SIFT puts every keypoint a quarter of a pixel to the right of its place, and below it.
#
# Guess: the keypoint of a round blob lies in the middle of the blob, whatever the blob's size.
# What happens: cv2.SIFT_create() says 0.25 px more in x and in y, for blobs of any size and at any
#   fraction of a pixel. SIFT doubles the image first; the enlargement takes the middle of a pixel to
#   2 x + 0.5, and places are only halved on the way back. With enable_precise_upscale=True they are
#   right to 0.01 px; the option is off by default, so that keypoints stay what they were.
# Source: opencv-python-headless 5.0.0.93 (4.12.0.88 as well), modules/features: sift.dispatch.cpp,
#   createInitialImage; documentation of cv2.SIFT_create.
# Why it matters: between two images the offset cancels, so no test of matches finds it. It stays
#   where a keypoint meets something else: a ground control point measured by SIFT, a label that is
#   sampled at a keypoint (0.25 px times the slope of the disparity), a match refined by another
#   matcher in one image only, heights of an RPC's sensor model at a keypoint (0.1 m of ground).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    opencv-python-headless==5.0.0.93 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import cv2
import numpy as np

print("OpenCV", cv2.__version__)
y, x = np.mgrid[:200, :200]
middles = [(100.0, 100.0), (100.25, 99.5), (97.3, 101.8), (90.75, 110.1)]
for precise in (False, True):
    sift = cv2.SIFT_create(enable_precise_upscale=precise)
    for width in (1.5, 2.5, 4.0, 6.0, 9.0):
        off = []
        for middle in middles:
            squares = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
            blob = (40 + 180 * np.exp(-squares / 2 / width**2)).round().astype(np.uint8)
            places = np.array([point.pt for point in sift.detect(blob)]).reshape(-1, 2) - middle
            off += [place for place in places if np.hypot(*place) < 1]  # a few blobs have none
        right, below = np.mean(off, axis=0)
        print(f"precise {precise!s:5}, blob of {width} px: {right:+.3f} px right, {below:+.3f} below")
        wanted = 0.0 if precise else 0.25
        assert abs(right - wanted) < 0.02 and abs(below - wanted) < 0.02
PYTHON
