"""Breaklines: where in an undecided triangle the step between two surfaces lies.

A triangle across a height step has points of a low and of a high surface. Edges of buildings are
straight over many points, so that the points on both sides along an edge say much better than the
three of one triangle where it runs: of all lines that part the low from the high points around, as
far along the edge as there is such a line (a corner ends it), the feasible ones form a convex set
in (offset, slope), see :mod:`.feasible_lines`. The breakline lies within the span of this set. A
triangle is cut there (:mod:`.surface`): what lies clearly on one side belongs to that
surface's plane, the strip in between may hold any height between both.

Of the triangles in a square of two spacings the first one that is cut finds the breakline, and the
others take it where it cuts them, too, and their own vertices lie where it says: four of five
triangles along a wall would find the same.

All follows from the points up to BREAKLINE_REACH around the triangles of a square, in an order of
theirs that no window changes. No image takes part, so that labels do not favour what images show
well.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from .delaunay import Triangles
from .feasible_lines import (
    MOST_CORNERS,
    MOST_STEP_POINTS,
    POLYGONS,
    RINGS,
    Around,
    Band,
    Centroid,
    Nearby,
    Polygons,
    Sides,
    StepPoints,
    feasible_lines,
    points_of_sides,
    points_within,
    step_points,
    sums_of_sides,
)
from .scale import BREAKLINE_REACH, PART, SurfaceScale, height_steps
from .vertices import Vertices

Steps = NDArray[np.int32]
Corners = tuple[int, int, int]  # of a triangle

NEAR_SPACINGS = 3.0  # within which points determine heights and the direction of a step
BAND_SPACINGS = 2.5  # and how far off the breakline points still bound it
SLACK_CELLS = 0.12  # horizontal noise of points, in cells
MARGIN_CELLS = 0.2  # added to either side of the feasible span
SMALLEST_AREA = 0.1  # of a triangle that is worth a cut, in squares of the spacing
WIDEST_STRIP = 1.5  # half the width of a strip that still says something, in spacings


class Planed(NamedTuple):
    """Vertices [n]: plan position, height, ``slopes`` [n, 2] of their planes (NaN for none)."""

    x: Ints
    y: Ints
    h: Ints
    slopes: Floats


class Breaklines(NamedTuple):
    """Breaklines of triangles [m], and the planes on both sides.

    ``line`` [m, 4]: (p, q, r, w): places with p x + q y - r <= -w lie low, >= w high, x and y from
    the triangle's first vertex; w NaN for none. ``planes`` [m, 8]: low, high plane: height at the
    first vertex, slopes; least and greatest height around. ``variance`` [m, 2] of heights about
    both, lattice steps². ``anchor`` [m, 2]: vertices whose classes the planes have.
    """

    line: Floats
    planes: Floats
    variance: Floats
    anchor: Steps


class _Limits(NamedTuple):
    """``spacing`` of points (parts of a cell); ``residual`` of a point on a plane (lattice steps);
    ``prior`` and ``least`` variance of heights (lattice steps²)."""

    spacing: float
    residual: float
    prior: float
    least: float


@kernel
def _spread_slopes(
    vertices: Vertices, triangles: Triangles, slopes: Floats, largest: float, residual: float
) -> Floats:
    """Slopes [n, 2] at vertices; those without take the nearest neighbour's on whose plane they
    lie (eq. 2 of docs/explanation/surface.md). ``largest``: circumradius of triangles that join
    neighbours."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    corner, radius = triangles.corner, triangles.radius
    out = slopes.copy()
    nearest = np.full(x.size, np.iinfo(np.int64).max)
    for t in range(len(corner)):
        if radius[t] > largest:
            continue
        for i in range(3):
            v = corner[t, i]
            if not np.isnan(slopes[v, 0]):
                continue
            for k in range(1, 3):
                w = corner[t, (i + k) % 3]
                if np.isnan(slopes[w, 0]):
                    continue
                u, s = x[v] - x[w], y[v] - y[w]
                off = float(h[v] - h[w]) - slopes[w, 0] * float(u) - slopes[w, 1] * float(s)
                far = u * u + s * s
                if abs(off) <= residual and far < nearest[v]:
                    nearest[v] = far
                    out[v, 0], out[v, 1] = slopes[w, 0], slopes[w, 1]
    return out


@inlined
def _height_at(planed: Planed, w: int, centre: Centroid) -> float:
    """Height of the plane of vertex w at a centroid."""
    u = centre.off_x - float(planed.x[w] - centre.x)
    v = centre.off_y - float(planed.y[w] - centre.y)
    return float(planed.h[w]) + planed.slopes[w, 0] * u + planed.slopes[w, 1] * v


