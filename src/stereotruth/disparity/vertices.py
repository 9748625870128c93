"""The points of a window as vertices over the ground, at places on a lattice.

- a ground cell (:class:`.rays.Rays`, half a pixel) gives one vertex at most: the
  mean of its top surface; a square of even ground gives one (:mod:`.even_squares`). This bounds
  memory at any density, averages noise where points are dense, and no two vertices coincide;
- plan places are integers (``PART`` parts of a cell) counted on the global lattice.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..kernels import inner, kernel
from ..lidar.lattice import LATTICE_M
from .even_squares import EVEN_PX, SIDE, even_squares
from .rays import Rays

Ints = NDArray[np.int64]
Steps = NDArray[np.int32]

PART_BITS = 5
PART = 1 << PART_BITS  # parts of a cell along each axis: 1 cm at pixels of 0.65 m
_LOWEST = np.iinfo(np.int32).min


@dataclass(frozen=True, eq=False)
class Vertices:
    """Vertices [n] of a window, in the order of their cells: south to north, then west to east.

    ``lon_q``, ``lat_q``, ``h_q`` int64: global lattice steps; ``x``, ``y`` int64: plan place in
    parts of a cell from the window's first cell; ``surface_class`` ASPRS class of the highest point
    of the cell; ``count`` of points that the vertex is the mean of.
    """

    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    x: Ints
    y: Ints
    surface_class: NDArray[np.uint8]
    count: Steps


@inner
def _whole(number: int, inverse: float) -> int:
    """``number`` // d, ``inverse`` = 1 / d; a division takes ten times as long.

    Exact from 0 to 2**50: there all roundings together are less than half a step.
    """
    return np.int64((number + 0.5) * inverse)


@kernel
def _raise_tops(
    lon_q: Ints,
    lat_q: Ints,
    h_q: Ints,
    classes: NDArray[np.uint8],
    first: tuple[int, int],
    cell: tuple[int, int],
    top: Steps,
    top_class: NDArray[np.uint8],
    returns: NDArray[np.uint8],
    index: Steps,
    place: Steps,
) -> int:
    """Takes first returns into the greatest height of each cell, of equals the greater class.

    Fills ``index`` (cell) and ``place`` [n, 3] (steps from the cell's corner, height); how many.
    """
    n = 0
    cols = top.shape[1]
    west, south = first[0] * cell[0], first[1] * cell[1]
    wide, tall = 1.0 / cell[0], 1.0 / cell[1]
    for k in range(lon_q.size):
        if returns[k] > 1:
            continue
        east, north = lon_q[k] - west, lat_q[k] - south
        i, j = _whole(east, wide), _whole(north, tall)
        index[n] = j * cols + i
        place[n, 0] = east - i * cell[0]
        place[n, 1] = north - j * cell[1]
        place[n, 2] = h = np.int32(h_q[k])
        n += 1
        if h > top[j, i]:
            top[j, i] = h
            top_class[j, i] = classes[k]
        elif h == top[j, i]:
            top_class[j, i] = max(top_class[j, i], classes[k])
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
    index: Steps, place: Steps, top: Steps, number: Steps, tolerance: int, sums: Steps
) -> None:
    """Per vertex, of the points at most ``tolerance`` below the cell's top: count, sums of places
    and of depths."""
    for k in range(index.size):
        depth = top[index[k]] - place[k, 2]
        if depth <= tolerance:
            n = number[index[k]]
            sums[n, 0] += 1
            sums[n, 1] += place[k, 0]
            sums[n, 2] += place[k, 1]
            sums[n, 3] += depth


@kernel
def _means(
    number: Steps, top: Steps, top_class: NDArray[np.uint8], sums: Steps, cell: tuple[int, int],
    before: tuple[int, int], squares: int, x: Steps, y: Steps, h: Steps,
    kinds: NDArray[np.uint8], square: Steps,
) -> None:  # fmt: skip
    """Place, height, class and square of each vertex; ``before``: cells of the first square,
    ``squares`` in a row. The sums of places become means."""
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
            x[k] = (i << PART_BITS) + _whole(sums[k, 1] << PART_BITS, wide)
            y[k] = (j << PART_BITS) + _whole(sums[k, 2] << PART_BITS, tall)
            kinds[k] = top_class[j, i]
            square[k] = (j + before[1]) // SIDE * squares + (i + before[0]) // SIDE


@kernel
def _thinned(
    number: Steps, sums: Steps, x: Steps, y: Steps, h: Steps, kinds: NDArray[np.uint8],
    cell: tuple[int, int], before: tuple[int, int], first: tuple[int, int],
    even: NDArray[np.bool_], height: Steps, one_of: Steps, points: Steps, places: Ints,
    surface_class: NDArray[np.uint8], count: Steps,
) -> int:  # fmt: skip
    """Vertices in the order of their cells, one in the middle of each ``even`` square.

    ``sums``: counts and mean places. To ``places`` [5, n] (lon_q, lat_q, h_q, x, y),
    ``surface_class`` and ``count``; their number.
    """
    rows, cols = number.shape
    m = 0
    for j in range(rows):
        q, down = divmod(j + before[1], SIDE)
        for p in range(even.shape[1]):
            west = p * SIDE - before[0]  # the square's first cell
            if even[q, p]:
                i = west + SIDE // 2
                if down != SIDE // 2:
                    continue
                # the middle lies at a corner of cells
                places[0, m], places[1, m] = (i + first[0]) * cell[0], (j + first[1]) * cell[1]
                places[2, m] = height[q, p]
                places[3, m], places[4, m] = i << PART_BITS, j << PART_BITS
                surface_class[m], count[m] = kinds[one_of[q, p]], points[q, p]
                m += 1
                continue
            for i in range(max(west, 0), min(west + SIDE, cols)):
                k = number[j, i]
                if k < 0:
                    continue
                places[0, m] = (i + first[0]) * cell[0] + sums[k, 1]
                places[1, m] = (j + first[1]) * cell[1] + sums[k, 2]
                places[2, m], places[3, m], places[4, m] = h[k], x[k], y[k]
                surface_class[m], count[m] = kinds[k], sums[k, 0]
                m += 1
    return m


@dataclass(eq=False)
class VertexBuilder:
    """Takes points, block by block, into the vertices of a box of the ground.

    ``low``, ``high``: corners (lattice lon, lat), both included; no point lies beyond.
    """

    rays: Rays
    low: tuple[int, int]
    high: tuple[int, int]
    parts: list[tuple[Steps, Steps]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.first = tuple(int(q // side) for q, side in zip(self.low, self.rays.cell))
        last = [q // side for q, side in zip(self.high, self.rays.cell)]
        shape = last[1] - self.first[1] + 1, last[0] - self.first[0] + 1
        self.top = np.full(shape, _LOWEST, dtype=np.int32)
        self.top_class = np.zeros(shape, dtype=np.uint8)

    def add(
        self,
        lon_q: Ints,
        lat_q: Ints,
        h_q: Ints,
        surface_class: NDArray[np.uint8],
        return_number: NDArray[np.uint8],
    ) -> None:
        """Points by lattice coordinates and class; later returns of a pulse lie below what the
        cameras see."""
        index, place = np.empty(lon_q.size, np.int32), np.empty((lon_q.size, 3), np.int32)
        taken = _raise_tops(
            lon_q,
            lat_q,
            h_q,
            surface_class,
            self.first,
            self.rays.cell,
            self.top,
            self.top_class,
            return_number,
            index,
            place,
        )
        self.parts.append((index[:taken], place[:taken]))

    def built(self) -> Vertices:
        """The vertices of all that was taken, one for each square of even ground."""
        number = np.empty(self.top.shape, np.int32)
        n = _numbered(self.top.reshape(-1), number.reshape(-1))
        sums = np.zeros((n, 4), np.int32)
        px = 1.0 / self.rays.px_per_m / LATTICE_M  # lattice steps of height
        flat = self.top.reshape(-1), number.reshape(-1)
        for index, place in self.parts:
            _sum_tops(index, place, *flat, int(SURFACE_PX * px), sums)
        self.parts = []
        cell, before = self.rays.cell, (self.first[0] % SIDE, self.first[1] % SIDE)
        rows, cols = (
            (size - 1 + cells) // SIDE + 1 for size, cells in zip(self.top.shape, before[::-1])
        )
        x, y, h, square = (np.empty(n, np.int32) for _ in range(4))
        kinds = np.empty(n, np.uint8)
        _means(
            number, self.top, self.top_class, sums, cell, before, cols, x, y, h, kinds, square
        )  # fmt: skip
        corner = -before[0] * PART, -before[1] * PART
        even, height, one_of = even_squares(
            x, y, h, kinds, square, (rows, cols), SIDE * PART, corner, EVEN_PX * px
        )
        points = np.zeros(rows * cols, np.int32)
        np.add.at(points, square, sums[:, 0])
        size = n - int(even[square].sum()) + int(even.sum())
        places = np.empty((5, size), np.int64)
        surface_class, count = np.empty(size, np.uint8), np.empty(size, np.int32)
        grids = (v.reshape(rows, cols) for v in (even, height, one_of, points))
        _thinned(
            number, sums, x, y, h, kinds, cell, before, self.first, *grids, places,
            surface_class, count,
        )  # fmt: skip
        return Vertices(*places, surface_class, count)
