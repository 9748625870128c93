"""Alignments from control points: known biases, blunders, uncertainty, refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereotruth.align.align import align, from_rpcs, write_alignment
from stereotruth.align.alignment import RPC_SHIFT, Alignment
from stereotruth.align.figures import draw_residuals
from stereotruth.core.errors import InputError
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.real_data import MARSEILLE
from ...synthetic.surveyed_pair import HEIGHT, LAT, LON, RPCS, SIZES, TRUE, change, make_gcps, run


def corner_error(affine: np.ndarray, true: np.ndarray, size: tuple[int, int]) -> float:
    c, r = np.array([[0, size[0], 0, size[0]], [0, 0, size[1], size[1]]], float)
    return float(np.abs((affine - true) @ np.array([c, r, np.ones(4)])).max())


@pytest.mark.parametrize("n", [4, 15])
def test_known_affine_is_recovered_from_noise_free_points(images, tmp_path, n):
    result = run(images, tmp_path, make_gcps(n, noise=0.0))
    for fit in result.fits:
        assert corner_error(fit.affine, TRUE[fit.view], fit.size) < 1e-4
        assert not fit.left_out and fit.sigma0 < 1e-4
    assert not result.warnings
    assert np.array_equal(result.left.affine, result.left_fit.affine)


@pytest.mark.parametrize("model", ["similarity", "shift"])
def test_simpler_models_are_recovered(images, tmp_path, model):
    turn = np.array([[1.0003, -0.0004, 5.0], [0.0004, 1.0003, -7.0]])
    moved = np.array([[1.0, 0.0, -9.5], [0.0, 1.0, 2.25]])
    true = dict.fromkeys(TRUE, turn if model == "similarity" else moved)
    result = run(images, tmp_path, make_gcps(8, noise=0.0, true=true), model=model)
    for fit in result.fits:
        assert corner_error(fit.affine, true[fit.view], fit.size) < 1e-4


def test_same_as_opencv_on_clean_points(images, tmp_path):
    """cv2.estimateAffine2D refines by Levenberg-Marquardt to a few 1e-3 px of the exact minimum."""
    for fit in run(images, tmp_path, make_gcps(15)).fits:
        predicted = np.array([g.predicted for g in fit.gcps])
        measured = np.array([g.measured for g in fit.gcps])
        theirs, _ = cv2.estimateAffine2D(predicted, measured, refineIters=100)
        assert corner_error(fit.affine, theirs, fit.size) < 0.02


@pytest.mark.parametrize("n", [15, 64])  # all minimal samples, and some of them
def test_order_of_the_points_changes_nothing(images, tmp_path, n):
    rows = make_gcps(n)
    for i in range(4, n, 12):
        rows[i]["right_row"] += 15.0 + i
    there, back = (run(images, tmp_path, some).to_dict() for some in (rows, rows[::-1]))
    for record in (there, back):
        del record["provenance"]
    assert there == back
    assert there["right"]["left_out"] == [f"G{i + 1:02d}" for i in range(4, n, 12)]


@pytest.mark.parametrize(("n", "blunders"), [(5, 1), (15, 4)])
def test_blunders_in_one_image_are_named_and_left_out_of_it_only(images, tmp_path, n, blunders):
    clean = run(images, tmp_path, make_gcps(n))
    rng = np.random.default_rng(n)
    rows = make_gcps(n)
    bad = rng.permutation(n)[:blunders]
    for i in bad:
        angle = rng.uniform(0, 2 * np.pi)
        rows[i]["left_col"] += 20 * np.cos(angle)
        rows[i]["left_row"] += 20 * np.sin(angle)
    result = run(images, tmp_path, rows)
    assert [g.id for g in result.left_fit.left_out] == sorted(f"G{i + 1:02d}" for i in bad)
    assert result.right_fit.left_out == ()
    assert np.array_equal(result.right.affine, clean.right.affine)
    for gcp in result.left_fit.left_out:
        assert 14 < np.hypot(*gcp.after) < 26
        assert "this image only" in gcp.reason
        assert any(gcp.id in text and "left image" in text for text in result.warnings)


# 15 m; and 7.3 px at 26 degrees, 1.6 px at 5 degrees
@pytest.mark.parametrize("wrong", [{"lat": 15.0 / 110950.0}, {"height": 12.0}])
def test_a_wrong_ground_coordinate_is_left_out_of_both(images, tmp_path, wrong):
    rows = make_gcps(12)
    for name, off in wrong.items():
        rows[7][name] += off
    for fit in run(images, tmp_path, rows).fits:
        assert [g.id for g in fit.left_out] == ["G08"]
        assert "wrong ground coordinates" in fit.left_out[0].reason


def test_leave_one_out_is_that_of_fits_without_the_point(images, tmp_path):
    rows = make_gcps(9)
    for model in ("affine", "similarity", "shift"):
        result = run(images, tmp_path, rows, model=model)
        for k, gcp in enumerate(result.left_fit.gcps):
            without = run(images, tmp_path, rows[:k] + rows[k + 1 :], model=model)
            predicted = without.left.affine @ (*gcp.predicted, 1.0)
            assert np.allclose(gcp.leave_one_out, gcp.measured - predicted, atol=1e-6)


def covariance_at(fit, col, row) -> np.ndarray:
    """Covariance [..., 2, 2] in px² of the corrected (col, row), from the GCPs' measurement."""
    design = fit.design(col, row)
    return design @ fit.covariance @ np.swapaxes(design, -1, -2)


