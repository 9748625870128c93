"""What the points of a site are like on the whole: how dense they are, and how rough its ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.geometry import DEGREE_M, metres_per_degree
from .lattice import CELL_DEG, LATTICE_M
from .point_store import SQUARES, Points, PointStore, query_points

Shows = Callable[[Floats, Floats, Floats], Bools]

ENOUGH = 8.0  # points in a square that holds any, on the average
SQUARE_M = 2.0  # of the roughness: so wide that 1 point/m² leaves few squares without a point
HIGHEST_M = 20.0  # a step counts for no more
MOST_CELLS = 64  # that are read, 0.9 km²
LEAST_STEPS = 1000  # with fewer the roughness is not known


def points_per_m2(stores: Sequence[PointStore], shows: Shows | None = None) -> float:
    """Points of all stores over the ground that they cover together, returns of any number.

    Each cell counts its points by squares of 7 m; of sparse points, which leave small squares empty
    by chance, by wider ones. Ground is covered where a square and those beside it hold points, so
    that squares at a rim, of a file, a survey or a lake, are left out, points and all. Where no
    square has its neighbours, all that hold points count. 0 if there are none.

    ``shows``: which places (lon, lat, degrees; height, m; [n]) are of interest, as the ground that
    images show: its rim is one more. By default all.
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
    narrow = np.cos(np.radians((cells[0] + 0.5) * CELL_DEG))
    square_m2 = (CELL_DEG / counts.shape[1] * DEGREE_M) ** 2 * narrow
    return float(counts[covered].sum() / (covered.sum(axis=(1, 2)) @ square_m2))


def _shown(cells: Ints, height: Floats, shows: Shows) -> Bools:
    """Whether the middle of each square [cells, SQUARES, SQUARES] is shown, at a cell's
    ``height``."""
    middle = (np.arange(SQUARES) + 0.5) / SQUARES
    out = np.empty((cells.shape[1], SQUARES, SQUARES), np.bool_)
    for k, (row, col) in enumerate(cells.T):
        lat, lon = np.meshgrid((row + middle) * CELL_DEG, (col + middle) * CELL_DEG, indexing="ij")
        level = np.full(lon.size, height[k])
        out[k] = shows(lon.reshape(-1), lat.reshape(-1), level).reshape(out.shape[1:])
    return out


def roughness_m(stores: Sequence[PointStore]) -> float | None:
    """How rough the ground of a site is, buildings and trees included.

    Mean step between the highest points of neighbouring squares of SQUARE_M, m, where these are
    measured from the plane of the ground. None if too few squares hold points. What stands up looks
    different from its sides and casts shadows, so that this tells how well images of a site match:
    :mod:`stereotruth.sensor.site_pairs`.

    MOST_CELLS cells of the point stores are read, evenly spread. The order of the stores plays no
    part.
    """
    rows, cols = (np.concatenate([getattr(s, f"cell_{k}") for s in stores]) for k in ("row", "col"))
    cells = np.unique(np.stack([rows, cols], axis=1), axis=0)
    chosen = np.unique(np.linspace(0, len(cells) - 1, min(MOST_CELLS, len(cells))).astype(int))
    total, count = 0.0, 0
    for row, col in cells[chosen]:
        south, west = row * CELL_DEG, col * CELL_DEG
        points = query_points(stores, west, south, west + CELL_DEG, south + CELL_DEG)
        if len(points):
            steps = _steps(points, west, south)
            total, count = total + float(steps.sum()), count + steps.size
    return total / count if count >= LEAST_STEPS else None


def _steps(points: Points, west: float, south: float) -> Floats:
    """Steps [n] between neighbouring squares that hold points of a box, m, HIGHEST_M at most.

    ``west``, ``south``: corner of the box, degrees. Heights are those over the plane of its points.
    """
    east, north = metres_per_degree(south)
    at = np.stack([(points.lat - south) * north, (points.lon - west) * east]) / SQUARE_M
    x, y, z = (of - of.mean() for of in (*at, points.height))
    xx, xy, yy, xz, yz = ((a * b).sum() for a, b in ((x, x), (x, y), (y, y), (x, z), (y, z)))
    determinant = xx * yy - xy * xy
    if determinant > 1e-9 * xx * yy:  # else points of a line
        z = z - ((yy * xz - xy * yz) * x + (xx * yz - xy * xz) * y) / determinant
    row, col = np.maximum(np.floor(at).astype(np.int64), 0)
    top = np.full((row.max() + 1, col.max() + 1), -np.inf)
    np.maximum.at(top, (row, col), z)
    top[np.isneginf(top)] = np.nan
    steps = np.concatenate([np.abs(np.diff(top, axis=axis)).ravel() for axis in (0, 1)])
    return np.minimum(steps[np.isfinite(steps)], HIGHEST_M)
