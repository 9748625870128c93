"""The points of each pixel condensed to one, and labels at the pixels' centres from it.

A pixel's points are condensed to one (:func:`condense`), whose position a recipe decides. With the
recipe surface it is the mean of the points on the facet that the pixel's centre sees. The mean
lies beside the centre; a plane through the means of the pixel and those of its neighbours on the
same surface takes the disparity there (:func:`at_centres`). No bias by the largest of several noisy
heights, by slopes, or by mixture where a roof's edge and the ground share a pixel.

Sums are of integers, so that the order of the points does not count; what is computed from
neighbours takes them in a fixed order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.status import Status, is_labelled
from ..epipolar.window_sums import SURFACE_PX
from ..lidar.lattice import PER_M
from ..lidar.smooth_maps import LocalProjection
from ..surface.raster import PRISM_IN_LEFT, VISIBLE, SeenSurface
from ..surface.scale import FACET_RESIDUAL_PX, HEIGHT_NOISE_M, PRIOR_NOISE_M
from .pair_window import PairWindow, WindowLabels
from .view_geometry import PixelScale
from .window_points import PX, PixelPoints

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Records = NDArray[np.void]


FEW = 3  # degrees of freedom below which the points' own spread says nothing
RIDGE = 0.1  # px², keeps planes through positions in a line level across it


@dataclass(frozen=True, eq=False)
class Pixels:
    """The point that stands for each pixel; arrays [h, w], NaN (0) where a pixel has none.

    ``count`` of the points used; ``x``, ``y`` (px, left grid) and ``disparity`` (px) of the point
    that stands for the pixel; ``highest`` (m); ``correlation`` mean of the points';
    ``surface_class`` ASPRS class of the highest point, ``day`` number of its day among those of the
    scene's points, 0 for not known; ``moments`` [h, w, 6]: sums over the points, about their mean,
    of uu, uv, vv, uz, vz, zz, with (u, v) the position in the left grid and z the disparity, px².
    """

    count: NDArray[np.int64]
    x: Floats
    y: Floats
    disparity: Floats
    highest: Floats
    correlation: Floats
    surface_class: NDArray[np.uint8]
    day: NDArray[np.uint8]
    moments: Floats


@kernel
def _collect(
    points: Records,
    start: Ints,
    use: Bools,
    origin: tuple[int, int],
    correlation: NDArray[np.float32],
    sums: Ints,
    highest: Floats,
    attributes: NDArray[np.uint8],
    mean_correlation: Floats,
    moments: Floats,
) -> None:
    """Per pixel from its points in ``use``; sums of products are of steps about the pixel's
    centre. ``attributes`` [2, pixels]: class and day of the highest point, of several the greater
    class, then the later day."""
    square = float(PX) * PX
    for p in range(start.size - 1):
        n = lon = lat = height = 0
        top = np.int32(-(1 << 31))
        top_class = top_day = np.uint8(0)
        least = np.int32((1 << 31) - 1)
        for k in range(start[p], start[p + 1]):
            if not use[k]:
                continue
            point = points[k]
            n += 1
            lon += point.lon
            lat += point.lat
            height += point.height
            least = min(least, point.disparity)
            now = point.height, point.surface_class, point.day
            if now > (top, top_class, top_day):
                top, top_class, top_day = now
        sums[p, 0], sums[p, 3] = n, height
        sums[p, 1], sums[p, 2] = lon + n * origin[0], lat + n * origin[1]
        attributes[0, p], attributes[1, p] = top_class, top_day
        highest[p] = top / PER_M if n else np.nan
        mean_correlation[p] = np.nan
        moments[p] = 0.0
        if n == 0:
            continue
        su = sv = sz = suu = suv = svv = suz = svz = szz = together = 0
        for k in range(start[p], start[p + 1]):
            if not use[k]:
                continue
            u, v = np.int64(points[k].u), np.int64(points[k].v)
            z = np.int64(points[k].disparity) - least
            su += u
            sv += v
            sz += z
            suu += u * u
            suv += u * v
            svv += v * v
            suz += u * z
            svz += v * z
            szz += z * z
            if correlation.size:
                together += np.int64(np.rint(np.float64(correlation[k]) * PX))
        if correlation.size:
            mean_correlation[p] = together / n / PX
        u, v, z = float(su), float(sv), float(sz)
        moments[p, 0] = (suu - u * u / n) / square
        moments[p, 1] = (suv - u * v / n) / square
        moments[p, 2] = (svv - v * v / n) / square
        moments[p, 3] = (suz - u * z / n) / square
        moments[p, 4] = (svz - v * z / n) / square
        moments[p, 5] = (szz - z * z / n) / square


def condense(
    window: PixelPoints,
    use: Bools,
    position_at: Callable[[Ints, Floats], Floats],
    correlation: NDArray[np.float32] | None = None,
) -> Pixels:
    """The pixels of a window from its points in ``use`` [n].

    ``position_at`` (sums, highest) gives the positions [4, pixels] (px, of the left image, then of
    the right one) of the point that stands for each pixel, NaN where it has none: from ``sums``
    int64[pixels, 4], number of points and sums of their longitudes, latitudes and heights (lattice
    steps), and ``highest`` (m). ``correlation`` [n] of the points or None.
    """
    size, shape = window.start.size - 1, window.shape
    sums = np.empty((size, 4), dtype=np.int64)
    highest, mean, moments = np.empty(size), np.empty(size), np.empty((size, 6))
    attributes = np.empty((2, size), dtype=np.uint8)
    _collect(
        window.points,
        window.start,
        use,
        window.origin,
        np.empty(0, dtype=np.float32) if correlation is None else correlation,
        sums,
        highest,
        attributes,
        mean,
        moments,
    )
    xy = position_at(sums, highest)
    return Pixels(
        count=sums[:, 0].reshape(shape),
        x=xy[0].reshape(shape),
        y=xy[1].reshape(shape),
        disparity=(xy[0] - xy[2]).reshape(shape),
        highest=highest.reshape(shape),
        correlation=mean.reshape(shape),
        surface_class=attributes[0].reshape(shape),
        day=attributes[1].reshape(shape),
        moments=moments.reshape(*shape, 6),
    )


@dataclass(frozen=True, eq=False)
class Labels:
    """Disparities (px) at the centres of pixels, arrays [h, w], NaN where there is none.

    ``slope`` [2, h, w]: of the disparity along x and y; ``variance`` (px²) of the disparity from
    the points alone.
    """

    disparity: Floats
    slope: Floats
    variance: Floats


@kernel
def _plane(
    disparity: Floats,
    x: Floats,
    y: Floats,
    first_row: int,
    first_col: int,
    label: Floats,
    slope: Floats,
    spread: Floats,
) -> None:
    """``spread``: variance (px²) that the slopes' uncertainty brings to the label."""
    rows, cols = disparity.shape
    for j in range(rows):
        for i in range(cols):
            here = disparity[j, i]
            label[j, i] = here
            if not np.isfinite(here):
                continue
            n = 0
            su = sv = sz = suu = suv = svv = suz = svz = szz = 0.0
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                for a in range(max(i - 1, 0), min(i + 2, cols)):
                    z = disparity[b, a] - here
                    if abs(z) <= SURFACE_PX:  # also false for NaN
                        u, v = x[b, a] - x[j, i], y[b, a] - y[j, i]
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
            u, v = first_col + i - x[j, i], first_row + j - y[j, i]
            label[j, i] = here + gx * u + gy * v
            slope[0, j, i] = gx
            slope[1, j, i] = gy
            rest = max(szz - gx * suz - gy * svz, 0.0) / (n - 3)
            spread[j, i] = rest * (u * u * svv - 2.0 * u * v * suv + v * v * suu) / det


