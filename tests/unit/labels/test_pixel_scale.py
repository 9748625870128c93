"""Tolerances of the surface, from a pixel on the ground and in height."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.labels.view_geometry import PixelScale, Rays
from stereotruth.surface.scale import FACET_RESIDUAL_PX, SurfaceScale


def test_tolerances_follow_the_pixel_and_domes_the_spacing_of_points() -> None:
    rays = Rays(np.zeros((2, 2, 3)), (3000, 3000), 0.6 / 0.668)  # cells of 0.33 m, half a pixel
    scales = (SurfaceScale.of(n, rays.cell) for n in (8.2, 8.2e-3))
    dense, sparse = (PixelScale.of(scale, rays) for scale in scales)
    assert dense.spacing_px**-2 == pytest.approx(8.2 * 0.668**2, rel=0.2)
    residual_px = dense.surface.residual_m * rays.px_per_m  # base over height is 0.6
    assert residual_px == pytest.approx(FACET_RESIDUAL_PX, rel=1e-3)
    assert FACET_RESIDUAL_PX <= 0.5  # a label of the wrong surface stays below a pixel
    assert sparse.surface.dome_m < dense.surface.dome_m


def test_a_coarser_image_sees_the_same_points_closer_together() -> None:
    """One surface serves images of pixels of 0.67 and of 1.34 m."""
    surface = SurfaceScale.of(2.0, (3000, 3000))
    fine, coarse = (
        PixelScale.of(surface, Rays(np.zeros((2, 2, 3)), (c, c), 1.0)) for c in (3000, 6000)
    )
    assert fine.spacing_px == pytest.approx(2 * coarse.spacing_px)
