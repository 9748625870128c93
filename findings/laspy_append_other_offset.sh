#!/usr/bin/env bash
# Points appended to a LAS file of another offset land elsewhere.
#
# Guess: laspy's mode "a" brings the coordinates of what is appended to the scale and offset of the
#   file, as its mode "w" does with the same points, or refuses them.
# What happens: mode "a" writes the stored integers as they are. Points whose own offset is 1000 m
#   off land 1000 m off, on top of others; nothing is said, and the bounds of the header agree.
# Source: laspy 2.7.0, LasAppender.append_points; LAS 1.4 R15, section 2.4 (X scale, X offset).
# Why it matters: tiles of national LiDAR have an offset each. Who joins the tiles of a scene by
#   appending gets a surface whose second tile lies on the first, and disparities of both.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check laspy==2.7.0 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import laspy
import numpy as np


def tile(first):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = [first, 0.0, 0.0], [0.01] * 3
    points = laspy.LasData(header)
    points.x, points.y, points.z = first + np.arange(3.0), np.zeros(3), np.zeros(3)
    return points


one, other = tile(500000.0), tile(501000.0)
one.write("joined.las")
with laspy.open("joined.las", "a") as file:
    file.append_points(other.points)
with laspy.open("written.las", "w", header=one.header) as file:
    for points in (one, other):
        file.write_points(points.points)
joined, written = laspy.read("joined.las"), laspy.read("written.las")
print("laspy", laspy.__version__)
print("given:    ", [*np.array(one.x).tolist(), *np.array(other.x).tolist()])
print("mode \"w\": ", np.array(written.x).tolist())
print("mode \"a\": ", np.array(joined.x).tolist(), "header: up to", joined.header.maxs[0])
assert list(written.x) == [500000.0, 500001.0, 500002.0, 501000.0, 501001.0, 501002.0]
assert list(joined.x) == [500000.0, 500001.0, 500002.0] * 2 and joined.header.maxs[0] == 500002.0
PYTHON
