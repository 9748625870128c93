"""Windows of one surface against NumPy in float64, pixel by pixel, on small made images."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from stereotruth.epipolar.surface_windows import (
    ALIKE,
    AS_BRIGHT,
    LEAST_ALIKE,
    alike_correlation,
    alike_mean,
    apart_from_steps,
    brightness_of_pair,
    correlation_and_expected,
    correlations,
    shifted_correlations,
    surface_correlation,
    surface_mean,
    surface_means,
)
from stereotruth.epipolar.window_sums import BEND, BLOCK, SURFACE_PX, wanted_runs

SHAPE = 40, 60
NO_NOISE = 0.0, 0.0
EVERY = np.ones(SHAPE, np.bool_)
FLAT = np.zeros((2, *SHAPE))
Pixels = Callable[[np.ndarray], np.ndarray]


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Left image, the right one brought to it, disparity of a slope with a step, and its slope.

    Holes in both images; a shadow in the right one, something bright in the left one.
    """
    rng = np.random.default_rng(seed)
    left = rng.uniform(450.0, 550.0, SHAPE)
    right = left + rng.normal(0.0, 20.0, SHAPE)
    right[:, 25:] *= 0.4
    left[10:25, 10:20] *= 2.0
    disparity = 3.0 + 0.3 * np.arange(SHAPE[1]) * np.ones(SHAPE)
    disparity[20:] += 5.0
    slope = np.zeros((2, *SHAPE))
    slope[0] = 0.3
    right[rng.uniform(size=SHAPE) < 0.05] = np.nan
    left[3:5, 3:9] = 0.0
    return left, right, disparity, slope


