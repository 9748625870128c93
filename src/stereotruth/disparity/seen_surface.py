"""Which surface a pixel's centre sees.

Points that others, nearer to the left camera (of larger disparity), surround in the left image are
covered; the surface is that of the uncovered point nearest to the centre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.window_sums import SURFACE_PX
from ..kernels import inlined, inner, kernel
from .pixel_points import PX, PixelPoints

Ints = NDArray[np.int64]
Records = NDArray[np.void]
Steps = NDArray[np.int32]
Bytes = NDArray[np.uint8]


OUTER_RINGS = 5  # rings of pixels that lack neighbours, see seen_surface
# A point is covered if the higher ones around it leave no gap of more than EMPTY_OCTANTS; looked
# for within COVER_PX, or further where points are sparse. Outside a straight edge the gap is 180°.
COVER_PX = 1.0
MAX_COVER_PX = 2.5
EMPTY_OCTANTS = 3
MANY = 12  # points in 3 x 3 pixels from which on a gap of four octants is no chance
_FINE = 4  # parts of a pixel along each axis

_NOTHING = np.int32(-(1 << 30))  # disparity (steps) below all that occur
_SURFACE = round(SURFACE_PX * PX)
_FINE_STEPS = PX // _FINE
_UNCOVERED, _ON_SURFACE = np.uint8(1), np.uint8(2)


def _surrounded(limit: int) -> NDArray[np.bool_]:
    """[256] by bit mask of octants: no more than ``limit`` octants in a row are empty."""
    table = np.zeros(256, dtype=np.bool_)
    for mask in range(1, 256):
        ring = "".join(str(mask >> (k % 8) & 1) for k in range(16))
        table[mask] = max(len(run) for run in ring.split("1")) <= limit
    return table


_SURROUNDED = _surrounded(EMPTY_OCTANTS)


class _Window(NamedTuple):
    """Points of a window by pixel, see :class:`.pixel_points.PixelPoints`, and ``flags`` of each:
    _UNCOVERED, _ON_SURFACE."""

    points: Records
    start: Ints
    shape: tuple[int, int]
    flags: Bytes


class _Ranges(NamedTuple):
    """Of each pixel's uncovered points: least and greatest disparity (steps), number."""

    low: Steps
    high: Steps
    count: Steps


@inner
def _octant(du: float, dv: float) -> int:
    """0 … 7 in the order of the angle: quadrant, then its first or second half."""
    mixed = (du < 0) != (dv < 0)
    quadrant = (4 if dv < 0 else 0) + (2 if mixed else 0)
    return quadrant + (1 if (abs(dv) > abs(du)) != mixed else 0)


@inner
def _update_range(window: _Window, p: int, ranges: _Ranges) -> None:
    """Least and greatest disparity of a pixel's uncovered points, and their number."""
    points, start, flags = window.points, window.start, window.flags
    least, greatest, n = -_NOTHING, _NOTHING, 0
    for k in range(start[p], start[p + 1]):
        if flags[k] & _UNCOVERED:
            least = min(least, points[k].disparity)
            greatest = max(greatest, points[k].disparity)
            n += 1
    ranges.low[p], ranges.high[p], ranges.count[p] = least, greatest, n


@kernel
def _update_ranges(window: _Window, ranges: _Ranges) -> None:
    """As :func:`_update_range`, of all pixels."""
    for p in range(ranges.count.size):
        _update_range(window, p, ranges)


