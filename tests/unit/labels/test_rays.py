"""Rays to cameras whose directions are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.labels.view_geometry import Rays
from stereotruth.lidar.lattice import LATTICE_DEG

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
