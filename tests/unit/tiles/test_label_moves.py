"""How far labels have moved between two stores, and the worst control point."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.products.grids import Layer, atomic_store, create_grid
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.tiles.label_moves import (
    KEPT,
    edit_lines,
    keep_samples,
    moves,
    sample_labels,
    since_last_run,
    worst_point,
)

from ...synthetic.flat_model import disparity_of, make_model, plane


@pytest.fixture(scope="module")
def model() -> EpipolarModel:
    return make_model()


@pytest.fixture(scope="module")
def disparity(model) -> np.ndarray:
    values = disparity_of(model, plane)
    values[100:120, 50:90] = np.nan
    return values


def write(path: Path, model: EpipolarModel, disparity: np.ndarray, lift: float = 0.0) -> Path:
    with atomic_store(path) as scratch:
        attrs = {"epipolar": model.to_dict()}
        layers = {
            name: Layer("float32", np.nan, {"units": units, "long_name": name})
            for name, units in (("disparity", "px"), ("height", "m"))
        }
        grid = create_grid(scratch, disparity.shape, layers, chunk=64, shard=128, attrs=attrs)
        grid["disparity"][:] = disparity
        grid["height"][:] = 60.0 + lift
    return path


def test_the_same_labels_have_not_moved(tmp_path, model, disparity):
    store = write(tmp_path / "a.zarr", model, disparity)
    found = moves(sample_labels(store), store)
    assert found.count > 1000 and found.most_px < 1e-3 and found.gone_share == 0


def test_labels_moved_by_what_was_planted(tmp_path, model, disparity):
    moved = disparity + np.float32(0.03)
    moved[:, :40] += np.float32(0.2)
    moved[200:210] = np.nan
    sample = sample_labels(write(tmp_path / "a.zarr", model, disparity))
    found = moves(sample, write(tmp_path / "b.zarr", model, moved))
    assert found.median_px == pytest.approx(0.03, abs=1e-3)
    assert found.most_px == pytest.approx(0.23, abs=1e-3)
    assert 0.01 < found.gone_share < 0.05


def test_heights_move_where_the_images_follow_the_lidar(tmp_path, model, disparity):
    sample = sample_labels(write(tmp_path / "a.zarr", model, disparity))
    found = moves(sample, write(tmp_path / "b.zarr", model, disparity, lift=-0.3))
    assert found.most_px < 1e-3
    assert (found.height_median_m, found.height_most_m) == pytest.approx((0.3, 0.3), abs=1e-4)
    assert "0.300 m" in str(found)


def test_a_grid_that_lies_elsewhere_moves_no_label(tmp_path, model, disparity):
    """Both images by the same part of a pixel: the same places of both images are joined."""
    sample = sample_labels(write(tmp_path / "a.zarr", model, disparity))
    by = 0.37
    images = {f"{v}_image": getattr(model, f"{v}_image").shifted(by, 0) for v in ("left", "right")}
    other = replace(model, **images)
    there = disparity_of(other, plane)
    found = moves(sample, write(tmp_path / "b.zarr", other, there))
    assert found.median_px < 2e-3 and found.most_px < 0.01


def test_samples_are_of_the_last_run_that_ended(tmp_path, monkeypatch, model, disparity):
    monkeypatch.chdir(tmp_path)
    first = {"A-1": write(tmp_path / "a.zarr", model, disparity)}
    second = {"A-1": write(tmp_path / "b.zarr", model, disparity + np.float32(0.1))}
    assert since_last_run(first) == {}
    keep_samples(first)
    for _ in range(2):  # the second time after a job that was killed before it kept its own
        assert since_last_run(second)["A-1"].median_px == pytest.approx(0.1, abs=1e-3)
    keep_samples(second)
    np.save(KEPT / "B-1.npy", np.zeros((3, 4)))  # of a release that kept no heights
    assert since_last_run({"B-1": second["A-1"]}) == {}
    assert since_last_run(second)["A-1"].most_px < 1e-3


def point(name: str, after: float, out: float, used: bool = True) -> dict:
    return {"id": name, "after": [after, 0.0], "leave_one_out": [0.0, out], "used": used}


def test_the_worst_control_point_is_the_one_that_the_others_predict_worst():
    good = [point(str(k), 0.4, 0.1) for k in range(5)]
    record = {
        "scene": "A-1",
        "left": {"gcps": [*good, point("left out", 9.0, 9.0, used=False)]},
        "right": {"gcps": [*good, point("7", 0.25, 0.6)]},
    }
    times, text = worst_point(record)
    assert times == pytest.approx(6.0) and edit_lines({}, [record]) == [f"A-1: {text}"]
    assert all(part in text for part in ("7 (right", "0.25 px", "6.0 times"))
    assert worst_point({"left": {"gcps": [{"id": "1", "after": [0, 0]}]}}) == (0.0, "")
    assert edit_lines({}, [{}]) == []
