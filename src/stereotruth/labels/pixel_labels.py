"""Labels of the visible facets, and of the points that pixels have themselves.

Points are added up pixel by pixel while they are read (:class:`OwnPoints`), against the facet that
the pixel's centre sees, so that none of them is kept. Where a pixel's points on this facet are the
surer ones, they are the label: a plane through the means of its points and those of its neighbours
on the same surface takes the disparity at the centre. No bias by the largest of several noisy
heights, by slopes, or by mixture where a roof's edge and the ground share a pixel.

Sums are of whole numbers, so that the order of the points does not count; what is computed from
neighbours takes them in a fixed order.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Bytes, Floats, Ints
from ..core.numerics.windows import box_max
from ..core.status import Status
from ..epipolar.window_sums import SURFACE_PX
from ..lidar.lattice import PER_M
from ..surface.raster import (
    FACET_IN_RIGHT,
    NO_FACET,
    PRISM_IN_LEFT,
    PRISM_IN_RIGHT,
    VISIBLE,
    SeenSurface,
)
from ..surface.scale import FACET_RESIDUAL_PX, HEIGHT_NOISE_M, PRIOR_NOISE_M
from .pair_window import USABLE, Labels, PairWindow, WindowLabels, merged_status
from .view_geometry import PixelScale
from .window_points import PointBlock

BITS = 16
PX = 1 << BITS  # steps per px
FEW = 3  # degrees of freedom below which the points' own spread says nothing
RIDGE = 0.1  # px², keeps planes through positions in a line level across it
# Points farther apart than this, px, show what lies lower between them.
SEEN_THROUGH_PX = 1.25
# What is added up of a pixel's points. Of those on its surface: their number; sums and products of
# their steps from the centre along x and y and above the surface; height (lattice steps) and class
# of the highest in one number. Then the number of all in both frames, and of those below.
COUNT, X, Y, Z, XX, XY, YY, XZ, YZ, ZZ, TOP, IN_FRAMES, LOWER = range(13)
NO_TOP = -(1 << 62)


class _Frames(NamedTuple):
    """A window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``, without its
    ``margin`` of px; pixels of both patches that are ``usable``, and the pixel at the ``origin`` of
    each patch."""

    shape: tuple[int, int]
    first: tuple[int, int]
    margin: int
    left: Bytes
    right: Bytes
    left_origin: tuple[int, int]
    right_origin: tuple[int, int]


@kernel
def _add(block: PointBlock, frames: _Frames, level: Floats, slope: Floats, sums: Ints) -> int:
    """Adds points to the ``sums`` [pixels, 13]; returns how many lie in the window, without its
    margin, and not in both frames.

    On the surface lies what is within SURFACE_PX of the disparity ``level`` [pixels] and ``slope``
    [2, pixels] at the pixel's centre; everything, where this is NaN.
    """
    h_q, surface_class, xy = block.h_q, block.surface_class, block.xy
    (rows, cols), first, margin = frames.shape, frames.first, frames.margin
    left, right = frames.left, frames.right
    left_origin, right_origin = frames.left_origin, frames.right_origin
    half, outside = PX // 2, 0
    low_x, low_y = first[1] - 1.0, first[0] - 1.0
    high_x, high_y = float(first[1] + cols), float(first[0] + rows)
    for k in range(h_q.size):
        x, y, x_right, y_right = xy[0, k], xy[1, k], xy[2, k], xy[3, k]
        if not (low_x < x < high_x and low_y < y < high_y and np.isfinite(x_right)):
            continue
        u, v = np.int64(np.rint(x * PX)), np.int64(np.rint(y * PX))
        col, row = (u + half) >> BITS, (v + half) >> BITS
        i, j = col - first[1], row - first[0]
        if i < 0 or j < 0 or i >= cols or j >= rows:
            continue
        # The test is of the places as rounded: what is read later lies in the frame.
        u_right = np.int64(np.rint(x_right * PX))
        shift = min(max(np.int64(np.rint(y_right * PX)) - v, -half), half - 1)
        # In line: as a function that takes arrays, it took 20 of 29 ns.
        c, r = (u >> BITS) - left_origin[1], (v >> BITS) - left_origin[0]
        d, q = (u_right >> BITS) - right_origin[1], (v + shift >> BITS) - right_origin[0]
        framed = 0 <= r < left.shape[0] and 0 <= c < left.shape[1]
        framed = framed and 0 <= q < right.shape[0] and 0 <= d < right.shape[1]
        if framed:
            in_left, in_right = left[np.uint64(r), np.uint64(c)], right[np.uint64(q), np.uint64(d)]
            framed = in_left & in_right == USABLE
        if not framed:
            is_inner = margin <= j < rows - margin and margin <= i < cols - margin
            outside += np.int64(is_inner)
            continue
        p = j * cols + i
        top = (np.int64(h_q[k]) << 8) | np.int64(surface_class[k])
        sums[p, IN_FRAMES] += 1
        if np.isnan(level[p]):
            sums[p, COUNT] += 1
            sums[p, TOP] = max(sums[p, TOP], top)
            continue
        disparity = float(u - u_right)
        u, v = u - (col << BITS), v - (row << BITS)
        lift = np.rint(disparity - level[p] * PX - slope[0, p] * u - slope[1, p] * v)
        if abs(lift) <= SURFACE_PX * PX:
            z = np.int64(lift)
            sums[p, COUNT] += 1
            sums[p, X] += u
            sums[p, Y] += v
            sums[p, Z] += z
            sums[p, XX] += u * u
            sums[p, XY] += u * v
            sums[p, YY] += v * v
            sums[p, XZ] += u * z
            sums[p, YZ] += v * z
            sums[p, ZZ] += z * z
            sums[p, TOP] = max(sums[p, TOP], top)
        elif lift < 0.0:
            sums[p, LOWER] += 1
    return outside


@kernel
def _means(sums: Ints, least: int, valid: Bools, means: Floats) -> None:
    """Of pixels with ``least`` points on a surface: ``means`` [3, pixels], px from the centre along
    x and y and above the surface; others are not ``valid``."""
    for p in range(valid.size):
        n = sums[p, COUNT]
        valid[p] &= n >= least
        if valid[p]:
            for m in range(3):
                means[m, p] = sums[p, X + m] / n / PX


@kernel
def _residual_squares(sums: Ints, off: Floats, wanted: Bools, squares: Floats) -> None:
    """Sums of squares (px²) of the points of the ``wanted`` pixels about a plane through their
    mean, whose slope is ``off`` [2, pixels] that of the surface; 0 of others."""
    square = float(PX) * PX
    for p in range(wanted.size):
        squares[p] = 0.0
        if not wanted[p]:
            continue
        n, x, y, z = sums[p, COUNT], float(sums[p, X]), float(sums[p, Y]), float(sums[p, Z])
        gx, gy = off[0, p], off[1, p]
        rest = sums[p, ZZ] - z * z / n
        rest -= 2.0 * (gx * (sums[p, XZ] - x * z / n) + gy * (sums[p, YZ] - y * z / n))
        rest += gx * gx * (sums[p, XX] - x * x / n) + gy * gy * (sums[p, YY] - y * y / n)
        rest += 2.0 * gx * gy * (sums[p, XY] - x * y / n)
        squares[p] = max(rest, 0.0) / square


@kernel
def _noise(
    count: Ints, squares: Floats, valid: Bools, few: float, least: float, out: Floats
) -> None:
    """Variances (px²) of single points over 3 x 3 pixels, added in one order; NaN where not
    ``valid``. ``few``: where too few points say it; ``least``: of all."""
    rows, cols = valid.shape
    for j in range(rows):
        for i in range(cols):
            out[j, i] = np.nan
            if not valid[j, i]:
                continue
            total = n = 0.0
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                for a in range(max(i - 1, 0), min(i + 2, cols)):
                    if valid[b, a]:
                        total += squares[b, a]
                        n += count[b, a] - 1
            out[j, i] = max(total / n if n >= FEW else few, least)


def noise_variance(count: Ints, squares: Floats, valid: Bools, px_per_m: float) -> Floats:
    """Variance (px²) of a point's disparity about its surface [h, w], pooled over 3 x 3 pixels;
    ``squares`` (px²): sums over the points of a pixel about its mean."""
    out = np.empty(valid.shape)
    floors = (PRIOR_NOISE_M * px_per_m) ** 2, (HEIGHT_NOISE_M * px_per_m) ** 2
    _noise(count, squares, valid, *floors, out)
    return out


@kernel
def _planes(
    means: Floats, level: Floats, slopes: Floats, valid: Bools, wanted: Bools, label: Floats,
    slope: Floats, spread: Floats,
) -> None:  # fmt: skip
    """Labels at the centres of the ``wanted`` pixels [h, w] by planes through the means of points
    up to 1 px around that lie on one surface; ``spread``: variance (px²) that the slopes'
    uncertainty brings. With fewer than four neighbours the slope is that of the facet."""
    rows, cols = valid.shape
    for j in range(rows):
        for i in range(cols):
            if not wanted[j, i]:
                continue
            x, y = means[0, j, i], means[1, j, i]
            here = level[j, i] + means[2, j, i] + slopes[0, j, i] * x + slopes[1, j, i] * y
            n = 0
            su = sv = sz = suu = suv = svv = suz = svz = szz = 0.0
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                for a in range(max(i - 1, 0), min(i + 2, cols)):
                    if not valid[b, a]:
                        continue
                    u, v = means[0, b, a], means[1, b, a]
                    z = level[b, a] + means[2, b, a] + slopes[0, b, a] * u + slopes[1, b, a] * v
                    z -= here
                    if abs(z) <= SURFACE_PX:
                        u, v = u + (a - i) - x, v + (b - j) - y
                        n += 1
                        su += u
                        sv += v
                        sz += z
                        suu += u * u
                        suv += u * v
                        svv += v * v
                        suz += u * z
                        svz += v * z
                        szz += z * z
            if n < 5:
                label[j, i] = level[j, i] + means[2, j, i]
                continue
            suu += RIDGE - su * su / n
            svv += RIDGE - sv * sv / n
            suv -= su * sv / n
            suz -= su * sz / n
            svz -= sv * sz / n
            szz -= sz * sz / n
            det = suu * svv - suv * suv
            gx = (suz * svv - svz * suv) / det
            gy = (svz * suu - suz * suv) / det
            label[j, i] = here - gx * x - gy * y
            slope[0, j, i], slope[1, j, i] = gx, gy
            rest = max(szz - gx * suz - gy * svz, 0.0) / (n - 3)
            spread[j, i] = rest * (x * x * svv - 2.0 * x * y * suv + y * y * suu) / det


@dataclass(frozen=True, eq=False)
class OwnPoints:
    """The points of each pixel on the surface that its centre sees, arrays [h, w]: their ``count``,
    height of the ``highest`` (m, NaN for none) and its ``surface_class`` (ASPRS)."""

    count: Ints
    highest: Floats
    surface_class: Bytes


@dataclass(frozen=True, eq=False)
class OwnLabels:
    """What each pixel's own points say, arrays [h, w].

    ``lift`` (px) of their mean above the surface that the centre sees, NaN for none; ``labels`` at
    the centres, where they can be surer than the surface, and whether they are (``surer``);
    ``points`` that they follow from; ``passed``: two points
    or more, all lower than the surface; ``in_frames``: number of points in both frames; ``outside``
    (one number): points of the window, without its margin, that are not in both.
    """

    lift: Floats
    labels: Labels
    surer: Bools
    points: OwnPoints
    passed: Bools
    in_frames: Ints
    outside: int


def own_labels(
    blocks: Iterable[PointBlock],
    window: PairWindow,
    seen: SeenSurface,
    px_per_m: float,
    min_points: int,
) -> OwnLabels:
    """What the points of a window, by ``blocks``, say beside the surface that is ``seen`` in it.

    A pixel of fewer than ``min_points`` has no label of them. ``px_per_m``: disparity of a metre of
    height.
    """
    shape = window.shape
    level = np.where(seen.visibility == PRISM_IN_LEFT, np.nan, seen.disparity)
    slopes = np.ascontiguousarray(seen.slope)
    sums = np.zeros((level.size, 13), np.int64)
    sums[:, TOP] = NO_TOP
    left, right = window.left, window.right
    origins = (left.row, left.col), (right.row, right.col)
    frames = _Frames(shape, window.first, window.margin, left.usable, right.usable, *origins)
    outside = sum(
        _add(block, frames, level.reshape(-1), slopes.reshape(2, -1), sums) for block in blocks
    )
    count, in_frames = (sums[:, column].reshape(shape) for column in (COUNT, IN_FRAMES))
    valid, means = np.isfinite(level), np.full((3, *shape), np.nan)
    _means(sums, min_points, valid.reshape(-1), means.reshape(3, -1))
    # only where these points can win, and beside it, where noise is taken from
    least = (HEIGHT_NOISE_M * px_per_m) ** 2 / np.maximum(count, 1)
    surer = valid & (seen.visibility == VISIBLE) & ~seen.bulging & (least <= seen.variance)
    wanted = valid & box_max(surer, 1)
    label, slope, squares = np.full(shape, np.nan), slopes.copy(), np.empty(shape)
    spread = np.zeros(shape)
    _planes(means, level, slopes, valid, wanted, label, slope, spread)
    off = (slope - slopes).reshape(2, -1)
    _residual_squares(sums, off, wanted.reshape(-1), squares.reshape(-1))
    noise = noise_variance(count, squares, wanted, px_per_m)
    variance = noise / np.maximum(count, 1) + spread
    with np.errstate(invalid="ignore"):
        surer &= variance <= seen.variance
        lift = np.where(wanted, label - level, means[2])
    top = sums[:, TOP].reshape(shape)
    points = OwnPoints(
        count.copy(),
        np.where(top != NO_TOP, (top >> 8) / PER_M, np.nan),
        np.where(top != NO_TOP, top & 255, 0).astype(np.uint8),
    )
    passed = (in_frames > 1) & (sums[:, LOWER].reshape(shape) == in_frames)
    return OwnLabels(
        lift, Labels(label, slope, variance), surer, points, passed, in_frames.copy(), outside
    )


def facet_labels(
    seen: SeenSurface, own: OwnLabels, window: PairWindow, scale: PixelScale, edge_margin_px: float
) -> WindowLabels:
    """Labels of a window by its facets, and by each pixel's ``own`` points where these agree.

    Pixels whose own points lie on the facet that their centre sees count as measured, and keep the
    label of these points if it is the surer one (one point is less than three around it, and no
    plane bulges). An edge is in a pixel whose points lie on another surface, or have all passed
    through the facet. Only where points are so sparse that others show through between them those
    that are lower say nothing, as the ground that a tower leans over. Nor has a pixel a label whose
    centre lies nearer than ``edge_margin_px`` to the edge of its surface.
    """
    is_dense = scale.spacing_px <= SEEN_THROUGH_PX
    with np.errstate(invalid="ignore"):
        measured = np.abs(own.lift) <= FACET_RESIDUAL_PX
        edge = own.lift > FACET_RESIDUAL_PX
        edge |= is_dense & (own.passed | (own.lift < -FACET_RESIDUAL_PX))
    if edge_margin_px > 0.0:
        projected = seen.projected
        all_of_it = projected.surface.facet, slice(None)
        edge |= projected.near_edge(seen.disparity, seen.slope, edge_margin_px, *all_of_it)
    visible, none = seen.visibility == VISIBLE, seen.visibility == NO_FACET
    inside, masked = window.usable(visible, seen.disparity)
    unknown = (seen.visibility == PRISM_IN_LEFT) | (seen.visibility == PRISM_IN_RIGHT)
    status = merged_status(
        {
            Status.MASKED: masked,
            Status.OUT_OF_FRAME: visible & ~inside,
            Status.HIDDEN_IN_RIGHT: seen.visibility == FACET_IN_RIGHT,
            Status.EDGE_IN_PIXEL: unknown | visible & edge | none & (own.in_frames > 0),
            Status.LABELLED: visible & measured,
            Status.LABELLED_BETWEEN: visible,
        }
    )
    measured = status == Status.LABELLED
    surer = measured & own.surer
    facets = np.where(measured | (status == Status.LABELLED_BETWEEN), seen.disparity, np.nan)
    points = own.points
    return WindowLabels(
        status=status,
        labels=Labels(
            np.where(surer, own.labels.disparity, facets),
            np.where(surer, own.labels.slope, seen.slope),
            np.where(surer, own.labels.variance, seen.variance),
        ),
        height=np.where(measured, points.highest, seen.height),
        surface_class=np.where(measured, points.surface_class, seen.surface_class),
        day=seen.day,
        point_count=np.where(measured, points.count, 0),
    )
