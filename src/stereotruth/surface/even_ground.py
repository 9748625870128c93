"""One vertex in place of many where the ground is even.

Points denser than pixels add nothing on even ground to what one vertex in four pixels says, and
triangles of all of them took most of the time of dense clouds. A square of SQUARE_CELLS by
SQUARE_CELLS cells becomes one vertex in its middle, at the mean height of its points there, if all
vertices of the nine squares around it have a residual to one plane of no more than
``SurfaceScale.even_m`` and are of one class. Squares lie on the global lattice and sums are of
integers, so that the vertices depend neither on the window nor on the order of the points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, inner, kernel
from .scale import PART, SQUARE_CELLS

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]

FEWEST_VERTICES = 3  # of an even square
FEWEST_AROUND = 36  # of the nine squares: a quarter of their cells
_SIDE = SQUARE_CELLS * PART


class SquareGrid(NamedTuple):
    """The squares of a window: ``shape`` (rows, cols); ``before`` (cols, rows): cells of the first
    square that lie before the window's first cell."""

    shape: tuple[int, int]
    before: tuple[int, int]

    @classmethod
    def around(cls, first: tuple[int, int], shape: tuple[int, int]) -> SquareGrid:
        """Of a window of ``shape`` (rows, cols) cells from the ``first`` cell (col, row) on."""
        before = first[0] % SQUARE_CELLS, first[1] % SQUARE_CELLS
        rows, cols = (
            (size - 1 + cells) // SQUARE_CELLS + 1 for size, cells in zip(shape, before[::-1])
        )
        return cls((rows, cols), before)


class CellVertices(NamedTuple):
    """Vertices [n], one for each cell with points: plan position (parts of a cell), height (lattice
    steps), ASPRS class, number of the square."""

    x: Steps
    y: Steps
    h: Steps
    surface_class: NDArray[np.uint8]
    square: Steps


class EvenGround(NamedTuple):
    """Squares [rows * cols]: which are even, the height in their middle (lattice steps), and
    ``one`` vertex of each."""

    is_even: NDArray[np.bool_]
    height: Steps
    one: Steps


class _InSquares(NamedTuple):
    """Vertices in the order of their squares, those of square s from ``start[s]`` to ``start[s +
    1]``.

    ``position`` [n, 3]: x, y from the middle of their square, height. ``surface_class``
    [squares]: class of all vertices of a square, -1 if they differ.
    """

    start: Steps
    order: Steps
    position: Steps
    surface_class: Steps


@inner
def _by_square(square: Steps, start: Steps) -> Steps:
    """Vertices in the order of their squares; ``start`` [squares + 1] gets where each begins."""
    start[:] = 0
    for k in square:
        start[k + 1] += 1
    for k in range(start.size - 1):
        start[k + 1] += start[k]
    filled = start[:-1].copy()
    out = np.empty(square.size, np.int32)
    for k in range(square.size):
        out[filled[square[k]]] = k
        filled[square[k]] += 1
    return out


@inlined
def _enough(start: Steps, s: int, cols: int) -> bool:
    """Whether a square and the eight around it hold enough vertices."""
    if start[s + 1] - start[s] < FEWEST_VERTICES:
        return False
    around = 0
    for first in (s - cols - 1, s - 1, s + cols - 1):
        for q in range(first, first + 3):
            if start[q + 1] == start[q]:
                return False
        around += start[first + 3] - start[first]
    return around >= FEWEST_AROUND


@inlined
def _moments(position: Steps, start: Steps, first: int, out: Ints) -> None:
    """Of a row of squares from square ``first`` on: sums over the vertices of each to ``out``.

    ``position`` [n, 3] of vertices, see :class:`_InSquares`; heights count from that of the
    square's first vertex. ``out`` [cols, 8]: sums of x, y, h, xx, xy, yy, xh, yh.
    """
    for i in range(out.shape[0]):
        begin, end = start[first + i], start[first + i + 1]
        su = sv = sw = suu = suv = svv = suw = svw = 0
        for at in range(begin, end):
            u, v = np.int64(position[at, 0]), np.int64(position[at, 1])
            w = np.int64(position[at, 2]) - np.int64(position[begin, 2])
            su, sv, sw = su + u, sv + v, sw + w
            suu, suv, svv = suu + u * u, suv + u * v, svv + v * v
            suw, svw = suw + u * w, svw + v * w
        row = out[i]
        row[0], row[1], row[2], row[3] = su, sv, sw, suu
        row[4], row[5], row[6], row[7] = suv, svv, suw, svw


