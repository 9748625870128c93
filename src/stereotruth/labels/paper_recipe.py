"""The paper's own way from points to labels (section III-C).

1. A point is dropped if the windows of both images around its places do not correlate
   (:func:`.paper_correlation.correlate`), whatever the reason: hidden, changed, moved.
2. A pixel's label is the disparity of one point: mean longitude and latitude of its points that
   are left, at the height of the highest.
3. A pixel with fewer than ``min_points`` of them has no label.

What the paper does not have is each label's uncertainty: the points' noise, pooled over 3 x 3
pixels, by the root of their number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import LabelSettings
from ..core.status import Status
from ..lidar.lattice import PER_DEG
from .pair_window import PairWindow, WindowLabels
from .paper_correlation import correlate
from .pixel_labels import Labels, condense, noise_variance
from .pixel_points import PixelPoints
from .view_geometry import ViewGeometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def paper_labels(
    settings: LabelSettings,
    model: ViewGeometry,
    points: PixelPoints,
    window: PairWindow,
    px_per_m: float,
    days: NDArray[np.uint16],
) -> WindowLabels:
    """Labels of a window from its points in both frames.

    ``window``: its patches are read for the settings' window. ``px_per_m``: disparity of a metre of
    height. ``days``: of the points, by their numbers.
    """

    def at_highest(sums: Ints, highest: Floats) -> Floats:
        """Positions [4, pixels] (px) of mean longitude and latitude at the greatest height."""
        xy = np.full((4, highest.size), np.nan)
        known = np.flatnonzero(sums[:, 0])
        lon, lat = (sums[known, axis] / sums[known, 0] / PER_DEG for axis in (1, 2))
        xy[:, known] = model.ground_to_epipolar(lon, lat, highest[known])
        return xy

    every = np.ones(points.points.size, dtype=np.bool_)
    correlation = correlate(points, every, window.left, window.right, settings.window)
    correlated = correlation >= settings.correlation_threshold
    pixels = condense(points, correlated, at_highest, correlation)
    labelled = pixels.count > 0
    level = np.zeros((2, *labelled.shape))
    noise = noise_variance(pixels, labelled, level, px_per_m)
    labels = Labels(
        disparity=np.where(labelled, pixels.disparity, np.nan),
        slope=level,
        variance=noise / np.maximum(pixels.count, 1),
    )
    status = np.full(points.shape, Status.NO_POINTS, dtype=np.uint8)
    status[points.outside.reshape(points.shape) > 0] = Status.OUT_OF_FRAME
    status[points.masked.reshape(points.shape)] = Status.MASKED
    status[points.count > 0] = Status.LOW_CORRELATION
    status[labelled] = Status.LABELLED
    status[labelled & (pixels.count < settings.min_points)] = Status.BELOW_MINIMUM_COUNT
    return WindowLabels(
        status=status,
        labels=labels,
        height=pixels.highest,
        surface_class=pixels.surface_class,
        day=days[pixels.day],
        point_count=pixels.count,
        correlation=pixels.correlation,
        change=np.zeros(status.shape, np.uint8),
        beyond=np.zeros(status.shape, np.uint32),
    )
