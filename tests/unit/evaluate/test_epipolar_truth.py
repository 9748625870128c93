"""The exact truth on the epipolar grid, against geometry by hand and the raw truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

from stereocities.camera import locate, project, rays
from stereocities.render import prepare
from stereocities.surfaces import terrain_heights
from stereocities.truth import open_truth, simulate_truth, truth_at
from stereotruth.epipolar.model import EpipolarModel, ImageModel
from stereotruth.evaluate.epipolar_truth import truth_window, write_grid_truth
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.small_cities import ONE_BOX, TOWN
from ...synthetic.surveyed_pair import linear_rpc

GROUND, ROOF, WALL = 1, 2, 3


def turned(city, offset: tuple[float, float]) -> EpipolarModel:
    """Images turned by 90 degrees, the left one also moved by ``offset`` px in (x, y).

    Rows run along those of the right image's columns: x = row, y = -col.
    """
    ready = prepare(city, city.scenes[0])
    sizes = [(c.cols, c.rows) for c in (ready.left, ready.right)]
    images = [
        ImageModel(
            np.array([[0.0, 1.0, at[0]], [-1.0, 0.0, size[0] - 1 + at[1]]]),
            (0.0, 0.0, float(size[0]), float(size[1])),
            np.zeros((4, 4)),
        )
        for size, at in zip(sizes, (offset, (0.0, 0.0)))
    ]
    sensors = [SensorModel(linear_rpc(0.7, 0.0, size), np.eye(2, 3)) for size in sizes]
    shape = sizes[0][0], sizes[0][1]
    box = (0.0, 0.0, 1.0, 1.0)
    return EpipolarModel(*sensors, *images, shape, *sizes, 0.0, (0.0, 1.0), box, {})


def test_box_and_ground_by_hand() -> None:
    """Rays against a box and nearly level ground, without the simulator's caster."""
    scene = ONE_BOX.scenes[0]
    ready = prepare(ONE_BOX, scene)
    model = turned(ONE_BOX, (0.37, -0.21))
    found = truth_window(model, ONE_BOX, scene, slice(0, 420), slice(0, 400))
    y, x = np.mgrid[0:420, 0:400].astype(float)
    colrow = np.stack([419 - 0.21 - y, x - 0.37], axis=-1).reshape(-1, 2)
    origin, toward = rays(ready.left.cam, colrow)
    cx, cy, length, width = ONE_BOX.single_box[:4]
    top = ready.surfaces.boxes[0, 6]

    def at(z):
        return origin + (z - origin[:, 2])[:, None] * toward

    roof = at(np.full(len(origin), top))
    on_roof = (np.abs(roof[:, 0] - cx) <= length / 2) & (np.abs(roof[:, 1] - cy) <= width / 2)
    ground = at(np.full(len(origin), 4.0))
    for _ in range(8):
        ground = at(terrain_heights(ready.surfaces, ground[:, :2])[:, 0])
    for kind, points, where in (
        (ROOF, roof, on_roof),
        (GROUND, ground, (found["surface"] == GROUND).ravel()),
    ):
        col, row = project(ready.right.cam, points).T
        disparity = x.ravel() - row
        parallax = ready.right.cols - 1 - col - y.ravel()
        assert where.sum() > 2000
        assert (found["surface"].ravel()[where] == kind).mean() > 0.999
        where &= found["surface"].ravel() == kind
        np.testing.assert_allclose(found["disparity"].ravel()[where], disparity[where], atol=2e-3)
        np.testing.assert_allclose(found["y_parallax"].ravel()[where], parallax[where], atol=2e-3)
    assert (found["surface"].ravel() == ROOF).sum() == pytest.approx(on_roof.sum(), abs=2)

    # hidden: the segment from the ground to the right camera passes through the box
    seen_ground = (found["surface"] == GROUND).ravel() & (found["covered"].ravel() == 1)
    col, row = project(ready.right.cam, ground).T
    inside = (col > 15) & (row > 15) & (col < ready.right.cols - 20) & (row < ready.right.rows - 20)
    eye, _ = rays(ready.right.cam, np.column_stack([col, row]))
    lean = (eye - ground)[:, :2] / (eye - ground)[:, 2:]
    low, high = np.zeros(len(eye)), top - ground[:, 2]
    for axis, (centre, half) in enumerate(((cx, length / 2), (cy, width / 2))):
        bounds = (np.array([[-half], [half]]) + centre - ground[:, axis]) / lean[:, axis]
        low, high = np.maximum(low, bounds.min(0)), np.minimum(high, bounds.max(0))
    hidden = low < high
    use = seen_ground & inside
    assert hidden[use].sum() > 1500
    assert (found["hidden"].ravel()[use] == hidden[use]).mean() > 0.9995
    assert (found["visible"].ravel()[use] == ~hidden[use]).mean() > 0.9995
    edge = found["edge"] > 0
    assert 100 < edge.sum() < 1500 and not (found["edge"] == 2).any()
    assert edge[found["surface"] == ROOF].mean() == pytest.approx(0.09, abs=0.05)


