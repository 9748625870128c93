"""Labels between points on a textured plane with a box, whose exact disparities are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.status import Status, is_labelled
from stereotruth.labels.recipe import label_window
from stereotruth.labels.scene_inputs import SceneInputs

from ...synthetic.box_scene import ROOF, Scene, dilated, hidden_truth
from ...synthetic.cameras import HEIGHT

SPACING = 2.5  # m: one point in 13 px


@pytest.fixture(scope="module")
def plane(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("plane"), box=False, spacing=SPACING)


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("box"), box=True, spacing=SPACING)


def test_a_plane_is_labelled_between_its_points(plane) -> None:
    grid = plane.project()
    disparity, status = grid["disparity"].values, grid["status"].values
    labelled = is_labelled(status)
    assert np.array_equal(labelled, np.isfinite(disparity))
    assert np.abs(disparity - plane.truth)[labelled].max() < 1e-3
    inner = dilated(dilated(labelled, 2), 2)
    inner[:20] = inner[-20:] = inner[:, :50] = inner[:, -50:] = False
    assert inner.sum() > 20_000
    assert labelled[inner].mean() > 0.999
    assert 0.04 < (status == Status.LABELLED)[inner].mean() < 0.12
    assert grid["point_count"].values[status == Status.LABELLED].min() == 1
    assert grid["point_count"].values[status == Status.LABELLED_BETWEEN].max() == 0
    assert np.abs(grid["height"].values[labelled] - HEIGHT).max() < 1e-2
    pixels = plane.summary["pixels"]
    assert pixels["labelled_between"] == (status == Status.LABELLED_BETWEEN).sum()
    assert "labelled_between" in grid["status"].attrs["flag_meanings"].split()


def test_by_the_papers_recipe_sparse_points_tell_of_the_other(plane, caplog) -> None:
    grid = plane.project(recipe="paper")
    assert "LiDAR points per m², pixels of 0.65 m: a point falls into" in caplog.text
    assert "project.recipe: surface" in caplog.text
    assert 0.0 < grid.attrs["points_per_px"] < 0.1  # one in 15 pixels
    assert "labelled_between" not in grid["status"].attrs["flag_meanings"]
    assert "labelled_between" not in plane.summary["pixels"]
    assert not (grid["status"].values == Status.LABELLED_BETWEEN).any()


def test_nothing_hidden_by_a_box_has_a_label(box) -> None:
    """No hidden pixel, no wall, no label of the wrong surface; what is clear keeps its label."""
    grid = box.project()
    status, disparity = grid["status"].values, grid["disparity"].values
    labelled = is_labelled(status)
    hidden = hidden_truth(box)
    assert hidden.sum() > 800
    assert not labelled[hidden].any()
    wall = (box.surface[2] > HEIGHT) & (box.surface[2] < ROOF)
    assert not labelled[wall].any()
    # A corner of the roof may reach in between three points of the ground, and no point tells.
    assert (np.abs(disparity - box.truth) > 1e-3).sum() < 4 * (SPACING / 0.65 / 2) ** 2
    # The step lies somewhere between points: a distance of points around it is given up, in each
    # view, and around what the prism over it may hide.
    reach = int(np.ceil(1.5 * SPACING / 0.65))
    roof = box.surface[2] == ROOF
    assert labelled[roof & ~dilated(~roof, reach)].mean() > 0.95  # triangles at its corners fail
    ground = ~dilated(roof | wall | hidden, reach)
    ground[:20] = ground[-20:] = ground[:, :80] = ground[:, -80:] = False
    assert ground.sum() > 5_000
    assert labelled[ground].mean() > 0.995


@pytest.mark.parametrize(("view", "recipe"), [("left", "surface"), ("right", "paper")])
def test_any_cut_and_any_order_give_the_same_bytes(box, view, recipe) -> None:
    def scene() -> SceneInputs:
        return box.inputs(LabelSettings(recipe=recipe), view)

    rows, cols = slice(60, 220), slice(70, 250)
    whole = label_window(scene(), rows, cols)[0]
    assert is_labelled(whole["status"]).mean() > (0.5 if recipe == "surface" else 0.03)
    part = scene()
    store = part.stores[0]
    read = store.query

    def shuffled(*corners: float):
        points = read(*corners)
        order = np.random.default_rng(0).permutation(len(points))
        names = points.__dataclass_fields__
        return type(points)(*(getattr(points, name)[order] for name in names))

    store.query = shuffled
    for row, col in ((slice(60, 130), cols), (slice(130, 220), slice(70, 160)),
                     (slice(130, 220), slice(160, 250))):  # fmt: skip
        found = label_window(part, row, col)[0]
        where = np.s_[row.start - 60 : row.stop - 60, col.start - 70 : col.stop - 70]
        for name, values in found.items():
            assert values.tobytes() == np.ascontiguousarray(whole[name][where]).tobytes(), name