@inner
def _fine_tops(points: Records, start: Ints, p: int, tops: Steps) -> None:
    """Greatest disparity in each of the _FINE² parts of a pixel."""
    first = p * _FINE * _FINE
    tops[first : first + _FINE * _FINE] = _NOTHING
    for k in range(start[p], start[p + 1]):
        i, j = (points[k].u + PX // 2) // _FINE_STEPS, (points[k].v + PX // 2) // _FINE_STEPS
        at = first + j * _FINE + i
        tops[at] = max(tops[at], points[k].disparity)


@inner
def _possible(across: int, down: int) -> int:
    """Octants that a pixel so many px off can lie in."""
    octants = 255
    if across:
        octants &= 195 if across > 0 else 60
    if down:
        octants &= 15 if down > 0 else 240
    return octants


@inner
def _may_be_surrounded(
    top: Steps,
    limit: int,
    row: int,
    col: int,
    n: int,
    shape: tuple[int, int],
    surrounded: NDArray[np.bool_],
) -> bool:
    """Whether pixels up to ``n`` px off whose ``top`` lies above a ``limit`` leave no gap.

    Beside a wall, what is higher lies to one side: no need to look closer.
    """
    rows, cols = shape
    octants = 0
    for b in range(max(row - n, 0), min(row + n + 1, rows)):
        for a in range(max(col - n, 0), min(col + n + 1, cols)):
            if top[b * cols + a] > limit:
                octants |= _possible(a - col, b - row)
                if surrounded[octants]:
                    return True
    return False


@inner
def _is_surrounded(
    window: _Window,
    k: int,
    p: int,
    n: int,
    far: float,
    top: Steps,
    tops: Steps,
    known: NDArray[np.bool_],
    surrounded: NDArray[np.bool_],
) -> bool:
    """Whether parts of higher disparity lie on all sides of point ``k`` of pixel ``p``.

    Of pixels up to ``n`` px off, up to the squared distance ``far`` (steps²). ``top``: greatest
    disparity of each pixel; ``tops`` of its parts, written where they are not ``known``.
    """
    points, start, (rows, cols) = window.points, window.start, window.shape
    row, col = p // cols, p % cols
    limit = points[k].disparity + _SURFACE
    octants = 0
    for b in range(max(row - n, 0), min(row + n + 1, rows)):
        for a in range(max(col - n, 0), min(col + n + 1, cols)):
            q = b * cols + a
            if top[q] <= limit:
                continue
            if not known[q]:
                known[q] = True
                _fine_tops(points, start, q, tops)
            du = (a - col) * PX - PX // 2 + _FINE_STEPS // 2 - points[k].u
            dv = (b - row) * PX - PX // 2 + _FINE_STEPS // 2 - points[k].v
            for part in range(_FINE * _FINE):
                if tops[q * _FINE * _FINE + part] > limit:
                    s = du + part % _FINE * _FINE_STEPS
                    t = dv + part // _FINE * _FINE_STEPS
                    if s * s + t * t <= far:
                        octants |= 1 << _octant(s, t)
            if surrounded[octants]:
                return True
    return False


@kernel
def _mark_covered(
    window: _Window, near: Steps, ceilings: Steps, surrounded: NDArray[np.bool_], ranges: _Ranges
) -> None:
    """Takes _UNCOVERED from the points that parts of higher disparity surround.

    ``near``: points in 3 x 3 pixels; ``ceilings`` [k]: the greatest disparity no more than k px
    off. ``ranges`` are brought up to date.
    """
    points, start, shape, flags = window.points, window.start, window.shape, window.flags
    low, top, ceilings = ranges.low, ceilings[0], ceilings[1:]
    tops = np.empty(top.size * _FINE * _FINE, np.int32)  # only what is needed is written
    known = np.zeros(top.size, np.bool_)
    cols = shape[1]
    for p in range(top.size):
        if ceilings[-1, p] <= low[p] + _SURFACE:
            continue
        distance = 3.0 / np.sqrt(max(near[p], 1))
        reach = min(max(1.7 * distance, COVER_PX), MAX_COVER_PX)
        n = int(reach + 0.875)  # the parts' centres reach to 3 / 8 px, places to 1 / 2 px
        far = (reach * PX) ** 2
        row, col = p // cols, p % cols
        # no point of the pixel is lower
        if not _may_be_surrounded(top, low[p] + _SURFACE, row, col, n, shape, surrounded):
            continue
        covered = False
        for k in range(start[p], start[p + 1]):
            limit = points[k].disparity + _SURFACE
            if ceilings[n - 1, p] <= limit:
                continue
            if not _may_be_surrounded(top, limit, row, col, n, shape, surrounded):
                continue
            if _is_surrounded(window, k, p, n, far, top, tops, known, surrounded):
                flags[k] = 0
                covered = True
        if covered:
            _update_range(window, p, ranges)


@inlined
def _nearest(window: _Window, q: int, across: int, down: int, best: tuple) -> tuple[int, int]:
    """(Squared distance to the centre, disparity) of the nearest: ``best``, or a point of pixel q.

    q lies ``across``, ``down`` px from the centre; of equals, the greater disparity.
    """
    points, start, flags = window.points, window.start, window.flags
    distance, disparity = best
    for k in range(start[q], start[q + 1]):
        if flags[k] & _UNCOVERED:
            u, v = across * PX + points[k].u, down * PX + points[k].v
            r, d = u * u + v * v, np.int64(points[k].disparity)
            if r < distance or (r == distance and d > disparity):
                distance, disparity = r, d
    return distance, disparity


@inner
def _on_edge(
    window: _Window,
    p: int,
    nearest: tuple[int, int],
    many: bool,
    margin: float,
    surrounded: NDArray[np.bool_],
) -> bool:
    """Whether an edge passes near pixel ``p``, see :func:`seen_surface`; ``nearest``: (squared
    distance, disparity) by :func:`_nearest`."""
    points, start, flags = window.points, window.start, window.flags
    rows, cols = window.shape
    distance, disparity = nearest
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


@inner
def _enclosed(ranges: _Ranges, shape: tuple[int, int], p: int, least: int, greatest: int) -> bool:
    """Whether four sides or corners of a pixel have nothing but disparities from ``least`` to
    ``greatest``: they leave no gap of three octants."""
    low, high, count = ranges.low, ranges.high, ranges.count
    rows, cols = shape
    row, col = p // cols, p % cols
    sides = corners = 0
    if 0 < row < rows - 1 and 0 < col < cols - 1:
        for b in range(-1, 2):
            for a in range(-1, 2):
                q = p + b * cols + a
                if count[q] > 0 and low[q] >= least and high[q] <= greatest:
                    sides += (a == 0) != (b == 0)
                    corners += a != 0 and b != 0
    return sides >= 4 or corners >= 4


@kernel
def _mark_seen(
    window: _Window,
    ranges: _Ranges,
    around: _Ranges,
    margin: float,
    surrounded: NDArray[np.bool_],
    seen: Steps,
    edge: NDArray[np.bool_],
) -> None:
    """Gives _ON_SURFACE to the points on the surface that their pixel's centre sees; number of
    these to ``seen`` [pixels], pixels on an edge to ``edge``. ``around``: of 3 x 3 pixels."""
    points, start, flags = window.points, window.start, window.flags
    low, high, count = ranges.low, ranges.high, ranges.count
    rows, cols = window.shape
    quarter = PX * PX // 4  # squared; points of other pixels are no nearer
    none = (np.int64(1 << 62), np.int64(_NOTHING))
    for p in range(count.size):
        seen[p] = 0
        edge[p] = False
        if count[p] == 0:
            continue
        row, col = p // cols, p % cols
        nearest = _nearest(window, p, 0, 0, none)
        if nearest[0] >= quarter:
            for b in range(max(row - 1, 0), min(row + 2, rows)):
                for a in range(max(col - 1, 0), min(col + 2, cols)):
                    if a != col or b != row:
                        nearest = _nearest(window, b * cols + a, a - col, b - row, nearest)
        disparity = nearest[1]
        least, greatest = disparity - _SURFACE, disparity + _SURFACE
        flat = around.low[p] >= least and around.high[p] <= greatest
        many = around.count[p] >= MANY
        if (many or not flat) and (many or margin > 0.0):
            enclosed = flat or margin == 0.0
            enclosed = enclosed and _enclosed(ranges, window.shape, p, least, greatest)
            if not enclosed:
                edge[p] = _on_edge(window, p, nearest, many, margin, surrounded)
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


def box_max(values: NDArray, reach: int) -> NDArray:
    """Maximum over squares of 2 * reach + 1 px, cut off at the edges."""
    size = 2 * reach + 1
    for axis in (0, 1):
        # what is repeated beyond an edge lies in the same squares as the edge
        pad = [(reach, reach) if a == axis else (0, 0) for a in (0, 1)]
        out = np.moveaxis(np.pad(values, pad, mode="edge"), axis, 0)
        width = 1
        while width < size:
            step = min(width, size - width)
            out = np.maximum(out[:-step], out[step:])
            width += step
        values = np.moveaxis(out, 0, axis)
    return np.ascontiguousarray(values)


def seen_surface(
    window: PixelPoints, edge_margin_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points [n] lie on the surface that their pixel's centre sees; pixels [h, w] on edges.

    A point is covered if points of another surface, nearer to the left camera by more than
    SURFACE_PX, lie on all sides of it in the left image (within COVER_PX, or 1.7 times the mean
    spacing of points). The uncovered point nearest to a pixel's centre, in the pixel or in one
    beside it, lies on the surface that is seen there; to it belong the uncovered points of the
    pixel within SURFACE_PX. There are none if the pixel only holds points of another surface.

    On an edge: either the points of its surface do not surround the centre: they leave a gap of
    more than EMPTY_OCTANTS, as beside a wall without points (not where points are so sparse
    that gaps come by chance). Or, half-way between the nearest points of its surface and of another
    one, the edge passes within ``edge_margin_px`` of the centre, so that it may as well see the
    other one.

    The outermost OUTER_RINGS rings of pixels lack neighbours.
    """
    shape, size = window.shape, window.start.size - 1
    flags = np.full(window.points.size, _UNCOVERED)
    points = _Window(window.points, window.start, shape, flags)
    ranges = _Ranges(*(np.empty(size, np.int32) for _ in range(3)))
    _update_ranges(points, ranges)
    top = ranges.high.reshape(shape)
    reach = range(int(np.ceil(MAX_COVER_PX)) + 1)
    ceilings = np.stack([box_max(top, px).reshape(-1) for px in reach])
    near = box_sum(ranges.count.reshape(shape)).reshape(-1)
    _mark_covered(points, near, ceilings, _SURROUNDED, ranges)
    low, high, count = (values.reshape(shape) for values in ranges)
    around = -box_max(-low, 1), box_max(high, 1), box_sum(count)
    seen, edge = np.empty(size, np.int32), np.empty(size, np.bool_)
    around = _Ranges(*(values.reshape(-1) for values in around))
    _mark_seen(points, ranges, around, edge_margin_px, _SURROUNDED, seen, edge)
    edge &= seen > 0
    return (flags & _ON_SURFACE) != 0, edge.reshape(shape)
