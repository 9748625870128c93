"""The vertices on both sides of a height step: which of its two planes each one lies on.

Only vertices of triangles that are no facets can bound a breakline. They are found by blocks of a
row of cells. Plan positions are in parts of a cell, heights in lattice steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from .feasible_lines import STEEPEST, Sides
from .scale import PART, PART_BITS
from .vertices import Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

BLOCK_BITS = PART_BITS + 3  # of parts of a cell: vertices of a row are found by such blocks
MOST_STEP_POINTS = 4096  # that determine a breakline, at most
INSIDE, COUNTS, HIGH = 1, 2, 4  # within reach; on a plane, for the breakline; on the high one
BEYOND_SHARE = 0.08  # with more points below the low and above the high plane, these are crowns


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
