"""A town and a single box for the simulator."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from stereocities.cities import Character, CitySpec, SceneSpec

ROOT = Path(__file__).parents[2]
NONE, GROUND, ROOF, WALL, TREE, WATER = range(6)
TOWN = CitySpec(
    "Town", 115.433, 30.232, 32650, 18.0, 21,
    Character(30, 0.3, 900, 20, 30, 0,
              {"slabs": 2, "lowrise": 2, "towers": 1.5, "fields": 1, "park": 1},
              (26, 55), 0.8, zone_m=200.0),
    (SceneSpec("Town-1", (0.0, 0.0), 620, 640, 301, ragged_m=(15.0, 15.0), gap_m=(90.0, 80.0)),),
)  # fmt: skip
ONE_BOX = CitySpec(
    "Box", 102.7, 25.04, 32648, 1860.0, 3,
    Character(0.0, 0.3, 900, 20, 0, 0, {"fields": 1}, (20, 40), 0.0),
    (SceneSpec("Box-1", (0.0, 0.0), 420, 400, 7, ragged_m=(0.0, 0.0)),),
    single_box=(6.0, -4.0, 40.0, 24.0, 50.0),
)  # fmt: skip


def read_points(path: Path) -> np.ndarray:
    """Columns lon, lat, height, left col, left row, right col, right row."""
    with path.open() as stream:
        return np.array([[float(v) for v in list(r.values())[1:]] for r in csv.DictReader(stream)])
