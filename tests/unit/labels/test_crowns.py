"""Labels of rough surfaces that pulses go through, whose exact disparities are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.status import Status, is_labelled
from stereotruth.labels.crowns import _clearance, _higher
from stereotruth.labels.recipe import label_window

from ...synthetic.box_scene import Scene, on_ground, write_points
from ...synthetic.cameras import HEIGHT, LAT, LON, METRES

THROUGH = 0.25  # share of the pulses
DEPTH_M = 9.0


def canopy(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Heights above the plane, m: bumps of some metres, steeper than a plane of points allows."""
    return 0.55 * (np.sin(1.9 * east + 0.7 * north) + np.sin(1.3 * north - 1.1 * east + 1.0))


def rays(scene: Scene) -> tuple[np.ndarray, ...]:
    """East, north and height of the canopy that every left pixel shows."""
    y, x = np.mgrid[: scene.model.shape[0], : scene.model.shape[1]].astype(float)
    col, row = scene.model.epipolar_to_left(x, y)
    low, high = (on_ground(scene.model.left, col, row, HEIGHT + h) for h in (0.0, 1.0))
    height = np.zeros(x.shape)
    for _ in range(60):  # no bump is as steep as a ray
        height = 0.5 * (height + canopy(*(low + (high - low) * height)))
    return *(low + (high - low) * height), HEIGHT + height


@pytest.fixture(scope="module")
def wood(tmp_path_factory) -> Scene:
    """A scene whose ground is a canopy, with a point each 1.2 m."""
    scene = Scene(tmp_path_factory.mktemp("wood"), box=False, spacing=1.2)
    points = scene.points.copy()
    east, north = (points[:, 0] - LON) * METRES[0], (points[:, 1] - LAT) * METRES[1]
    points[:, 2] += canopy(east, north)
    passed = np.random.default_rng(5).random(len(points)) < THROUGH
    points[passed, 2] -= DEPTH_M
    scene.store = write_points(scene.folder, points, "canopy")
    east, north, height = rays(scene)
    xy = scene.model.ground_to_epipolar(LON + east / METRES[0], LAT + north / METRES[1], height)
    scene.truth = (xy[0] - xy[2]).reshape(scene.model.shape)
    return scene


def test_a_canopy_is_labelled_with_an_uncertainty_of_its_own(wood) -> None:
    grid = wood.project()
    status, disparity = grid["status"].values, grid["disparity"].values
    assert np.array_equal(is_labelled(status), np.isfinite(disparity))
    crown = status == Status.LABELLED_CROWN
    inside = np.zeros(status.shape, np.bool_)
    inside[40:-40, 60:-60] = True
    assert (crown & inside).sum() > 0.2 * inside.sum()
    error = np.abs(disparity - wood.truth)[crown & inside]
    sigma = grid["uncertainty"].values[crown & inside]
    assert 0.55 < (error < sigma).mean() < 0.9
    assert (error < 2.0 * sigma).mean() > 0.87
    assert (error > DEPTH_M / 3).mean() < 0.002  # what went through is no surface
    assert grid["point_count"].values[crown].max() == 0
    assert np.isfinite(grid["height"].values[crown]).all()
    assert wood.summary["pixels"]["labelled_crown"] == crown.sum()
    assert Status.TOO_UNCERTAIN.label not in grid["status"].attrs["flag_meanings"]


def test_any_cut_gives_the_same_crowns(wood) -> None:
    def labels(rows: slice, cols: slice):
        settings = LabelSettings()
        return label_window(wood.inputs(settings, "right"), rows, cols)[0]

    whole = labels(slice(60, 180), slice(80, 220))
    assert (whole["status"] == Status.LABELLED_CROWN).sum() > 1000
    for row, col in ((slice(60, 111), slice(80, 220)), (slice(111, 180), slice(133, 220))):
        part = labels(row, col)
        where = np.s_[row.start - 60 : row.stop - 60, col.start - 80 : col.stop - 80]
        for name, values in part.items():
            assert values.tobytes() == np.ascontiguousarray(whole[name][where]).tobytes(), name


def test_what_is_higher_and_what_turns_away() -> None:
    flat, every = np.zeros((5, 40)), np.ones((5, 40), np.bool_)
    flat[2, 20] = 3.0
    higher = _higher(flat, 1, every)
    assert higher[2, 19] == higher[3, 21] == 3.0
    assert higher[2, 18] == 0.0 and _higher(flat, 3, every)[2, 18] == 3.0
    assert np.isnan(_higher(flat, 3, ~every)).all()
    near = _clearance(np.zeros((5, 40)), flat, 0, every)
    assert np.isinf(near[0, 5]) and np.isinf(near[2, 21])
    assert near[2, 19] == 1.0 - 3.0  # covered by its neighbour,
    assert near[2, 17] == 0.0 and near[2, 16] == 1.0  # as the pixel is that lies 3 px beside it
    assert np.isinf(near[1, 17]) and _clearance(np.zeros((5, 40)), flat, 1, every)[1, 17] == 0.0
