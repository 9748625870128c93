"""The noise of two images of the same ground by brightness, and images of equal noise."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereotruth.epipolar.image_noise import STEPS, NoiseCurve, pair_noise
from stereotruth.epipolar.surface_windows import correlation_and_expected

SIDE = 400
LEVEL = np.zeros((2, SIDE, SIDE), np.float32)
SHIFT = 7  # px of disparity
MODEL = SimpleNamespace(
    shape=(SIDE, SIDE),
    height_range=(-30.0, 30.0),
    epipolar_to_ground=lambda x, y, height: (x, y),
    ground_to_epipolar=lambda lon, lat, height: np.stack([lon, lat, lon - height, lat]),
)


def texture(seed: int, contrast: float) -> np.ndarray:
    """A random field of a standard deviation, DN, smooth over some pixels, about 500."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), 1.5)
    return 500.0 + contrast * field / field.std()


def noisy(image: np.ndarray, sigma: np.ndarray | float, seed: int, blur: float = 0.0) -> np.ndarray:
    """An image with noise, white or of neighbours that correlate, in whole grey values."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=image.shape), blur)
    return np.clip(np.rint(image + sigma * noise / noise.std()), 1, 65535).astype(np.uint16)


def shaded_pair(blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Ground in the light and in shadow, where the noise is six times as great; a half of it has
    texture."""
    shade = np.arange(SIDE)[:, None] // 60 % 2 == 1
    has_texture = np.arange(SIDE) < SIDE // 2
    ground = np.where(has_texture, texture(1, 60.0), 500.0)
    left = np.where(shade, 0.16, 0.4) * ground
    sigma = np.where(shade, 6.0, 1.0)
    right = np.roll(left, -SHIFT, axis=1)
    return noisy(left, sigma, 3, blur), noisy(right, sigma, 4, blur)


@pytest.mark.parametrize("blur", [0.0, 0.55])
def test_noise_is_known_by_brightness_whether_its_neighbours_correlate(blur: float) -> None:
    curves = pair_noise(*shaded_pair(blur), MODEL)
    for curve in curves:
        dark, lit = np.interp([80.0, 200.0], curve.brightness, curve.deviation)
        assert dark == pytest.approx(6.0, rel=0.25)
        assert lit == pytest.approx(1.0, rel=0.25)


def test_noise_of_images_without_ground_in_common_is_rounding_at_least() -> None:
    nothing = np.zeros((SIDE, SIDE), np.uint16)
    for curve in pair_noise(nothing, nothing, MODEL):
        assert curve.deviation == pytest.approx((12.0**-0.5,))


def test_images_of_equal_noise_have_the_same_at_all_brightness() -> None:
    curve = NoiseCurve((60.0, 200.0), (6.0, 1.0))
    levels = np.full((2, 200, 200), 60.0) + 140.0 * np.arange(2)[:, None, None]
    sigma = np.interp(levels[:, 0, 0], curve.brightness, curve.deviation)
    for image, of in zip(levels, sigma):
        equal = curve.equalised(noisy(image, of, 5).astype(np.float32))
        assert equal.std() == pytest.approx(STEPS, rel=0.15)
    values = np.arange(65536, dtype=np.float32)[None]
    equal = curve.equalised(values)[0]
    assert equal[0] == 0.0 and (equal[1:] > 0.0).all() and (np.diff(equal) >= 0.0).all()


@pytest.mark.parametrize("contrast", [10.0, 20.0])
def test_expected_correlation_is_that_of_the_same_ground(contrast: float) -> None:
    """On the average, where there is enough of it."""
    sigma, ground = 10.0, texture(3, contrast)
    left, right = (noisy(ground, sigma, seed).astype(np.float32) for seed in (4, 5))
    noise = (sigma**2, sigma**2)
    found, expected = correlation_and_expected(left, right, LEVEL[0], LEVEL, 9, noise)
    attenuated = contrast**2 / (contrast**2 + sigma**2)  # Spearman
    told = np.isfinite(expected)
    assert told.mean() > 0.9
    assert expected[told].mean() == pytest.approx(attenuated, abs=0.08)
    assert found[told].mean() == pytest.approx(expected[told].mean(), abs=0.1)