def test_right_view_comes_back_to_itself() -> None:
    """What a right pixel shows lies where the left view's own truth has it in the right grid."""
    scene = TOWN.scenes[0]
    model = turned(TOWN, (0.37, -0.21))
    window = slice(100, 228), slice(100, 228)
    right = truth_window(model, TOWN, scene, *window, view="right")
    y, x = np.mgrid[window].astype(float)
    seen = right["visible"] == 1
    assert 0.5 < seen.mean() < 1.0 and right["hidden"].any()
    at = x + right["disparity"], y - right["y_parallax"]
    left = truth_at(TOWN, scene, *model.epipolar_to_left(*at))
    x_back, y_back = model.right_to_epipolar(left["right_col"], left["right_row"])
    assert (left["surface"] == right["surface"])[seen].mean() > 0.999
    assert (left["visible_right"] == 1)[seen].mean() > 0.999
    same = seen & (left["surface"] == right["surface"])
    # where a ray grazes a surface, 2 cm of tolerance are more along it
    for back, here in ((x_back, x), (y_back, y)):
        off = np.abs(back - here)[same]
        assert np.quantile(off, 0.99) < 2e-3 and off.max() < 0.1
    hidden = right["hidden"] == 1
    assert (np.abs(x_back - x)[hidden] > 0.01).mean() > 0.99


def test_pixel_centres_that_are_raw_centres_hold_the_raw_truth(tmp_path: Path) -> None:
    scene = TOWN.scenes[0]
    simulate_truth(TOWN, scene, tmp_path / "raw.zarr")
    raw = open_truth(tmp_path / "raw.zarr")
    model = turned(TOWN, (0.0, 0.0))
    model.save(tmp_path / "epipolar.json")
    for workers in (1, 2):
        out = tmp_path / f"grid{workers}.zarr"
        write_grid_truth(TOWN, scene, tmp_path / "epipolar.json", out, workers=workers)
    files = [
        sorted(p for p in (tmp_path / f"grid{n}.zarr").rglob("*") if p.is_file()) for n in "12"
    ]
    assert [a.read_bytes() for a in files[0]] == [b.read_bytes() for b in files[1]]
    grid = zarr.open_group(out, mode="r")

    def upright(name: str) -> np.ndarray:
        return grid[name][:].T[:, ::-1]

    for name, other in (
        ("visible", "visible_right"), ("hidden", "hidden_right"), ("surface", "surface"),
        ("changed", "changed"), ("changed_right", "changed_right"), ("covered", "covered"),
    ):  # fmt: skip
        assert (upright(name) == raw[other].values).all(), name
    row, col = np.mgrid[0:640, 0:620]
    expected = row - raw.right_row.values
    np.testing.assert_allclose(upright("disparity"), expected, atol=2e-5)
    ready = prepare(TOWN, scene)
    expected = ready.right.cols - 1 - raw.right_col.values - (619 - col)
    np.testing.assert_allclose(upright("y_parallax"), expected, atol=4e-5)
    # both kinds of change occur, and each in view of the LiDAR that is higher or lower
    changed, height = raw.changed.values, raw.height.values
    assert {0, 1, 2} == set(np.unique(changed))
    xyz = locate(
        ready.left.cam, ready.frame, np.argwhere(changed == 1)[:, ::-1], height[changed == 1]
    )
    boxes = ready.surfaces.boxes[ready.surfaces.box_view == 2]
    far = np.min([np.hypot(*(xyz[:, :2] - b[:2]).T) - np.hypot(*b[4:6]) for b in boxes], axis=0)
    assert (far < 6).all()  # beside or below a box that the LiDAR alone has
    assert not ((upright("changed_right") > 0) & (changed > 0)).any()
