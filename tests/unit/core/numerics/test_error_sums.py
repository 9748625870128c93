"""Sums of errors against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.statistics import Calibration, ErrorSum, median_and_nmad

# --------------------------------------------------------------------------------- statistics


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
    nmad = median_and_nmad(errors)[1]
    assert figures["nmad"] == pytest.approx(nmad, abs=0.004)
    assert ErrorSum().figures()["mean_absolute"] is None


def test_calibration_of_a_normal_distribution_and_of_another_by_decile():
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.05, 0.5, 200_000)
    calibration, part = Calibration(), Calibration()
    calibration.add(rng.normal(0, sigma[:50_000]), sigma[:50_000])
    part.add(rng.normal(0, sigma[50_000:]), sigma[50_000:])
    calibration.merge(part)
    figures = calibration.figures()
    assert figures["count"] == 200_000
    assert figures["share_below_1"] == pytest.approx(0.6827, abs=0.005)
    assert figures["share_below_2"] == pytest.approx(0.9545, abs=0.003)
    assert figures["mean_uncertainty"] == pytest.approx(0.275, abs=0.002)
    for k, decile in enumerate(figures["deciles"]):
        assert decile["count"] == pytest.approx(20_000, rel=0.1)
        assert decile["mean_uncertainty"] == pytest.approx(0.0725 + 0.045 * k, rel=0.02)
        assert decile["rms_error"] == pytest.approx(decile["mean_uncertainty"], rel=0.04)
        assert decile["share_below_1"] == pytest.approx(0.6827, abs=0.02)
    assert sum(d["count"] for d in figures["deciles"]) == 200_000

    # half of the uncertainties, the small ones, are too small by a factor of two
    wrong = Calibration()
    wrong.add(rng.normal(0, np.where(sigma < 0.275, 2 * sigma, sigma)), sigma)
    deciles = wrong.figures()["deciles"]
    assert deciles[0]["share_below_1"] == pytest.approx(0.3829, abs=0.02)
    assert deciles[0]["share_below_2"] == pytest.approx(0.6827, abs=0.02)
    assert deciles[-1]["share_below_1"] == pytest.approx(0.6827, abs=0.02)
    assert Calibration().figures() == {
        "count": 0, "share_below_1": None, "share_below_2": None, "deciles": []
    }  # fmt: skip
