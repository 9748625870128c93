"""Which triangles a window's labels can follow from.

The points of a window lie up to a halo around all that it shows and what may hide it, since
triangles follow from the points around them, and the box of these holds more: low ground where
only a tower would hide something. A square of ground is in view if a surface there, at any height
of the points around it, may be seen in the window's pixels from either camera. Triangles are made
of the points in the halo of such squares; of the triangles, those that touch a square in view are
cut at outlines, projected and drawn: half of all, or less.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from .local_projection import LocalProjection
from .vertices import PART_BITS, Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

SQUARE_BITS = PART_BITS + 4  # of parts of a cell: squares of 8 pixels
SPARE_PX = 3.0  # for what is not linear in a square, and roundings
# A pixel may be asked for a surface that is drawn out beyond its points (open pixels): its place in
# the right image lies up to this much farther off.
DRAWN_OUT_PX = 16.0


@kernel
def _ranges(x: Ints, y: Ints, h: Ints, low: Ints, high: Ints) -> None:
    """Least and greatest height in each square."""
    for k in range(x.size):
        j, i = y[k] >> SQUARE_BITS, x[k] >> SQUARE_BITS
        low[j, i], high[j, i] = min(low[j, i], h[k]), max(high[j, i], h[k])


@inner
def _along(values: Ints, reach: int, out: Ints) -> None:
    """Greatest value of up to ``reach`` rows around each."""
    rows, cols = values.shape
    for j in range(rows):
        for i in range(cols):
            out[j, i] = values[j, i]
        for b in range(max(j - reach, 0), min(j + reach + 1, rows)):
            for i in range(cols):
                out[j, i] = max(out[j, i], values[b, i])


@kernel
def _greatest_around(values: Ints, reach: int) -> Ints:
    """Greatest value of up to ``reach`` squares around each, along both axes."""
    out, turned = np.empty_like(values), np.empty((values.shape[1], values.shape[0]), np.int64)
    _along(values, reach, out)
    back = np.empty_like(turned)
    for j in range(values.shape[0]):
        for i in range(values.shape[1]):
            back[i, j] = out[j, i]
    _along(back, reach, turned)
    for j in range(values.shape[0]):
        for i in range(values.shape[1]):
            out[j, i] = turned[i, j]
    return out


@kernel
def _touching(x: Ints, y: Ints, corner: Steps, squares: Bools) -> Bools:
    """Which triangles' bounding boxes touch one of the ``squares``."""
    out = np.zeros(len(corner), np.bool_)
    for t in range(len(corner)):
        a, b, c = corner[t]
        west, east = min(x[a], x[b], x[c]) >> SQUARE_BITS, max(x[a], x[b], x[c]) >> SQUARE_BITS
        south, north = min(y[a], y[b], y[c]) >> SQUARE_BITS, max(y[a], y[b], y[c]) >> SQUARE_BITS
        for j in range(south, north + 1):
            for i in range(west, east + 1):
                out[t] |= squares[j, i]
    return out


@kernel
def _inside(x: Ints, y: Ints, squares: Bools) -> Bools:
    """Which vertices lie in one of the ``squares``."""
    out = np.empty(x.size, np.bool_)
    for k in range(x.size):
        out[k] = squares[y[k] >> SQUARE_BITS, x[k] >> SQUARE_BITS]
    return out


@dataclass(frozen=True, eq=False)
class GroundInView:
    """``squares`` [rows, cols] of the ground, from the vertices' origin, that a window may see."""

    squares: Bools

    @classmethod
    def of(
        cls,
        vertices: Vertices,
        reach: float,
        local: LocalProjection,
        first: tuple[int, int],
        shape: tuple[int, int],
        cell: tuple[int, int],
    ) -> GroundInView:
        """Of a window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``.

        Surfaces may be as high as any of the ``vertices`` up to ``reach`` (parts of a cell) away.
        ``local`` projects all that lies in the box of the vertices; ``cell``: (lon, lat) size in
        lattice steps.
        """
        grid = tuple((int(v.max(initial=0)) >> SQUARE_BITS) + 1 for v in (vertices.y, vertices.x))
        far = np.iinfo(np.int64).max
        low, high = np.full(grid, far), np.full(grid, -far)
        _ranges(vertices.x, vertices.y, vertices.h_q, low, high)
        around = (int(reach) >> SQUARE_BITS) + 1
        low, high = -_greatest_around(-low, around), _greatest_around(high, around)
        squares = high >= low
        if squares.any():
            places = _corners(vertices, cell, *np.nonzero(squares), low[squares], high[squares])
            xy = local.at_points(*places).reshape(4, 8, -1)
            squares[squares] = _seen(xy, first, shape)
        return cls(squares)

    def touching(self, vertices: Vertices, corner: Steps) -> Bools:
        """Which triangles [m, 3] may be seen."""
        return _touching(vertices.x, vertices.y, corner, self.squares)

    def near(self, vertices: Vertices, cells: int) -> Bools:
        """Which vertices lie up to so many ``cells`` around all that may be seen."""
        around = (cells >> (SQUARE_BITS - PART_BITS)) + 1
        wide = _greatest_around(self.squares.astype(np.int64), around) > 0
        return _inside(vertices.x, vertices.y, wide)

    def with_halo(self, vertices: Vertices, halo: int) -> Vertices:
        """The vertices up to ``halo`` cells around all that may be seen."""
        kept = self.near(vertices, halo)
        return Vertices(*(getattr(vertices, f.name)[kept] for f in fields(Vertices)))


def _corners(
    vertices: Vertices, cell: tuple[int, int], row: Ints, col: Ints, low: Ints, high: Ints
) -> Ints:
    """Lattice coordinates [3, 8 n] of the corners of squares at two heights."""
    edges = []
    for part, q, place, step in (
        (col, vertices.lon_q, vertices.x, cell[0]),
        (row, vertices.lat_q, vertices.y, cell[1]),
    ):
        at = np.stack([part, part + 1]) * (step << (SQUARE_BITS - PART_BITS))
        at += q[0] - (place[0] * step >> PART_BITS)
        # the projection knows the places of points alone
        edges.append(np.clip(at, q.min(), q.max()))
    return np.hstack(
        [
            np.stack([edges[0][i], edges[1][j], height])
            for i in range(2)
            for j in range(2)
            for height in (low, high)
        ]
    )


def _seen(xy: Floats, first: tuple[int, int], shape: tuple[int, int]) -> Bools:
    """Which squares a window may see, by the places ``xy`` [4, 8, n] of their corners (px)."""
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
        nearest, farthest = shift.max() + DRAWN_OUT_PX, shift.min() - DRAWN_OUT_PX
        in_right = (least[2] <= side + cols - 1 - farthest) & (most[2] >= side - nearest)
    return in_left | (in_rows[1] & in_right) | unknown