def at_centres(pixels: Pixels, valid: Bools, first: tuple[int, int], px_per_m: float) -> Labels:
    """Labels of the ``valid`` pixels of a window whose first pixel is (row, col) ``first``.

    Pixels with fewer than four neighbours on their surface keep the disparity of their point. The
    outermost ring of pixels lacks neighbours. ``px_per_m``: disparity of a metre of height.
    """
    disparity = np.where(valid, pixels.disparity, np.nan)
    label = np.empty(disparity.shape)
    slope, spread = np.zeros((2, *disparity.shape)), np.zeros(disparity.shape)
    _plane(disparity, pixels.x, pixels.y, *first, label, slope, spread)
    noise = noise_variance(pixels, valid, slope, px_per_m)
    return Labels(label, slope, noise / np.maximum(pixels.count, 1) + spread)


@kernel
def _residual_squares(
    moments: Floats, count: Ints, valid: Bools, slope: Floats, squares: Floats, freedom: Floats
) -> None:
    """Sums of squares about the surface's slope, and degrees of freedom; 0 where not ``valid``."""
    for j in range(valid.shape[0]):
        for i in range(valid.shape[1]):
            squares[j, i] = freedom[j, i] = 0.0
            if not valid[j, i]:
                continue
            uu, uv, vv = moments[j, i, 0], moments[j, i, 1], moments[j, i, 2]
            uz, vz, zz = moments[j, i, 3], moments[j, i, 4], moments[j, i, 5]
            gx, gy = slope[0, j, i], slope[1, j, i]
            rest = zz - 2.0 * (gx * uz + gy * vz)
            rest = rest + gx * gx * uu + 2.0 * gx * gy * uv + gy * gy * vv
            squares[j, i] = max(rest, 0.0)
            freedom[j, i] = count[j, i] - 1.0


