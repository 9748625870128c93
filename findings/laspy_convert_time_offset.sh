#!/usr/bin/env bash
# Conversion of LAS 1.5 to LAS 1.4 moves the GPS times of all points by years.
#
# Guess: LAS 1.5 may count GPS times from an offset that its header names (1500 for 1.5e9 s). LAS 1.4
#   has 1e9 s only, so that laspy.convert(points, file_version="1.4") brings the times there, or
#   refuses; and las.gps_time, like las.x, has the offset applied.
# What happens: the stored numbers stay, the offset is dropped, and the file says that its times are
#   absolute: a flight of 2025 becomes one of 2009. Points of a file of another offset that are
#   appended keep their numbers, too. las.gps_time is what is stored. Nothing is said.
# Source: laspy 2.7.0; LAS 1.5, "Global Encoding", bits 0 and 6, and "Time Offset"; the format's own
#   working group recommends the offset 1500 for flights from 2023 to 2031.
# Why it matters: COPC and most readers want LAS 1.4. What has changed between LiDAR and images, the
#   epoch in which heights and places are brought to the images, and strips that are told by gaps in
#   time all rest on these numbers. In 15.8 years a plate moves by up to a metre.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check laspy==2.7.0 numpy==2.2.6
venv/bin/python - <<'PYTHON'
from datetime import datetime, timedelta

import laspy
import numpy as np

START = datetime(1980, 1, 6)  # of GPS time


def write(name, day, offset):
    header = laspy.LasHeader(point_format=6, version="1.5")
    header.global_encoding.gps_time_offset = True
    header.gps_time_offset = offset
    points = laspy.LasData(header)
    points.x = points.y = points.z = np.arange(3.0)
    points.gps_time = np.full(3, (day - START).total_seconds() - 1e6 * offset)
    points.write(name)


def days(name):
    las = laspy.read(name)
    absolute = las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    offset = las.header.gps_time_offset if las.header.version.minor == 5 else 1000
    told = [(START + timedelta(seconds=1e6 * offset + float(t))).date() for t in las.gps_time]
    print(name, "LAS", las.header.version, "absolute:", absolute, sorted(set(map(str, told))))
    return {day.year for day in told}


print("laspy", laspy.__version__)
write("flight.las", datetime(2025, 6, 1), 1500)
write("earlier.las", datetime(2020, 6, 1), 1250)
assert days("flight.las") == {2025} and days("earlier.las") == {2020}
laspy.convert(laspy.read("flight.las"), file_version="1.4").write("converted.las")
assert days("converted.las") == {2009}
with laspy.open("flight.las", mode="a") as file:
    file.append_points(laspy.read("earlier.las").points)
assert days("flight.las") == {2025, 2028}
PYTHON
