"""The rigorous camera and the local frame."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyproj
import pytest

from stereocities.camera import LocalFrame, locate, project, rays
from stereocities.cities import LEFT_GSD_M, RIGHT_GSD_M, Jitter, ViewSpec
from stereocities.render import prepare

from ...synthetic.small_cities import ONE_BOX


def test_local_frame_agrees_with_pyproj() -> None:
    frame = LocalFrame(113.4, 24.2, 36.0)
    xyz = np.random.default_rng(0).uniform(-3000, 3000, (500, 3))
    lonlath = frame.to_geodetic(xyz)
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    np.testing.assert_allclose(
        np.array(to_ecef.transform(*lonlath.T)).T, frame.to_ecef(xyz), atol=1e-7
    )
    np.testing.assert_allclose(frame.from_geodetic(lonlath), xyz, atol=1e-7)


@pytest.mark.parametrize("ascending", [False, True])
def test_camera_round_trip_and_ground_sampling(ascending: bool) -> None:
    spec = replace(ONE_BOX, scenes=(replace(ONE_BOX.scenes[0], ascending=ascending),))
    ready = prepare(spec, spec.scenes[0])
    rng = np.random.default_rng(1)
    for camera, gsd in ((ready.left, LEFT_GSD_M), (ready.right, RIGHT_GSD_M)):
        colrow = rng.uniform(0, 1, (400, 2)) * [camera.cols, camera.rows]
        xyz = locate(camera.cam, ready.frame, colrow, 1860 + rng.uniform(0, 600, 400))
        assert np.abs(project(camera.cam, xyz) - colrow).max() < 1e-5
        middle = np.array([camera.cols / 2, camera.rows / 2])
        steps = locate(
            camera.cam, ready.frame, middle + np.array([[0, 0], [1, 0], [0, 1]]), np.full(3, 1864.0)
        )
        across, along = np.linalg.norm(steps[1:] - steps[0], axis=1)
        assert across == pytest.approx(gsd, rel=0.03)
        assert along == pytest.approx(gsd, rel=0.03)
        # not mirrored: columns to the right of falling rows, seen from above
        c, r = steps[1] - steps[0], steps[2] - steps[0]
        assert c[0] * r[1] - c[1] * r[0] < 0
    tilts = [
        math.degrees(math.acos(1 / np.linalg.norm(rays(c.cam, [[c.cols / 2, c.rows / 2]])[1])))
        for c in (ready.left, ready.right)
    ]
    # angles at the ground: those at the satellite times (R + h) / R, and the roll
    assert tilts[0] == pytest.approx(5.4, abs=1.3)
    assert tilts[1] == pytest.approx(28.2, abs=0.8)


def test_jitter_swings_lines_by_what_is_asked_and_rpcs_know_nothing_of_it() -> None:
    plain = prepare(ONE_BOX, ONE_BOX.scenes[0])
    city = replace(ONE_BOX, left=ViewSpec(jitter=Jitter(0.3, (1.0, 3.0))))
    ready = prepare(city, city.scenes[0])
    still, swung = plain.left, ready.left
    assert np.array_equal(swung.rpc.coefficients, still.rpc.coefficients)
    assert np.array_equal(ready.right.cam, plain.right.cam)
    row = np.arange(0.0, still.rows)
    at = np.column_stack([np.full(row.size, 100.0), row])
    xyz = locate(swung.cam, ready.frame, at, np.full(row.size, 1864.0))
    assert np.abs(project(swung.cam, xyz) - at).max() < 1e-5
    moved = at - project(still.cam, xyz)
    assert np.sqrt(np.mean(moved**2, axis=0)) == pytest.approx(0.3, rel=0.05)
    waves = np.abs(np.fft.rfft(moved[:, 0]))[1:6]
    assert set(np.argsort(waves)[-2:] + 1) == {1, 3}
