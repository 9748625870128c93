"""All lines that part the low from the high points around a step.

A line is u = a + b v, ``u`` across the step, ``v`` along it. Each point bounds (a, b) by one linear
constraint: the lines that fit are a convex polygon, found by clipping. It serves
:mod:`.outlines`; lengths are in any unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import inlined, inner

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]

BACK = 1.5  # mean distances before a corner: the last points are left out, they may lie beyond it
GAP = 4.6  # points expected in an area that is empty with a chance of 1 %
STEEPEST = 1.2  # slope of an edge against its first guess
CORNERS = 24  # of the polygon of feasible lines at most
STATES = 64  # polygons that are kept while they are clipped
RINGS = 32  # by which points are sorted


@inner
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
    lines: Floats, s: int, m: int, new: int, value: Floats, sign: float, bound: float
) -> int:
    """The part of polygon ``s`` of ``m`` corners with sign * value <= bound, to polygon ``new``.

    ``value`` of each corner. Returns the number of corners.
    """
    n = 0
    here = sign * value[0] - bound
    for i in range(m):
        k = i + 1 if i + 1 < m else 0
        there = sign * value[k] - bound
        if here <= 0.0:
            lines[new, 0, n], lines[new, 1, n] = lines[s, 0, i], lines[s, 1, i]
            n += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            part = here / (here - there)
            for axis in range(2):
                start = lines[s, axis, i]
                lines[new, axis, n] = start + part * (lines[s, axis, k] - start)
            n += 1
        here = there
    return n


@inlined
def _by_distance(v: Floats, n: int, reach: float, start: Steps, order: Steps) -> None:
    """Numbers of the points by growing |v|, to ``order`` [n]: by rings, ``start`` [RINGS + 1], then
    by insertion."""
    start[:] = 0
    scale = RINGS / reach
    for i in range(n):
        start[min(np.int64(abs(v[i]) * scale), RINGS - 1) + 1] += 1
    for ring in range(RINGS):
        start[ring + 1] += start[ring]
    for i in range(n):
        ring = min(np.int64(abs(v[i]) * scale), RINGS - 1)
        order[start[ring]] = i
        start[ring] += 1
    for at in range(1, n):
        i, k = order[at], at
        far = abs(v[i])
        while k > 0 and abs(v[order[k - 1]]) > far:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i


@inner
def _feasible(
    u: Floats, v: Floats, high: Bools, order: Steps, n: int, s: int, band: float, slack: float,
    limit: Floats, lines: Floats, size: Steps, taken: Floats, value: Floats,
) -> int:  # fmt: skip
    """The lines u = a + b v with low points at smaller and high ones at greater u.

    Points are taken in ``order``, by growing |v| to both sides, up to ``limit`` [2] (v < 0,
    v >= 0). The first that no line fits ends its side there: ``limit`` is set to its |v|. Polygon
    ``s`` of ``lines`` [STATES + 1, 2, CORNERS] is clipped by the points beyond ``taken[s]``, and
    what is left of it is the next one, whose last point lies ``taken`` far along. Returns the
    number of the last one. ``value`` [CORNERS] is room to work in.
    """
    m, first = size[s], taken[s]
    for at in range(n):
        i = order[at]
        far = abs(v[i])
        low, top = np.inf, -np.inf
        for j in range(m):
            here = lines[s, 0, j] + lines[s, 1, j] * v[i]
            value[j] = here
            low, top = min(low, here), max(top, here)
        # most points bound none of the lines that are left
        bounds_low = (low < u[i] - slack) & (u[i] <= top + band)
        bounds_high = (top > u[i] + slack) & (u[i] >= low - band)
        side = 1 if v[i] >= 0.0 else 0
        known = (far <= first) | (far > limit[side])
        if known | (not (bounds_high if high[i] else bounds_low)):
            continue
        sign = 1.0 if high[i] else -1.0
        found = _clipped(lines, s, m, s + 1, value, sign, sign * u[i] + slack)
        if found < 3:
            limit[side] = far
            continue
        m = min(found, CORNERS - 4)
        new = s + 1 if s + 1 < STATES else s  # none is kept beyond
        for j in range(m if new == s else 0):
            lines[new, 0, j], lines[new, 1, j] = lines[s + 1, 0, j], lines[s + 1, 1, j]
        s = new
        size[s], taken[s] = m, far
    return s


@inner
def _no_gap(
    u: Floats, v: Floats, high: Bools, n: int, band: float, limit: Floats, lines: Floats,
    size: Steps, s: int, value: Floats,
) -> int:  # fmt: skip
    """Drops lines so far off the high points that some would lie in between; the polygon left.

    Of points strewn at random none lies in an area where GAP are expected with a chance of
    exp(-GAP). Low points may be missing in the LiDAR's own shadow, high ones not.
    """
    at = 0.5 * (limit[1] - limit[0])
    m = size[s]
    top = -np.inf
    k = 0
    for j in range(m):
        here = lines[s, 0, j] + lines[s, 1, j] * at
        if here > top:
            top, k = here, j
    a, b = lines[s, 0, k], lines[s, 1, k]
    first, last = np.inf, -np.inf
    count = 0
    for i in range(n):
        off = u[i] - a - b * v[i]
        if high[i] and -limit[0] <= v[i] <= limit[1] and off <= band:
            count += 1
            first, last = min(first, v[i]), max(last, v[i])
    if count < 3:
        return s
    at = 0.5 * (first + last)
    top = -np.inf
    for j in range(m):
        value[j] = lines[s, 0, j] + lines[s, 1, j] * at
        top = max(top, value[j])
    # GAP expected points, of count in a strip of this length and width band
    found = _clipped(lines, s, m, s + 1, value, -1.0, GAP * band / float(count) - top)
    if found < 3:
        return s
    size[s + 1] = found
    return s + 1


@inner
def line_between(
    u: Floats, v: Floats, high: Bools, n: int, extent: float, reach: float, distance: float,
    band: float, slack: float, limit: Floats, lines: Floats, size: Steps, taken: Floats,
    value: Floats, order: Steps, start: Steps,
) -> int:  # fmt: skip
    """The lines between ``n`` low and high points, as the corners (a, b) of a polygon.

    Returns its number among ``lines`` [STATES + 1, 2, CORNERS]; it has ``size`` [STATES + 1]
    corners, three at least. Points up to ``reach`` along count, ``band`` off and with ``slack`` in
    their place; ``limit`` [2] takes how far along either way the lines hold. |a| <= ``extent``.
    ``taken`` [STATES + 1], ``value`` [CORNERS], ``order`` [n], ``start`` [RINGS + 1] are room to
    work in.
    """
    for j in range(4):
        lines[0, 0, j] = extent if j == 1 or j == 2 else -extent
        lines[0, 1, j] = STEEPEST if j > 1 else -STEEPEST
    size[0], taken[0] = 4, -1.0
    limit[:] = reach
    _by_distance(v, n, reach, start, order)
    s = _feasible(u, v, high, order, n, 0, band, slack, limit, lines, size, taken, value)
    if limit[0] < reach or limit[1] < reach:
        for side in range(2):
            if limit[side] < reach:
                limit[side] = limit[side] - BACK * distance
        # as far as the points of both sides still count, nothing changes
        while s > 0 and taken[s] > min(limit[0], limit[1]):
            s -= 1
        s = _feasible(u, v, high, order, n, s, band, slack, limit, lines, size, taken, value)
    return _no_gap(u, v, high, n, distance, limit, lines, size, s, value)
