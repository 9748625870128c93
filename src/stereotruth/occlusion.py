"""What hides a point from the left or the right view, seen from the point cloud itself.

The paper (section III-C) removes hidden points by the correlation of image windows alone
(:mod:`stereotruth.correlation`). Here the points decide by themselves:

1. A pixel shows the surface that its centre sees. Points that others, nearer to the left camera
   (of larger disparity), surround in the left image are covered; the uncovered point nearest to
   the centre tells the surface (:func:`seen_surface`).
2. The scene is a grid of ground cells, each as high as the top surface of its points. Below its top
   a cell counts as solid, so that walls hide although no LiDAR point lies on them
   (:func:`build_surface`).
3. What a pixel shows is hidden in a view if the ray from there to that camera, which rises along a
   straight track over the ground, runs into a cell (:func:`hidden_pixels`).

Nothing is tuned to a scene: ray directions, cell size and tolerances follow from the epipolar
model. Cells lie on the global lattice of the points and rays depend on the model only, so that
results do not depend on blocks, files or their order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

from .points import LATTICE_DEG, LATTICE_M, Points

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

EDGE = 5  # px; see seen_surface
METHODS = ("correlation", "geometric", "both", "none")
# Points that differ by no more than this in disparity (px) belong to one surface: a slope of 45°
# spans 0.6 px over a pixel of GF-7, a storey 3 px.
SURFACE_PX = 1.0
# A point is covered if the higher ones around it leave no gap of more than EMPTY_OCTANTS; looked
# for within COVER_PX, or further where points are sparse. Outside a straight edge the gap is 180°.
COVER_PX = 1.0
MAX_COVER_PX = 2.5
EMPTY_OCTANTS = 3
MANY = 12  # points in 3 x 3 pixels from which on a gap of four octants is no chance
# Cells are finer than pixels, so that walls stand where they are: 0.7 % more of the visible pixels
# were kept than with cells of a pixel, at equal shares of hidden ones.
CELL_PX = 0.5
# A ray is stopped by a cell that reaches TOLERANCE_PX of disparity (as height) above it. A cell
# with a step of SURFACE_PX before it is taken to begin AHEAD_CELLS earlier (roof edges are sampled
# on their inner side). The ray's first NEAREST_CELLS do not count (noise would hide itself).
TOLERANCE_PX = 0.25
AHEAD_CELLS = 0.75
NEAREST_CELLS = 0.5
# Rounds of filling cells without points: radius in cells within which three known ones are needed.
FILL_RADII = (1, 2, 4)
_FINE = 4  # parts of a pixel along each axis
_TILE = 32  # cells, of the coarse grid of maxima that bounds the search
_PER_M = round(1 / LATTICE_M)


class Model(Protocol):
    """What is used of :class:`stereotruth.epipolar.EpipolarModel`."""

    shape: tuple[int, int]
    reference_height: float

    def ground_to_epipolar(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> Floats:
        """float64[4, n]: x_left, y_left, x_right, y_right in px."""

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where the left image's ray meets a height."""


# ----------------------------------------------------------------- tops of pixels and of cells


