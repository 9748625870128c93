"""The points of a window as vertices over the ground, at integer positions on a lattice.

- a ground cell (half a pixel) has one vertex at most: the mean of its top surface; a square of even
  ground has one (:func:`even_ground`). This bounds memory at any density, averages noise where
  points are dense, and no two vertices coincide;
- plan positions are integers (``PART`` parts of a cell) counted on the global lattice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Bytes, Ints
from .scale import PART, PART_BITS, SQUARE_CELLS, SquareGrid, SurfaceScale, height_steps

Steps = NDArray[np.int32]

FEWEST_VERTICES = 3  # of an even square
FEWEST_AROUND = 36  # of the nine squares: a quarter of their cells
_SIDE = SQUARE_CELLS * PART

Days = NDArray[np.uint16]

_LOWEST = np.iinfo(np.int32).min


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

    Points denser than pixels add nothing on even ground to what one vertex in four pixels says. A
    square of SQUARE_CELLS by SQUARE_CELLS cells becomes one vertex in its middle, at the mean
    height of its points there, if all vertices of the nine squares around it lie on one plane and
    are of one class. Squares lie on the global lattice and sums are of integers, so that the
    vertices depend neither on the window nor on the order of the points. Squares at the border of
    the window are not even: what lies beyond is unknown.
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


class Vertices(NamedTuple):
    """Vertices [n] of a window, in the order of their cells: south to north, then west to east.

    ``lon_q``, ``lat_q``, ``h_q`` int64: global lattice steps; ``x``, ``y`` int64: plan position in
    parts of a cell from the window's first cell; ``surface_class`` uint8: ASPRS class of the
    highest point of the cell; ``count`` int32: number of points that the vertex is the mean of;
    ``day`` uint16: when that highest point was measured, since 1970-01-01; 0: not known.
    """

    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    x: Ints
    y: Ints
    surface_class: Bytes
    count: Steps
    day: Days

    @classmethod
    def empty(cls, size: int) -> Vertices:
        """Room for so many."""
        places = (np.empty(size, np.int64) for _ in range(5))
        return cls(
            *places, np.empty(size, np.uint8), np.empty(size, np.int32), np.empty(size, np.uint16)
        )

    def taken(self, index: NDArray[np.integer]) -> Vertices:
        """The vertices of an index."""
        return Vertices(*(values.take(index) for values in self))


class _Points(NamedTuple):
    """Points [n]: lattice coordinates, ASPRS class, number of the return in its pulse, day."""

    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    surface_class: Bytes
    return_number: Bytes
    day: Days


class _CellTops(NamedTuple):
    """Greatest height of each cell [rows, cols], its class and day; ``first`` cell of the window
    and size of a ``cell`` (lon, lat, lattice steps)."""

    height: Steps
    surface_class: Bytes
    day: Days
    first: tuple[int, int]
    cell: tuple[int, int]


@inner
def whole_quotient(number: int, inverse: float) -> int:
    """``number`` // d, ``inverse`` = 1 / d; a division takes ten times as long.

    Exact from 0 to 2**50: there all roundings together are less than half a step.
    """
    return np.int64((number + 0.5) * inverse)


@kernel
def _raise_tops(points: _Points, tops: _CellTops, index: Steps, position: Steps) -> int:
    """Raise the greatest height of each cell by first returns; of equals the greater class stays,
    and the later day.

    Fills ``index`` (cell) and ``position`` [n, 3] (steps from the cell's corner, height); returns
    how many points are first returns.
    """
    lon_q, lat_q, h_q = points.lon_q, points.lat_q, points.h_q
    classes, returns, days = points.surface_class, points.return_number, points.day
    top, top_class, top_day = tops.height, tops.surface_class, tops.day
    first, cell = tops.first, tops.cell
    n = 0
    cols = top.shape[1]
    west, south = first[0] * cell[0], first[1] * cell[1]
    wide, tall = 1.0 / cell[0], 1.0 / cell[1]
    for k in range(lon_q.size):
        if returns[k] > 1:
            continue
        east, north = lon_q[k] - west, lat_q[k] - south
        i, j = whole_quotient(east, wide), whole_quotient(north, tall)
        index[n] = j * cols + i
        position[n, 0] = east - i * cell[0]
        position[n, 1] = north - j * cell[1]
        position[n, 2] = h = np.int32(h_q[k])
        n += 1
        if h > top[j, i]:
            top[j, i] = h
            top_class[j, i], top_day[j, i] = classes[k], days[k]
        elif h == top[j, i]:
            if classes[k] > top_class[j, i]:
                top_class[j, i], top_day[j, i] = classes[k], days[k]
            elif classes[k] == top_class[j, i]:
                top_day[j, i] = max(top_day[j, i], days[k])
    return n


@kernel
def _numbered(top: Steps, number: Steps) -> int:
    """Numbers the cells with points in their order, -1 for others; returns how many there are."""
    n = 0
    for k in range(top.size):
        number[k] = -1
        if top[k] > _LOWEST:
            number[k] = n
            n += 1
    return n


@kernel
def _sum_tops(
    index: Steps, position: Steps, top: Steps, number: Steps, tolerance: int, sums: Steps
) -> None:
    """Per vertex, of the points at most ``tolerance`` below the cell's top: count, sums of
    positions and of depths, to ``sums`` [n, 4]."""
    for k in range(index.size):
        depth = top[index[k]] - position[k, 2]
        if depth <= tolerance:
            n = number[index[k]]
            sums[n, 0] += 1
            sums[n, 1] += position[k, 0]
            sums[n, 2] += position[k, 1]
            sums[n, 3] += depth


@kernel
def _means(
    number: Steps, tops: _CellTops, sums: Steps, grid: SquareGrid, out: CellVertices
) -> None:
    """Position, height, class and square of each vertex, to ``out``; the sums of positions become
    means."""
    x, y, h, classes, square = out.x, out.y, out.h, out.surface_class, out.square
    top, top_class, cell, before = tops.height, tops.surface_class, tops.cell, grid.before
    rows, cols = top.shape
    wide, tall = 1.0 / cell[0], 1.0 / cell[1]
    for j in range(rows):
        for i in range(cols):
            k = number[j, i]
            if k < 0:
                continue
            n, h[k] = sums[k, 0], top[j, i]
            if n > 1:
                sums[k, 1], sums[k, 2] = sums[k, 1] // n, sums[k, 2] // n
                h[k] = (n * np.int64(top[j, i]) - sums[k, 3]) // n
            x[k] = (i << PART_BITS) + whole_quotient(sums[k, 1] << PART_BITS, wide)
            y[k] = (j << PART_BITS) + whole_quotient(sums[k, 2] << PART_BITS, tall)
            classes[k] = top_class[j, i]
            row, col = (j + before[1]) // SQUARE_CELLS, (i + before[0]) // SQUARE_CELLS
            square[k] = row * grid.shape[1] + col


@kernel
def _thinned(
    number: Steps,
    sums: Steps,
    cells: CellVertices,
    tops: _CellTops,
    grid: SquareGrid,
    even: EvenGround,
    points: Steps,
    out: Vertices,
) -> int:
    """Vertices in the order of their cells, one in the middle of each even square, to ``out``.

    ``sums``: counts and mean positions; ``points``: number of points of each square. Returns the
    number of vertices.
    """
    first, cell, before, days = tops.first, tops.cell, grid.before, tops.day
    x, y, h, classes = cells.x, cells.y, cells.h, cells.surface_class
    is_even, height, one = even.is_even, even.height, even.one
    rows, cols = number.shape
    squares = grid.shape[1]
    m = 0
    for j in range(rows):
        row, down = divmod(j + before[1], SQUARE_CELLS)
        for p in range(squares):
            s = row * squares + p
            west = p * SQUARE_CELLS - before[0]  # the square's first cell
            if is_even[s]:
                i = west + SQUARE_CELLS // 2
                if down != SQUARE_CELLS // 2:
                    continue
                # the middle lies at a corner of cells
                out.lon_q[m], out.lat_q[m] = (i + first[0]) * cell[0], (j + first[1]) * cell[1]
                out.h_q[m] = height[s]
                out.x[m], out.y[m] = i << PART_BITS, j << PART_BITS
                k = one[s]
                out.surface_class[m], out.count[m] = classes[k], points[s]
                out.day[m] = days[y[k] >> PART_BITS, x[k] >> PART_BITS]
                m += 1
                continue
            for i in range(max(west, 0), min(west + SQUARE_CELLS, cols)):
                k = number[j, i]
                if k < 0:
                    continue
                out.lon_q[m] = (i + first[0]) * cell[0] + sums[k, 1]
                out.lat_q[m] = (j + first[1]) * cell[1] + sums[k, 2]
                out.h_q[m], out.x[m], out.y[m] = h[k], x[k], y[k]
                out.surface_class[m], out.count[m] = classes[k], sums[k, 0]
                out.day[m] = days[j, i]
                m += 1
    return m


@dataclass(eq=False)
class VertexBuilder:
    """Takes points, block by block, into the vertices of a box of the ground.

    ``low``, ``high``: corners (lattice lon, lat), both included; no point lies beyond.
    """

    scale: SurfaceScale
    low: tuple[int, int]
    high: tuple[int, int]
    blocks: list[tuple[Steps, Steps]] = field(default_factory=list)

    def __post_init__(self) -> None:
        cell = self.scale.cell
        first = tuple(int(q // side) for q, side in zip(self.low, cell))
        last = [q // side for q, side in zip(self.high, cell)]
        shape = last[1] - first[1] + 1, last[0] - first[0] + 1
        height = np.full(shape, _LOWEST, dtype=np.int32)
        classes, days = (np.zeros(shape, dtype) for dtype in (np.uint8, np.uint16))
        self.tops = _CellTops(height, classes, days, first, tuple(cell))

    def add(
        self,
        lon_q: Ints,
        lat_q: Ints,
        h_q: Ints,
        surface_class: Bytes,
        return_number: Bytes,
        day: Days,
    ) -> None:
        """Points by lattice coordinates, class and day; later returns of a pulse lie below what the
        cameras see."""
        index, position = np.empty(lon_q.size, np.int32), np.empty((lon_q.size, 3), np.int32)
        points = _Points(lon_q, lat_q, h_q, surface_class, return_number, day)
        kept = _raise_tops(points, self.tops, index, position)
        self.blocks.append((index[:kept], position[:kept]))

    def built(self) -> Vertices:
        """The vertices of all points, one for each square of even ground."""
        top = self.tops.height
        number = np.empty(top.shape, np.int32)
        n = _numbered(top.reshape(-1), number.reshape(-1))
        sums = np.zeros((n, 4), np.int32)
        tolerance = int(height_steps(self.scale.top_m))
        for index, position in self.blocks:
            _sum_tops(index, position, top.reshape(-1), number.reshape(-1), tolerance, sums)
        self.blocks = []
        grid = SquareGrid.around(self.tops.first, top.shape)
        cells = CellVertices(
            *(np.empty(n, np.int32) for _ in range(3)), np.empty(n, np.uint8), np.empty(n, np.int32)
        )
        _means(number, self.tops, sums, grid, cells)
        even = even_ground(cells, grid, height_steps(self.scale.even_m))
        points = np.zeros(even.is_even.size, np.int32)
        np.add.at(points, cells.square, sums[:, 0])
        size = n - int(even.is_even[cells.square].sum()) + int(even.is_even.sum())
        out = Vertices.empty(size)
        _thinned(number, sums, cells, self.tops, grid, even, points, out)
        return out
