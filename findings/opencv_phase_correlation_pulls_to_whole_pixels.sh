#!/usr/bin/env bash
# OpenCV's phase correlation finds a shift of a quarter of a pixel as 0.04 px.
#
# Guess: cv2.phaseCorrelate, which "achieves sub-pixel accuracy", finds the shift of two images without
#   noise that differ by a shift and nothing else, to some hundredths of a pixel.
# What happens: 0.125 px are found as 0.02, 0.25 px as 0.04, 0.375 px as 0.08, and 0.625 px as 0.96: all
#   go towards whole pixels, by up to 0.3 px, with and without a window. scikit-image finds 0.25 px of
#   the same images (upsample_factor=100). The mean over 5 x 5 px around the peak is to blame: the
#   peak of a shifted image is a sinc, with negative sides.
# Source: opencv-python-headless 5.0.0.93 (4.14.0.94 as well), modules/imgproc:
#   phasecorr.cpp, weightedCentroid; issue 9158 of opencv/opencv;
#   scikit-image 0.26.0.
# Why it matters: images of two dates, ortho images and LiDAR, or bands of one sensor are aligned by
#   it. The remaining shift seems to be zero after the first pass, and 0.2 px stay in every label; shifts by
#   windows over a scene look like steps at whole pixels.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    opencv-python-headless==5.0.0.93 scikit-image==0.26.0 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import cv2
import numpy as np
import skimage
from skimage.registration import phase_cross_correlation

print("OpenCV", cv2.__version__, "scikit-image", skimage.__version__)
SIZE = 256
x, y = np.fft.rfftfreq(SIZE)[None], np.fft.fftfreq(SIZE)[:, None]
frequency = np.hypot(x, y)
frequency[0, 0] = 1.0
texture = np.fft.rfft2(np.random.default_rng(0).normal(size=(SIZE, SIZE))) / frequency
texture[0, 0] = texture[SIZE // 2] = texture[:, -1] = 0.0
image = np.fft.irfft2(texture)
window = cv2.createHanningWindow((SIZE, SIZE), cv2.CV_64F)
for shift, wanted in ((0.0, 0.0), (0.125, 0.02), (0.25, 0.04), (0.375, 0.08), (0.625, 0.96), (1.0, 1.01)):
    moved = np.fft.irfft2(texture * np.exp(-2j * np.pi * x * shift))
    found = cv2.phaseCorrelate(image, moved, window)[0][0]
    other = -phase_cross_correlation(image, moved, upsample_factor=100)[0][1]
    print(f"shift of {shift} px: OpenCV {found:.3f}, scikit-image {other:.2f}")
    assert abs(found - wanted) < 0.015 and abs(other - shift) < 0.011
PYTHON
