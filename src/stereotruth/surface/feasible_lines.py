"""The feasible lines of a breakline: all that part the low from the high points around.

Points are the vertices of triangles that are no facets; no others can bound a breakline. They are
found by blocks of a row of cells. Which of the two planes of the step each one lies on, says
:func:`points_of_sides`. Plan positions are in parts of a cell, heights in lattice steps.

A line is u = a + b v, ``u`` across the step, ``v`` along it. Each point is one half-plane of (a, b)
(eq. 5 of docs/explanation/surface.md): the feasible lines are a convex polygon, the intersection of
all half-planes, computed by clipping. Lengths are in any unit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from .scale import PART, PART_BITS
from .vertices import Vertices

Steps = NDArray[np.int32]

BACK = 1.5  # spacings before a corner: the last points are left out, they may lie beyond it
GAP = 4.6  # points expected in an area that is empty with a probability of 1 %
STEEPEST = 1.2  # slope of a breakline against its first direction
MOST_CORNERS = 24  # of the polygon of feasible lines
POLYGONS = 64  # that are kept while they are clipped
RINGS = 32  # by which points are sorted


BLOCK_BITS = PART_BITS + 3  # of parts of a cell: vertices of a row are found by such blocks
MOST_STEP_POINTS = 4096  # that determine a breakline, at most
INSIDE, COUNTS, HIGH = 1, 2, 4  # within reach; on a plane, for the breakline; on the high one
BEYOND_SHARE = 0.08  # with more points below the low and above the high plane, these are crowns


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


class StepPoints(NamedTuple):
    """The vertices beside height steps, in the order of their cells.

    ``vertex`` [n]: their number; ``position`` int32 [n, 4]: x, y, height, 1 where the vertex has a
    plane; ``slopes`` [n, 2] of that plane; ``first`` [rows, blocks + 1]: number of the first one in
    each block of a row of cells.
    """

    vertex: Ints
    position: Steps
    slopes: Floats
    first: Steps


class Centroid(NamedTuple):
    """Centroid of a triangle: ``x``, ``y`` of its first vertex, and offset from there."""

    x: int
    y: int
    off_x: float
    off_y: float


class Nearby(NamedTuple):
    """Numbers of :class:`StepPoints` and their offsets from a centroid."""

    which: Steps
    dx: Floats
    dy: Floats


class Around(NamedTuple):
    """Points around a centroid: offsets, height, whether there is a plane; in ``side``, what
    :func:`_tell_sides` says."""

    dx: Floats
    dy: Floats
    height: Steps
    has_plane: Bools
    side: NDArray[np.uint8]


@kernel
def _fill_blocks(x: Ints, y: Ints, vertex: Ints, first: Steps) -> None:
    """Number of the first vertex of each block, see :class:`StepPoints`."""
    rows, blocks = first.shape[0], first.shape[1] - 1
    k = 0
    for row in range(rows):
        for block in range(blocks):
            first[row, block] = k
            while (
                k < vertex.size
                and y[vertex[k]] >> PART_BITS == row
                and x[vertex[k]] >> BLOCK_BITS == block
            ):
                k += 1
        first[row, blocks] = k


def step_points(vertices: Vertices, slopes: Floats, beside_step: Bools) -> StepPoints:
    """The vertices [n] ``beside_step`` and the ``slopes`` [n, 2] of their planes, NaN for none."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    vertex = np.flatnonzero(beside_step)
    own = slopes[vertex]
    has_plane = ~np.isnan(own[:, 0])
    position = np.stack([x[vertex], y[vertex], h[vertex], has_plane], axis=1).astype(np.int32)
    blocks, rows = (int(v[vertex].max(initial=-1)) for v in (x >> BLOCK_BITS, y >> PART_BITS))
    first = np.empty((rows + 1, blocks + 2), np.int32)
    _fill_blocks(x, y, vertex, first)
    return StepPoints(vertex, position, own, first)


@inlined
def _row_of_disc(
    first: Steps, row: int, mid_x: float, mid_y: float, radius: float
) -> tuple[int, int]:
    """From which to which vertex those of a row of cells within ``radius`` of a position are."""
    south = float(row << PART_BITS)
    off = max(mid_y - south - float(PART - 1), south - mid_y, 0.0)
    half = np.sqrt(max(radius * radius - off * off, 0.0)) + 1.0
    blocks = first.shape[1] - 1
    begin = min(max(np.int64(mid_x - half) >> BLOCK_BITS, 0), blocks)
    end = max(min((np.int64(mid_x + half) >> BLOCK_BITS) + 1, blocks), begin)
    return first[row, begin], first[row, end]


@inlined
def points_within(points: StepPoints, centre: Centroid, radius: float, near: Nearby) -> int:
    """Fills ``near`` with the points within ``radius`` of a centroid; returns their number."""
    position, first = points.position, points.first
    which, dx, dy = near.which, near.dx, near.dy
    ax, ay, ox, oy = centre.x, centre.y, centre.off_x, centre.off_y
    n = 0
    mid_x, mid_y = float(ax) + ox, float(ay) + oy
    bottom = max(np.int64(mid_y - radius) >> PART_BITS, 0)
    top = min((np.int64(mid_y + radius) >> PART_BITS) + 1, first.shape[0])
    for row in range(bottom, top):
        begin, end = _row_of_disc(first, row, mid_x, mid_y, radius)
        for k in range(begin, min(end, begin + MOST_STEP_POINTS - n)):
            px, py = float(position[k, 0] - ax) - ox, float(position[k, 1] - ay) - oy
            which[n], dx[n], dy[n] = k, px, py
            n += px * px + py * py <= radius * radius
    return n


