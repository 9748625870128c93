"""What a window may see of the ground: no label follows from anything else."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.labels import recipe as module
from stereotruth.labels import scene_inputs
from stereotruth.labels.window_points import ground_in_view
from stereotruth.surface.scale import PART
from stereotruth.surface.surface_store import Region
from stereotruth.surface.vertices import Vertices

from ...synthetic.box_scene import Scene

CELL = (100, 100)  # lattice steps, half a pixel


class Leaning:
    """Images of 200 lattice steps a pixel; 10 steps of height are a pixel to the left, in the right
    image one to the right: the disparity falls by two with each."""

    def at_points(self, lon, lat, h):
        x, y = lon / 200.0, lat / 200.0
        return np.stack([x - h / 10.0, y, x + h / 10.0, y])


def vertices(height_at) -> Vertices:
    """One in each cell of 200 by 200 pixels, from (0, 0) on."""
    y, x = (v.reshape(-1).astype(np.int64) for v in np.mgrid[0:400, 0:400])
    h = height_at(x / 2.0, y / 2.0).astype(np.int64)
    ones = np.ones(x.size, np.int32)
    return Vertices(x * 100, y * 100, h, x * PART, y * PART, ones.astype(np.uint8), ones, ones)


def in_view(height_at) -> np.ndarray:
    """Squares of 8 px that a window of 40 by 40 px in the middle may see."""
    found = vertices(height_at)
    return ground_in_view(found, 32.0 * PART, CELL, Leaning(), (80, 80), (40, 40)).squares


def test_a_tower_far_off_is_in_view() -> None:
    """500 steps of height move it by 50 px to the left, into the window."""
    flat = in_view(lambda x, y: 0.0 * x)
    squares = in_view(lambda x, y: np.where((x > 150) & (x < 160) & (y > 95) & (y < 105), 500, 0))
    assert squares[12, 19] and not flat[12, 19]
    assert not squares[:9].any() and not squares[16:].any() and not squares[:, :7].any()


def test_triangles_that_touch_stay() -> None:
    found = vertices(lambda x, y: 0.0 * x)
    squares = np.zeros((25, 25), np.bool_)
    squares[10, 10] = True  # cells 160 to 175
    view = Region(squares)
    corner = np.array([[400 * j + i, 400 * j + i + 1, 400 * (j + 1) + i]
                       for j, i in ((160, 159), (160, 158), (175, 175), (176, 170))])  # fmt: skip
    touching = view.touching(found, corner.astype(np.int32) - 100, 100)
    assert touching.tolist() == [True, False, True, False]
    across = np.array([[400 * 150 + 150, 400 * 150 + 190, 400 * 190 + 150]], np.int32)
    assert view.touching(found, across, 0).all()


def test_labels_are_those_of_all_triangles(tmp_path_factory, monkeypatch) -> None:
    box = Scene(tmp_path_factory.mktemp("box"), box=True, spacing=2.5)
    scene = box.inputs(LabelSettings(), "right")
    windows = [(slice(r, r + 50), slice(c, c + 50)) for r in (90, 140) for c in (60, 110, 160)]
    labels = [module.label_window(scene, *window)[0] for window in windows]
    sizes = []

    def everything(*args):
        seen = made(*args)
        sizes.append((seen.squares.size, seen.squares.sum()))
        return Region(np.ones_like(seen.squares))

    made = module.ground_in_view
    monkeypatch.setattr(module, "ground_in_view", everything)
    for window, layers in zip(windows, labels):
        for name, values in module.label_window(scene, *window)[0].items():
            assert values.tobytes() == layers[name].tobytes(), name
    whole, seen = np.sum(sizes, axis=0)
    assert seen < 0.7 * whole


@pytest.mark.slow
def test_labels_are_those_of_all_blocks(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("stereotruth.surface.make_surface.block_side", lambda scale: 32)
    scene = Scene(tmp_path, box=True, spacing=2.5).inputs(LabelSettings(), "left")
    windows = [(slice(r, r + 50), slice(c, c + 50)) for r in (90, 140) for c in (60, 110, 160)]
    labels = [module.label_window(scene, *window)[0] for window in windows]
    taken = [len(scene.surface_blocks(*window)) for window in windows]
    monkeypatch.setattr(scene_inputs, "blocks_in_view", lambda blocks, *_: blocks)
    for window, layers in zip(windows, labels):
        for name, values in module.label_window(scene, *window)[0].items():
            assert values.tobytes() == layers[name].tobytes(), name
    assert sum(taken) < 0.7 * sum(len(scene.surface_blocks(*window)) for window in windows)
