#!/usr/bin/env bash
# pyproj fails with "list index out of range" where PROJ has no operation but a null one.
#
# Guess: TransformerGroup between two systems that both stand in EPSG's register tells of no
#   operation by an empty list, or by a ProjError.
# What happens: from IGS20 (EPSG:10177) to ITRF2020 (EPSG:9989), both geographic in three dimensions,
#   it raises IndexError; Transformer.from_crs says "Input is not a transformation." The two frames
#   are the same to some mm.
# Source: pyproj 3.7.2 (PROJ 9.5.1).
# Why it matters: who looks for ProjError and CRSError, as the documentation names them, ends in a
#   traceback on a valid pair of codes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check pyproj==3.7.2
venv/bin/python - <<'PYTHON'
import pyproj
from pyproj.transformer import TransformerGroup

print("pyproj", pyproj.__version__, "PROJ", pyproj.proj_version_str)
said = []
for make in (TransformerGroup, pyproj.Transformer.from_crs):
    try:
        make(10177, 9989, always_xy=True)
        said.append("")
    except Exception as error:
        said.append(repr(error))
print(said)
assert said[0] == "IndexError('list index out of range')" and "not a transformation" in said[1]
PYTHON
