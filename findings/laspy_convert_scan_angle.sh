#!/usr/bin/env bash
# Conversion of an old point format to a new one loses the scan angle and the overlap.
#
# Guess: laspy.convert(points, point_format_id=6) carries what both formats can hold: the scan angle
#   (whole degrees in formats 0 to 5, steps of 0.006 degrees in 6 to 10), and class 12, overlap, for
#   which formats 6 to 10 have a flag.
# What happens: fields go over by name. The scan angle has another name, so that all angles are 0;
#   class 12 stays, which is reserved in the new formats, and no flag is set. Nothing is said.
# Source: laspy 2.7.0; LAS 1.4 R15, tables 8, 9 and 17 (classes 12 and overlap flag, scan angle).
# Why it matters: strips are told apart, and points at the edge of a strip left out, by angle and by
#   overlap. After the conversion all points look as if measured straight down, once each.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check laspy==2.7.0 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import laspy
import numpy as np

header = laspy.LasHeader(point_format=3, version="1.2")
points = laspy.LasData(header)
points.x = points.y = points.z = np.arange(3.0)
points.scan_angle_rank = np.array([-20, 0, 15], np.int8)
points.classification = np.array([12, 2, 2], np.uint8)
new = laspy.convert(points, point_format_id=6)
print("laspy", laspy.__version__)
print("format 3: angles", np.array(points.scan_angle_rank), "classes", np.array(points.classification))
print("format", new.header.point_format.id, end=": ")
print("angles", np.array(new.scan_angle), "classes", np.array(new.classification), end=" ")
print("overlap flags", np.array(new.overlap))
assert not np.any(new.scan_angle) and not np.any(np.array(new.overlap))
assert list(new.classification) == [12, 2, 2]
PYTHON