def by_hand(
    statistic: Pixels, counts: np.ndarray, disparity: np.ndarray, slope: np.ndarray, reach: int,
    every: int = 1, bright: tuple[np.ndarray, ...] = (), share: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """``statistic`` of the mask of each pixel's window."""
    rows, cols = np.indices(SHAPE)
    out = np.full(SHAPE, np.nan)
    for y, x in np.ndindex(SHAPE):
        down, across = rows - y, cols - x
        away = np.maximum(np.abs(down), np.abs(across))
        plane = disparity[y, x] + slope[0, y, x] * across + slope[1, y, x] * down
        window = (away <= reach) & (down % every == 0) & (across % every == 0) & counts
        window &= np.abs(disparity - plane) <= SURFACE_PX + BEND * away
        for level in bright:
            window &= np.abs(level - level[y, x]) <= share * level[y, x]
        out[y, x] = statistic(window)
    return out


def assert_same(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < tolerance
    assert np.isfinite(found).mean() > 0.2


@pytest.mark.parametrize(("window", "apart"), [(5, False), (9, True)])
def test_correlation_is_that_of_the_surface(window: int, apart: bool) -> None:
    left, right, disparity, slope = scene()
    counts = np.isfinite(right) & (apart_from_steps(disparity) if apart else EVERY)

    def coefficient(chosen: np.ndarray) -> float:
        enough = chosen.sum() >= window
        return np.corrcoef(left[chosen], right[chosen])[0, 1] if enough else np.nan

    expected = by_hand(coefficient, counts, disparity, slope, window // 2)
    expected[np.isnan(right)] = np.nan
    clear = apart_from_steps(disparity) if apart else None
    found = surface_correlation(left, right, disparity, slope, window, clear)
    assert_same(found, expected, 1e-5)
    runs = wanted_runs(EVERY)
    several = np.stack([right, 2.0 * right, np.full(SHAPE, 5.0)])
    both = correlations(left, several, disparity, slope, counts, window, runs)
    assert np.array_equal(both[0][np.isfinite(right)], found[np.isfinite(right)], equal_nan=True)
    assert np.allclose(both[0], both[1], atol=1e-6, equal_nan=True)
    assert np.nanmax(both[2]) == 0.0  # of one brightness


def test_correlation_of_pixels_that_are_alike() -> None:
    left, right, disparity, slope = scene()
    bright = brightness_of_pair(left, right)
    counts = np.isfinite(right) & (left != 0.0)

    def coefficient(chosen: np.ndarray) -> float:
        enough = chosen.sum() >= LEAST_ALIKE
        return np.corrcoef(left[chosen], right[chosen])[0, 1] if enough else np.nan

    levels = tuple(level.astype(np.float64) for level in bright)
    expected = by_hand(coefficient, counts, disparity, slope, 4, 1, levels, ALIKE)
    runs = wanted_runs(EVERY)
    found = alike_correlation(left, right, bright, disparity, slope, 4, NO_NOISE, runs)
    decided = np.isfinite(expected)
    assert_same(found, np.where(decided, expected, np.nan), 1e-4)


@pytest.mark.parametrize(("reach", "every", "alike"), [(1, 1, False), (6, 2, False), (6, 2, True)])
def test_means_are_those_of_the_surface(reach: int, every: int, alike: bool) -> None:
    left, right, disparity, slope = scene(1)
    values = np.random.default_rng(2).uniform(size=SHAPE)
    values[10:12] = np.nan
    bright = brightness_of_pair(left, right)
    levels = tuple(level.astype(np.float64) for level in bright) if alike else ()

    def mean(chosen: np.ndarray) -> float:
        return values[chosen].mean() if chosen.any() else np.nan

    around = disparity, slope, reach, every
    expected = by_hand(mean, np.isfinite(values), *around, levels, AS_BRIGHT)
    if alike:
        found = alike_mean(values, bright, *around, NO_NOISE, wanted_runs(EVERY))
        assert_same(found, expected, 1e-6)
        return
    found = surface_mean(values, *around)
    voting = np.arange(SHAPE[0]) % every == 0  # rows of the grid vote: of these, as by hand
    assert_same(found[voting], expected[voting], 1e-6)
    shifted = surface_mean(values[1:], disparity[1:], slope[:, 1:], reach, every, None, 1)
    assert np.array_equal(shifted[reach:], found[1 + reach :], equal_nan=True)
    together = surface_means(np.stack([values, -3.0 * values]), *around)
    assert np.array_equal(together[0], found, equal_nan=True)


def test_what_is_wanted_has_the_values_that_all_together_have() -> None:
    """To the bit; runs of one pixel, at the borders, too, and rows longer than a block."""
    rng, shape = np.random.default_rng(3), (14, 3 * BLOCK)
    left, right = rng.uniform(450.0, 550.0, (2, *shape))
    surface = rng.normal(scale=0.5, size=shape), rng.normal(scale=0.1, size=(2, *shape))
    bright = brightness_of_pair(left, right)
    wanted = rng.uniform(size=shape) < 0.02
    wanted[:, [0, 1, 40, BLOCK - 1, BLOCK, -2, -1]] = True
    for of in (
        lambda runs: surface_mean(left, *surface, 9, 1, runs),
        lambda runs: surface_mean(left, *surface, 8, 4, runs),
        lambda runs: alike_mean(left, bright, *surface, 8, 2, NO_NOISE, runs),
        lambda runs: surface_correlation(left, right, *surface, 9, None, runs),
        lambda runs: alike_correlation(left, right, bright, *surface, 4, NO_NOISE, runs),
    ):
        every, some = (of(wanted_runs(what)) for what in (np.ones(shape, np.bool_), wanted))
        assert np.array_equal(every[wanted], some[wanted], equal_nan=True)


def test_windows_end_at_the_edges_of_either_image() -> None:
    """Of a shadow in the right one, and of a bright roof in the left one alone."""
    rng = np.random.default_rng(4)
    left = rng.uniform(450.0, 550.0, SHAPE)
    right = left.copy()
    right[:, 40:] *= 0.3
    left[:, :20] = rng.uniform(1400.0, 1600.0, (SHAPE[0], 20))
    bright, level = brightness_of_pair(left, right), np.full(SHAPE, 2.0)
    runs = wanted_runs(EVERY)
    found = alike_correlation(left, right, bright, level, FLAT, 4, NO_NOISE, runs)
    assert np.nanmin(found[:, 21:]) > 0.99
    assert np.nanmean(found[:, :19]) < 0.2
    steps = np.digitize(np.arange(SHAPE[1]), [20, 40]) * np.ones(SHAPE)
    means = alike_mean(steps, bright, level, FLAT, 8, 1, NO_NOISE, runs)
    sharp = np.min(np.abs(np.arange(SHAPE[1])[:, None] - [19.5, 39.5]), axis=1) > 2.0
    assert np.array_equal(means[:, sharp], steps[:, sharp])  # brightness is of 3 x 3 px


@pytest.mark.parametrize("alike", [False, True])
def test_noise_is_told_from_ground(alike: bool) -> None:
    """Images of the same ground correlate as noise leaves it; of noise alone nothing is known."""
    rng, noise = np.random.default_rng(5), (144.0, 144.0)
    level, runs = np.full(SHAPE, 2.0), wanted_runs(EVERY)

    def compared(contrast: float) -> tuple[np.ndarray, np.ndarray]:
        """Correlation over what is expected, and the latter."""
        ground = rng.normal(500.0, contrast, SHAPE)
        left, right = (ground + rng.normal(0.0, 12.0, SHAPE) for _ in range(2))
        if alike:
            bright = brightness_of_pair(left, right)
            out = alike_correlation(left, right, bright, level, FLAT, 4, noise, runs)
            return out, out
        found, expected = correlation_and_expected(left, right, level, FLAT, 9, noise)
        return found / expected, expected

    ratio, expected = compared(12.0)
    assert np.nanmedian(ratio) == pytest.approx(1.0, abs=0.2)
    if not alike:
        assert np.nanmedian(expected) == pytest.approx(0.5, abs=0.1)
    assert np.isnan(compared(0.0)[1]).mean() > 0.8


def test_brightness_follows_from_the_pixels_around_alone() -> None:
    """To the bit, whatever part of an image is given."""
    image = np.random.default_rng(6).uniform(1.0, 3000.0, SHAPE).astype(np.float32)
    image[5, 5] = 0.0
    whole, _ = brightness_of_pair(image, image)
    part, _ = brightness_of_pair(image[8:30, 7:50], image[8:30, 7:50])
    assert np.array_equal(whole[9:29, 8:49], part[1:-1, 1:-1])
    assert np.isnan(whole[5, 5])
    around = np.delete(image[4:7, 5:8].ravel(), 3)
    assert whole[5, 6] == pytest.approx(around.mean(), rel=1e-6)


def test_few_pixels_at_many_shifts() -> None:
    """Where windows shift by whole columns and rows, as NumPy has them."""
    rng = np.random.default_rng(7)
    left, right = rng.normal(size=(2, *SHAPE)).astype(np.float32)
    disparity = np.full(SHAPE, 5.0, np.float32)
    disparity[:, 30:] = 9.0
    places = np.array([[25, 20, 0], [25, 20, -3], [40, 20, 0], [25, 20, -19]])
    limits = np.array([[-2, 3], [-2, 3], [-60, 1], [0, 0]])
    found = shifted_correlations(left, right, disparity, places, limits, half=4, least=10)
    assert found.shape == (4, 121)
    for one, (x, y, down), d, end in zip(found, places[:3], (5, 5, 9), (30, 60, 60)):
        rows, cols = np.s_[y - 4 : y + 5], np.s_[x - 4 : min(x + 5, end)]
        for shift in (-1, 0, 1):
            there = right[y - 4 + down : y + 5 + down][:, cols.start - d + shift :]
            width = cols.stop - cols.start
            expected = np.corrcoef(left[rows, cols].ravel(), there[:, :width].ravel())[0, 1]
            assert one[60 + shift] == pytest.approx(expected, abs=1e-6)
    assert np.isnan(found[0, :58]).all() and np.isnan(found[0, 64:]).all()  # not asked for
    assert np.isnan(found[2, 0]) and np.isnan(found[3]).all()  # beside the image
    halfway = shifted_correlations(
        left, np.roll(left, -5, axis=1), disparity, places[:1], limits[:1], 0.5, half=4, least=10
    )
    assert halfway[0, 2] < 0.9 and halfway[0, 3] < 0.9  # columns 2.5 and 3.5 of the middle 3
