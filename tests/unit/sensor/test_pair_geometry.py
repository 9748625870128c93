"""Which image of a pair looks backward."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from stereotruth.sensor.pair_geometry import view_order

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, camera

OVERLAP = np.array([[100.0, 200.0], [100.0, 200.0]])


@pytest.mark.parametrize(
    ("left", "right", "order"),
    [
        (BACKWARD, FORWARD, "left looks backward"),
        (FORWARD, BACKWARD, "left looks forward"),
        (BACKWARD, BACKWARD, "across track"),  # an image and its copy: neither
    ],
)
def test_the_view_that_looks_backward_is_told(left, right, order) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert view_order(camera(left), camera(right), OVERLAP, HEIGHT) == order