@inlined
def _explaining_vertex(
    planed: Planed,
    corner: Corners,
    one: int,
    one_h: float,
    centre: Centroid,
    points: StepPoints,
    near: Nearby,
    n: int,
    limits: _Limits,
) -> tuple[int, float, bool]:
    """Nearest of the ``n`` points ``near`` whose plane could explain the corners that do not lie on
    the plane of vertex ``one`` (of height ``one_h`` at the centroid).

    Returns the number of the vertex or -1, height of its plane at the centroid, whether it is the
    upper one.
    """
    x, y, h, slopes = planed.x, planed.y, planed.h, planed.slopes
    position, residual = points.position, limits.residual
    lift = 0.0
    for w in corner:
        if np.isnan(slopes[w, 0]):
            px, py = float(x[w] - centre.x) - centre.off_x, float(y[w] - centre.y) - centre.off_y
            off = float(h[w]) - one_h - slopes[one, 0] * px - slopes[one, 1] * py
            if abs(off) > abs(lift):
                lift = off
    radius = NEAR_SPACINGS * limits.spacing
    other, other_h, best = -1, 0.0, radius * radius
    if abs(lift) <= residual:
        return other, other_h, True
    least = max(abs(lift) - residual, 2.0 * residual)
    for k in range(n):
        w = near.which[k]
        dx, dy = near.dx[k], near.dy[k]
        r2 = dx * dx + dy * dy
        if not position[w, 3] or r2 >= best:
            continue
        at = float(position[w, 2]) - points.slopes[w, 0] * dx - points.slopes[w, 1] * dy
        if (at - one_h if lift > 0.0 else one_h - at) >= least:
            best, other, other_h = r2, w, at
    if other >= 0:
        other = points.vertex[other]
    return other, other_h, lift > 0.0


@inlined
def _two_planes(
    planed: Planed,
    corner: Corners,
    centre: Centroid,
    points: StepPoints,
    limits: _Limits,
    near: Nearby,
    planes: Floats,
) -> tuple[int, int, int]:
    """The vertices of the low and the high plane of a triangle, -1 if there are no two, and the
    number of points ``near`` it; fills ``planes`` [2, 3]: height at the centroid, slopes."""
    low, top, low_h, top_h, without = -1, -1, np.inf, -np.inf, False
    for w in corner:
        if np.isnan(planed.slopes[w, 0]):
            without = True
            continue
        at = _height_at(planed, w, centre)
        if at < low_h:
            low, low_h = w, at
        if at > top_h:
            top, top_h = w, at
    one_only = top_h - low_h <= 2.0 * limits.residual
    if low < 0 or (one_only and not without):
        return -1, -1, 0
    n = points_within(points, centre, NEAR_SPACINGS * limits.spacing, near)
    if one_only:
        other, other_h, is_top = _explaining_vertex(
            planed, corner, low, 0.5 * (low_h + top_h), centre, points, near, n, limits
        )
        if other < 0:
            return -1, -1, 0
        if is_top:
            top, top_h = other, other_h
        else:
            low, low_h = other, other_h
    slopes = planed.slopes
    planes[0, 0], planes[0, 1], planes[0, 2] = low_h, slopes[low, 0], slopes[low, 1]
    planes[1, 0], planes[1, 1], planes[1, 2] = top_h, slopes[top, 0], slopes[top, 1]
    return low, top, n


@inlined
def _fits_corners(
    planed: Planed,
    corner: Corners,
    centre: Centroid,
    planes: Floats,
    line: tuple[float, float, float, float],
    residual: float,
) -> bool:
    """Whether the triangle's own vertices lie where the ``line`` (p, q, r, w) and the planes
    say."""
    p, q, r, width = line
    slack = SLACK_CELLS * PART
    for w in corner:
        px, py = float(planed.x[w] - centre.x), float(planed.y[w] - centre.y)
        dx, dy, h = px - centre.off_x, py - centre.off_y, float(planed.h[w])
        s = p * px + q * py - r
        off_low = h - planes[0, 0] - planes[0, 1] * dx - planes[0, 2] * dy
        off_high = h - planes[1, 0] - planes[1, 1] * dx - planes[1, 2] * dy
        if abs(off_low) <= residual:
            good = s <= width + slack
        elif abs(off_high) <= residual:
            good = s >= -width - slack
        else:
            good = abs(s) <= width + 2.0 * slack
        if not good:
            return False
    return True


