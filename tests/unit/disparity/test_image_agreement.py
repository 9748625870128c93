"""Agreement of images and labels on small fields whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.image_agreement import (
    outvoted,
    outvoted_nearby,
    surface_mean,
    warp_to_left,
)
from stereotruth.disparity.image_patches import read_patch
from stereotruth.epipolar.surface_correlation import surface_correlation

LEVEL = np.zeros((2, 80, 80))


def texture(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(200, 1200, shape)


def test_warp_samples_at_x_less_disparity() -> None:
    """A cubic along x is reproduced to its last digit; outside the image there is nothing."""
    x = np.arange(200.0)
    image = np.broadcast_to(np.round(500 + 2 * x + 0.01 * x * x), (40, 200)).astype(np.uint16)
    rows, cols = slice(5, 25), slice(60, 120)
    patch = read_patch(image, rows, slice(0, 200), 9)
    disparity = np.full((20, 60), 10.25)
    warped = warp_to_left(patch, rows, cols, disparity)
    at = np.arange(60, 120) - 10.25
    assert np.abs(warped - (500 + 2 * at + 0.01 * at * at)).max() < 0.6  # of the rounding
    disparity[:, :5] = np.nan
    disparity[:, 5:9] = 300.0
    warped = warp_to_left(patch, rows, cols, disparity)
    assert np.isnan(warped[:, :9]).all()
    assert np.isfinite(warped[:, 9:]).all()


def test_surface_correlation_stays_on_the_surface() -> None:
    """Beside a step, what the other surface shows does not count."""
    left = texture((60, 60))
    warped = 0.7 * left + 40
    warped[:, 30:] = texture((60, 30), seed=1)  # the upper surface shows something else
    disparity = np.zeros((60, 60))
    disparity[:, 30:] = 20.0
    found = surface_correlation(left, warped, disparity, LEVEL[:, :60, :60], 9)
    assert found[:, :30] == pytest.approx(1.0, abs=1e-5)
    assert np.abs(found[:, 30:]).mean() < 0.25
    # With one surface, the same pixels would be mixed.
    mixed = surface_correlation(left, warped, np.zeros((60, 60)), LEVEL[:, :60, :60], 9)
    assert mixed[:, 28:30].max() < 0.99


def test_correlation_is_that_of_numpy() -> None:
    left, warped = texture((21, 21)), texture((21, 21), seed=1)
    warped[3, 4] = np.nan
    found = surface_correlation(left, warped, np.zeros((21, 21)), LEVEL[:, :21, :21], 7)
    window = np.s_[2:9, 3:10]
    known = np.isfinite(warped[window])
    expected = np.corrcoef(left[window][known], warped[window][known])[0, 1]
    assert found[5, 6] == pytest.approx(expected, abs=1e-5)
    assert np.isnan(found[3, 4])
    assert (
        surface_correlation(left, np.full((21, 21), 5.0), np.zeros((21, 21)), LEVEL[:, :21, :21], 7)
        == 0
    ).all()


def test_single_failures_are_not_change_but_a_region_is() -> None:
    correlation = np.full((80, 80), 0.9)
    rng = np.random.default_rng(2)
    correlation[rng.random((80, 80)) < 0.2] = 0.1
    disparity = np.zeros((80, 80))
    assert not outvoted(correlation, disparity, LEVEL, 0.5).any()
    disparity[30:50, 30:50] = 15.0
    correlation[30:50, 30:50] = np.where(rng.random((20, 20)) < 0.2, 0.9, 0.1)
    changed = outvoted(correlation, disparity, LEVEL, 0.5)
    assert changed[30:50, 30:50].all()
    assert changed.sum() == 400
    disparity[40, 40] = np.nan
    assert not outvoted(correlation, disparity, LEVEL, 0.5)[40, 40]


def test_a_slope_is_one_surface_and_a_low_roof_another() -> None:
    """A hillside of 0.8 px per px votes as one; ground does not vote for a roof of 3.5 px."""
    x = np.broadcast_to(np.arange(60.0), (60, 60))
    slope = np.zeros((2, 60, 60))
    slope[0] = 0.8
    correlation = np.full((60, 60), 0.9)
    correlation[30, 30] = 0.1
    assert not outvoted(correlation, 0.8 * x, slope, 0.5).any()
    roof = np.s_[22:38, 22:38]
    disparity, correlation = np.zeros((60, 60)), np.full((60, 60), 0.9)
    disparity[roof], correlation[roof] = 3.5, 0.2
    changed = outvoted(correlation, disparity, np.zeros((2, 60, 60)), 0.5)
    assert changed[roof].all()
    assert changed.sum() == 256


def test_surface_mean_is_that_of_the_surface() -> None:
    values = np.ones((60, 60))
    disparity = np.zeros((60, 60))
    disparity[:, 30:], values[:, 30:] = 20.0, 5.0
    values[10, 10] = np.nan
    level = LEVEL[:, :60, :60]
    found = surface_mean(values, disparity, level, 4, 1)
    assert found[:, :30] == pytest.approx(1.0)
    assert found[:, 30:] == pytest.approx(5.0)
    assert np.isnan(surface_mean(np.full((60, 60), np.nan), disparity, level)).all()


@pytest.mark.parametrize("usual", [0.95, 0.65])
def test_what_is_small_is_told_by_what_is_usual_around_it(usual) -> None:
    """A tree of 6 px amid agreeing ground: its surroundings outvote it, its own pixels do not."""
    correlation = np.full((80, 80), usual)
    correlation[37:43, 37:43] = 0.45
    level = np.zeros((80, 80))
    assert not outvoted(correlation, level, LEVEL, 0.5).any()
    found = outvoted_nearby(correlation, level, LEVEL, 0.0, 0.8, 2)
    assert found[39:41, 39:41].all()
    assert not found[:30].any() and not found[:, 50:].any()
