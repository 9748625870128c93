"""Agreement of images and labels on small fields whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.image_agreement import Agreement
from stereotruth.disparity.image_patches import read_patch
from stereotruth.disparity.surface_means import apart_from_steps, surface_mean, warp_to_left
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
    assert not Agreement(correlation, disparity, LEVEL, 0.5).outvoted().any()
    disparity[30:50, 30:50] = 15.0
    correlation[30:50, 30:50] = np.where(rng.random((20, 20)) < 0.2, 0.9, 0.1)
    changed = Agreement(correlation, disparity, LEVEL, 0.5).outvoted()
    assert changed[30:50, 30:50].all()
    assert changed.sum() == 400
    disparity[40, 40] = np.nan
    assert not Agreement(correlation, disparity, LEVEL, 0.5).outvoted()[40, 40]


def test_a_slope_is_one_surface_and_a_low_roof_another() -> None:
    """A hillside of 0.8 px per px votes as one; ground does not vote for a roof of 3.5 px."""
    x = np.broadcast_to(np.arange(60.0), (60, 60))
    slope = np.zeros((2, 60, 60))
    slope[0] = 0.8
    correlation = np.full((60, 60), 0.9)
    correlation[30, 30] = 0.1
    assert not Agreement(correlation, 0.8 * x, slope, 0.5).outvoted().any()
    roof = np.s_[22:38, 22:38]
    disparity, correlation = np.zeros((60, 60)), np.full((60, 60), 0.9)
    disparity[roof], correlation[roof] = 3.5, 0.2
    changed = Agreement(correlation, disparity, np.zeros((2, 60, 60)), 0.5).outvoted()
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


@pytest.mark.parametrize("noise", [20.0, 200.0])
@pytest.mark.parametrize("size, trust", [(10, 1.0), (8, 0.5)])
def test_what_is_small_is_told_by_what_is_usual_around_it(noise, size, trust) -> None:
    """A hut amid agreeing ground: its surroundings outvote it, its own pixels do not.

    Where points are sparse, they miss larger things, and fewer failures are enough.
    """
    left = texture((80, 80))
    warped = left + np.random.default_rng(1).normal(0.0, noise, left.shape)
    warped[36 : 36 + size, 36 : 36 + size] = texture((size, size), seed=2)
    level = np.zeros((80, 80))
    correlation = surface_correlation(left, warped, level, LEVEL, 9)
    assert not Agreement(correlation, level, LEVEL, 0.5).outvoted().any()
    found = Agreement(correlation, level, LEVEL, 0.5, trust).outvoted_nearby()
    assert found[38:42, 38:42].all()
    assert not found[:24].any() and not found[:, 58:].any()


def test_a_roof_that_is_blurred_into_the_ground_is_no_change() -> None:
    """A bright roof beside dull ground, which the other view shows beside more ground."""
    ground, roof = 60 + 0.05 * texture((80, 80)), 2000 + texture((80, 80), seed=1)
    left = np.where(np.arange(80) < 40, roof, ground)
    warped = np.where(np.arange(80) < 40, roof, ground)
    left[:, 40:42] += np.array([600.0, 60.0])  # what the optics bring over
    disparity = np.where(np.arange(80) < 40, 15.0, 0.0) * np.ones((80, 1))
    disparity[:, 39:41] = np.nan  # the edge itself has no label
    clear = apart_from_steps(disparity)
    assert not clear[:, 38:42].any() and clear[1:-1, 1:38].all() and clear[1:-1, 42:-1].all()
    warped[:, 39:41] = np.nan
    mixed = surface_correlation(left, warped, disparity, LEVEL, 9)
    assert Agreement(mixed, disparity, LEVEL, 0.5, 1.0).outvoted_nearby()[20:60, 41:44].all()
    found = surface_correlation(left, warped, disparity, LEVEL, 9, clear)
    assert found[20:60, 41:46] == pytest.approx(1.0, abs=1e-4)
    assert not Agreement(found, disparity, LEVEL, 0.5, 1.0).outvoted_nearby().any()


@pytest.mark.parametrize("noise", [20.0, 100.0])
def test_the_rim_of_a_change_belongs_to_it(noise) -> None:
    """Ground that a building hides which only the images have: its corners are outvoted by what
    is around; no pixel counts as changed whose window holds nothing of it."""
    left = texture((100, 100))
    warped = left + np.random.default_rng(1).normal(0.0, noise, left.shape)
    warped[30:70, 30:70] = texture((40, 40), seed=2)
    level, slope = np.zeros((100, 100)), np.zeros((2, 100, 100))
    correlation = surface_correlation(left, warped, level, slope, 9)
    changed = Agreement(correlation, level, slope, 0.5).outvoted()
    inside = np.zeros((100, 100), np.bool_)
    inside[30:70, 30:70] = True
    assert changed[45:55, 45:55].all() and not changed[30:34, 30:34].any()
    found = changed | Agreement(correlation, level, slope, 0.5).beside(changed)
    assert (found & inside).sum() > 0.97 * inside.sum()
    touched = np.zeros((100, 100), np.bool_)
    touched[26:74, 26:74] = True
    assert not (found & ~touched).any()


def test_steps_are_told_from_slopes() -> None:
    x = np.arange(30.0)
    slope = np.broadcast_to(0.6 * x, (20, 30)).copy()
    inner = np.s_[1:-1, 1:-1]
    assert apart_from_steps(slope)[inner].all()
    slope[:, 15:] += 2.0
    found = apart_from_steps(slope)
    assert not found[:, 14:16].any() and found[inner][:, :13].all()
