"""Shadows by the LiDAR's surface, against those of a box, which are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereotruth.disparity import recipe
from stereotruth.disparity.pair_window import PairWindow
from stereotruth.disparity.recipe import label_window
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.disparity.settings import Settings
from stereotruth.disparity.shadows import SunView
from stereotruth.epipolar.sun import sun_over

from ...synthetic.box_scene import HALF, ROOF, Scene, dilated, seen
from ...synthetic.cameras import HEIGHT, LAT, LON

SUNS = (140.0, 50.0), (215.0, 35.0)  # azimuth, elevation
ROWS, COLS = slice(60, 220), slice(70, 250)


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("box"), box=True)


def inputs_of(box: Scene, view: str = "left", suns=SUNS, **settings) -> SceneInputs:
    inputs = box.inputs(Settings(**{"diachronic": True} | settings), view)
    return replace(inputs, suns=suns)


def window_of(inputs: SceneInputs, monkeypatch) -> PairWindow:
    """The window ROWS, COLS with its shadows."""
    windows = []

    def record(labels, window, comparison):
        windows.append(window)
        return labels

    with monkeypatch.context() as patch:
        patch.setattr(recipe, "without_changes", record)
        label_window(inputs, ROWS, inputs.pair.cols(COLS))
    return windows[0]


def truth(surface: tuple[np.ndarray, ...], sun: tuple[float, float]) -> np.ndarray:
    """Which pixels [h, w] the box keeps from the sun, by its sides and the way to the sun."""
    east, north, height = surface
    azimuth, elevation = np.radians(sun)
    enter, leave = np.full(east.shape, 1e-3), np.full(east.shape, np.inf)
    for at, low, high, per_m in (
        (east, -HALF[0], HALF[0], math.sin(azimuth) / math.tan(elevation)),
        (north, -HALF[1], HALF[1], math.cos(azimuth) / math.tan(elevation)),
        (height, HEIGHT, ROOF, 1.0),
    ):
        ends = np.stack([(low - at) / per_m, (high - at) / per_m])
        enter, leave = np.maximum(enter, ends.min(axis=0)), np.minimum(leave, ends.max(axis=0))
    return enter < leave


@pytest.mark.parametrize("view", ["left", "right"])
def test_a_box_casts_its_shadow(box, view, monkeypatch) -> None:
    """In both images, each by its own sun, within 2 px of its edge."""
    window = window_of(inputs_of(box, view), monkeypatch)
    patches, views = (window.left, window.right), ("left", "right")
    if view == "right":  # the mirrored pair
        views = ("right", "left")
    for patch, shaded, of in zip(patches, window.shaded, views):
        true = truth(seen(box.model, of, box=True), SUNS[of == "right"])
        known = np.ones(true.shape, np.bool_)
        if view == "right":
            true = true[:, ::-1]
        rows, cols = (
            slice(first, first + n) for first, n in zip((patch.row, patch.col), shaded.shape)
        )
        inside = slice(max(rows.start, 0), rows.stop), slice(max(cols.start, 0), cols.stop)
        true, known = true[inside], known[inside]
        found = shaded[inside[0].start - rows.start :, inside[1].start - cols.start :]
        found = found[: true.shape[0], : true.shape[1]]
        edge = dilated(true, 2) & dilated(~true, 2)
        known &= ~edge
        known[:8] = known[-8:] = known[:, :8] = known[:, -8:] = False  # without points
        assert 300 < (true & known).sum() < 0.5 * known.sum()
        assert (found != true)[known].mean() < 1e-3


@pytest.mark.parametrize("view", ["left", "right"])
def test_any_cut_gives_the_same_bytes(box, view) -> None:
    scene = inputs_of(box, view)
    whole = label_window(scene, ROWS, COLS)[0]
    for row, col in ((slice(60, 130), COLS), (slice(130, 220), slice(70, 160)),
                     (slice(130, 220), slice(160, 250))):  # fmt: skip
        found = label_window(inputs_of(box, view), row, col)[0]
        where = np.s_[row.start - 60 : row.stop - 60, col.start - 70 : col.stop - 70]
        for name, values in found.items():
            assert values.tobytes() == np.ascontiguousarray(whole[name][where]).tobytes(), name


def test_casters_are_the_blocks_toward_the_sun(box) -> None:
    """However far off, as far as their height reaches; and no others."""
    scene = inputs_of(box)
    block, view = scene.ground.every[0], scene.sun_views[0]
    low = block._replace(heights=(0, 0))

    def moved(cells_lon: int, cells_lat: int, height: int):
        steps = np.array([cells_lon * view.cell[0], cells_lat * view.cell[1]] * 2)
        return low._replace(box=tuple(np.add(low.box, steps).tolist()), heights=(0, height))

    assert view.shift[0] > 0 > view.shift[1]  # a sun in the south-east
    tower = 10_000_000  # lattice steps: 1 km
    far = round(view.shift[0] * tower), round(view.shift[1] * tower)
    assert view.casters([low], [moved(*far, tower)])
    assert not view.casters([low], [moved(*far, tower // 2)])
    assert not view.casters([low], [moved(-far[0], -far[1], tower)])
    assert not view.casters([], [low])


@pytest.mark.parametrize(
    ("suns", "settings"),
    [
        (SUNS, {"diachronic": False}),
        (SUNS, {"recipe": "paper"}),
        ((SUNS[0], None), {}),
        ((SUNS[0], (215.0, 10.0)), {}),  # so low that most lies in shadow
        ((SUNS[0], "2020-10-25"), {}),
    ],
)
def test_shadows_are_predicted_where_both_suns_are_known(box, suns, settings) -> None:
    assert inputs_of(box, suns=suns, **settings).predicted_suns is None


def test_the_sun_follows_from_a_time(box) -> None:
    inputs = inputs_of(box, suns=(SUNS[0], "2020-10-25T03:12:45+00:00"))
    (_, sun) = inputs.predicted_suns
    from datetime import UTC, datetime

    true = sun_over(datetime(2020, 10, 25, 3, 12, 45, tzinfo=UTC), LON, LAT)
    assert np.allclose(sun, true, atol=0.02)
    assert inputs_of(box, "right", suns=inputs.suns).predicted_suns == (sun, SUNS[0])


def test_a_view_of_the_sun_does_not_depend_on_the_window(box) -> None:
    scene = inputs_of(box)
    again = SunView.of(SUNS[0], scene.pair.model, scene.ground.scale.cell)
    assert again == scene.sun_views[0]
