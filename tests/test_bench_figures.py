"""Labels and alignments of benchmarks against check points and exact points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from figures import evaluate_checkpoints, geometry_errors, sample_labels

from .synthetic.surveyed_pair import LAT, LON
from .synthetic.truth_scene import (
    Scene,
    ground_at,
    make_scene,
    perfect_labels,
    sensor,
    write_disparity,
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"))


def test_labels_are_sampled_bilinearly_and_not_across_edges():
    y, x = np.mgrid[0:40, 0:50].astype(float)
    grid = 0.1 * x - 0.07 * y
    grid[:, 30:] += 12.0
    grid[20:, :10] = np.nan
    px = np.array([3.25, 29.4, 29.6, 5.0, 5.0, 5.0, -0.4, 49.4, 60.0])
    py = np.array([7.75, 11.0, 11.0, 19.3, 19.6, 25.0, 0.0, 39.4, 1.0])
    got, inner = sample_labels(grid, px, py)
    assert np.flatnonzero(inner).tolist() == [0, 6, 7]
    smooth = 0.1 * px - 0.07 * py
    assert got[0] == pytest.approx(smooth[0])
    assert got[1] == pytest.approx(0.1 * 29 - 0.77)
    assert got[2] == pytest.approx(0.1 * 30 - 0.77 + 12)
    assert got[3] == pytest.approx(0.1 * 5 - 0.07 * 19)  # the labelled neighbour, the nearest
    assert np.isnan(got[[4, 5, 8]]).all()  # the nearest is not labelled, or there is none
    assert got[6] == pytest.approx(0.0)
    assert got[7] == pytest.approx(0.1 * 49 - 0.07 * 39 + 12)


def test_check_points_of_perfect_labels(scene, tmp_path):
    store = write_disparity(scene, tmp_path / "disparity.zarr", perfect_labels(scene))
    rng = np.random.default_rng(6)
    col, row = rng.uniform(20, 330, 200), rng.uniform(30, 140, 200)
    lon, lat, height = ground_at(scene.model.left, col, row)
    right_col, right_row = scene.model.right.project(lon, lat, height)
    lines = ["id,lon,lat,height,left_col,left_row,right_col,right_row"]
    for k in range(200):
        values = (lon[k], lat[k], height[k], col[k], row[k], right_col[k] + 0.2, right_row[k] - 0.1)
        lines.append(f"C{k:03d}," + ",".join(f"{v:.10f}" for v in values))
    lines.append(f"C900,{LON},{LAT},60,100,100,,")
    (tmp_path / "c.csv").write_text("\n".join(lines))
    figures = evaluate_checkpoints(store, tmp_path / "c.csv", scene="S-1")
    before = np.array(scene.model.right_to_epipolar(189.0, 209.0))
    moved = np.array(scene.model.right_to_epipolar(189.2, 208.9)) - before
    assert figures["points"] == figures["labelled"] == 200
    assert figures["median"] == pytest.approx(moved[0], abs=0.003)
    assert figures["nmad"] < 0.003
    assert figures["inner"]["count"] > 150
    assert figures["y_parallax_median"] == pytest.approx(moved[1], abs=0.003)


def test_errors_on_exact_points_are_those_of_the_alignment(scene):
    """By a right sensor that is off by (0.3, -0.4) px: parallax runs along raw rows."""
    wrong = replace(scene.model, right=sensor("right", (0.3, -0.4)))
    at = np.array([189.0, 209.0])
    before = np.array(scene.model.right_to_epipolar(*at))
    moved = np.array(scene.model.right_to_epipolar(*(at + np.array([0.3, -0.4])))) - before
    disparity, parallax = geometry_errors(wrong, scene.raw_truth, step=5)
    assert disparity.figures()["bias"] == pytest.approx(-moved[0], abs=0.003)
    assert parallax.figures()["rms"] < 1e-3  # measured in the images, whatever the sensor says
    disparity, _ = geometry_errors(scene.model, scene.raw_truth, step=5)
    assert disparity.figures()["max"] < 1e-6
    assert disparity.count > 4000
