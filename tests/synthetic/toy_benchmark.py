"""The dataset of a benchmark with two methods of known errors."""

from __future__ import annotations

import csv
from pathlib import Path

SHAPE = (24, 32)
CITIES = {"KM": "train", "WH": "test"}  # Kunming has training tiles, Wuhan none


def settings(**more):
    return {"thresholds_px": [3, 1], "bootstrap": 50, "seed": 1, "panels": 2, **more}


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))