@inlined
def _mean_line(
    planed: Planed,
    corner: Corners,
    centre: Centroid,
    normal: tuple[float, float],
    polygons: Polygons,
    s: int,
) -> tuple[float, float, float, float]:
    """The line (p, q, r, w) in the middle of the feasible ones of polygon ``s``, and half the width
    of the strip over the triangle that holds all of them (eq. 6 of docs/explanation/surface.md)."""
    lines, number = polygons.corner, polygons.size[s]
    nx, ny = normal
    mean_a = mean_b = 0.0
    for j in range(number):
        mean_a, mean_b = mean_a + lines[s, 0, j], mean_b + lines[s, 1, j]
    mean_a, mean_b = mean_a / number, mean_b / number
    norm = np.sqrt(1.0 + mean_b * mean_b)
    width = 0.0
    for w in corner:
        dx, dy = float(planed.x[w] - centre.x), float(planed.y[w] - centre.y)
        along = nx * (dy - centre.off_y) - ny * (dx - centre.off_x)
        for j in range(number):
            off = lines[s, 0, j] - mean_a + (lines[s, 1, j] - mean_b) * along
            width = max(width, abs(off) / norm)
    width += MARGIN_CELLS * PART
    # (u - a - b v) / norm, in x and y from the first vertex
    p, q = (nx + mean_b * ny) / norm, (ny - mean_b * nx) / norm
    return p, q, mean_a / norm + p * centre.off_x + q * centre.off_y, width


@inlined
def _cuts(
    planed: Planed, corner: Corners, centre: Centroid, line: tuple[float, float, float, float]
) -> bool:
    """Whether vertices of a triangle lie to both sides of a ``line`` (p, q, r, w)."""
    low, high = np.inf, -np.inf
    for w in corner:
        s = line[0] * float(planed.x[w] - centre.x) + line[1] * float(planed.y[w] - centre.y)
        low, high = min(low, s - line[2]), max(high, s - line[2])
    return low < 0.0 < high


class _Shared(NamedTuple):
    """Of the triangle that has found a breakline: its ``planes`` [2, 3] at its centroid, ``sums``
    [2, 5] of the points on them, ``whole`` [4]: their vertices, least and greatest height."""

    planes: Floats
    sums: Floats
    whole: Ints


@inlined
def _keep(
    planed: Planed,
    a: int,
    centre: Centroid,
    line: tuple[float, float, float, float],
    shared: _Shared,
    limits: _Limits,
    out: Breaklines,
    t: int,
) -> None:
    """The breakline of triangle ``t``, whose first vertex is ``a``, to ``out``; ``centre``: of the
    triangle that has found it."""
    dx, dy = float(planed.x[a] - centre.x), float(planed.y[a] - centre.y)
    p, q, r, width = line
    out.line[t, 0], out.line[t, 1] = p, q
    out.line[t, 2], out.line[t, 3] = r - p * dx - q * dy, width
    for side in range(2):
        count, gx, gy = shared.sums[side, 0], shared.planes[side, 1], shared.planes[side, 2]
        level = shared.planes[side, 0] + shared.sums[side, 3] / count
        out.planes[t, 3 * side] = level - gx * (centre.off_x - dx) - gy * (centre.off_y - dy)
        out.planes[t, 3 * side + 1], out.planes[t, 3 * side + 2] = gx, gy
        variance = (shared.sums[side, 4] + limits.prior) / (count + 1.0)
        out.variance[t, side] = max(variance, limits.least)
        out.anchor[t, side] = shared.whole[side]
    out.planes[t, 6], out.planes[t, 7] = shared.whole[2], shared.whole[3]


