"""The noise of an image by its flattest parts, and what it leaves of a correlation."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereotruth.epipolar.image_noise import noise_of, resampled_noise
from stereotruth.epipolar.image_reader import Source
from stereotruth.epipolar.surface_correlation import correlation_and_expected
from stereotruth.numerics.cubic_convolution import six_point_weights_of_row

from ...synthetic.images import write_image

SIDE = 400
LEVEL = np.zeros((2, SIDE, SIDE), np.float32)


def texture(seed: int, contrast: float) -> np.ndarray:
    """A random field of a standard deviation, DN, smooth over some pixels, about 500."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), 1.5)
    return 500.0 + contrast * field / field.std()


def noisy(image: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    """An image with white noise, whole grey values."""
    noise = np.random.default_rng(seed).normal(scale=sigma, size=image.shape)
    return np.rint(image + noise).astype(np.uint16)


@pytest.mark.parametrize("sigma", [3.0, 10.0])
def test_noise_is_that_of_the_flattest_parts(tmp_path: Path, sigma: float) -> None:
    """With blurred texture of six to twenty times the noise all over, and a rim of nodata."""
    pixels = noisy(texture(1, 60.0), sigma, 2)
    pixels[:, :30] = 0
    with Source(write_image(tmp_path / "noisy.tif", None, pixels)) as source:
        assert noise_of(source) == pytest.approx(sigma, rel=0.12)


def test_resampling_leaves_what_its_kernel_does() -> None:
    """White noise, shifted by every tenth of a pixel along both axes."""
    noise = np.random.default_rng(3).normal(size=(300, 300))
    left = []
    for phase in np.arange(10) / 10:
        weights = np.empty((6, 1), np.float32)
        six_point_weights_of_row(np.array([phase], np.float32), weights)
        along = np.apply_along_axis(np.convolve, 1, noise, weights[:, 0], "valid")
        left.append(along.std())
    assert resampled_noise(1.0, (1.0, 1.0)) == pytest.approx(np.mean(np.square(left)), rel=0.02)
    assert resampled_noise(1.0, (2.0, 2.0)) == pytest.approx(np.mean(np.square(left)) / 2, rel=0.02)


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
