#!/usr/bin/env bash
# OpenCV fits transformations of UTM coordinates with half a metre of rounding.
#
# Guess: estimateAffine3D, estimateTranslation3D, estimateAffine2D and findHomography take points of
#   64 bits and give matrices of 64 bits, so that points which agree exactly are fitted exactly.
# What happens: the points are cut to 32 bits first, in steps of 0.5 m at a northing of 5,400 km. Points
#   that were moved by (1.2, -0.7, 0.4) m are "moved by" (1.2031, -0.625, 0.4) m; the affine
#   transformation in space leaves 0.2 m rms. An affine from pixels to UTM leaves 0.02 m, the way back
#   0.25 px. estimateAffine3D with force_rotation=True, another algorithm, leaves 1e-9 m.
# Source: opencv-python-headless 5.0.0.93; modules/3d (calib3d in OpenCV 4): ptsetreg.cpp,
#   convertTo(..., CV_32F). The documentation names no type for the points.
# Why it matters: control points, shifts between two surveys and georeferences by fit come out a
#   fraction of a pixel off, all points as inliers. A coordinate from a corner of the site is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    opencv-python-headless==5.0.0.93 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import cv2
import numpy as np

print("OpenCV", cv2.__version__)
rng = np.random.default_rng(0)
MOVE = np.array([1.2, -0.7, 0.4])
pixels = rng.uniform(0, 40_000, (200, 2))
offsets = np.column_stack([pixels @ [[0.5, 0.02], [0.01, -0.5]], rng.uniform(0, 100, 200)])


def rms(matrix, source, target):
    off = source @ matrix[:, :-1].T + matrix[:, -1] - target
    return float(np.sqrt((off**2).sum(axis=1).mean()))


found = {}
for name, corner in (("from a corner", [0, 0, 0]), ("in UTM", [500_000, 5_400_000, 0])):
    first = offsets + corner
    plan = first[:, :2].copy()
    shift = cv2.estimateTranslation3D(first, first + MOVE)[1].ravel()
    values = [
        float(np.abs(shift - MOVE).max()),
        rms(cv2.estimateAffine3D(first, first + MOVE)[1], first, first + MOVE),
        rms(cv2.estimateAffine3D(first, first + MOVE, force_rotation=True)[0], first, first + MOVE),
        rms(cv2.estimateAffine2D(pixels, plan)[0], pixels, plan),
        rms(cv2.estimateAffine2D(plan, pixels)[0], plan, pixels),
    ]
    found[name] = values
    print(name)
    print(f"  estimateTranslation3D: {shift.round(4)}; estimateAffine3D {values[1]:.4f} m rms,")
    print(f"  with force_rotation {values[2]:.1e} m; estimateAffine2D {values[3]:.4f} m, back {values[4]:.4f} px")
near, far = found.values()
assert max(near) < 0.01
assert abs(far[0] - 0.075) < 0.01 and 0.1 < far[1] < 0.5 and far[2] < 1e-6
assert 0.01 < far[3] < 0.1 and 0.1 < far[4] < 0.6
PYTHON
