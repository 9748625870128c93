"""Labels of the visible facets, and of the points that pixels have themselves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..status import Status, is_labelled
from ..surface.scale import FACET_RESIDUAL_PX
from .pair_window import PairWindow, WindowLabels
from .pixel_labels import Labels, OwnLabels
from .visibility import VISIBLE, VisibleSurface

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
    visible: VisibleSurface, own: OwnLabels, window: PairWindow, see_through: bool
) -> WindowLabels:
    """Labels of a window by its facets, and by each pixel's ``own`` points where these agree.

    Pixels whose own points lie on the facet that their centre sees count as measured, and keep the
    label of these points if it is the surer one (one point is less than three around it, and no
    plane bulges). Points of another surface are an edge in the pixel. Only where points are so
    sparse that others show through between them (``see_through``) those behind are hidden, as the
    ground is that a tower leans over.
    """
    status = _STATUS[visible.visibility]
    row, col = np.nonzero(visible.visibility == VISIBLE)
    inside, masked = window.usable(row, col, visible.disparity[row, col])
    status[row[~inside], col[~inside]] = Status.OUT_OF_FRAME
    status[row[masked], col[masked]] = Status.MASKED
    labels, measured = _merged(visible, own.labels, status, see_through)
    has_points = own.in_frames > 0
    status[(status == Status.NO_POINTS) & has_points] = Status.EDGE_IN_PIXEL
    status[is_labelled(status) & own.on_edge] = Status.EDGE_IN_PIXEL
    measured &= status == Status.LABELLED
    points = own.points
    return WindowLabels(
        status=status,
        labels=labels,
        height=np.where(measured, points.highest, visible.height),
        surface_class=np.where(measured, points.surface_class, visible.surface_class),
        day=visible.day,
        point_count=np.where(measured, points.count, 0),
        correlation=np.full(status.shape, np.nan),
        change=np.zeros(status.shape, np.uint8),
    )


def _merged(
    visible: VisibleSurface, own: Labels, status: NDArray[np.uint8], see_through: bool
) -> tuple[Labels, NDArray[np.bool_]]:
    """Labels of facets and ``own`` points, and which pixels these measure; sets their
    ``status``."""
    between = status == Status.LABELLED_BETWEEN
    with np.errstate(invalid="ignore"):
        lift = own.disparity - visible.disparity
        measured = between & (np.abs(lift) <= FACET_RESIDUAL_PX)
        other = lift > FACET_RESIDUAL_PX if see_through else np.abs(lift) > FACET_RESIDUAL_PX
        status[between & other] = Status.EDGE_IN_PIXEL
    status[measured] = Status.LABELLED
    surer = measured & (own.variance <= visible.variance) & ~visible.bulging
    labelled = np.where(is_labelled(status), visible.disparity, np.nan)
    labels = Labels(
        np.where(surer, own.disparity, labelled),
        np.where(surer, own.slope, visible.slope),
        np.where(surer, own.variance, visible.variance),
    )
    return labels, measured