@njit(cache=True, nogil=True, error_model="numpy")
def _highest(index: Ints, value: Floats, use: NDArray[np.bool_], highest: Floats) -> None:
    for k in range(index.size):
        if use[k] and value[k] > highest[index[k]]:
            highest[index[k]] = value[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _below_top(
    index: Ints,
    value: Floats,
    use: NDArray[np.bool_],
    highest: Floats,
    tolerance: float,
    out: NDArray[np.bool_],
) -> None:
    for k in range(index.size):
        out[k] = use[k] and value[k] >= highest[index[k]] - tolerance


def top_surface(
    index: Ints, value: Floats, use: NDArray[np.bool_], size: int, tolerance: float
) -> NDArray[np.bool_]:
    """Which of the points in ``use`` are at most ``tolerance`` below the highest of their bin.

    ``index`` [n] is the bin (0 … size - 1) of each point, ``value`` [n] its height or disparity.
    """
    highest = np.full(size, -np.inf)
    _highest(index, value, use, highest)
    out = np.empty(index.size, dtype=np.bool_)
    _below_top(index, value, use, highest, tolerance, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _fine_tops(xy: Floats, use: NDArray[np.bool_], first: tuple[int, int], tops: Floats) -> None:
    """Greatest disparity in each of _FINE² parts of a pixel; ``tops`` [rows, cols] of parts."""
    for k in range(xy.shape[1]):
        if use[k]:
            i = int(np.floor((xy[0, k] + 0.5 - first[1]) * _FINE))
            j = int(np.floor((xy[1, k] + 0.5 - first[0]) * _FINE))
            tops[j, i] = max(tops[j, i], xy[0, k] - xy[2, k])


def _surrounded(limit: int) -> NDArray[np.bool_]:
    """[256] by bit mask of octants: no more than ``limit`` octants in a row are empty."""
    table = np.zeros(256, dtype=np.bool_)
    for mask in range(1, 256):
        ring = "".join(str(mask >> (k % 8) & 1) for k in range(16))
        table[mask] = max(len(run) for run in ring.split("1")) <= limit
    return table


@njit(cache=True, nogil=True, error_model="numpy")
def _count(pixel: Ints, use: NDArray[np.bool_], out: Ints) -> None:
    for k in range(pixel.size):
        if use[k]:
            out[pixel[k]] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _octant(du: float, dv: float) -> int:
    """0 … 7 in the order of the angle: quadrant, then its first or second half."""
    mixed = (du < 0.0) != (dv < 0.0)
    quadrant = (4 if dv < 0.0 else 0) + (2 if mixed else 0)
    return quadrant + (1 if (abs(dv) > abs(du)) != mixed else 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _uncovered(
    xy: Floats,
    pixel: Ints,
    use: NDArray[np.bool_],
    first: tuple[int, int],
    tops: Floats,
    ceiling: Floats,
    reach: Floats,
    tolerance: float,
    surrounded: NDArray[np.bool_],
    out: NDArray[np.bool_],
) -> None:
    """``out``: points in ``use`` that parts of higher disparity do not surround.

    ``ceiling`` and ``reach`` (px) by pixel: no part within reach is higher; where to look.
    """
    for k in range(pixel.size):
        out[k] = use[k]
        limit = xy[0, k] - xy[2, k] + tolerance
        if not use[k] or ceiling[pixel[k]] <= limit:
            continue
        u = (xy[0, k] + 0.5 - first[1]) * _FINE
        v = (xy[1, k] + 0.5 - first[0]) * _FINE
        i, j = int(np.floor(u)), int(np.floor(v))
        far = reach[pixel[k]] * _FINE
        n = int(np.ceil(far))
        octants = 0
        for b in range(max(j - n, 0), min(j + n + 1, tops.shape[0])):
            dv = b + 0.5 - v
            for a in range(max(i - n, 0), min(i + n + 1, tops.shape[1])):
                du = a + 0.5 - u
                if tops[b, a] > limit and du * du + dv * dv <= far * far:
                    octants |= 1 << _octant(du, dv)
        out[k] = not surrounded[octants]


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(
    xy: Floats,
    use: NDArray[np.bool_],
    first: tuple[int, int],
    distance: Floats,
    disparity: Floats,
) -> None:
    """Per pixel: disparity of the point in ``use`` nearest to its centre (ties: the greater)."""
    rows, cols = distance.shape
    for k in range(xy.shape[1]):
        if not use[k]:
            continue
        x, y = xy[0, k] - first[1], xy[1, k] - first[0]
        i, j = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        d = xy[0, k] - xy[2, k]
        for b in range(max(j - 1, 0), min(j + 2, rows)):
            for a in range(max(i - 1, 0), min(i + 2, cols)):
                q = (x - a) ** 2 + (y - b) ** 2
                if q < distance[b, a] or (q == distance[b, a] and d > disparity[b, a]):
                    distance[b, a] = q
                    disparity[b, a] = d


@njit(cache=True, nogil=True, error_model="numpy")
def _around(
    xy: Floats,
    use: NDArray[np.bool_],
    first: tuple[int, int],
    disparity: Floats,
    tolerance: float,
    other: Floats,
    octants: Ints,
    count: Ints,
) -> None:
    """Per pixel, of the points in it and in those beside it.

    ``other``: squared distance of the centre to the nearest one of another surface; ``octants``:
    bits of those in which its own surface has points; ``count``: how many there are.
    """
    rows, cols = disparity.shape
    for k in range(xy.shape[1]):
        if not use[k]:
            continue
        x, y = xy[0, k] - first[1], xy[1, k] - first[0]
        i, j = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        d = xy[0, k] - xy[2, k]
        for b in range(max(j - 1, 0), min(j + 2, rows)):
            for a in range(max(i - 1, 0), min(i + 2, cols)):
                count[b, a] += 1
                if abs(d - disparity[b, a]) <= tolerance:
                    octants[b, a] |= 1 << _octant(x - a, y - b)
                else:
                    q = (x - a) ** 2 + (y - b) ** 2
                    other[b, a] = min(other[b, a], q)


@njit(cache=True, nogil=True, error_model="numpy")
def _near_surface(
    xy: Floats,
    pixel: Ints,
    use: NDArray[np.bool_],
    disparity: Floats,
    tolerance: float,
    out: NDArray[np.bool_],
) -> None:
    for k in range(pixel.size):
        out[k] = use[k] and abs(xy[0, k] - xy[2, k] - disparity[pixel[k]]) <= tolerance


def box_sum(values: NDArray) -> NDArray:
    """Sum over 3 x 3 pixels, always added in one order; zero beyond the edges."""
    padded = np.pad(values, 1)
    rows, cols = values.shape
    return sum(padded[r : r + rows, c : c + cols] for r in range(3) for c in range(3))


def seen_surface(
    xy: Floats,
    pixel: Ints,
    use: NDArray[np.bool_],
    rows: slice,
    cols: slice,
    edge_margin_px: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of the points in ``use`` lie on the surface that their pixel's centre sees.

    A point is covered if points of another surface, nearer to the left camera by more than
    SURFACE_PX, lie on all sides of it in the left image (within COVER_PX, or 1.7 times the mean
    distance of points). The uncovered point nearest to a pixel's centre, in the pixel or in one
    beside it, tells the surface that is seen there; to it belong the uncovered points of the pixel
    within SURFACE_PX. There are none if the pixel only holds points of another surface.

    The second result tells which of them lie in a pixel on an edge. Either the points of its
    surface do not surround the centre: they leave a gap of more than EMPTY_OCTANTS, as beside a
    wall that no point tells of (not where points are so sparse that gaps come by chance). Or,
    half-way between the nearest points of its surface and of another one, the edge passes within
    ``edge_margin_px`` of the centre, so that it may as well see the other one.

    ``pixel`` is the row-major index into ``rows`` x ``cols``; ``xy`` [4, n] as in
    :func:`stereotruth.correlation.correlate`. The outermost EDGE rings of pixels lack neighbours.
    """
    shape = rows.stop - rows.start, cols.stop - cols.start
    first = (rows.start, cols.start)
    tops = np.full((shape[0] * _FINE, shape[1] * _FINE), -np.inf)
    _fine_tops(xy, use, first, tops)
    count = np.zeros(shape[0] * shape[1], dtype=np.int64)
    _count(pixel, use, count)
    distance = 3.0 / np.sqrt(np.maximum(box_sum(count.reshape(shape)), 1))
    reach = np.clip(1.7 * distance, COVER_PX, MAX_COVER_PX)
    highest = tops.reshape(shape[0], _FINE, shape[1], _FINE).max(axis=(1, 3))
    ceiling = maximum_filter(highest, 2 * int(np.ceil(MAX_COVER_PX)) + 1, mode="nearest")
    uncovered = np.empty(use.size, dtype=np.bool_)
    _uncovered(
        xy,
        pixel,
        use,
        first,
        tops,
        ceiling.reshape(-1),
        reach.reshape(-1),
        SURFACE_PX,
        _surrounded(EMPTY_OCTANTS),
        uncovered,
    )
    distance, disparity = np.full(shape, np.inf), np.full(shape, np.nan)
    _nearest(xy, uncovered, first, distance, disparity)
    other = np.full(shape, np.inf)
    octants, around = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    _around(xy, uncovered, first, disparity, SURFACE_PX, other, octants, around)
    edge = ~_surrounded(EMPTY_OCTANTS)[octants] & (around >= MANY)
    edge |= np.sqrt(other) < np.sqrt(distance) + 2.0 * edge_margin_px
    out = np.empty(use.size, dtype=np.bool_)
    _near_surface(xy, pixel, uncovered, disparity.reshape(-1), SURFACE_PX, out)
    return out, out & edge.reshape(-1)[pixel]


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    index: Ints, use: NDArray[np.bool_], lon_q: Ints, lat_q: Ints, h_q: Ints, sums: Ints
) -> None:
    for k in range(index.size):
        if use[k]:
            i = index[k]
            sums[i, 0] += 1
            sums[i, 1] += lon_q[k]
            sums[i, 2] += lat_q[k]
            sums[i, 3] += h_q[k]


def exact_sums(points: Points, index: Ints, use: NDArray[np.bool_], size: int) -> Ints:
    """int64 [size, 4] per bin: number of the points in ``use``, sums of lon_q, lat_q, h_q.

    Integers of the points' lattice: exact, whatever the order of the points.
    """
    sums = np.zeros((size, 4), dtype=np.int64)
    _add(index, use, points.lon_q, points.lat_q, points.h_q, sums)
    return sums


# ------------------------------------------------------------------------------ scene geometry


@dataclass(frozen=True, eq=False)
class Rays:
    """Directions of the rays to both cameras, and the size of the surface's cells.

    ``track`` float64[2, 2, 3]: (view, lon or lat, coefficients of 1, x, y): degrees that a ray to
    the left (0) or right (1) camera moves over the ground per metre of height, as a linear function
    of the left epipolar pixel. ``cell``: (lon, lat) size of a cell in lattice steps.
    ``px_per_m``: disparity per metre of height in the scene's middle.
    """

    track: Floats
    cell: tuple[int, int]
    px_per_m: float

    @classmethod
    def of(cls, model: Model) -> Rays:
        """From the epipolar model alone."""
        rows, cols = model.shape
        # An odd count, so that the middle of the grid is among the places.
        y, x = (
            c.reshape(-1)
            for c in np.meshgrid(
                np.linspace(0, rows - 1, 5), np.linspace(0, cols - 1, 5), indexing="ij"
            )
        )
        low = np.full(x.size, float(model.reference_height))
        rise = 50.0  # m
        lon, lat = model.epipolar_to_ground(x, y, low)
        base = model.ground_to_epipolar(lon, lat, low)
        x_high = x.copy()
        left = np.stack(model.epipolar_to_ground(x, y, low + rise))
        right = left
        disparity = np.zeros(x.size)
        for step in range(4):  # x_left of the point of the right ray at the greater height
            right = np.stack(model.epipolar_to_ground(x_high, y, low + rise))
            there = model.ground_to_epipolar(*right, low + rise)
            if step == 0:
                disparity = there[0] - there[2] - (base[0] - base[2])
            x_high += base[2] - there[2]
        design = np.stack([np.ones(x.size), x, y], axis=1)
        seen = np.isfinite(lon) & np.isfinite(left).all(0) & np.isfinite(right).all(0)
        track = np.empty((2, 2, 3))
        for view, end in enumerate((left, right)):
            for axis, start in enumerate((lon, lat)):
                values = (end[axis] - start)[seen] / rise
                track[view, axis] = np.linalg.lstsq(design[seen], values, rcond=None)[0]
        track = np.round(track, 15)  # degrees: drops what depends on the linear algebra library
        # Square cells on the ground, of the area of a left pixel.
        middle = (
            np.array([cols / 2, cols / 2 + 1, cols / 2]),
            np.array([rows / 2] * 2 + [rows / 2 + 1]),
        )
        lon3, lat3 = model.epipolar_to_ground(*middle, np.full(3, float(model.reference_height)))
        shrink = np.cos(np.radians(lat3[0]))
        area = abs(
            (lon3[1] - lon3[0]) * (lat3[2] - lat3[0]) - (lon3[2] - lon3[0]) * (lat3[1] - lat3[0])
        )  # degrees²
        side = CELL_PX * np.sqrt(area * shrink) / LATTICE_DEG  # steps of latitude
        cell = (max(round(side / shrink), 1), max(round(side), 1))
        return cls(track, cell, float(np.round(np.nanmedian(disparity) / rise, 9)))

    def reach(self, cols: slice, rows: slice) -> Floats:
        """[2, 2] (lon, lat; lowest, highest) degrees per metre that any ray from a window moves."""
        corners = np.array(
            [[1.0, x, y] for x in (cols.start, cols.stop) for y in (rows.start, rows.stop)]
        )
        moves = self.track @ corners.T  # [view, axis, corner]
        low = np.minimum(moves.min(axis=(0, 2)), 0.0)
        high = np.maximum(moves.max(axis=(0, 2)), 0.0)
        return np.stack([low, high], axis=1)


# ------------------------------------------------------------------------------------- surface


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights of ground cells [j (lat), i (lon)] in m, -inf where unknown.

    (``row``, ``col``): global index of the first cell, lattice coordinate // cell size.
    ``ceiling``: the highest of each square of _TILE cells.
    """

    height: NDArray[np.float32]
    ceiling: NDArray[np.float32]
    row: int
    col: int


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_holes(height: NDArray[np.float32], radius: int, out: NDArray[np.float32]) -> None:
    rows, cols = height.shape
    for j in range(rows):
        for i in range(cols):
            out[j, i] = height[j, i]
            if height[j, i] > -np.inf:
                continue
            known = 0
            lowest = np.float32(np.inf)
            for b in range(max(j - radius, 0), min(j + radius + 1, rows)):
                for a in range(max(i - radius, 0), min(i + radius + 1, cols)):
                    if height[b, a] > -np.inf:
                        known += 1
                        lowest = min(lowest, height[b, a])
            if known >= 3:
                out[j, i] = lowest


def build_surface(points: Points, rays: Rays) -> Surface | None:
    """The surface of all given points; None if there are none.

    A cell's height is the mean of its top surface. Cells without points take the lowest of their
    neighbours, if three are known, in rounds of growing radius (roofs do not grow).
    """
    if len(points) == 0:
        return None
    i = points.lon_q // rays.cell[0]
    j = points.lat_q // rays.cell[1]
    col, row = int(i.min()), int(j.min())
    shape = int(j.max()) - row + 1, int(i.max()) - col + 1
    index = (j - row) * shape[1] + (i - col)
    everyone = np.ones(len(points), dtype=np.bool_)
    size = shape[0] * shape[1]
    top = top_surface(index, points.height, everyone, size, SURFACE_PX / rays.px_per_m)
    sums = exact_sums(points, index, top, size)
    height = np.full(size, -np.inf, dtype=np.float32)
    known = sums[:, 0] > 0
    height[known] = sums[known, 3] / sums[known, 0] / _PER_M
    height = height.reshape(shape)
    for radius in FILL_RADII:
        filled = np.empty_like(height)
        _fill_holes(height, radius, filled)
        height = filled
    tiles = [-(-n // _TILE) for n in shape]
    padded = np.full([n * _TILE for n in tiles], -np.inf, dtype=np.float32)
    padded[: shape[0], : shape[1]] = height
    ceiling = padded.reshape(tiles[0], _TILE, tiles[1], _TILE).max(axis=(1, 3))
    return Surface(height, ceiling, row, col)


# ---------------------------------------------------------------------------------------- rays


@njit(cache=True, nogil=True, error_model="numpy")
def _highest_on_track(ceiling: NDArray[np.float32], i: int, j: int, di: float, dj: float) -> float:
    """The highest tile in the box around the track from cell (i, j) over (di, dj) cells."""
    i0, i1 = min(i, i + int(np.floor(di)) - 1), max(i, i + int(np.ceil(di)) + 1)
    j0, j1 = min(j, j + int(np.floor(dj)) - 1), max(j, j + int(np.ceil(dj)) + 1)
    i0, i1 = max(i0 // _TILE, 0), min(i1 // _TILE, ceiling.shape[1] - 1)
    j0, j1 = max(j0 // _TILE, 0), min(j1 // _TILE, ceiling.shape[0] - 1)
    highest = -np.inf
    for q in range(j0, j1 + 1):
        for p in range(i0, i1 + 1):
            highest = max(highest, ceiling[q, p])
    return highest


@njit(cache=True, nogil=True, error_model="numpy")
def _is_hidden(
    height: NDArray[np.float32],
    ceiling: NDArray[np.float32],
    top: float,
    i: int,
    j: int,
    a: float,
    b: float,
    start: float,
    du: float,
    dv: float,
    ahead: float,
    nearest: float,
    tolerance: float,
    step: float,
) -> bool:
    """Does the ray from place (a, b) in [0, 1)² of cell (i, j) at height ``start`` hit a cell?

    (du, dv): cells per metre of rise; ``top``: no cell is higher (m). The cell of the start does
    not count: what lies above the start there is the business of :func:`seen_surface`.
    """
    speed = np.hypot(du, dv)
    if speed < 1e-6:  # the camera stands in the zenith
        return False
    if start + tolerance >= top:
        return False
    # Only tiles on the way can stop the ray; the way ends where it rises above all of them.
    top = min(top, _highest_on_track(ceiling, i, j, du * (top - start), dv * (top - start)))
    rise = 1.0 / speed  # m per cell of way
    du *= rise
    dv *= rise
    step_i, step_j = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    # Way to the next border of cells along each axis, and between borders.
    between_u = 1.0 / abs(du) if du != 0.0 else np.inf
    between_v = 1.0 / abs(dv) if dv != 0.0 else np.inf
    next_u = (1.0 - a if du > 0.0 else a) * between_u if du != 0.0 else np.inf
    next_v = (1.0 - b if dv > 0.0 else b) * between_v if dv != 0.0 else np.inf
    rows, cols = height.shape
    before = height[j, i]
    while True:
        if next_u < next_v:
            way = next_u
            next_u += between_u
            i += step_i
        else:
            way = next_v
            next_v += between_v
            j += step_j
        if i < 0 or j < 0 or i >= cols or j >= rows:
            return False
        here = height[j, i]
        if start + max(way - ahead, nearest) * rise + tolerance >= top:
            return False
        if here - before > step:
            way -= ahead
        if here > start + max(way, nearest) * rise + tolerance:
            return True
        before = here


@njit(cache=True, nogil=True, error_model="numpy")
def _hidden(
    height: NDArray[np.float32],
    ceiling: NDArray[np.float32],
    origin: tuple[int, int],
    cell: tuple[int, int],
    sums: Ints,
    track: Floats,
    first: tuple[int, int],
    width: int,
    ahead: float,
    nearest: float,
    tolerance: float,
    step: float,
    out: NDArray[np.uint8],
) -> None:
    """``out`` [bins]: 0 seen in both views, 1 hidden from the left, 2 from the right only.

    ``track`` in cells per metre; bin k is the pixel at row first[0] + k // width and column
    first[1] + k % width.
    """
    top = -np.inf
    for tile in ceiling.flat:
        top = max(top, tile)
    for k in range(sums.shape[0]):
        out[k] = 0
        n = sums[k, 0]
        if n == 0:
            continue
        # Integer arithmetic keeps the place free of any block's origin.
        i = sums[k, 1] // (n * cell[0])
        j = sums[k, 2] // (n * cell[1])
        a = (sums[k, 1] - i * n * cell[0]) / (n * cell[0])
        b = (sums[k, 2] - j * n * cell[1]) / (n * cell[1])
        start = sums[k, 3] / n / _PER_M
        y = float(first[0] + k // width)
        x = float(first[1] + k % width)
        for view in range(2):
            t = track[view]
            du = t[0, 0] + t[0, 1] * x + t[0, 2] * y
            dv = t[1, 0] + t[1, 1] * x + t[1, 2] * y
            if _is_hidden(
                height,
                ceiling,
                top,
                i - origin[1],
                j - origin[0],
                a,
                b,
                start,
                du,
                dv,
                ahead,
                nearest,
                tolerance,
                step,
            ):
                out[k] = view + 1
                break


def hidden_pixels(
    surface: Surface, rays: Rays, sums: Ints, rows: slice, cols: slice
) -> NDArray[np.uint8]:
    """Whether what each pixel of a window shows is hidden.

    ``sums`` [pixels, 4] come from :func:`exact_sums` over the seen surfaces, pixels in row-major
    order of ``rows`` x ``cols`` of the left epipolar grid. Returns uint8 [pixels]: 0 seen in both
    views (or no point), 1 hidden from the left, 2 hidden from the right.
    """
    out = np.empty(len(sums), dtype=np.uint8)
    per_cell = np.array(rays.cell, dtype=np.float64)[None, :, None] * LATTICE_DEG
    _hidden(
        surface.height,
        surface.ceiling,
        (surface.row, surface.col),
        rays.cell,
        sums,
        rays.track / per_cell,
        (rows.start, cols.start),
        cols.stop - cols.start,
        AHEAD_CELLS,
        NEAREST_CELLS,
        TOLERANCE_PX / rays.px_per_m,
        SURFACE_PX / rays.px_per_m,
        out,
    )
    return out
