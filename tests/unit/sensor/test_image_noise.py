"""Noise of two images of the same ground, images of equal noise, and their detail."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereotruth.sensor.image_noise import GREATEST, MEAN, STEPS, NoiseCurve, detail, pair_noise

SIDE = 400
SHIFT = 7  # px of disparity
DISPARITIES = -30, 30


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
    curves = pair_noise(*shaded_pair(blur), DISPARITIES)
    for curve in curves:
        dark, lit = np.interp([80.0, 200.0], curve.brightness, curve.deviation)
        assert dark == pytest.approx(6.0, rel=0.25)
        assert lit == pytest.approx(1.0, rel=0.25)


def test_noise_of_images_without_ground_in_common_is_rounding_at_least() -> None:
    nothing = np.zeros((SIDE, SIDE), np.uint16)
    for curve in pair_noise(nothing, nothing, DISPARITIES):
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


# ------------------------------------------------------------------ detail


def speckle(seed: int = 0, spread: float = 150.0) -> np.ndarray:
    return np.round(np.random.default_rng(seed).normal(900.0, spread, (60, 70)))


def test_a_shadow_has_the_detail_of_the_lit_ground() -> None:
    """A fifth of the brightness and of the contrast; only beside its edge is the detail another."""
    lit = speckle()
    shadowed = lit.copy()
    shadowed[:, 40:] = np.round(lit[:, 40:] / 5.0)
    expected, _ = detail(lit, 0.0)
    found, _ = detail(shadowed, 0.0)
    assert (found[:, :38] == expected[:, :38]).all()
    assert found[2:-2, 42:-2] == pytest.approx(expected[2:-2, 42:-2], abs=0.05)
    assert np.abs(found[2:-2, 2:-2] - MEAN).max() <= GREATEST


def test_there_is_none_beside_nodata() -> None:
    image = speckle()
    image[30, 30] = 0.0
    found, _ = detail(image, 0.0)
    empty = np.zeros(image.shape, np.bool_)
    empty[28:33, 28:33] = empty[:2] = empty[-2:] = empty[:, :2] = empty[:, -2:] = True
    assert ((found == 0.0) == empty).all()


def test_signal_is_what_exceeds_the_noise() -> None:
    """White noise alone has no signal; texture of four times its deviation has 16 / 17."""
    inner = np.s_[6:-6, 6:-6]
    _, nothing = detail(speckle(1, 20.0), 400.0)
    assert nothing[inner].mean() < 0.1
    _, some = detail(speckle(2, 20.0 * np.sqrt(17.0)), 400.0)
    assert some[inner].mean() == pytest.approx(16.0 / 17.0, abs=0.02)


def test_no_block_changes_it() -> None:
    image = speckle(3)
    whole, part = detail(image, 50.0), detail(image[10:50, 12:60], 50.0)
    for of_all, own in zip(whole, part):
        assert (own[6:-6, 6:-6] == of_all[16:44, 18:54]).all()