@pytest.mark.slow
def test_covariance_predicts_the_spread_over_many_measurements(images, tmp_path):
    """Deviations at a corner over 200 sets of noise, against the predicted: within 20 %."""
    errors, predicted = [], []
    at = (3900.0, 100.0)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rows = make_gcps(15, noise=0.0)
        for row in rows:
            row["left_col"] += 0.25 * rng.standard_normal()
            row["left_row"] += 0.25 * rng.standard_normal()
        fit = run(images, tmp_path, rows).left_fit
        rpc = np.linalg.solve(TRUE["left"][:, :2], np.array(at) - TRUE["left"][:, 2])
        errors.append(fit.affine @ (*rpc, 1.0) - at)
        predicted.append(covariance_at(fit, *at))
    expected = np.sqrt(np.mean(predicted, axis=0).diagonal())
    assert np.allclose(np.std(errors, axis=0), expected, rtol=0.2)


def collinear(n: int = 12) -> list[dict]:
    rows = make_gcps(n, noise=0.0)
    for k, row in enumerate(rows):
        row["lon"], row["lat"] = LON + 0.001 * (k - n / 2), LAT + 0.0005 * (k - n / 2)
        row["height"] = HEIGHT
        for view in ("left", "right"):
            there = SensorModel(RPCS[view], TRUE[view]).project(row["lon"], row["lat"], HEIGHT)
            row[f"{view}_col"], row[f"{view}_row"] = map(float, there)
    return rows


def off(count: int, n: int, view: str) -> list[dict]:
    """Of ``n`` points, some that are off in a view by more and more."""
    rows = make_gcps(n)
    for k in range(count):
        rows[k][f"{view}_col"] += 50.0 * (k + 1)
    return rows


@pytest.mark.parametrize(
    ("rows", "options", "told"),
    [
        (make_gcps(3), {}, "'similarity' or 'shift'"),
        (make_gcps(2), {"model": "similarity"}, "'shift'"),
        (collinear(), {}, "one line"),
        (off(1, 4, "left"), {}, "G01"),
        (off(5, 14, "right"), {}, "5 of 14 GCPs"),
        (change(make_gcps(), left_col=4100.0), {}, "GCP G06"),
        ([{**row, "lon": row["lon"] - 3} for row in make_gcps()], {}, "112."),
        ([{**row, "left_row": 2999 - row["left_row"]} for row in make_gcps()], {}, "200 %"),
        ([{**row, "height": row["height"] / 0.3048} for row in make_gcps()], {}, "do not fit"),
        ([{**row, "right_col": "", "right_row": ""} for row in make_gcps()], {}, "0 GCPs"),
        (change(make_gcps(), left_col=500.0), {"strict": True}, "GCP G06 left out"),
    ],
)
def test_refusals_name_file_and_remedy(images, tmp_path, rows, options, told):
    with pytest.raises(InputError) as caught:
        run(images, tmp_path, rows, **options)
    text = str(caught.value)
    assert told in text and "Remedy: " in text and "Test-1" in text
    assert text.startswith(str(tmp_path / "gcps.csv"))


def test_without_gcps_the_rpcs_stand_with_their_uncertainty(images, tmp_path):
    alignment = from_rpcs(images["left"], images["right"], scene="S-1")
    assert (alignment.left.affine == np.eye(2, 3)).all()
    middle = covariance_at(alignment.left_fit, SIZES["left"][0] / 2, SIZES["left"][1] / 2)
    assert np.sqrt(np.diag(middle)) == pytest.approx([RPC_SHIFT] * 2, rel=1e-3)
    assert "no ground control points" in alignment.warnings[0]
    files = [tmp_path / name for name in ("a.json", "r.csv", "f.png")]
    write_alignment(alignment, *files[:2])
    draw_residuals(alignment, files[2])
    again = Alignment.read(files[0])
    assert again.to_dict() == alignment.to_dict()
    assert np.isnan(again.left_fit.sigma0) and np.isnan(again.left_fit.rms("after"))


@pytest.mark.skipif(not MARSEILLE.is_dir(), reason="the shared real scene is not here")
def test_marseille():
    """Measured independently: right image off by (-1.192, 0.051) px, left by almost nothing."""
    result = align(MARSEILLE / "left.tif", MARSEILLE / "right.tif", MARSEILLE / "gcps.csv")
    middle = np.array([512.0, 512.0, 1.0])
    assert np.allclose(result.left.affine @ middle - 512, 0.0, atol=0.05)
    assert np.allclose(result.right.affine @ middle - 512, (-1.192, 0.051), atol=0.02)
    assert not result.warnings
    assert 79 < result.reference_height < 315
