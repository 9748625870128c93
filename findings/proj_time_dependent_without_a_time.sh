#!/usr/bin/env bash
# PROJ takes a place without a time through a time-dependent transformation, at a time of its own.
#
# Guess: coordinates without an epoch are refused by a transformation of 14 parameters, or a change
#   of epoch within a dynamic frame moves them.
# What happens: without a time each step is taken at the epoch of its own parameters, 2010 for
#   NAD83(2011), 2020 for GDA2020: 0.14 m and 0.34 m beside the place of 2020 and of 2026. And a
#   transformation from ITRF2020 to ITRF2020 does nothing whatever the epochs are: PROJ has no
#   motion of plates in it.
# Source: pyproj 3.7.2 (PROJ 9.5.1).
# Why it matters: transform(x, y, z) is what everybody writes. Nothing tells that a year is missing.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check pyproj==3.7.2
venv/bin/python - <<'PYTHON'
import math

import pyproj

print("pyproj", pyproj.__version__, "PROJ", pyproj.proj_version_str)


def apart(one, other):
    east = (one[0] - other[0]) * 111320 * math.cos(math.radians(other[1]))
    return math.hypot(east, (one[1] - other[1]) * 111200)


places = ("NAD83(2011)", 6319, (-81.66, 30.33), 2020.0), ("GDA2020", 7843, (151.2, -33.9), 2026.0)
found = []
for name, code, place, year in places:
    change = pyproj.Transformer.from_crs(code, 9989, always_xy=True)
    found.append(apart(change.transform(*place, 0.0), change.transform(*place, 0.0, year)))
    print(f"{name}: without a time {found[-1]:.2f} m beside the place of {year:g}")
same = pyproj.Transformer.from_crs(9989, 9989, always_xy=True)
moved = apart(same.transform(151.2, -33.9, 0.0, 2000.0), (151.2, -33.9))
print(f"ITRF2020 at 2000 to ITRF2020: {moved} m")
assert abs(found[0] - 0.14) < 0.01 and abs(found[1] - 0.34) < 0.01 and moved == 0.0
PYTHON
