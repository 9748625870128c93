"""Labels of the visible facets, and of the points that pixels have themselves."""

from __future__ import annotations

import numpy as np

from ..core.status import Status, is_labelled
from ..surface.raster import VISIBLE, SeenSurface
from ..surface.scale import FACET_RESIDUAL_PX
from .pair_window import PairWindow, WindowLabels
from .pixel_labels import Labels, OwnLabels
from .pixel_scale import PixelScale

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
