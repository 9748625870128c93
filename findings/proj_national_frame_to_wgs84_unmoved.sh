#!/usr/bin/env bash
# PROJ moves NAD83(2011) to WGS 84 by nothing, and to every recent realisation of WGS 84 by 1.8 m.
#
# Guess: NAD83(2011) to WGS 84 in three dimensions (EPSG:6319 to EPSG:4979) uses the transformation
#   of 14 parameters that PROJ knows, at the epoch that is given.
# What happens: the best and only operation is "NAD83(2011) to WGS 84 (1)", three zeros: at
#   Jacksonville 0.00 m, with an accuracy of 2 m. To WGS 84 (G2296) (EPSG:10605), a member of the
#   ensemble that EPSG:4979 is, the same place goes 0.95 m in plan and -1.48 m in height, with an
#   accuracy of 0.01 m. ETRS89, GDA2020, NAD83(CSRS) and NZGD2000 do the same. No network, no grid.
# Source: pyproj 3.7.2 (PROJ 9.5.1, EPSG v11.022); EPSG:4979 has been an ensemble since EPSG v10.
# Why it matters: RPCs and GNSS are in WGS 84 (G...). National LiDAR that is "brought to WGS 84" by
#   PROJ's defaults lies 1 to 5 px beside the images, and nothing fails.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check pyproj==3.7.2
venv/bin/python - <<'PYTHON'
import math

import pyproj

pyproj.network.set_network_enabled(False)
print("pyproj", pyproj.__version__, "PROJ", pyproj.proj_version_str)
place, found = (-81.66, 30.33), {}
for name, code in (("the ensemble", 4979), ("G2296", 10605)):
    change = pyproj.Transformer.from_crs(6319, code, always_xy=True)
    lon, lat, height, _ = change.transform(*place, 0.0, 2020.0)
    east = (lon - place[0]) * 111320 * math.cos(math.radians(place[1]))
    found[name] = math.hypot(east, (lat - place[1]) * 111200), height
    print(f"WGS 84, {name}: plan %.2f m, up %.2f m, accuracy {change.accuracy} m" % found[name])
assert found["the ensemble"] == (0.0, 0.0)
assert abs(found["G2296"][0] - 0.95) < 0.01 and abs(found["G2296"][1] + 1.48) < 0.01
PYTHON
