"""The spread of two results."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.methods.matcher import spread


def test_two_independent_results_tell_their_standard_deviation():
    rng = np.random.default_rng(1)
    first, second = rng.normal(20, 0.5, (2, 200, 200)).astype(np.float32)
    sigma = spread(first, second)
    assert np.sqrt((sigma[2:-2, 2:-2] ** 2).mean()) == pytest.approx(0.5, rel=0.03)
    assert sigma.dtype == np.float32


def test_holes_of_either_do_not_count():
    first, second = np.zeros((2, 12, 12), np.float32)
    second += np.float32(np.sqrt(2))
    second[3, 3] = first[7, 7] = np.nan
    first[0, 0], second[0, 0] = np.nan, 1e6
    sigma = spread(first, second)
    assert np.isnan(sigma[[0, 7], [0, 7]]).all() and np.isnan(sigma).sum() == 2
    assert sigma[3, 3] == pytest.approx(1) and np.nanmax(np.abs(sigma - 1)) < 1e-6