@kernel
def _pooled(
    squares: Floats, freedom: Floats, valid: Bools, few: float, least: float, out: Floats
) -> None:
    """Variances over 3 x 3 pixels, added in one order; NaN where not ``valid``."""
    rows, cols = valid.shape
    for j in range(rows):
        for i in range(cols):
            out[j, i] = np.nan
            if not valid[j, i]:
                continue
            total = n = 0.0
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                for a in range(max(i - 1, 0), min(i + 2, cols)):
                    total += squares[b, a]
                    n += freedom[b, a]
            out[j, i] = max(total / n if n >= FEW else few, least)


def noise_variance(pixels: Pixels, valid: Bools, slope: Floats, px_per_m: float) -> Floats:
    """Variance (px²) of a point's disparity about its surface, pooled over 3 x 3 pixels."""
    squares, freedom, out = (np.empty(valid.shape) for _ in range(3))
    _residual_squares(pixels.moments, pixels.count, valid, slope, squares, freedom)
    floors = (PRIOR_NOISE_M * px_per_m) ** 2, (HEIGHT_NOISE_M * px_per_m) ** 2
    _pooled(squares, freedom, valid, *floors, out)
    return out


@dataclass(frozen=True, eq=False)
class OwnPoints:
    """The points of each pixel on the surface that its centre sees, arrays [h, w]: their ``count``,
    height of the ``highest`` (m, NaN for none) and its ``surface_class`` (ASPRS)."""

    count: NDArray[np.int64]
    highest: Floats
    surface_class: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class OwnLabels:
    """What each pixel's own points say, arrays [h, w]: ``labels`` at the centres, and ``points``
    that they follow from; ``passed``: two points or more, all lower than the surface that the
    centre sees; ``in_frames``: number of points in both frames."""

    labels: Labels
    points: OwnPoints
    passed: Bools
    in_frames: NDArray[np.int32]


