"""All lines that part the low from the high points around a step.

A line is u = a + b v, ``u`` across the step, ``v`` along it. Each point bounds (a, b) by one linear
constraint: the lines that fit are a convex polygon, found by clipping. It serves
:mod:`.outlines`; lengths are in any unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

BACK = 1.5  # mean distances before a corner: the last points are left out, they may lie beyond it
GAP = 4.6  # points expected in an area that is empty with a chance of 1 %
STEEPEST = 1.2  # slope of an edge against its first guess
CORNERS = 24  # of the polygon of feasible lines at most


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


@inner
def _feasible(
    u: Floats, v: Floats, high: Bools, order: Ints, n: int, extent: float, band: float,
    slack: float, limit: Floats, polygon: Floats, spare: Floats,
) -> int:  # fmt: skip
    """The lines u = a + b v with low points at smaller and high ones at greater u.

    Points are taken by growing |v| to both sides, up to ``limit`` [2] (v < 0, v >= 0). The first
    that no line fits ends its side there: ``limit`` is set to its |v|. Returns the number of
    corners of ``polygon`` [2, :].
    """
    m = 4
    polygon[0, :4] = (-extent, extent, extent, -extent)
    polygon[1, :4] = (-STEEPEST, -STEEPEST, STEEPEST, STEEPEST)
    least_a, most_a, least_b, most_b = -extent, extent, -STEEPEST, STEEPEST
    for k in range(n):
        i = order[k]
        side = 1 if v[i] >= 0.0 else 0
        if abs(v[i]) > limit[side]:
            continue
        # most points are far from all lines that are left
        if high[i]:
            if most_a + max(least_b * v[i], most_b * v[i]) <= u[i] + slack:
                continue
        elif least_a + min(least_b * v[i], most_b * v[i]) >= u[i] - slack:
            continue
        low, top = np.inf, -np.inf
        for j in range(m):
            at = polygon[0, j] + polygon[1, j] * v[i]
            low, top = min(low, at), max(top, at)
        if u[i] < low - band or u[i] > top + band:
            continue
        if high[i]:  # a + b v <= u + slack
            if top <= u[i] + slack:
                continue
            found = clip(polygon[0], polygon[1], m, 1.0, v[i], u[i] + slack, spare[0], spare[1])
        else:
            if low >= u[i] - slack:
                continue
            found = clip(polygon[0], polygon[1], m, -1.0, -v[i], slack - u[i], spare[0], spare[1])
        if found < 3:
            limit[side] = abs(v[i])
            continue
        m = min(found, CORNERS - 4)
        least_a, most_a, least_b, most_b = np.inf, -np.inf, np.inf, -np.inf
        for j in range(m):  # a slice would be copied twice
            polygon[0, j], polygon[1, j] = spare[0, j], spare[1, j]
            least_a, most_a = min(least_a, spare[0, j]), max(most_a, spare[0, j])
            least_b, most_b = min(least_b, spare[1, j]), max(most_b, spare[1, j])
    return m


@inner
def _no_gap(
    u: Floats, v: Floats, high: Bools, n: int, band: float, limit: Floats, polygon: Floats, m: int,
    spare: Floats,
) -> int:  # fmt: skip
    """Drops lines so far off the high points that some would lie in between; corners left.

    Of points strewn at random none lies in an area where GAP are expected with a chance of
    exp(-GAP). Low points may be missing in the LiDAR's own shadow, high ones not.
    """
    at = 0.5 * (limit[1] - limit[0])
    top = -np.inf
    k = 0
    for j in range(m):
        here = polygon[0, j] + polygon[1, j] * at
        if here > top:
            top, k = here, j
    first, last = np.inf, -np.inf
    count = 0
    for i in range(n):
        off = u[i] - polygon[0, k] - polygon[1, k] * v[i]
        if high[i] and -limit[0] <= v[i] <= limit[1] and off <= band:
            count += 1
            first, last = min(first, v[i]), max(last, v[i])
    if count < 3:
        return m
    at = 0.5 * (first + last)
    top = -np.inf
    for j in range(m):
        top = max(top, polygon[0, j] + polygon[1, j] * at)
    # GAP expected points, of count in a strip of this length and width band
    found = clip(
        polygon[0], polygon[1], m, -1.0, -at, GAP * band / float(count) - top, spare[0], spare[1]
    )
    if found < 3:
        return m
    for j in range(found):
        polygon[0, j], polygon[1, j] = spare[0, j], spare[1, j]
    return found


@inner
def line_between(
    u: Floats, v: Floats, high: Bools, n: int, extent: float, reach: float, distance: float,
    band: float, slack: float, limit: Floats, polygon: Floats,
) -> int:  # fmt: skip
    """The lines between ``n`` low and high points, as the corners (a, b) of a polygon.

    ``polygon`` [4, CORNERS] takes them in its first two rows; returns their number, less than 3 if
    no line fits. Points up to ``reach`` along count, ``band`` off and with ``slack`` in their
    place; ``limit`` [2] takes how far along either way the lines hold. |a| <= ``extent``.
    """
    order = np.argsort(np.abs(v[:n]))
    limit[:] = reach
    lines, spare = polygon[:2], polygon[2:]
    found = _feasible(u, v, high, order, n, extent, band, slack, limit, lines, spare)
    if limit[0] < reach or limit[1] < reach:
        for side in range(2):
            if limit[side] < reach:
                limit[side] = limit[side] - BACK * distance
        found = _feasible(u, v, high, order, n, extent, band, slack, limit, lines, spare)
        if found < 3:
            return found
    return _no_gap(u, v, high, n, distance, limit, lines, found, spare)
