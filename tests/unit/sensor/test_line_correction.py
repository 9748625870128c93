"""Corrections by line: their inverse, their words, the epipolar model of images that have one."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.line_correction import LineCorrection
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.cameras import HEIGHT, LAT, LON
from ...synthetic.textured_pair import SIZE, TRUE


def swinging(seed: int, px: float = 0.3) -> LineCorrection:
    """Coefficients of ``px`` each: lines jump more from one to the next than any attitude does."""
    values = np.random.default_rng(seed).normal(0, px, (2, 23))
    return LineCorrection((0.0, SIZE[1] - 1.0), values)


def jittering() -> tuple[SensorModel, SensorModel]:
    return tuple(SensorModel(s.rpc, s.affine, swinging(k)) for k, s in enumerate(TRUE))


def places(count: int = 200) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(3)
    lon, lat = LON + rng.uniform(-1e-3, 1e-3, count), LAT + rng.uniform(-1e-3, 1e-3, count)
    return lon, lat, HEIGHT + rng.uniform(-20, 20, count)


def test_what_is_added_is_taken_off_again_in_and_beside_the_image():
    lines = swinging(1)
    row = np.concatenate([np.linspace(-50, SIZE[1] + 50, 701), [np.nan]])
    col = np.full_like(row, 12.0)
    back = lines.take(*lines.add(col, row))
    assert np.allclose(back[0][:-1], 12.0, atol=1e-8)
    assert np.allclose(back[1][:-1], row[:-1], atol=1e-8)
    assert np.isnan(back[1][-1])
    assert np.abs(np.subtract(lines.add(col, row), (col, row))[:, :-1]).max() > 0.1


def test_its_record_evaluates_by_its_own_words():
    values = json.loads(json.dumps(swinging(2).to_dict()))
    row = 101.25
    n = len(values["col"])
    s = (row - values["row_min"]) / (values["row_max"] - values["row_min"]) * (n - 3)
    i = min(int(np.floor(s)), n - 4)
    f = s - i
    weights = (
        (1 - f) ** 3 / 6,
        (3 * f**3 - 6 * f**2 + 4) / 6,
        (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6,
        f**3 / 6,
    )
    by_hand = [sum(w * values[k][i + a] for a, w in enumerate(weights)) for k in ("col", "row")]
    assert np.allclose(LineCorrection.from_dict(values).at(row), by_hand, atol=1e-12)


def test_a_sensor_projects_what_it_localises():
    sensor = jittering()[0]
    lon, lat, height = places()
    col, row = sensor.project(lon, lat, height)
    back = sensor.localize(col, row, height)
    assert np.abs(np.subtract(back, (lon, lat))).max() < 1e-12
    again = SensorModel.from_dict(json.loads(json.dumps(sensor.to_dict())))
    assert np.array_equal(again.project(lon, lat, height), (col, row))
    assert np.abs(np.subtract(sensor.smooth.project(lon, lat, height), (col, row))).max() > 0.1


def test_an_rpc_that_stands_for_it_says_what_it_lacks():
    sensor = jittering()[0]
    _, of_smooth = sensor.smooth.corrected_rpc()
    _, error = sensor.corrected_rpc()
    assert of_smooth < 1e-3
    assert error > 0.2


def test_rows_of_images_that_jitter_are_equal(tmp_path):
    """What RPCs cannot follow leaves no y-parallax, and labels are where the images show them."""
    left, right = jittering()
    model = fit_epipolar(left, right, SIZE, SIZE, HEIGHT)
    model.save(tmp_path / "epipolar.json")
    model = EpipolarModel.load(tmp_path / "epipolar.json")
    ground = places()
    x_left, y_left = model.left_to_epipolar(*left.project(*ground))
    x_right, y_right = model.right_to_epipolar(*right.project(*ground))
    assert np.abs(y_left - y_right).max() < 0.01
    assert np.allclose(
        model.ground_to_epipolar(*ground), [x_left, y_left, x_right, y_right], atol=1e-6
    )
    assert np.allclose(model.epipolar_to_left(x_left, y_left), left.project(*ground), atol=1e-6)
    assert "by_line" in json.loads((tmp_path / "epipolar.json").read_text())["formula"]


@pytest.mark.parametrize("values", [np.zeros((2, 3)), np.full((2, 5), np.nan), np.zeros(8)])
def test_what_is_no_correction_is_refused(values):
    with pytest.raises(ValueError, match="correction by line"):
        LineCorrection((0.0, 10.0), values)
