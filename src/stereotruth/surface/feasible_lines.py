"""The feasible lines of a breakline: all that part the low from the high points around.

A line is u = a + b v, ``u`` across the step, ``v`` along it. Each point is one half-plane of (a, b)
(eq. 5 of docs/explanation/surface.md): the feasible lines are a convex polygon, the intersection of
all half-planes, computed by clipping. Lengths are in any unit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]

BACK = 1.5  # spacings before a corner: the last points are left out, they may lie beyond it
GAP = 4.6  # points expected in an area that is empty with a probability of 1 %
STEEPEST = 1.2  # slope of a breakline against its first direction
MOST_CORNERS = 24  # of the polygon of feasible lines
POLYGONS = 64  # that are kept while they are clipped
RINGS = 32  # by which points are sorted


class Sides(NamedTuple):
    """Points on both sides of a step: ``u`` across, ``v`` along it, whether on the high side."""

    u: Floats
    v: Floats
    is_high: Bools


class Band(NamedTuple):
    """Lengths of a breakline: ``reach`` along it, ``width`` off it within which points bound it,
    ``slack`` of their positions, ``spacing`` of points."""

    reach: float
    width: float
    slack: float
    spacing: float


class Polygons(NamedTuple):
    """Polygons of feasible lines, in the order in which they were clipped.

    ``corner`` [POLYGONS + 1, 2, MOST_CORNERS]: (a, b); ``size`` [POLYGONS + 1]: number of corners;
    ``last`` [POLYGONS + 1]: |v| of the last point that clipped it; ``limit`` [2]: how far along
    either way the lines hold. ``value`` [MOST_CORNERS], ``order``, ``far`` [points], ``ring``
    [RINGS + 1]: room to work in.
    """

    corner: Floats
    size: Steps
    last: Floats
    limit: Floats
    value: Floats
    order: Steps
    far: Floats
    ring: Steps


@inlined
def clip(a: Floats, b: Floats, n: int, p: float, q: float, r: float, c: Floats, d: Floats) -> int:
    """The part of a convex polygon (a, b)[n] with p a + q b <= r, to (c, d); its corners."""
    m = 0
    for i in range(n):
        k = i + 1 if i + 1 < n else 0
        here, there = p * a[i] + q * b[i] - r, p * a[k] + q * b[k] - r
        if here <= 0.0:
            c[m], d[m] = a[i], b[i]
            m += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            part = here / (here - there)
            c[m], d[m] = a[i] + part * (a[k] - a[i]), b[i] + part * (b[k] - b[i])
            m += 1
    return m


@inlined
def _clipped(
    corner: Floats, s: int, m: int, new: int, value: Floats, sign: float, bound: float
) -> int:
    """The part of polygon ``s`` of ``m`` corners with sign * value <= bound, to polygon ``new``.

    ``value`` of each corner. Returns the number of corners. Without branches, which the processor
    could not predict: what does not count is written over.
    """
    n = 0
    here = sign * value[0] - bound
    for i in range(m):
        k = i + 1 if i + 1 < m else 0
        there = sign * value[k] - bound
        a, b = corner[s, 0, i], corner[s, 1, i]
        corner[new, 0, n], corner[new, 1, n] = a, b
        n += here <= 0.0
        part = here / (here - there)
        corner[new, 0, n] = a + part * (corner[s, 0, k] - a)
        corner[new, 1, n] = b + part * (corner[s, 1, k] - b)
        n += ((here < 0.0) & (there > 0.0)) | ((there < 0.0) & (here > 0.0))
        here = there
    return n


@inlined
def _by_distance(v: Floats, n: int, reach: float, polygons: Polygons) -> None:
    """Numbers of the points by growing |v|, to ``order`` [n], and |v|, to ``far`` [n]: by rings,
    then by insertion."""
    order, distance, ring = polygons.order, polygons.far, polygons.ring
    ring[:] = 0
    scale = RINGS / reach
    for i in range(n):
        ring[min(np.int64(abs(v[i]) * scale), RINGS - 1) + 1] += 1
    for k in range(RINGS):
        ring[k + 1] += ring[k]
    for i in range(n):
        k = min(np.int64(abs(v[i]) * scale), RINGS - 1)
        order[ring[k]], distance[ring[k]] = i, abs(v[i])
        ring[k] += 1
    for at in range(1, n):
        i, far, k = order[at], distance[at], at
        while k > 0 and distance[k - 1] > far:
            order[k], distance[k] = order[k - 1], distance[k - 1]
            k -= 1
        order[k], distance[k] = i, far


@inlined
def _intersection(sides: Sides, n: int, band: Band, polygons: Polygons, s: int) -> int:
    """Clips polygon ``s`` by the half-planes of the points beyond its last one (eq. 5 of
    docs/explanation/surface.md); returns the number of the polygon that is left.

    Points are taken by growing |v| to both sides, up to ``limit`` [2] (v < 0, v >= 0). The first
    that no line fits ends its side there: ``limit`` gets its |v|.
    """
    u, v, is_high = sides.u, sides.v, sides.is_high
    corner, size, last, limit = polygons.corner, polygons.size, polygons.last, polygons.limit
    value, order, distance = polygons.value, polygons.order, polygons.far
    width, slack = band.width, band.slack
    m, first = size[s], last[s]
    for at in range(n):
        i, far = order[at], distance[at]
        if far > max(limit[0], limit[1]):
            break
        side = 1 if v[i] >= 0.0 else 0
        if (far <= first) | (far > limit[side]):
            continue
        low, top = np.inf, -np.inf
        for j in range(m):
            here = corner[s, 0, j] + corner[s, 1, j] * v[i]
            value[j] = here
            low, top = min(low, here), max(top, here)
        # most points bound none of the lines that are left
        bounds_low = (low < u[i] - slack) & (u[i] <= top + width)
        bounds_high = (top > u[i] + slack) & (u[i] >= low - width)
        if not (bounds_high if is_high[i] else bounds_low):
            continue
        sign = 1.0 if is_high[i] else -1.0
        corners = _clipped(corner, s, m, s + 1, value, sign, sign * u[i] + slack)
        if corners < 3:
            limit[side] = far
            continue
        m = min(corners, MOST_CORNERS - 4)
        new = s + 1 if s + 1 < POLYGONS else s  # none is kept beyond
        for j in range(m if new == s else 0):
            corner[new, 0, j], corner[new, 1, j] = corner[s + 1, 0, j], corner[s + 1, 1, j]
        s = new
        size[s], last[s] = m, far
    return s


@inlined
def _without_gap(sides: Sides, n: int, width: float, polygons: Polygons, s: int) -> int:
    """Drops lines so far off the high points that some would lie in between; the polygon left.

    Of points strewn at random none lies in an area where GAP are expected with a probability of
    exp(-GAP). Low points may be missing in the LiDAR's own shadow, high ones not.
    """
    u, v, is_high = sides.u, sides.v, sides.is_high
    corner, size, limit, value = polygons.corner, polygons.size, polygons.limit, polygons.value
    at = 0.5 * (limit[1] - limit[0])
    m = size[s]
    top = -np.inf
    k = 0
    for j in range(m):
        here = corner[s, 0, j] + corner[s, 1, j] * at
        if here > top:
            top, k = here, j
    a, b = corner[s, 0, k], corner[s, 1, k]
    first, last = np.inf, -np.inf
    count = 0
    for i in range(n):
        off = u[i] - a - b * v[i]
        if is_high[i] and -limit[0] <= v[i] <= limit[1] and off <= width:
            count += 1
            first, last = min(first, v[i]), max(last, v[i])
    if count < 3:
        return s
    at = 0.5 * (first + last)
    top = -np.inf
    for j in range(m):
        value[j] = corner[s, 0, j] + corner[s, 1, j] * at
        top = max(top, value[j])
    # GAP expected points, of count in a strip of this length and width
    corners = _clipped(corner, s, m, s + 1, value, -1.0, GAP * width / float(count) - top)
    if corners < 3:
        return s
    size[s + 1] = corners
    return s + 1


@inlined
def feasible_lines(sides: Sides, n: int, extent: float, band: Band, polygons: Polygons) -> int:
    """The lines between ``n`` low and high points, as the corners (a, b) of one of ``polygons``.

    |a| <= ``extent``. Returns the number of the polygon, which has three corners at least.
    """
    corner, size, last, limit = polygons.corner, polygons.size, polygons.last, polygons.limit
    for j in range(4):
        corner[0, 0, j] = extent if j == 1 or j == 2 else -extent
        corner[0, 1, j] = STEEPEST if j > 1 else -STEEPEST
    size[0], last[0] = 4, -1.0
    limit[:] = band.reach
    _by_distance(sides.v, n, band.reach, polygons)
    s = _intersection(sides, n, band, polygons, 0)
    if limit[0] < band.reach or limit[1] < band.reach:
        for side in range(2):
            if limit[side] < band.reach:
                limit[side] = limit[side] - BACK * band.spacing
        # as far as the points of both sides still count, nothing changes
        while s > 0 and last[s] > min(limit[0], limit[1]):
            s -= 1
        s = _intersection(sides, n, band, polygons, s)
    return _without_gap(sides, n, band.spacing, polygons, s)
