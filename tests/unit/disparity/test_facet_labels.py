"""Which label a pixel has of a facet and of its own points."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.facet_labels import facet_labels
from stereotruth.disparity.image_patches import read_patch
from stereotruth.disparity.pair_window import PairWindow
from stereotruth.disparity.pixel_labels import Labels, OwnLabels, OwnPoints
from stereotruth.disparity.visibility import VISIBLE, VisibleSurface
from stereotruth.status import Status


@pytest.mark.parametrize("see_through", [True, False])
def test_points_behind_the_seen_surface_are_no_edge_where_they_show_through(see_through) -> None:
    """A roof over sparse ground points: these are hidden by it, those before it are not."""
    shape = (8, 8)
    level, zeros = np.full(shape, 10.0), np.zeros(shape)
    visible = VisibleSurface(
        visibility=np.full(shape, VISIBLE, np.uint8),
        disparity=level,
        slope=np.zeros((2, *shape)),
        variance=zeros,
        height=zeros,
        surface_class=zeros.astype(np.uint8),
        day=zeros.astype(np.uint16),
        bulging=np.arange(8) + zeros == 5,
        strips=np.full(shape, -np.inf),
        projected=None,
    )
    points, nothing = np.full(shape, np.nan), np.zeros(shape, np.uint8)
    points[2, 2:6] = 10.2, 4.0, 16.0, 10.2  # on the surface, behind, before it; where it bulges
    own = OwnLabels(
        Labels(points, np.zeros((2, *shape)), zeros),
        OwnPoints(zeros, points, nothing),
        np.zeros(shape, np.bool_),
        np.zeros(shape, np.int32),
    )
    left = read_patch(np.full((20, 40), 500, np.uint16), slice(4, 12), slice(12, 20), 1)
    right = read_patch(np.full((20, 40), 500, np.uint16), slice(4, 12), slice(0, 20), 1)
    window = PairWindow(slice(4, 12), slice(12, 20), 0, left, right)
    found = facet_labels(visible, own, window, see_through)
    labels, status = found.labels, found.status
    assert list(status[2, 2:5]) == [
        Status.LABELLED,
        Status.LABELLED_BETWEEN if see_through else Status.EDGE_IN_PIXEL,
        Status.EDGE_IN_PIXEL,
    ]
    assert labels.disparity[2, 2] == pytest.approx(10.2)
    assert status[2, 5] == Status.LABELLED and labels.disparity[2, 5] == 10.0  # no plane bulges
    assert np.isfinite(labels.disparity[2, 2:5]).tolist() == [True, see_through, False]
