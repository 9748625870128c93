"""Rays to cameras whose directions are known, and what a pixel is on the ground and in height."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.labels.view_geometry import PixelScale, Rays
from stereotruth.lidar.lattice import LATTICE_DEG
from stereotruth.surface.scale import FACET_RESIDUAL_PX, SurfaceScale

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, METRES, camera

SIZE = (320, 280)


def model_of(left=BACKWARD, right=FORWARD, angle: float = 90.0):
    sensors = [camera(tilt, angle=angle, size=SIZE) for tilt in (left, right)]
    return fit_epipolar(*sensors, SIZE, SIZE, HEIGHT, height_range=(HEIGHT - 50, HEIGHT + 100))


@pytest.mark.parametrize(
    "tilts", [(BACKWARD, FORWARD), ((0.1, 0.3), (-0.2, -0.3)), ((0.0, 0.5), (0.0, 0.1))]
)
def test_ray_directions_and_scale(tilts) -> None:
    """A ray to a camera runs against the way the camera's image moves with height: 1e-5 m per m."""
    model = model_of(*tilts)
    rays = Rays.of(model)
    for view, tilt in enumerate(tilts):
        metres = rays.track[view, :, 0] * METRES
        assert metres == pytest.approx([-tilt[0], -tilt[1]], abs=1e-5)
        assert np.abs(rays.track[view, :, 1:]).max() * 300 * METRES.max() < 1e-5
    size = np.array(rays.cell) * LATTICE_DEG * METRES
    assert size == pytest.approx([0.325, 0.325], rel=0.02)
    base = np.hypot(*np.subtract(*tilts)) / 0.65
    assert rays.px_per_m == pytest.approx(base, rel=1e-3)


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
