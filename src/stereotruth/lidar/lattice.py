"""The global lattice of the points: steps of 1e-9 degree and 1e-4 m, and cells of it."""

from __future__ import annotations

import math

import numpy as np

LATTICE_DEG = 1e-9
LATTICE_M = 1e-4
PER_DEG = 10**9
PER_M = 10**4
CELL_BITS = 20


def cell_key(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """One int64 that sorts cells by row, then column."""
    return (np.asarray(row, np.int64) << 32) + (np.asarray(col, np.int64) + (1 << 30))


def lattice_box(
    lon_min: float, lat_min: float, lon_max: float, lat_max: float
) -> tuple[int, int, int, int]:
    """The lattice points q with minimum <= q / 1e9 <= maximum (in float64), as inclusive limits."""

    def lowest(limit: float) -> int:
        q = math.ceil(limit * PER_DEG)
        while (q - 1) / PER_DEG >= limit:
            q -= 1
        while q / PER_DEG < limit:
            q += 1
        return q

    west, south, east, north = (
        min(max(float(value), -1000.0), 1000.0) for value in (lon_min, lat_min, lon_max, lat_max)
    )
    return lowest(west), lowest(south), -lowest(-east), -lowest(-north)
