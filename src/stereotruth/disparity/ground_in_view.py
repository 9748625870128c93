"""Which triangles a window's labels can follow from.

The points of a window lie up to a halo around all that it shows and what may hide it, since
triangles follow from the points around them. What is cut, drawn and projected are only those that
may be seen in the window's pixels, from either camera: half of all, or less. A square of ground is
in view if a surface there, at any height of the points around it, may be; a triangle if it touches
such a square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from .local_projection import LocalProjection
from .vertices import PART, PART_BITS, Vertices

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


@dataclass(frozen=True, eq=False)
class Window:
    """A window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``, and what
    projects the ground into both images there; ``cell``: (lon, lat) size in lattice steps."""

    local: LocalProjection
    first: tuple[int, int]
    shape: tuple[int, int]
    cell: tuple[int, int]

    def in_view(self, vertices: Vertices, corner: Steps, reach: float) -> Bools:
        """Which triangles [m, 3] of ``vertices`` this window may see, from either camera.

        Their surfaces may be as high as any vertex up to ``reach`` (parts of a cell) from the
        middle of a triangle, and no triangle is wider.
        """
        if vertices.x.size == 0 or len(corner) == 0:
            return np.zeros(len(corner), np.bool_)
        grid = tuple((int(v.max()) >> SQUARE_BITS) + 1 for v in (vertices.y, vertices.x))
        far = np.iinfo(np.int64).max
        low, high = np.full(grid, far), np.full(grid, -far)
        _ranges(vertices.x, vertices.y, vertices.h_q, low, high)
        around = (int(reach) >> SQUARE_BITS) + 1
        low, high = -_greatest_around(-low, around), _greatest_around(high, around)
        squares = high >= low
        squares[squares] = self._seen(vertices, *np.nonzero(squares), low[squares], high[squares])
        return _touching(vertices.x, vertices.y, corner, squares)

    def _seen(self, vertices: Vertices, row: Ints, col: Ints, low: Ints, high: Ints) -> Bools:
        """Which squares [n] this window may see between two heights."""
        lattice = []
        parts = col, row
        for k, (place, q) in enumerate(
            ((vertices.x, vertices.lon_q), (vertices.y, vertices.lat_q))
        ):
            edges = np.stack([parts[k], parts[k] + 1]) * ((1 << SQUARE_BITS) // PART * self.cell[k])
            edges += q[0] - (place[0] * self.cell[k] >> PART_BITS)
            # the projection knows the places of points alone
            lattice.append(np.clip(edges, q.min(), q.max()))
        corners = [
            (lattice[0][i], lattice[1][j], height)
            for i in range(2)
            for j in range(2)
            for height in (low, high)
        ]
        places = np.hstack([np.stack(each) for each in corners])
        xy = self.local.at_points(*places).reshape(4, 8, -1)
        disparity = xy[0] - xy[2]
        xy = np.where(np.isfinite(xy), xy, np.nan)
        least, most = xy.min(axis=1) - SPARE_PX, xy.max(axis=1) + SPARE_PX
        (top, side), (rows, cols) = self.first, self.shape
        unknown = np.isnan(least).any(axis=0)
        with np.errstate(invalid="ignore"):
            in_left = (least[0] <= side + cols - 1) & (most[0] >= side)
            in_left &= (least[1] <= top + rows - 1) & (most[1] >= top)
            known = in_left & ~unknown
            if not known.any():
                return in_left | unknown
            shift = disparity[:, known]
            in_right = least[2] <= side + cols - 1 - shift.min() + DRAWN_OUT_PX
            in_right &= most[2] >= side - shift.max() - DRAWN_OUT_PX
            in_right &= (least[3] <= top + rows - 1) & (most[3] >= top)
        return in_left | in_right | unknown
