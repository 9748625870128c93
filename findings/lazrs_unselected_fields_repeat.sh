#!/usr/bin/env bash
# Fields that are not decompressed repeat the first point of a chunk.
#
# Guess: of a LAZ file read with a selection of fields, those that are not selected are zero, so that
#   no height and no class is mistaken for a measured one.
# What happens: in point formats 6 to 10 every point of a chunk has the height, class and source of
#   the chunk's first point: plausible values, all equal. In formats 0 to 5 the selection has no
#   effect, and all values are right.
# Source: laspy 2.7.0 (DecompressionSelection) with lazrs 0.8.2; LAZ 1.4 stores each field of formats
#   6 to 10 as a layer of its own.
# Why it matters: a selection makes reading twice as fast. Who selects coordinates and forgets the
#   class takes a whole chunk of 50,000 points for ground, or for none, by its first point, and
#   only for files of the new formats.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check laspy==2.7.0 lazrs==0.8.2 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import laspy
import lazrs
import numpy as np


def read_back(point_format, version):
    points = laspy.LasData(laspy.LasHeader(point_format=point_format, version=version))
    points.x = points.y = points.z = np.array([10.0, 11.0, 12.0])
    points.classification, points.point_source_id = [2, 6, 5], [7, 8, 9]
    points.write("points.laz")
    with laspy.open("points.laz", decompression_selection=laspy.DecompressionSelection.base()) as f:
        found = f.read()
    names = "z", "classification", "point_source_id"
    values = [np.array(found[name]).tolist() for name in names]
    print(f"format {point_format}:", dict(zip(names, values)))
    return values


print("laspy", laspy.__version__, "lazrs", lazrs.__version__ if hasattr(lazrs, "__version__") else "")
assert read_back(3, "1.2") == [[10.0, 11.0, 12.0], [2, 6, 5], [7, 8, 9]]
assert read_back(6, "1.4") == [[10.0, 10.0, 10.0], [2, 2, 2], [7, 7, 7]]
PYTHON
