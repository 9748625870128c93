"""Stated uncertainties against errors: what theory says of oracles, ignorance and intervals."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stereobench.scores.confidence import LEVELS, SHARES, Confidence

COUNT = 400_000


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(7)


def confidence(error, sigma, parts=1):
    found = Confidence()
    for some in np.array_split(np.arange(len(error)), parts):
        truth = np.full(len(some), 5.0)
        found.add(truth + error[some], sigma[some], truth)
    return found


def test_an_oracle_has_no_area(rng):
    error = rng.normal(0, 2, COUNT)
    found = confidence(error, np.abs(error)).figures()
    assert found["ause_px"] == 0 and found["ause_share_of_random"] == 0
    assert found["ause_random_px"] > 0.3
    # any that has the order right is one; the width of the bins (0.5 %) is what it costs
    assert confidence(error, 3 * np.abs(error)).figures()["ause_px"] == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("tied", [True, False], ids=["all equal", "random"])
def test_what_knows_nothing_has_the_area_of_theory(rng, tied):
    """Errors evenly from 0 to 1 px: the oracle leaves (1 - f) / 2 of a share f taken away, and
    what knows nothing 1 / 2, so that the area between is 1 / 4 px."""
    error = rng.uniform(0, 1, COUNT)
    sigma = np.ones(COUNT) if tied else rng.uniform(0.1, 2, COUNT)
    found = confidence(error, sigma)
    stated, oracle = found.curves()
    assert stated == pytest.approx(np.full(len(SHARES), 0.5), abs=1e-3 if tied else 0.02)
    assert oracle == pytest.approx((1 - SHARES) / 2, abs=2e-3)
    figures = found.figures()
    assert figures["ause_px"] == pytest.approx(0.25, abs=1e-3 if tied else 5e-3)
    assert figures["ause_random_px"] == pytest.approx(0.25, abs=1e-3)
    assert figures["ause_share_of_random"] == pytest.approx(1, abs=0.02)


def test_normal_errors_of_stated_spread_lie_in_their_intervals(rng):
    sigma = rng.uniform(0.2, 3, COUNT)
    error = rng.normal(0, sigma)
    found = confidence(error, sigma).figures()
    too_sure = confidence(error, sigma / 2).figures()
    for level in LEVELS:
        name = f"interval_{100 * level:g}_percent"
        assert found[f"{name}_coverage_share"] == pytest.approx(level, abs=4e-3)
        assert too_sure[f"{name}_coverage_share"] < level - 0.1
    assert found["calibration_factor"] == pytest.approx(1, abs=0.01)
    assert too_sure["calibration_factor"] == pytest.approx(2, abs=0.02)
    # 68.27 %: one standard deviation to either side
    assert found["interval_68.27_percent_mean_width_px"] == pytest.approx(2 * 1.6, rel=5e-3)
    assert 0 < found["ause_px"] < found["ause_random_px"]
    json.dumps(found)


def test_pixels_that_lack_something_do_not_count():
    found = Confidence()
    assert found.figures() == {"pixels": 0}
    one = np.array([1.0, np.nan, 1.0, 1.0])
    found.add(one, np.roll(one, 1), np.roll(one, 2))
    assert found.count == 1
    assert found.figures()["ause_px"] == found.figures()["epe_px"] == 0
    assert found.figures()["ause_share_of_random"] is None
