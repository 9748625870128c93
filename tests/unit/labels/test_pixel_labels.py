"""Which label a pixel has of a facet and of its own points."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.status import Status
from stereotruth.labels.pair_window import (
    PRECEDENCE,
    Labels,
    PairWindow,
    merged_status,
    read_patch,
)
from stereotruth.labels.pixel_labels import OwnLabels, OwnPoints, facet_labels
from stereotruth.labels.view_geometry import PixelScale
from stereotruth.surface.raster import VISIBLE, SeenSurface
from stereotruth.surface.scale import SurfaceScale, ground_cell


@pytest.mark.parametrize("see_through", [True, False])
def test_points_that_passed_are_an_edge_unless_they_show_through(see_through) -> None:
    """A roof over sparse ground points, which it hides; over dense ones, an edge."""
    shape = (8, 8)
    level, zeros = np.full(shape, 10.0), np.zeros(shape)
    seen = SeenSurface(
        visibility=np.full(shape, VISIBLE, np.uint8),
        plane=level,
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
    points[2, [2, 4, 5]] = 10.2, 10.8, 10.2  # on the surface, before it; where it bulges
    passed = np.zeros(shape, np.bool_)
    passed[2, 3] = True
    own = OwnLabels(
        points - level,
        Labels(points, np.zeros((2, *shape)), zeros),
        np.isfinite(points) & ~seen.bulging,
        OwnPoints(zeros, points, nothing),
        passed,
        zeros,
        0,
    )
    left = read_patch(np.full((20, 40), 500, np.uint16), slice(4, 12), slice(12, 20), 1)
    right = read_patch(np.full((20, 40), 500, np.uint16), slice(4, 12), slice(0, 20), 1)
    window = PairWindow(slice(4, 12), slice(12, 20), 0, left, right)
    spacing = 2.0 if see_through else 1.0
    surface = SurfaceScale.of((spacing * 0.5) ** -2, ground_cell((5e-6, 5e-6)))
    found = facet_labels(seen, own, window, PixelScale(1.0, 0.5, surface), 0.0)
    labels, status = found.labels, found.status
    assert list(status[2, 2:5]) == [
        Status.LABELLED,
        Status.LABELLED_BETWEEN if see_through else Status.EDGE_IN_PIXEL,
        Status.EDGE_IN_PIXEL,
    ]
    assert labels.disparity[2, 2] == pytest.approx(10.2)
    assert status[2, 5] == Status.LABELLED and labels.disparity[2, 5] == 10.0  # no plane bulges
    assert np.isfinite(labels.disparity[2, 2:5]).tolist() == [True, see_through, False]


def test_statuses_are_merged_in_one_order() -> None:
    """Whatever the order of the masks; what a pixel had before counts as one of them."""
    every = np.ones((1, 3), np.bool_)
    labelled = {Status.LABELLED_BETWEEN: every, Status.LABELLED: np.array([[True, False, True]])}
    edge = {Status.EDGE_IN_PIXEL: np.array([[False, False, True]])}
    before = merged_status(labelled)
    assert before.tolist() == [[Status.LABELLED, Status.LABELLED_BETWEEN, Status.LABELLED]]
    assert np.array_equal(merged_status(edge, before), merged_status({**edge, **labelled}))
    assert set(PRECEDENCE) <= set(Status) and PRECEDENCE[-1] == Status.NO_POINTS
    for without in (Status.MASKED, Status.OUT_OF_FRAME, Status.HIDDEN_IN_RIGHT, Status.CHANGED):
        for label in (status for status in PRECEDENCE if status.carries_label):
            assert merged_status({label: every, without: every}).tolist() == [[without] * 3]
