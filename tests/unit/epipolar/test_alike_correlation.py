"""Correlation over pixels of one surface that are as bright as the centre, on small made images."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.alike_correlation import (
    ALIKE,
    LEAST_PIXELS,
    alike_correlation,
    brightness,
    brightness_of_pair,
)
from stereotruth.epipolar.surface_correlation import wanted_runs

SHAPE = 40, 60
NO_NOISE = 0.0, 0.0
EVERY = np.ones(SHAPE, np.bool_)


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left image, the right one brought to it, disparity with a step and holes."""
    rng = np.random.default_rng(seed)
    left = rng.uniform(400.0, 600.0, SHAPE)
    right = left + rng.normal(0.0, 20.0, SHAPE)
    right[:, 25:] *= 0.4
    left[10:25, 10:20] *= 2.0
    disparity = np.full(SHAPE, 3.0)
    disparity[20:] += 5.0
    right[rng.uniform(size=SHAPE) < 0.05] = np.nan
    left[3:5, 3:9] = 0.0
    return left, right, disparity


def compared(
    left: np.ndarray, right: np.ndarray, disparity: np.ndarray, slope: np.ndarray, reach: int = 4,
    noise: tuple[float, float] = NO_NOISE, wanted: np.ndarray = EVERY,
) -> np.ndarray:  # fmt: skip
    """The coefficients of the ``wanted`` pixels, with the brightness of both images."""
    images = left, right
    levels, runs = brightness_of_pair(*images), wanted_runs(wanted)
    return alike_correlation(*images, levels, disparity, slope, reach, noise, runs)


def by_hand(
    left: np.ndarray, right: np.ndarray, disparity: np.ndarray, y: int, x: int, reach: int
) -> float:
    """The coefficient at one pixel, in float64."""
    left_levels = brightness(np.where(left != 0, left, np.nan)).astype(np.float64)
    right_levels = brightness(right).astype(np.float64)
    known = np.isfinite(left_levels) & np.isfinite(right_levels)
    part = np.s_[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
    same = known[part] & (np.abs(disparity[part] - disparity[y, x]) <= 1.0)
    for levels in (left_levels, right_levels):
        same &= np.abs(levels[part] - levels[y, x]) <= ALIKE * levels[y, x]
    if not known[y, x] or same.sum() < LEAST_PIXELS:
        return np.nan
    return float(np.corrcoef(left[part][same], right[part][same])[0, 1])


@pytest.mark.parametrize("reach", [2, 4])
def test_it_is_the_coefficient_of_the_pixels_that_are_alike(reach: int) -> None:
    left, right, disparity = scene()
    flat = np.zeros((2, *SHAPE))
    found = compared(left, right, disparity, flat, reach)
    expected = np.array(
        [
            [by_hand(left, right, disparity, y, x, reach) for x in range(SHAPE[1])]
            for y in range(SHAPE[0])
        ]
    )
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < 1e-4
    assert np.isfinite(found).mean() > 0.2


def test_a_shadow_lowers_it_nowhere() -> None:
    """Beside its edge, too, since the pixels beyond are not alike."""
    left = np.random.default_rng(1).uniform(450.0, 550.0, SHAPE)
    right = left.copy()
    right[:, 30:] *= 0.3
    flat = np.full(SHAPE, 2.0), np.zeros((2, *SHAPE))
    found = compared(left, right, *flat)
    beside = found[:, 26:34]
    assert np.nanmin(beside) > 0.99


def test_other_ground_beside_does_not_count() -> None:
    """A bright roof of the left image alone agrees with nothing; ground up to it agrees."""
    rng = np.random.default_rng(2)
    left = rng.uniform(450.0, 550.0, SHAPE)
    right = left.copy()
    left[:, 30:] = rng.uniform(1400.0, 1600.0, left[:, 30:].shape)
    flat = np.full(SHAPE, 2.0), np.zeros((2, *SHAPE))
    found = compared(left, right, *flat)
    assert np.nanmin(found[:, :29]) > 0.99
    assert np.nanmean(found[:, 31:]) < 0.2


def test_noise_is_taken_off_and_what_it_drowns_is_not_known() -> None:
    rng = np.random.default_rng(3)
    ground = rng.normal(500.0, 12.0, SHAPE)
    images = [ground + rng.normal(0.0, 12.0, SHAPE) for _ in range(2)]
    flat = np.full(SHAPE, 2.0), np.zeros((2, *SHAPE))

    def found(images: list[np.ndarray]) -> np.ndarray:
        return compared(*images, *flat, noise=(144.0, 144.0))

    assert abs(np.nanmedian(found(images)) - 1.0) < 0.2
    noise_alone = [rng.normal(500.0, 12.0, SHAPE) for _ in range(2)]
    assert np.isnan(found(noise_alone)).mean() > 0.9


@pytest.mark.parametrize("share", [0.02, 0.4])
def test_what_is_wanted_has_the_values_that_all_together_have(share: float) -> None:
    left, right, disparity = scene(4)
    flat = np.zeros((2, *SHAPE))
    wanted = np.random.default_rng(5).uniform(size=SHAPE) < share
    every, some = (compared(left, right, disparity, flat, wanted=of) for of in (EVERY, wanted))
    assert np.array_equal(every[wanted], some[wanted], equal_nan=True)


def test_brightness_follows_from_the_pixels_around_alone() -> None:
    """To the bit, whatever part of an image is given."""
    image = np.random.default_rng(6).uniform(1.0, 3000.0, SHAPE).astype(np.float32)
    image[5, 5] = np.nan
    whole, part = brightness(image), brightness(image[8:30, 7:50])
    assert np.array_equal(whole[9:29, 8:49], part[1:-1, 1:-1])
    assert np.isnan(whole[5, 5]) and np.isfinite(whole[5, 6])
    assert whole[5, 6] == pytest.approx(np.nanmean(image[4:7, 5:8]), rel=1e-6)