@kernel
def _on_surface(
    points: Records, start: Ints, disparity: Floats, slope: Floats, use: Bools, passed: Bools
) -> None:
    """Which points [n] lie within SURFACE_PX of a surface of the ``disparity`` and ``slope`` at
    their pixel's centre, by pixel; where the disparity is NaN, of the pixel's highest point.

    ``passed`` [pixels]: two points or more, all of them lower than the surface.
    """
    for p in range(start.size - 1):
        z, gx, gy = disparity[p], slope[0, p], slope[1, p]
        if np.isnan(z):
            z, gx, gy = -np.inf, 0.0, 0.0
            for k in range(start[p], start[p + 1]):
                z = max(z, points[k].disparity / PX)
        passed[p] = start[p + 1] - start[p] > 1
        for k in range(start[p], start[p + 1]):
            point = points[k]
            lift = (point.disparity - gx * point.u - gy * point.v) / PX - z
            use[k] = abs(lift) <= SURFACE_PX
            passed[p] &= lift < -SURFACE_PX


def own_labels(
    points: PixelPoints,
    seen: SeenSurface,
    projection: LocalProjection,
    px_per_m: float,
    min_points: int,
) -> OwnLabels:
    """Labels by each pixel's points on the facet that its centre sees (recipe surface).

    A pixel of fewer than ``min_points`` has none. ``px_per_m``: disparity of a metre of height.
    """
    level = np.where(seen.visibility == PRISM_IN_LEFT, np.nan, seen.disparity).reshape(-1)
    use, passed = np.empty(points.points.size, np.bool_), np.empty(level.size, np.bool_)
    slope = np.ascontiguousarray(seen.slope).reshape(2, -1)
    _on_surface(points.points, points.start, level, slope, use, passed)
    pixels = condense(points, use, lambda sums, _: projection.at_means(sums))
    labels = at_centres(pixels, pixels.count >= min_points, points.first, px_per_m)
    # copied, so that the sums of all pixels, which the counts are a part of, are freed
    own = OwnPoints(pixels.count.copy(), pixels.highest, pixels.surface_class)
    return OwnLabels(labels, own, passed.reshape(points.shape), points.count)


# Points farther apart than this, px, show what lies lower between them.
SEEN_THROUGH_PX = 1.25
_STATUS = np.array(  # by visibility
    [
        Status.NO_POINTS,
        Status.LABELLED_BETWEEN,
        Status.EDGE_IN_PIXEL,
        Status.EDGE_IN_PIXEL,
        Status.HIDDEN_IN_RIGHT,
    ],
    dtype=np.uint8,
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
    status = _STATUS[seen.visibility]
    row, col = np.nonzero(seen.visibility == VISIBLE)
    inside, masked = window.usable(row, col, seen.disparity[row, col])
    status[row[~inside], col[~inside]] = Status.OUT_OF_FRAME
    status[row[masked], col[masked]] = Status.MASKED
    status[(status == Status.NO_POINTS) & (own.in_frames > 0)] = Status.EDGE_IN_PIXEL
    is_dense = scale.spacing_px <= SEEN_THROUGH_PX
    with np.errstate(invalid="ignore"):
        lift = own.labels.disparity - seen.disparity
        measured = np.abs(lift) <= FACET_RESIDUAL_PX
        edge = lift > FACET_RESIDUAL_PX
        edge |= is_dense & (own.passed | (lift < -FACET_RESIDUAL_PX))
        surer = measured & (own.labels.variance <= seen.variance) & ~seen.bulging
    if edge_margin_px > 0.0:
        projected = seen.projected
        all_of_it = projected.surface.facet, slice(None)
        edge |= projected.near_edge(seen.disparity, seen.slope, edge_margin_px, *all_of_it)
    between = status == Status.LABELLED_BETWEEN
    status[between & edge] = Status.EDGE_IN_PIXEL
    measured &= between & ~edge
    status[measured] = Status.LABELLED
    surer &= measured
    facets = np.where(is_labelled(status), seen.disparity, np.nan)
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
        correlation=np.full(status.shape, np.nan),
        change=np.zeros(status.shape, np.uint8),
        beyond=np.zeros(status.shape, np.uint32),
    )
