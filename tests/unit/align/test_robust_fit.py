"""Blunders among control points."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.align.gcp_checks import System, find_blunders


@pytest.mark.slow
def test_good_points_with_noise_are_never_thrown_away():
    """300 random sets of 4 to 20 points with 0.25 px noise."""
    rng = np.random.default_rng(5)
    thrown = 0
    for k in range(300):
        n = int(rng.integers(4, 21))
        predicted = rng.uniform(0, 3000, (n, 2))
        measured = predicted + [5, -8] + 0.25 * rng.standard_normal((n, 2))
        used, _, _ = find_blunders(System.of("affine", predicted, measured), floor=1.25, seed=k)
        thrown += int((~used).sum())
    assert thrown == 0