@inlined
def _on_plane(
    height: float, low: float, high: float, r2: float, spacing: float, residual: float
) -> tuple[bool, bool]:
    """Whether a point lies on one of two planes of heights ``low`` and ``high`` there, and whether
    on the high one (eq. 4 of docs/explanation/surface.md). ``r2``: squared distance from the
    centroid.

    Without branches, which the processor could not predict.
    """
    gap = high - low
    off_low, off_high = abs(height - low), abs(height - high)
    tolerance = min(residual * (1.0 + np.sqrt(r2) / (4.0 * spacing)), gap / 3.0)
    return (gap >= 2.0 * residual) & (min(off_low, off_high) <= tolerance), off_high < off_low


@inlined
def sums_of_sides(
    points: StepPoints,
    planes: Floats,
    near: Nearby,
    n: int,
    spacing: float,
    residual: float,
    sums: Floats,
) -> bool:
    """Sums over the ``n`` points ``near`` on either plane to ``sums`` [2, 5]: number, offsets,
    residuals and their squares; False if a plane has none, or too many lie beyond both.

    ``planes`` [2, 3]: low, high: height at the centroid, slopes.
    """
    position, which, dx, dy = points.position, near.which, near.dx, near.dy
    sums[:] = 0.0
    beyond = 0
    for k in range(n):
        height = float(position[which[k], 2])
        low = planes[0, 0] + planes[0, 1] * dx[k] + planes[0, 2] * dy[k]
        high = planes[1, 0] + planes[1, 1] * dx[k] + planes[1, 2] * dy[k]
        beyond += (height < low - residual) | (height > high + residual)
        r2 = dx[k] * dx[k] + dy[k] * dy[k]
        on_one, is_high = _on_plane(height, low, high, r2, spacing, residual)
        if on_one and position[which[k], 3]:
            side = np.int64(is_high)
            off = height - (high if is_high else low)
            sums[side, 0] += 1.0
            sums[side, 1] += dx[k]
            sums[side, 2] += dy[k]
            sums[side, 3] += off
            sums[side, 4] += off * off
    empty = min(sums[0, 0], sums[1, 0]) == 0.0
    return not empty and beyond <= BEYOND_SHARE * (sums[0, 0] + sums[1, 0])


@inlined
def _tell_sides(
    around: Around,
    n: int,
    planes: Floats,
    normal: tuple[float, float],
    radius: float,
    widest: float,
    spacing: float,
    residual: float,
) -> None:
    """The :data:`INSIDE`, :data:`COUNTS` and :data:`HIGH` of ``n`` points, to ``side``.

    Nothing else, so that the compiler takes several points at once.
    """
    dx, dy, height, side = around.dx, around.dy, around.height, around.side
    nx, ny = normal
    low_h, low_x, low_y = planes[0, 0], planes[0, 1], planes[0, 2]
    high_h, high_x, high_y = planes[1, 0], planes[1, 1], planes[1, 2]
    for k in range(n):
        px, py = dx[k], dy[k]
        r2 = px * px + py * py
        inside = r2 <= radius * radius
        across, along = nx * px + ny * py, nx * py - ny * px
        low, high = low_h + low_x * px + low_y * py, high_h + high_x * px + high_y * py
        on_one, on_high = _on_plane(float(height[k]), low, high, r2, spacing, residual)
        counts = inside & on_one & (across <= widest + STEEPEST * abs(along))
        side[k] = (INSIDE if inside else 0) + (COUNTS if counts else 0) + (HIGH if on_high else 0)


@inlined
def points_of_sides(
    points: StepPoints,
    centre: Centroid,
    planes: Floats,
    normal: tuple[float, float],
    radius: float,
    widest: float,
    spacing: float,
    residual: float,
    around: Around,
    sides: Sides,
) -> tuple[int, int, int]:
    """Positions of the points on either plane across and along the step, to ``sides``; their
    number; least and greatest height of all within ``radius``.

    ``normal``: unit vector across the step, to the high side. Low points that lie more than
    ``widest`` beyond the steepest lines through the centroid, and high ones there, can neither
    bound the breakline nor show a gap.
    """
    position, first = points.position, points.first
    dx, dy, height, has_plane = around.dx, around.dy, around.height, around.has_plane
    side, u, v, is_high = around.side, sides.u, sides.v, sides.is_high
    ax, ay, ox, oy = centre.x, centre.y, centre.off_x, centre.off_y
    nx, ny = normal
    m = n = 0
    least, most = np.int32(np.iinfo(np.int32).max), np.int32(np.iinfo(np.int32).min)
    mid_x, mid_y = float(ax) + ox, float(ay) + oy
    bottom = max(np.int64(mid_y - radius) >> PART_BITS, 0)
    top = min((np.int64(mid_y + radius) >> PART_BITS) + 1, first.shape[0])
    for row in range(bottom, top):
        begin, end = _row_of_disc(first, row, mid_x, mid_y, radius)
        for k in range(begin, min(end, begin + MOST_STEP_POINTS)):
            dx[n], dy[n] = float(position[k, 0] - ax) - ox, float(position[k, 1] - ay) - oy
            height[n], has_plane[n] = position[k, 2], position[k, 3] != 0
            n += 1
        if n < MOST_STEP_POINTS and row + 1 < top:
            continue
        _tell_sides(around, n, planes, normal, radius, widest, spacing, residual)
        for k in range(n):
            inside, counts = side[k] & INSIDE != 0, side[k] & COUNTS != 0
            least = min(least, height[k] if inside else least)
            most = max(most, height[k] if inside else most)
            u[m], v[m] = nx * dx[k] + ny * dy[k], nx * dy[k] - ny * dx[k]
            is_high[m] = side[k] & HIGH != 0
            m = min(m + (counts & has_plane[k]), MOST_STEP_POINTS - 1)
        n = 0
    return m, least, most
