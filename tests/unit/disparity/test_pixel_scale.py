"""Tolerances of the surface, from a pixel on the ground and in height."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.pixel_scale import FACET_RESIDUAL_PX, PixelScale
from stereotruth.disparity.rays import Rays


def test_tolerances_follow_the_pixel_and_weights_the_spacing_of_points() -> None:
    rays = Rays(np.zeros((2, 2, 3)), (3000, 3000), 0.5)  # cells of 0.33 m, half a pixel
    dense, sparse = (PixelScale.of(n, rays) for n in (8.2, 8.2e-3))
    assert dense.detection_weight == 1.0 and sparse.detection_weight < 0.1
    assert dense.points_per_px == pytest.approx(8.2 * 0.668**2, rel=0.2)
    assert dense.surface.residual_m * rays.px_per_m == FACET_RESIDUAL_PX
    assert FACET_RESIDUAL_PX <= 0.5  # a label of the wrong surface stays below a pixel
    assert sparse.surface.dome_m < dense.surface.dome_m