@kernel
def _fill_breaklines(
    planed: Planed,
    corner: Steps,
    square: Ints,
    order: Ints,
    radius: Floats,
    points: StepPoints,
    limits: _Limits,
    out: Breaklines,
) -> None:
    """The breakline of each triangle [m, 3] of circumradius ``radius`` [m], to ``out`` (eq. 4 to 6
    of docs/explanation/surface.md), in an ``order`` [m] in which those of a ``square`` [m] follow
    each other."""
    # Made here, the compiler knows their shapes: a fifth of the time.
    near = Nearby(
        np.empty(MOST_STEP_POINTS, np.int32), np.empty(MOST_STEP_POINTS), np.empty(MOST_STEP_POINTS)
    )
    sides = Sides(
        np.empty(MOST_STEP_POINTS), np.empty(MOST_STEP_POINTS), np.empty(MOST_STEP_POINTS, np.bool_)
    )
    most = 2 * MOST_STEP_POINTS
    around = Around(
        np.empty(most), np.empty(most), np.empty(most, np.int32), np.empty(most, np.bool_),
        np.empty(most, np.uint8),
    )  # fmt: skip
    polygons = Polygons(
        np.empty((POLYGONS + 1, 2, MOST_CORNERS)),
        np.empty(POLYGONS + 1, np.int32),
        np.empty(POLYGONS + 1),
        np.empty(2),
        np.empty(MOST_CORNERS),
        np.empty(MOST_STEP_POINTS, np.int32),
        np.empty(MOST_STEP_POINTS),
        np.empty(RINGS + 1, np.int32),
    )
    planes, sums = np.empty((2, 3)), np.empty((2, 5))
    shared = _Shared(np.empty((2, 3)), np.empty((2, 5)), np.empty(4, np.int64))
    spacing, residual = limits.spacing, limits.residual
    reach, width = BREAKLINE_REACH * spacing, BAND_SPACINGS * spacing
    band = Band(reach, width, SLACK_CELLS * PART, spacing)
    x, y = planed.x, planed.y
    lead, normal, s = Centroid(0, 0, 0.0, 0.0), (0.0, 0.0), 0
    leads, of_square = False, square[0] if square.size else 0
    for t in order:
        out.line[t, 3] = np.nan
        a, b, c = abc = corner[t, 0], corner[t, 1], corner[t, 2]
        area = float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
        if area < 2.0 * SMALLEST_AREA * spacing * spacing:
            continue
        if leads and of_square == square[t]:
            line = _mean_line(planed, abc, lead, normal, polygons, s)
            fits = line[3] <= WIDEST_STRIP * spacing and _cuts(planed, abc, lead, line)
            if fits and _fits_corners(planed, abc, lead, shared.planes, line, residual):
                _keep(planed, a, lead, line, shared, limits, out, t)
                continue
        ox = float(x[b] - x[a] + x[c] - x[a]) / 3.0
        oy = float(y[b] - y[a] + y[c] - y[a]) / 3.0
        centre = Centroid(x[a], y[a], ox, oy)
        low, top, n = _two_planes(planed, abc, centre, points, limits, near, planes)
        if low < 0 or not sums_of_sides(points, planes, near, n, spacing, residual, sums):
            continue
        nx = sums[1, 1] / sums[1, 0] - sums[0, 1] / sums[0, 0]
        ny = sums[1, 2] / sums[1, 0] - sums[0, 2] / sums[0, 0]
        length = np.sqrt(nx * nx + ny * ny)
        if length == 0.0:
            continue
        leads = False
        lead, normal = centre, (nx / length, ny / length)
        extent = 4.0 * radius[t]
        m, least_h, most_h = points_of_sides(
            points, centre, planes, normal, reach, extent + width, spacing, residual, around, sides
        )  # fmt: skip
        s = feasible_lines(sides, m, extent, band, polygons)
        line = _mean_line(planed, abc, centre, normal, polygons, s)
        if line[3] > WIDEST_STRIP * spacing:
            continue
        if not _fits_corners(planed, abc, centre, planes, line, residual):
            continue
        leads, of_square = True, square[t]
        for side in range(2):
            for k in range(3):
                shared.planes[side, k] = planes[side, k]
            for k in range(5):
                shared.sums[side, k] = sums[side, k]
        shared.whole[0], shared.whole[1] = low, top
        shared.whole[2], shared.whole[3] = least_h, most_h
        _keep(planed, a, centre, line, shared, limits, out, t)


def breaklines(
    vertices: Vertices,
    triangles: Triangles,
    slopes: Floats,
    is_facet: Bools,
    chosen: Ints,
    scale: SurfaceScale,
    variances: tuple[float, float],
) -> Breaklines:
    """The breaklines of the ``chosen`` [m] triangles.

    ``slopes`` [n, 2] of the facets at each vertex, NaN for none; ``is_facet``: which triangles are
    facets, whose vertices beside no step bound none; ``variances``: prior and least one of heights,
    lattice steps².
    """
    residual = height_steps(scale.residual_m)
    for _ in range(2):
        slopes = _spread_slopes(vertices, triangles, slopes, scale.facet_radius, residual)
    beside_step = np.zeros(vertices.x.size, np.bool_)
    beside_step[triangles.corner[~is_facet].reshape(-1)] = True
    size = chosen.size
    out = Breaklines(
        np.empty((size, 4)), np.empty((size, 8)), np.empty((size, 2)), np.empty((size, 2), np.int32)
    )
    corner = triangles.corner[chosen]
    side_lon, side_lat = (scale.shared_cells * cell for cell in scale.cell)
    first = corner[:, 0]
    row, col = vertices.lat_q[first] // side_lat, vertices.lon_q[first] // side_lon
    square = (row << 32) + col
    _fill_breaklines(
        Planed(vertices.x, vertices.y, vertices.h_q, slopes),
        corner,
        square,
        np.argsort(square, kind="stable"),
        triangles.radius[chosen],
        step_points(vertices, slopes, beside_step),
        _Limits(scale.spacing, residual, *variances),
        out,
    )
    return out