@inlined
def _plane(
    squares: _InSquares, moments: Ints, s: int, row: int, cols: int, tolerance: float
) -> tuple[bool, float, float]:
    """Whether the vertices of the nine squares around square ``s`` lie on one plane, and its slopes
    (eq. 1 of docs/explanation/surface.md, for all vertices of nine squares).

    ``moments`` [3, cols, 8]: :func:`_moments` of the rows of squares, by their number modulo 3.
    """
    position, start = squares.position, squares.start
    i, side = s - row * cols, _SIDE
    base = np.int64(position[start[s], 2])
    n = su = sv = sw = suu = suv = svv = suw = svw = 0
    for down in range(-1, 2):
        v = down * side
        for across in range(-1, 2):
            u = across * side
            q = s + down * cols + across
            number = np.int64(start[q + 1] - start[q])
            w = np.int64(position[start[q], 2]) - base
            m = moments[(row + down) % 3, i + across]
            n += number
            su, sv, sw = su + m[0] + number * u, sv + m[1] + number * v, sw + m[2] + number * w
            suu += m[3] + u * (2 * m[0] + number * u)
            suv += m[4] + u * m[1] + v * (m[0] + number * u)
            svv += m[5] + v * (2 * m[1] + number * v)
            suw += m[6] + u * m[2] + w * (m[0] + number * u)
            svw += m[7] + v * m[2] + w * (m[1] + number * v)
    cuu, cuv, cvv = float(n * suu - su * su), float(n * suv - su * sv), float(n * svv - sv * sv)
    cuw, cvw = float(n * suw - su * sw), float(n * svw - sv * sw)
    area = cuu * cvv - cuv * cuv
    gx, gy = (cuw * cvv - cvw * cuv) / area, (cvw * cuu - cuw * cuv) / area
    level = (float(sw) - gx * float(su) - gy * float(sv)) / float(n)
    for down in range(-1, 2):
        for across in range(-1, 2):
            q = s + down * cols + across
            for at in range(start[q], start[q + 1]):
                u, v = position[at, 0] + across * side, position[at, 1] + down * side
                w = np.int64(position[at, 2]) - base
                above = float(w) - gx * float(u) - gy * float(v)
                if not abs(above - level) <= tolerance:
                    return False, 0.0, 0.0
    return True, gx, gy


@inner
def _in_squares(cells: CellVertices, grid: SquareGrid) -> _InSquares:
    """The vertices by their squares."""
    x, y, h, classes = cells.x, cells.y, cells.h, cells.surface_class
    rows, cols = grid.shape
    start = np.empty(rows * cols + 1, np.int32)
    order = _by_square(cells.square, start)
    position, common = np.empty((order.size, 3), np.int32), np.empty(rows * cols, np.int32)
    west, south = -grid.before[0] * PART, -grid.before[1] * PART
    for s in range(rows * cols):
        j, i = divmod(s, cols)
        middle_x, middle_y = west + i * _SIDE + _SIDE // 2, south + j * _SIDE + _SIDE // 2
        common[s] = classes[order[start[s]]] if start[s + 1] > start[s] else -1
        for at in range(start[s], start[s + 1]):
            k = order[at]
            position[at, 0], position[at, 1] = x[k] - middle_x, y[k] - middle_y
            position[at, 2] = h[k]
            if classes[k] != common[s]:
                common[s] = -1
    return _InSquares(start, order, position, common)


@kernel
def even_ground(cells: CellVertices, grid: SquareGrid, tolerance: float) -> EvenGround:
    """Which squares are even: residuals to one plane (eq. 1 and 2 of docs/explanation/surface.md)
    of ``tolerance`` (lattice steps) at most.

    Squares at the border of the window are not even: what lies beyond is unknown.
    """
    rows, cols = grid.shape
    squares = _in_squares(cells, grid)
    start, order, position = squares.start, squares.order, squares.position
    common = squares.surface_class
    is_even = np.zeros(rows * cols, np.bool_)
    height, one = np.zeros(rows * cols, np.int32), np.zeros(rows * cols, np.int32)
    moments = np.empty((3, cols, 8), np.int64)
    for j in range(rows):
        _moments(position, start, j * cols, moments[j % 3])
        # with this row, those around the one before are complete
        for i in range(1, cols - 1 if j > 1 else 1):
            s = (j - 1) * cols + i
            same = common[s] >= 0
            for q in (s - cols, s, s + cols):
                same &= common[q - 1] == common[s]
                same &= (common[q] == common[s]) & (common[q + 1] == common[s])
            if not same or not _enough(start, s, cols):
                continue
            is_even[s], gx, gy = _plane(squares, moments, s, j - 1, cols, tolerance)
            if is_even[s]:
                base, above = np.int64(position[start[s], 2]), 0.0
                for at in range(start[s], start[s + 1]):
                    u, v = float(position[at, 0]), float(position[at, 1])
                    above += float(position[at, 2] - base) - gx * u - gy * v
                height[s] = base + np.int64(np.rint(above / float(start[s + 1] - start[s])))
                one[s] = order[start[s]]
    return EvenGround(is_even, height, one)
