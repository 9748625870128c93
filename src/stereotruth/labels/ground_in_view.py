"""The ground that a window may see: blocks of the surface's store, then squares of these.

Ground is in view if a surface there, at any height of the points around it, may be seen in the
window's pixels from either camera. The points of a window hold more: low ground where only a tower
would hide something.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.box_max import box_max
from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..lidar.smooth_maps import LocalProjection
from ..surface.scale import PART_BITS
from ..surface.surface_store import SQUARE_BITS, Block, Region
from ..surface.vertices import Vertices
from .view_geometry import ViewGeometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SPARE_PX = 3.0  # for what is not linear in a square or between places of a block, and roundings
# A pixel may see a surface that is extrapolated beyond its points: its position in the right image
# lies up to this much farther off.
EXTRAPOLATED_PX = 16.0


@kernel
def _ranges(x: Ints, y: Ints, h: Ints, low: Ints, high: Ints) -> None:
    """Least and greatest height in each square."""
    for k in range(x.size):
        j, i = y[k] >> SQUARE_BITS, x[k] >> SQUARE_BITS
        low[j, i], high[j, i] = min(low[j, i], h[k]), max(high[j, i], h[k])


def blocks_in_view(
    blocks: Sequence[Block], model: ViewGeometry, first: tuple[int, int], shape: tuple[int, int]
) -> tuple[Block, ...]:
    """Of the ``blocks`` around a window, those that hold a square of :func:`ground_in_view`.

    The box around the ground of a turned window holds up to twice as many. One at least, if there
    are any, since a window may have points and no surface.
    """
    if not blocks:
        return ()
    box = np.array([block.box for block in blocks], dtype=np.float64)
    heights = np.array([block.heights for block in blocks]) * LATTICE_M
    share = np.linspace(0.0, 1.0, 3)[:, None]
    lon, lat = (box[:, k] + share * (box[:, k + 2] - box[:, k]) for k in (0, 1))
    at = [  # three places along each side, at the lowest and the highest surface around
        model.ground_to_epipolar(x * LATTICE_DEG, y * LATTICE_DEG, np.full(len(box), height))
        for x in lon
        for y in lat
        for height in (heights.min(), heights.max())
    ]
    seen = _in_view(np.stack(at, axis=1), first, shape)
    return tuple(block for block, in_view in zip(blocks, seen) if in_view) or tuple(blocks[:1])


def ground_in_view(
    vertices: Vertices,
    reach: float,
    cell: tuple[int, int],
    projection: LocalProjection,
    first: tuple[int, int],
    shape: tuple[int, int],
) -> Region:
    """Of a window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``.

    Surfaces may be as high as any of the ``vertices`` up to ``reach`` (parts of a cell) away.
    ``cell``: (lon, lat) size, lattice steps. ``projection`` holds all that lies in the box of the
    vertices.
    """
    grid = tuple((int(v.max(initial=0)) >> SQUARE_BITS) + 1 for v in (vertices.y, vertices.x))
    far = np.iinfo(np.int64).max
    low, high = np.full(grid, far), np.full(grid, -far)
    _ranges(vertices.x, vertices.y, vertices.h_q, low, high)
    around = (int(reach) >> SQUARE_BITS) + 1
    low, high = -box_max(-low, around), box_max(high, around)
    squares = high >= low
    if squares.any():
        row, col = np.nonzero(squares)
        corners = _corners(vertices, cell, row, col, low[squares], high[squares])
        xy = projection.at_points(*corners).reshape(4, 8, -1)
        squares[squares] = _in_view(xy, first, shape)
    return Region(squares)


def _corners(
    vertices: Vertices, cell: tuple[int, int], row: Ints, col: Ints, low: Ints, high: Ints
) -> Ints:
    """Lattice coordinates [3, 8 n] of the corners of squares at two heights."""
    edges = []
    for square, q, plan, size in (
        (col, vertices.lon_q, vertices.x, cell[0]),
        (row, vertices.lat_q, vertices.y, cell[1]),
    ):
        at = np.stack([square, square + 1]) * (size << (SQUARE_BITS - PART_BITS))
        at += q[0] - (plan[0] * size >> PART_BITS)
        # the projection holds the positions of points alone
        edges.append(np.clip(at, q.min(), q.max()))
    return np.hstack(
        [
            np.stack([edges[0][i], edges[1][j], height])
            for i in range(2)
            for j in range(2)
            for height in (low, high)
        ]
    )


def _in_view(xy: Floats, first: tuple[int, int], shape: tuple[int, int]) -> Bools:
    """Which parts [n] of the ground a window may see, by the positions ``xy`` [4, k, n] (px) of k
    places around each."""
    (top, side), (rows, cols) = first, shape
    unknown = ~np.isfinite(xy).all(axis=(0, 1))
    disparity = xy[0] - xy[2]
    least, most = xy.min(axis=1) - SPARE_PX, xy.max(axis=1) + SPARE_PX
    with np.errstate(invalid="ignore"):
        in_rows = (least[[1, 3]] <= top + rows - 1) & (most[[1, 3]] >= top)
        in_left = in_rows[0] & (least[0] <= side + cols - 1) & (most[0] >= side)
        shift = disparity[:, in_left & ~unknown]
        if shift.size == 0:
            return in_left | unknown
        nearest, farthest = shift.max() + EXTRAPOLATED_PX, shift.min() - EXTRAPOLATED_PX
        in_right = (least[2] <= side + cols - 1 - farthest) & (most[2] >= side - nearest)
    return in_left | (in_rows[1] & in_right) | unknown
