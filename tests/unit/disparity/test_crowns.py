"""Labels of rough surfaces that pulses go through, whose exact disparities are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.dataset.sure_labels import NAME, TOO_UNCERTAIN
from stereotruth.disparity.crowns import RoughSurface, _higher, _narrowest
from stereotruth.disparity.label_window import label_window
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.disparity.settings import Settings
from stereotruth.disparity.smooth_triangles import Scale
from stereotruth.disparity.status import Status, is_labelled
from stereotruth.lidar.lattice import LATTICE_M

from ...synthetic.box_scene import Scene, on_ground, write_points
from ...synthetic.cameras import HEIGHT, LAT, LON, METRES
from ...synthetic.strewn_points import CELL_M, surface_of

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
    grid = wood.project(correlation_threshold=-1)
    status, disparity = grid["status"].values, grid["disparity"].values
    assert np.array_equal(is_labelled(status), np.isfinite(disparity))
    crown = status == Status.LABELLED_CROWN
    inside = np.zeros(status.shape, np.bool_)
    inside[40:-40, 60:-60] = True
    assert (crown & inside).sum() > 0.2 * inside.sum()
    error = np.abs(disparity - wood.truth)[crown & inside]
    sigma = grid["uncertainty"].values[crown & inside]
    assert 0.55 < (error < sigma).mean() < 0.9
    assert (error < 2.0 * sigma).mean() > 0.88
    assert (error > DEPTH_M / 3).mean() < 0.002  # what went through is no surface
    assert grid["point_count"].values[crown].max() == 0
    assert np.isfinite(grid["height"].values[crown]).all()
    assert wood.summary["pixels"]["labelled_crown"] == crown.sum()
    assert NAME not in grid["status"].attrs["flag_meanings"]
    assert TOO_UNCERTAIN == Status.TOO_UNCERTAIN and Status.TOO_UNCERTAIN.name.lower() == NAME


@pytest.mark.parametrize("view", ["left", "right"])
def test_any_cut_gives_the_same_crowns(wood, view) -> None:
    def labels(rows: slice, cols: slice):
        settings = Settings(correlation_threshold=-1)
        return label_window(SceneInputs(*wood.images, (wood.store,), settings, view), rows, cols)[0]

    whole = labels(slice(60, 180), slice(80, 220))
    assert (whole["status"] == Status.LABELLED_CROWN).sum() > 1000
    for row, col in ((slice(60, 111), slice(80, 220)), (slice(111, 180), slice(133, 220))):
        part = labels(row, col)
        where = np.s_[row.start - 60 : row.stop - 60, col.start - 80 : col.stop - 80]
        for name, values in part.items():
            assert values.tobytes() == np.ascontiguousarray(whole[name][where]).tobytes(), name


def test_points_that_went_through_are_left_out_but_not_the_ground_of_a_gap() -> None:
    """A rough canopy 8 m above the ground with a gap of 8 m; a quarter of the pulses go through."""
    rng = np.random.default_rng(2)

    def height(x, y):
        top = 8.0 + rng.uniform(-0.8, 0.8, x.size)
        gap = np.hypot(x - 25.0, y - 25.0) < 4.0
        return np.where(gap | (rng.random(x.size) < 0.25), 0.0, top)

    surface = surface_of(height)
    tops = RoughSurface.of(surface, Scale.of(1.0, CELL_M), 1.0).vertices
    x, y = (q / 3000 * CELL_M for q in (tops.lon_q, tops.lat_q))
    low = tops.h_q * LATTICE_M < 4.0
    far = np.hypot(x - 25.0, y - 25.0)
    well_inside = (np.abs(x - 25.0) < 17.0) & (np.abs(y - 25.0) < 17.0)
    assert low[far < 3.0].all() and (far < 3.0).sum() > 10
    assert low[(far > 6.0) & well_inside].mean() < 0.05


def test_what_is_higher_and_what_turns_away() -> None:
    flat = np.zeros((5, 40))
    flat[2, 20] = 3.0
    assert _higher(flat, 1)[2, 19] == _higher(flat, 1)[3, 21] == 3.0
    assert _higher(flat, 1)[2, 18] == 0.0 and _higher(flat, 3)[2, 18] == 3.0
    assert np.isnan(_higher(np.full((3, 3), np.nan), 1)).all()
    narrow = _narrowest(flat)
    assert narrow[0, 5] == 1.0
    assert narrow[2, 19] == 1.0 - 3.0  # hidden by its neighbour,
    assert narrow[2, 17] == 0.0 and narrow[2, 16] == 1.0  # as the pixel is that lies 3 px beside it
    assert narrow[2, 21] == 1.0
