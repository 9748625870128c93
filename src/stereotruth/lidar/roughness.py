"""How rough the ground of a site is, buildings and trees included, by its points.

What stands up looks different from its sides and casts shadows, so that roughness tells how well
images of a site match: :mod:`stereotruth.sensor.site_pairs`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.degrees import metres_per_degree
from .lattice import CELL_BITS, LATTICE_DEG
from .point_store import Points, PointStore, query_points

Floats = NDArray[np.float64]

SQUARE_M = 2.0  # so wide that 1 point/m² leaves few squares without a point
HIGHEST_M = 20.0  # a step counts for no more
MOST_CELLS = 64  # that are read, 0.9 km²
LEAST_STEPS = 1000  # with fewer the roughness is not known


def roughness_m(stores: Sequence[PointStore]) -> float | None:
    """Mean step between the highest points of neighbouring squares of SQUARE_M, m, where these are
    measured from the plane of the ground. None if too few squares hold points.

    MOST_CELLS cells of the point stores are read, evenly spread. The order of the stores plays no
    part.
    """
    rows, cols = (np.concatenate([getattr(s, f"cell_{k}") for s in stores]) for k in ("row", "col"))
    cells = np.unique(np.stack([rows, cols], axis=1), axis=0)
    chosen = np.unique(np.linspace(0, len(cells) - 1, min(MOST_CELLS, len(cells))).astype(int))
    side = (1 << CELL_BITS) * LATTICE_DEG
    total, count = 0.0, 0
    for row, col in cells[chosen]:
        south, west = row * side, col * side
        found = steps(query_points(stores, west, south, west + side, south + side), west, south)
        total, count = total + float(found.sum()), count + found.size
    return total / count if count >= LEAST_STEPS else None


def steps(points: Points, west: float, south: float) -> Floats:
    """Steps [n] between neighbouring squares that hold points of a box, m, HIGHEST_M at most.

    ``west``, ``south``: corner of the box, degrees. Heights are those over the plane of its points.
    """
    if not len(points):
        return np.empty(0)
    east, north = metres_per_degree(south)
    at = np.stack([(points.lat - south) * north, (points.lon - west) * east]) / SQUARE_M
    row, col = np.maximum(np.floor(at).astype(np.int64), 0)
    top = np.full((row.max() + 1, col.max() + 1), -np.inf)
    np.maximum.at(top, (row, col), _over_plane(at, points.height))
    top[np.isneginf(top)] = np.nan
    found = np.concatenate([np.abs(np.diff(top, axis=axis)).ravel() for axis in (0, 1)])
    return np.minimum(found[np.isfinite(found)], HIGHEST_M)


def _over_plane(at: Floats, height: Floats) -> Floats:
    """Heights [n] over the plane that fits them best at places [2, n]."""
    about = np.stack([*at, height])
    about -= about.mean(axis=1, keepdims=True)
    x, y, z = about
    xx, xy, yy = (x * x).sum(), (x * y).sum(), (y * y).sum()
    determinant = xx * yy - xy * xy
    if determinant <= 1e-9 * xx * yy:  # points of a line
        return z
    xz, yz = (x * z).sum(), (y * z).sum()
    return z - ((yy * xz - xy * yz) * x + (xx * yz - xy * xz) * y) / determinant
