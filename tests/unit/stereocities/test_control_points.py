"""Control points and check points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereocities.camera import project
from stereocities.render import prepare

from ...synthetic.small_cities import TOWN, read_points


def test_points_are_exact_and_measured_with_a_quarter_of_a_pixel(town: Path) -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    measured, exact, checks = (read_points(town / f"{n}.csv") for n in ("gcps", "exact", "checks"))
    assert len(exact) >= 18 and len(checks) >= 50
    for table in (exact, checks):
        xyz = ready.frame.from_geodetic(table[:, :3])
        assert np.abs(project(ready.left.cam, xyz) - table[:, 3:5]).max() < 5e-4
        assert np.abs(project(ready.right.cam, xyz) - table[:, 5:7]).max() < 5e-4
    assert (measured[:, :3] == exact[:, :3]).all()
    assert np.std(measured[:, 3:] - exact[:, 3:]) == pytest.approx(0.25, abs=0.07)
    distance = np.linalg.norm(exact[:, None, :3] - checks[None, :, :3], axis=2)
    assert distance.min() > 1e-6
