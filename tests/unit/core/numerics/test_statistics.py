"""Robust estimates of what is known, with blunders in it; sums of errors against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.statistics import (
    Calibration,
    ErrorSum,
    biweight,
    huber_weights,
    median_and_nmad,
    reweighted_fit,
    robust_sigma,
    tukey_weights,
)

TRUE = np.array([2.0, -0.5])


def line(blunders: float, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    x = rng.uniform(-5, 5, 400)
    y = TRUE[0] + TRUE[1] * x + rng.normal(0, noise, x.size)
    y[rng.choice(x.size, int(blunders * x.size), replace=False)] += 8.0
    return np.column_stack([np.ones(x.size), x]), y


def test_deviations_of_a_normal_distribution():
    errors = np.random.default_rng(2).normal(0.3, 0.5, 40000)
    assert median_and_nmad(errors) == pytest.approx((0.3, 0.5), abs=0.02)
    assert robust_sigma(errors - 0.3, 0.0) == pytest.approx(0.5, abs=0.02)
    assert robust_sigma(errors, 3.0) == 3.0


def test_weights_fall_from_one_to_nothing():
    assert biweight(np.array([0.0, 0.5, -0.5, 1.0, 7.0, np.nan])).tolist() == [
        1, 0.5625, 0.5625, 0, 0, 0,
    ]  # fmt: skip
    assert tukey_weights(np.array([0.0, 4.685])) == pytest.approx([1, 0])
    assert huber_weights(np.array([0.0, -1.345, 2.69])) == pytest.approx([1, 1, 0.5])


@pytest.mark.parametrize("weights", [tukey_weights, huber_weights])
def test_blunders_do_not_move_a_line(weights):
    design, values = line(blunders=0.2)
    plain = np.linalg.lstsq(design, values, rcond=None)[0]
    assert abs(plain[0] - TRUE[0]) > 1.0
    start = np.array([np.median(values), 0.0])
    found = reweighted_fit(design, values, weights, least_sigma=1e-4, start=start)
    # Huber's weight of a blunder is small and not nothing
    assert found == pytest.approx(TRUE, abs=0.012 if weights is tukey_weights else 0.06)
    design, values = line(blunders=0.0, noise=0.0)
    found = reweighted_fit(design, values, huber_weights, least_sigma=1e-3)
    assert found == pytest.approx(TRUE, abs=1e-9)


def test_error_sum_agrees_with_numpy():
    rng = np.random.default_rng(1)
    errors = np.concatenate([rng.normal(0.05, 0.3, 20001), rng.uniform(-40, 40, 300)])
    total, part = ErrorSum(), ErrorSum()
    total.add(errors[:7000])
    part.add(errors[7000:])
    total.merge(part)
    figures = total.figures()
    assert figures["count"] == errors.size
    assert figures["mean_absolute"] == pytest.approx(np.abs(errors).mean(), abs=1e-6)
    assert figures["rms"] == pytest.approx(np.sqrt((errors**2).mean()), abs=1e-6)
    assert figures["bias"] == pytest.approx(errors.mean(), abs=1e-6)
    assert figures["max"] == pytest.approx(np.abs(errors).max(), abs=1e-6)
    assert figures["median"] == pytest.approx(np.median(errors), abs=0.0021)
    assert figures["median_absolute"] == pytest.approx(np.median(np.abs(errors)), abs=0.0021)
    assert figures["share_over_1_px"] == pytest.approx((np.abs(errors) > 1).mean(), abs=1e-6)
    assert figures["nmad"] == pytest.approx(median_and_nmad(errors)[1], abs=0.004)
    assert ErrorSum().figures()["mean_absolute"] is None


def test_calibration_of_a_normal_distribution_and_of_another_by_decile():
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.05, 0.5, 200_000)
    calibration, part = Calibration(), Calibration()
    calibration.add(rng.normal(0, sigma[:50_000]), sigma[:50_000])
    part.add(rng.normal(0, sigma[50_000:]), sigma[50_000:])
    calibration.merge(part)
    figures = calibration.figures()
    assert figures["share_below_1"] == pytest.approx(0.6827, abs=0.005)
    assert figures["share_below_2"] == pytest.approx(0.9545, abs=0.003)
    assert figures["mean_uncertainty"] == pytest.approx(0.275, abs=0.002)
    for k, decile in enumerate(figures["deciles"]):
        assert decile["count"] == pytest.approx(20_000, rel=0.1)
        assert decile["mean_uncertainty"] == pytest.approx(0.0725 + 0.045 * k, rel=0.02)
        assert decile["rms_error"] == pytest.approx(decile["mean_uncertainty"], rel=0.04)
        assert decile["share_below_1"] == pytest.approx(0.6827, abs=0.02)
    assert sum(d["count"] for d in figures["deciles"]) == figures["count"] == 200_000

    # half of the uncertainties, the small ones, are too small by a factor of two
    wrong = Calibration()
    wrong.add(rng.normal(0, np.where(sigma < 0.275, 2 * sigma, sigma)), sigma)
    deciles = wrong.figures()["deciles"]
    assert deciles[0]["share_below_1"] == pytest.approx(0.3829, abs=0.02)
    assert deciles[-1]["share_below_1"] == pytest.approx(0.6827, abs=0.02)
    assert Calibration().figures()["deciles"] == []
