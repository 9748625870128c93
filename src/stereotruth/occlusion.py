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

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from .pixel_points import PX, PixelPoints, Records
from .points import LATTICE_DEG, LATTICE_M, Points

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]

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
_TILE = 8  # cells, of the coarse grid of maxima that bounds the search
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


# ------------------------------------------------------------------- what a pixel's centre sees

_NOTHING = np.int32(-(1 << 30))  # disparity (steps) below all that occur
_SURFACE = round(SURFACE_PX * PX)
_PART = PX // _FINE
_UNCOVERED, _ON_SURFACE = np.uint8(1), np.uint8(2)


def _surrounded(limit: int) -> NDArray[np.bool_]:
    """[256] by bit mask of octants: no more than ``limit`` octants in a row are empty."""
    table = np.zeros(256, dtype=np.bool_)
    for mask in range(1, 256):
        ring = "".join(str(mask >> (k % 8) & 1) for k in range(16))
        table[mask] = max(len(run) for run in ring.split("1")) <= limit
    return table


_SURROUNDED = _surrounded(EMPTY_OCTANTS)


@njit(cache=True, nogil=True, error_model="numpy")
def _octant(du: float, dv: float) -> int:
    """0 … 7 in the order of the angle: quadrant, then its first or second half."""
    mixed = (du < 0) != (dv < 0)
    quadrant = (4 if dv < 0 else 0) + (2 if mixed else 0)
    return quadrant + (1 if (abs(dv) > abs(du)) != mixed else 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _range(
    points: Records, start: Ints, p: int, flags: NDArray[np.uint8], low: Steps, high: Steps
) -> int:
    """Least and greatest disparity of a pixel's uncovered points, and how many there are."""
    least, greatest, n = -_NOTHING, _NOTHING, 0
    for k in range(start[p], start[p + 1]):
        if flags[k] & _UNCOVERED:
            least = min(least, points[k].disparity)
            greatest = max(greatest, points[k].disparity)
            n += 1
    low[p], high[p] = least, greatest
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _ranges(
    points: Records,
    start: Ints,
    flags: NDArray[np.uint8],
    low: Steps,
    high: Steps,
    count: NDArray[np.int32],
) -> None:
    for p in range(count.size):
        count[p] = _range(points, start, p, flags, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _fine_tops(points: Records, start: Ints, p: int, tops: Steps) -> None:
    """Greatest disparity in each of the _FINE² parts of a pixel."""
    first = p * _FINE * _FINE
    tops[first : first + _FINE * _FINE] = _NOTHING
    for k in range(start[p], start[p + 1]):
        i, j = (points[k].u + PX // 2) // _PART, (points[k].v + PX // 2) // _PART
        at = first + j * _FINE + i
        tops[at] = max(tops[at], points[k].disparity)


@njit(cache=True, nogil=True, error_model="numpy")
def _possible(across: int, down: int) -> int:
    """Octants that a pixel so many px off can lie in."""
    octants = 255
    if across:
        octants &= 195 if across > 0 else 60
    if down:
        octants &= 15 if down > 0 else 240
    return octants


@njit(cache=True, nogil=True, error_model="numpy")
def _uncovered(
    points: Records,
    start: Ints,
    shape: tuple[int, int],
    near: NDArray[np.int32],
    top: Steps,
    ceilings: Steps,
    surrounded: NDArray[np.bool_],
    flags: NDArray[np.uint8],
    low: Steps,
    high: Steps,
    count: NDArray[np.int32],
) -> None:
    """Takes _UNCOVERED from the points that parts of higher disparity surround.

    ``near``: points in 3 x 3 pixels; ``top`` of each pixel; ``ceilings`` [k]: the greatest ``top``
    no more than k + 1 px off. ``low``, ``high``, ``count`` (see _range) are brought up to date.
    """
    tops = np.empty(top.size * _FINE * _FINE, np.int32)  # only what is needed is written
    known = np.zeros(top.size, np.bool_)
    rows, cols = shape
    for p in range(top.size):
        if ceilings[-1, p] <= low[p] + _SURFACE:
            continue
        distance = 3.0 / np.sqrt(max(near[p], 1))
        reach = min(max(1.7 * distance, COVER_PX), MAX_COVER_PX)
        n = int(reach + 0.875)  # the parts' centres reach to 3 / 8 px, places to 1 / 2 px
        far = (reach * PX) ** 2
        row, col = p // cols, p % cols
        first_row, end_row = max(row - n, 0), min(row + n + 1, rows)
        first_col, end_col = max(col - n, 0), min(col + n + 1, cols)
        covered = False
        for k in range(start[p], start[p + 1]):
            limit = points[k].disparity + _SURFACE
            if ceilings[n - 1, p] <= limit:
                continue
            # Beside a wall, what is higher lies to one side: no need to look closer.
            octants = 0
            for b in range(first_row, end_row):
                for a in range(first_col, end_col):
                    if top[b * cols + a] > limit:
                        octants |= _possible(a - col, b - row)
            if not surrounded[octants]:
                continue
            octants = 0
            for b in range(first_row, end_row):
                for a in range(first_col, end_col):
                    q = b * cols + a
                    if top[q] <= limit:
                        continue
                    if not known[q]:
                        known[q] = True
                        _fine_tops(points, start, q, tops)
                    du = (a - col) * PX - PX // 2 + _PART // 2 - points[k].u
                    dv = (b - row) * PX - PX // 2 + _PART // 2 - points[k].v
                    for part in range(_FINE * _FINE):
                        if tops[q * _FINE * _FINE + part] > limit:
                            s = du + part % _FINE * _PART
                            t = dv + part // _FINE * _PART
                            if s * s + t * t <= far:
                                octants |= 1 << _octant(s, t)
                if surrounded[octants]:
                    flags[k] = 0
                    covered = True
                    break
        if covered:
            count[p] = _range(points, start, p, flags, low, high)


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(
    points: Records, start: Ints, q: int, across: int, down: int, flags: NDArray[np.uint8], best
) -> tuple[int, int]:
    """(Squared distance to the centre, disparity) of the nearest: ``best``, or a point of pixel q.

    q lies ``across``, ``down`` px from the centre; of equals, the greater disparity.
    """
    distance, disparity = best
    for k in range(start[q], start[q + 1]):
        if flags[k] & _UNCOVERED:
            u, v = across * PX + points[k].u, down * PX + points[k].v
            r, d = u * u + v * v, np.int64(points[k].disparity)
            if r < distance or (r == distance and d > disparity):
                distance, disparity = r, d
    return distance, disparity


@njit(cache=True, nogil=True, error_model="numpy")
def _on_edge(
    points: Records,
    start: Ints,
    shape: tuple[int, int],
    p: int,
    flags: NDArray[np.uint8],
    distance: int,
    disparity: int,
    many: bool,
    margin: float,
    surrounded: NDArray[np.bool_],
) -> bool:
    """See :func:`seen_surface`; ``distance`` (squared) and ``disparity`` by _nearest."""
    rows, cols = shape
    row, col = p // cols, p % cols
    other = np.inf
    octants = 0
    for b in range(max(row - 1, 0), min(row + 2, rows)):
        for a in range(max(col - 1, 0), min(col + 2, cols)):
            q = b * cols + a
            for k in range(start[q], start[q + 1]):
                if flags[k] & _UNCOVERED:
                    u, v = (a - col) * PX + points[k].u, (b - row) * PX + points[k].v
                    if abs(points[k].disparity - disparity) <= _SURFACE:
                        octants |= 1 << _octant(u, v)
                    else:
                        other = min(other, float(u * u + v * v))
            if margin == 0.0 and surrounded[octants]:  # no other point is nearer than the nearest
                return False
    if many and not surrounded[octants]:
        return True
    return np.sqrt(other) < np.sqrt(float(distance)) + 2.0 * margin * PX


@njit(cache=True, nogil=True, error_model="numpy")
def _seen(
    points: Records,
    start: Ints,
    shape: tuple[int, int],
    low: Steps,
    high: Steps,
    count: NDArray[np.int32],
    around: NDArray[np.int32],
    lowest: Steps,
    highest: Steps,
    margin: float,
    surrounded: NDArray[np.bool_],
    flags: NDArray[np.uint8],
    seen: NDArray[np.int32],
    edge: NDArray[np.bool_],
) -> None:
    """``around``, ``lowest``, ``highest``: of ``count``, ``low``, ``high`` in 3 x 3 pixels."""
    rows, cols = shape
    quarter = PX * PX // 4  # squared; points of other pixels are no nearer
    none = (np.int64(1 << 62), np.int64(_NOTHING))
    for p in range(count.size):
        seen[p] = 0
        edge[p] = False
        if count[p] == 0:
            continue
        row, col = p // cols, p % cols
        distance, disparity = _nearest(points, start, p, 0, 0, flags, none)
        if distance >= quarter:
            for b in range(max(row - 1, 0), min(row + 2, rows)):
                for a in range(max(col - 1, 0), min(col + 2, cols)):
                    if a != col or b != row:
                        distance, disparity = _nearest(
                            points,
                            start,
                            b * cols + a,
                            a - col,
                            b - row,
                            flags,
                            (distance, disparity),
                        )
        least, greatest = disparity - _SURFACE, disparity + _SURFACE
        flat = lowest[p] >= least and highest[p] <= greatest
        many = around[p] >= MANY
        if (many or not flat) and (many or margin > 0.0):
            # Four sides or corners with nothing but this surface leave no gap of three octants.
            sides = corners = 0
            if (flat or margin == 0.0) and 0 < row < rows - 1 and 0 < col < cols - 1:
                for b in range(-1, 2):
                    for a in range(-1, 2):
                        q = p + b * cols + a
                        if count[q] > 0 and low[q] >= least and high[q] <= greatest:
                            sides += (a == 0) != (b == 0)
                            corners += a != 0 and b != 0
            if sides < 4 and corners < 4:
                edge[p] = _on_edge(
                    points,
                    start,
                    shape,
                    p,
                    flags,
                    distance,
                    disparity,
                    many,
                    margin,
                    surrounded,
                )
        one = low[p] >= least and high[p] <= greatest
        for k in range(start[p], start[p + 1]):
            on_surface = one or abs(points[k].disparity - disparity) <= _SURFACE
            if flags[k] & _UNCOVERED and on_surface:
                flags[k] |= _ON_SURFACE
                seen[p] += 1


def box_sum(values: NDArray) -> NDArray:
    """Sum over 3 x 3 pixels, always added in one order; zero beyond the edges."""
    padded = np.pad(values, 1)
    rows, cols = values.shape
    return sum(padded[r : r + rows, c : c + cols] for r in range(3) for c in range(3))


def _box_max(values: Steps, reach: int) -> Steps:
    """Maximum over squares of 2 * reach + 1 px, cut off at the edges."""
    for axis in (0, 1):
        out = values.copy()
        near, far = np.moveaxis(values, axis, 0), np.moveaxis(out, axis, 0)
        for step in range(1, reach + 1):
            np.maximum(far[step:], near[:-step], out=far[step:])
            np.maximum(far[:-step], near[step:], out=far[:-step])
        values = out
    return values


def seen_surface(
    window: PixelPoints, edge_margin_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points [n] lie on the surface that their pixel's centre sees; pixels [h, w] on edges.

    A point is covered if points of another surface, nearer to the left camera by more than
    SURFACE_PX, lie on all sides of it in the left image (within COVER_PX, or 1.7 times the mean
    distance of points). The uncovered point nearest to a pixel's centre, in the pixel or in one
    beside it, tells the surface that is seen there; to it belong the uncovered points of the pixel
    within SURFACE_PX. There are none if the pixel only holds points of another surface.

    On an edge: either the points of its surface do not surround the centre: they leave a gap of
    more than EMPTY_OCTANTS, as beside a wall that no point tells of (not where points are so sparse
    that gaps come by chance). Or, half-way between the nearest points of its surface and of another
    one, the edge passes within ``edge_margin_px`` of the centre, so that it may as well see the
    other one.

    The outermost EDGE rings of pixels lack neighbours.
    """
    points, start, shape = window.points, window.start, window.shape
    size = start.size - 1
    low, high = np.empty(size, np.int32), np.empty(size, np.int32)
    count, seen = np.empty(size, np.int32), np.empty(size, np.int32)
    flags = np.full(points.size, _UNCOVERED)
    _ranges(points, start, flags, low, high, count)
    top = high.copy()
    reach = range(1, int(np.ceil(MAX_COVER_PX)) + 1)
    ceilings = np.stack([_box_max(top.reshape(shape), px).reshape(-1) for px in reach])
    near = box_sum(count.reshape(shape)).reshape(-1)
    _uncovered(points, start, shape, near, top, ceilings, _SURROUNDED, flags, low, high, count)
    edge = np.empty(size, dtype=np.bool_)
    _seen(
        points,
        start,
        shape,
        low,
        high,
        count,
        box_sum(count.reshape(shape)).reshape(-1),
        -_box_max(-low.reshape(shape), 1).reshape(-1),
        _box_max(high.reshape(shape), 1).reshape(-1),
        edge_margin_px,
        _SURROUNDED,
        flags,
        seen,
        edge,
    )
    edge &= seen > 0
    return (flags & _ON_SURFACE) != 0, edge.reshape(shape)


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
def _floor_divide(q: int, divisor: int, inverse: float) -> int:
    """q // divisor of 0 <= q < 2**31 and a divisor below 2**20; exact, and without a division."""
    return np.int64((q + 0.5) * inverse)


@njit(cache=True, nogil=True, error_model="numpy")
def _raise_tops(
    lon_q: Ints,
    lat_q: Ints,
    h_q: Ints,
    first: tuple[int, int],
    cell: tuple[int, int],
    top: Steps,
    index: Steps,
    height: Steps,
) -> None:
    """Takes points into the greatest height of each cell; fills ``index`` and ``height``."""
    cols = top.shape[1]
    inverse = (1.0 / cell[0], 1.0 / cell[1])
    west, south = first[0] * cell[0], first[1] * cell[1]
    for k in range(lon_q.size):
        i = _floor_divide(lon_q[k] - west, cell[0], inverse[0])
        j = _floor_divide(lat_q[k] - south, cell[1], inverse[1])
        index[k] = j * cols + i
        height[k] = h_q[k]
        top[j, i] = max(top[j, i], height[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_tops(
    index: Steps, height: Steps, top: Steps, tolerance: int, count: Steps, below: Ints
) -> None:
    """Per cell, of the points at most ``tolerance`` below its top: number, sum of the depths."""
    for k in range(index.size):
        depth = top[index[k]] - height[k]
        if depth <= tolerance:
            count[index[k]] += 1
            below[index[k]] += depth


@njit(cache=True, nogil=True, error_model="numpy")
def _means_of_tops(
    top: Steps, count: Steps, below: Ints, per_m: int, out: NDArray[np.float32]
) -> None:
    for k in range(top.size):
        n = np.int64(count[k])
        out[k] = (n * top[k] - below[k]) / n / per_m if n > 0 else -np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _tile_tops(height: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """The highest of each square of _TILE cells."""
    out[:] = -np.inf
    for j in range(height.shape[0]):
        for i in range(height.shape[1]):
            out[j // _TILE, i // _TILE] = max(out[j // _TILE, i // _TILE], height[j, i])


@njit(cache=True, nogil=True, error_model="numpy")
def _holes(height: NDArray[np.float32], reach: int, out: Ints) -> int:
    """Fills ``out`` with the flat indices of unknown cells near known ones; returns their number.

    Near: in squares of ``reach`` cells beside one with known cells; others are out of reach.
    """
    rows, cols = height.shape
    known = np.zeros(((rows - 1) // reach + 3, (cols - 1) // reach + 3), np.bool_)
    for j in range(rows):
        for i in range(cols):
            if height[j, i] > -np.inf:
                known[j // reach + 1, i // reach + 1] = True
    n = 0
    for q in range(known.shape[0] - 2):
        for p in range(known.shape[1] - 2):
            if not known[q : q + 3, p : p + 3].any():
                continue
            for j in range(q * reach, min((q + 1) * reach, rows)):
                for i in range(p * reach, min((p + 1) * reach, cols)):
                    if height[j, i] == -np.inf:
                        out[n] = j * cols + i
                        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_holes(height: NDArray[np.float32], holes: Ints, radius: int) -> int:
    """Fills ``holes`` (flat indices); moves those that stay to the front, returns their number."""
    rows, cols = height.shape
    value = np.empty(holes.size, np.float32)
    for n in range(holes.size):
        j, i = holes[n] // cols, holes[n] % cols
        value[n] = -np.inf
        known = 0
        lowest = np.float32(np.inf)
        for b in range(max(j - radius, 0), min(j + radius + 1, rows)):
            for a in range(max(i - radius, 0), min(i + radius + 1, cols)):
                if height[b, a] > -np.inf:
                    known += 1
                    lowest = min(lowest, height[b, a])
        if known >= 3:
            value[n] = lowest
    left = 0
    for n in range(holes.size):
        if value[n] > -np.inf:
            height[holes[n] // cols, holes[n] % cols] = value[n]
        else:
            holes[left] = holes[n]
            left += 1
    return left


@dataclass(eq=False)
class SurfaceBuilder:
    """Takes points, block by block, into the surface of a box of the ground.

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
        self.top = np.full(shape, np.iinfo(np.int32).min, dtype=np.int32)

    def add(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> None:
        """Points by lattice coordinates."""
        index, height = np.empty(lon_q.size, np.int32), np.empty(lon_q.size, np.int32)
        _raise_tops(lon_q, lat_q, h_q, self.first, self.rays.cell, self.top, index, height)
        self.parts.append((index, height))

    def built(self) -> Surface:
        """The surface of all that was taken.

        A cell's height is the mean of its top surface. Cells without points take the lowest of
        their neighbours, if three are known, in rounds of growing radius (roofs do not grow).
        """
        top = self.top.reshape(-1)
        count, below = np.zeros(top.size, np.int32), np.zeros(top.size, np.int64)
        tolerance = int(SURFACE_PX / self.rays.px_per_m * _PER_M)
        for index, depth in self.parts:
            _sum_tops(index, depth, top, tolerance, count, below)
        self.parts = []
        height = np.empty(self.top.shape, dtype=np.float32)
        _means_of_tops(top, count, below, _PER_M, height.reshape(-1))
        holes = np.empty(height.size, dtype=np.int64)  # only what is needed is written
        n = _holes(height, sum(FILL_RADII), holes)
        for radius in FILL_RADII:
            n = _fill_holes(height, holes[:n], radius)
        ceiling = np.empty([-(-n // _TILE) for n in height.shape], dtype=np.float32)
        _tile_tops(height, ceiling)
        return Surface(height, ceiling, self.first[1], self.first[0])


def build_surface(points: Points, rays: Rays) -> Surface | None:
    """The surface of all given points; None if there are none."""
    if len(points) == 0:
        return None
    low, high = ((int(edge(points.lon_q)), int(edge(points.lat_q))) for edge in (np.min, np.max))
    builder = SurfaceBuilder(rays, low, high)
    builder.add(points.lon_q, points.lat_q, points.h_q)
    return builder.built()


# ---------------------------------------------------------------------------------------- rays


@njit(cache=True, nogil=True, error_model="numpy")
def _to_border(place: float, size: float, speed: float) -> tuple[float, float]:
    """Way to the next border of cells of a ``size``, and between borders, along one axis."""
    if speed == 0.0:
        return np.inf, np.inf
    return (size - place if speed > 0.0 else place) / abs(speed), size / abs(speed)


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
    speed = np.sqrt(du * du + dv * dv)
    if speed < 1e-6:  # the camera stands in the zenith
        return False
    if start + tolerance >= top:
        return False
    rise = 1.0 / speed  # m per cell of way
    du *= rise
    dv *= rise
    step_i, step_j = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    rows, cols = height.shape
    # From tile to tile: the way to the end of the last one that reaches up to the ray.
    p, q = i // _TILE, j // _TILE
    next_u, between_u = _to_border(i - p * _TILE + a, _TILE, du)
    next_v, between_v = _to_border(j - q * _TILE + b, _TILE, dv)
    way = 0.0
    end = -1.0
    while 0 <= p < ceiling.shape[1] and 0 <= q < ceiling.shape[0]:
        ray = start + max(way - ahead, nearest) * rise + tolerance
        if ray >= top:
            break
        if ceiling[q, p] > ray:
            end = min(next_u, next_v) + 1e-6
        if next_u < next_v:
            way = next_u
            next_u += between_u
            p += step_i
        else:
            way = next_v
            next_v += between_v
            q += step_j
    next_u, between_u = _to_border(a, 1.0, du)
    next_v, between_v = _to_border(b, 1.0, dv)
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
        if way > end or i < 0 or j < 0 or i >= cols or j >= rows:
            return False
        here = height[j, i]
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
