"""How dense a scene's points are, over the ground that they cover.

Cells of the point stores, 117 m wide, are too coarse for that: at the rim of a survey, and all over
a small one, they are partly filled. So each cell counts its points by squares of 7 m (wider ones
for sparse points, which leave small squares empty by chance). Ground is covered where a square and
those beside it hold points: squares at a rim, of a file, a survey or a lake, are left out, points
and all. Where only a part of the ground is of interest, as the one that images show, its rim is one
more: points elsewhere count for nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import DEGREE_M
from .lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from .point_store import SQUARES, PointStore

Floats = NDArray[np.float64]
Shows = Callable[[Floats, Floats, Floats], NDArray[np.bool_]]

ENOUGH = 8.0  # points in a square that holds any, on the average


def points_per_m2(stores: Sequence[PointStore], shows: Shows | None = None) -> float:
    """Points of all stores over the ground that they cover together, returns of any number.

    ``shows``: which places (lon, lat, degrees; height, m; [n]) are of interest; by default all.
    Where no square has its neighbours, all that hold points count. 0 if there are none.
    """
    rows, cols = (np.concatenate([getattr(s, f"cell_{k}") for s in stores]) for k in ("row", "col"))
    cells, which = np.unique(np.stack([rows, cols]), axis=1, return_inverse=True)
    counts = np.zeros((cells.shape[1], SQUARES, SQUARES))
    height = np.full(cells.shape[1], np.inf)  # of the lowest point
    ends = np.cumsum([0, *(s.cell_row.size for s in stores)])
    for store, first, end in zip(stores, ends, ends[1:]):
        counts[which[first:end]] += store.square_counts  # a store has a cell once
        lowest = store.cell_heights[:, 0] * LATTICE_M
        height[which[first:end]] = np.minimum(height[which[first:end]], lowest)
    if shows is not None:
        counts *= _shown(cells, height, shows)
    if not counts.any():
        return 0.0
    while counts.shape[1] > 1 and counts[counts > 0].mean() < ENOUGH:
        half = counts.shape[1] // 2
        counts = counts.reshape(-1, half, 2, half, 2).sum(axis=(2, 4))
    held = counts > 0
    covered = np.zeros_like(held)
    covered[:, 1:-1, 1:-1] = (
        held[:, 1:-1, 1:-1]
        & held[:, :-2, 1:-1]
        & held[:, 2:, 1:-1]
        & held[:, 1:-1, :-2]
        & held[:, 1:-1, 2:]
    )
    if not covered.any():
        covered = held
    steps = 1 << CELL_BITS
    narrow = np.cos(np.radians((cells[0] + 0.5) * steps * LATTICE_DEG))
    square_m2 = (steps / counts.shape[1] * LATTICE_DEG * DEGREE_M) ** 2 * narrow
    return float(counts[covered].sum() / (covered.sum(axis=(1, 2)) @ square_m2))


def _shown(cells: NDArray[np.int64], height: Floats, shows: Shows) -> NDArray[np.bool_]:
    """Whether the middle of each square [cells, SQUARES, SQUARES] is shown, at a cell's
    ``height``."""
    middle = (np.arange(SQUARES) + 0.5) / SQUARES
    side = (1 << CELL_BITS) * LATTICE_DEG
    out = np.empty((cells.shape[1], SQUARES, SQUARES), np.bool_)
    for k in range(cells.shape[1]):
        lat, lon = np.meshgrid(
            *((cells[axis, k] + middle) * side for axis in (0, 1)), indexing="ij"
        )
        level = np.full(lon.size, height[k])
        out[k] = shows(lon.reshape(-1), lat.reshape(-1), level).reshape(out.shape[1:])
    return out
