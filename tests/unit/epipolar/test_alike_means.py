"""Means over pixels of one surface that are as bright as the centre, on small made images."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.alike_correlation import brightness_of_pair
from stereotruth.epipolar.alike_means import AS_BRIGHT, alike_mean
from stereotruth.epipolar.surface_correlation import wanted_runs

SHAPE = 40, 60
EVERY = np.ones(SHAPE, np.bool_)
FLAT = np.zeros((2, *SHAPE))
NO_NOISE = 0.0, 0.0


def by_hand(
    values: np.ndarray, left: np.ndarray, right: np.ndarray, disparity: np.ndarray,
    y: int, x: int, reach: int, every: int,
) -> float:  # fmt: skip
    """The mean at one pixel, in float64."""
    levels = brightness_of_pair(left, right)
    steps = range(-reach, reach + 1, every)
    found = []
    for b in (y + step for step in steps if 0 <= y + step < SHAPE[0]):
        for a in (x + step for step in steps if 0 <= x + step < SHAPE[1]):
            same = abs(disparity[b, a] - disparity[y, x]) <= 1.0 and np.isfinite(values[b, a])
            same &= all(abs(of[b, a] - of[y, x]) <= AS_BRIGHT * of[y, x] for of in levels)
            if same:
                found.append(values[b, a])
    return float(np.mean(found)) if found else np.nan


@pytest.mark.parametrize(("reach", "every"), [(3, 1), (6, 2)])
def test_it_is_the_mean_of_the_pixels_that_are_alike(reach: int, every: int) -> None:
    rng = np.random.default_rng(0)
    left, right = rng.uniform(300.0, 900.0, (2, *SHAPE))
    left[3:5, 3:9] = 0.0
    right[rng.uniform(size=SHAPE) < 0.05] = np.nan
    values = rng.uniform(size=SHAPE)
    values[10:12] = np.nan
    disparity = np.full(SHAPE, 3.0)
    disparity[20:] += 5.0
    given = values, left, right, disparity
    bright = brightness_of_pair(left, right)
    found = alike_mean(values, bright, disparity, FLAT, reach, every, NO_NOISE, wanted_runs(EVERY))
    expected = np.array(
        [[by_hand(*given, y, x, reach, every) for x in range(SHAPE[1])] for y in range(SHAPE[0])]
    )
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < 1e-6
    assert np.isfinite(found).mean() > 0.8


def test_it_ends_at_an_edge_of_either_image() -> None:
    """A step of the values there stays as sharp as it is."""
    rng = np.random.default_rng(1)
    left, right = rng.uniform(480.0, 520.0, (2, *SHAPE))
    left[:, 20:] *= 2.0
    right[:, 40:] *= 0.4
    values = np.zeros(SHAPE)
    values[:, 20:40] = 1.0
    bright = brightness_of_pair(left, right)
    found = alike_mean(
        values, bright, np.full(SHAPE, 2.0), FLAT, 8, 1, NO_NOISE, wanted_runs(EVERY)
    )
    beside_edges = np.abs(np.arange(SHAPE[1]) - 19.5) < 2.0  # brightness is of 3 x 3 px
    beside_edges |= np.abs(np.arange(SHAPE[1]) - 39.5) < 2.0
    assert np.array_equal(found[:, ~beside_edges], values[:, ~beside_edges])


@pytest.mark.parametrize("share", [0.02, 0.4])
def test_what_is_wanted_has_the_values_that_all_together_have(share: float) -> None:
    rng = np.random.default_rng(2)
    values, left, right = rng.uniform(0.5, 1.0, (3, *SHAPE))
    given = values, brightness_of_pair(left, right), np.full(SHAPE, 2.0), FLAT, 5, 1
    wanted = rng.uniform(size=SHAPE) < share
    every, some = (alike_mean(*given, NO_NOISE, wanted_runs(of)) for of in (EVERY, wanted))
    assert np.array_equal(every[wanted], some[wanted], equal_nan=True)
