"""Robust estimates and their intervals."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit.estimates import Estimate, cells, location, ratio, robust_fit


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
    found = location(np.zeros(50), np.zeros(50, np.int64))
    assert found.beyond(0.3, 0.01) is None
    assert Estimate(2.0, 0.1, 20).beyond(0.3, 0.01) is True
    assert Estimate(0.0, 0.01, 20).beyond(0.3, 0.01) is False
    assert Estimate(0.3, 0.05, 20).beyond(0.3, 0.01) is None
    assert ratio(np.ones(3), np.ones(3), np.arange(3)).beyond(0.5, 0.01) is None
