#!/usr/bin/env bash
# OpenCV divides the disparities of a PFM file by the scale of its header.
#
# Guess: the third line of a PFM header tells the order of bytes by its sign, and the values of a
#   disparity map are pixels, as readers and writers of stereo benchmarks have it.
# What happens: cv2.imread divides all values by the size of that number: 10.5 px with the scale
#   -1/255, which some writers of disparities use, come back as 2677.5 px. With -1 all is right.
# Source: opencv-python-headless 4.12.0.88, modules/imgcodecs (PFM); Debevec's description of the
#   format; Middlebury's stereo software ignores the size of the scale.
# Why it matters: a benchmark that reads results by OpenCV scores a right method with hundreds of
#   pixels of error, and nothing tells that it is the reader.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check opencv-python-headless==4.12.0.88 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import cv2
import numpy as np

disparity = np.array([[1.0, 2.0, 10.5]], "<f4")
print("OpenCV", cv2.__version__, "written:", disparity[0].tolist())
read = {}
for scale in ("-1", "-0.003921569"):
    with open("map.pfm", "wb") as file:
        file.write(f"Pf\n3 1\n{scale}\n".encode() + disparity.tobytes())
    read[scale] = cv2.imread("map.pfm", cv2.IMREAD_UNCHANGED)[0]
    print(f"scale {scale}:", read[scale].tolist())
assert read["-1"].tolist() == [1.0, 2.0, 10.5]
assert np.allclose(read["-0.003921569"], np.array([1.0, 2.0, 10.5]) * 255.0, rtol=1e-4)
PYTHON
