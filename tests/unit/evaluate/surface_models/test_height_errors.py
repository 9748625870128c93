"""Sums of vertical errors against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.evaluate.surface_models.score import HeightErrors


def test_figures_are_those_of_all_errors():
    rng = np.random.default_rng(0)
    errors = rng.normal(0.4, 1.3, 20_000)
    errors[:3000] = np.nan
    of = HeightErrors()
    for part in np.array_split(errors, 7):
        of.add(part)
    known = errors[3000:]
    found = of.figures()
    assert found["points"] == 20_000
    assert found["known_share"] == pytest.approx(0.85)
    assert found["mean_m"] == pytest.approx(known.mean(), abs=1e-4)
    assert found["mean_absolute_m"] == pytest.approx(np.abs(known).mean(), abs=1e-4)
    assert found["rms_m"] == pytest.approx(np.sqrt((known**2).mean()), abs=1e-4)
    median = np.median(known)
    assert found["median_m"] == pytest.approx(median, abs=0.006)
    assert found["nmad_m"] == pytest.approx(1.4826 * np.median(np.abs(known - median)), abs=0.02)
    assert found["le90_m"] == pytest.approx(np.quantile(np.abs(known), 0.9), abs=0.01)
    assert found["share_over_1_m"] == pytest.approx((np.abs(known) > 1).mean(), abs=1e-4)


def test_nothing_is_told_of_nothing():
    assert HeightErrors().figures()["known_share"] is None
    lost = HeightErrors()
    lost.add(np.full(5, np.nan))
    assert lost.figures()["known_share"] == 0.0
    assert lost.figures()["mean_m"] is None
