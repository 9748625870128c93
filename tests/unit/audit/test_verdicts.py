"""Estimates with intervals that hold, and verdicts at the rate of false alarms that is stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereobench.audit.estimates import Estimate, cells, location, ratio, robust_fit
from stereobench.audit.verdicts import FAULT, GOOD, Audited, judge
from stereotruth.core.config.methods import AuditLimits
from stereotruth.tiles.stereo_dataset import Pair

PAIR = Pair("P", "City", "test", Path(), Path(), None)


@pytest.mark.slow
def test_intervals_hold_what_they_promise():
    """Errors common to a cell: an interval that took the matches for independent would not hold."""
    rng = np.random.default_rng(5)
    covered = independent = 0
    runs = 200
    for _ in range(runs):
        x, y = rng.uniform(0, 1024, (2, 800))
        group = cells(x, y)
        shared = rng.normal(0, 0.1, group.max() + 1)[group]
        values = shared + rng.normal(0, 0.1, x.size)
        values[:80] += 8  # mismatches
        found = location(values, group)
        low, high = found.interval(0.05)
        covered += low <= 0 <= high
        wrong = 1.96 * np.std(values[80:]) / np.sqrt(720)
        independent += abs(found.value) <= wrong
    assert 0.90 <= covered / runs <= 0.99
    assert independent / runs < 0.85


def test_robust_fit_finds_a_trend_among_mismatches():
    rng = np.random.default_rng(6)
    x, y = rng.uniform(-1, 1, (2, 2000))
    values = 0.3 - 0.5 * x + 0.2 * y + rng.normal(0, 0.1, x.size)
    values[:200] = rng.uniform(-5, 5, 200)
    design = np.column_stack([np.ones(x.size), x, y])
    found = robust_fit(design, values, cells(512 + 512 * x, 512 + 512 * y))
    for got, true in zip(found, (0.3, -0.5, 0.2)):
        assert abs(got.value - true) < 4 * got.error
        assert got.error < 0.01


def test_too_few_cells_say_nothing():
    assert location(np.zeros(50), np.zeros(50, np.int64)).beyond(0.3, 0.01) is None
    assert ratio(np.ones(3), np.ones(3), np.arange(3)).beyond(0.5, 0.01) is None
    assert Estimate(2.0, 0.1, 20).beyond(0.3, 0.01) is True
    assert Estimate(0.0, 0.01, 20).beyond(0.3, 0.01) is False
    assert Estimate(0.3, 0.05, 20).beyond(0.3, 0.01) is None


def verdict(bias, error, limits):
    plain = [0.0, 0.01, 40]
    figures = {
        "same_shape": True,
        "identical_images": False,
        "grey_values": {},
        "dtype": ["uint16"],
        "matches": 500,
        "rows": {"parallax": plain, "tilt_x": plain, "tilt_y": plain},
        "labels": {"labelled": 0.8, "strays": [], "outside": 0.0, "spikes": [], "step": None},
        "convention": {"taken": "as stated"},
        "bias": {
            "matches": 500,
            "bias": [bias, error, 40],
            **dict.fromkeys(("tilt_x", "tilt_y", "scale"), plain),
        },
        "contradicted": {"share": [0.001, 0.001, 40], "labels": 5000},
        "hidden": {"share": 0.0},
        "registration": {"move": [1, 0], "gain": [-0.1, 0.01, 40]},
    }
    return Audited(PAIR, figures, judge(figures, limits, 20)).verdict


@pytest.mark.slow
def test_verdicts_have_the_error_rate_that_is_stated():
    """Biases at the very edge of what is tolerated, many datasets of 20 pairs."""
    rng = np.random.default_rng(62)
    limits = AuditLimits(contradicted_share=0.05, false_alarms=0.2)
    alarms = 0
    for _ in range(120):
        seen = 0.3 + 0.05 * rng.standard_normal(20)
        spread = 0.05 * np.sqrt(rng.chisquare(40, 20) / 40)
        alarms += any(verdict(b, e, limits) == FAULT for b, e in zip(seen, spread))
    assert alarms / 120 <= 0.2
    assert verdict(2.0, 0.05, limits) == FAULT
    assert verdict(0.0, 0.02, limits) == GOOD
    assert verdict(0.3, 0.05, limits) == "undecided"
