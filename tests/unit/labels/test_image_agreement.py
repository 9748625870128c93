"""Agreement of images and labels on small fields whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.surface_windows import apart_from_steps, surface_correlation
from stereotruth.labels.change_probability import Comparison, contradicted
from stereotruth.labels.pair_window import PairWindow, read_patch
from stereotruth.labels.pixel_labels import Labels

from ...synthetic import textured_fields as fields

LEVEL = np.zeros((2, 80, 80))


def texture(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(200, 1200, shape)


def test_warp_samples_at_x_less_disparity() -> None:
    """A cubic along x is reproduced to its last digit; outside the image there is nothing."""
    x = np.arange(200.0)
    image = np.broadcast_to(np.round(500 + 2 * x + 0.01 * x * x), (40, 200)).astype(np.uint16)
    rows, cols = slice(5, 25), slice(60, 120)
    patch = read_patch(image, rows, slice(0, 200), 9)
    window = PairWindow(rows, cols, 0, patch, patch)
    disparity = np.full((20, 60), 10.25)
    left, warped = window.images_at(disparity)
    assert np.array_equal(left, image[rows, cols])
    at = np.arange(60, 120) - 10.25
    assert np.abs(warped - (500 + 2 * at + 0.01 * at * at)).max() < 0.6  # of the rounding
    disparity[:, :5] = np.nan
    disparity[:, 5:9] = 300.0
    _, warped = window.images_at(disparity)
    assert np.isnan(warped[:, :9]).all()
    assert np.isfinite(warped[:, 9:]).all()


def test_beside_a_blurred_roof_pixels_apart_from_steps_correlate() -> None:
    """A bright roof beside dull ground, which the other view shows beside more ground."""
    ground, roof = 60 + 0.05 * texture((80, 80)), 2000 + texture((80, 80), seed=1)
    left = np.where(np.arange(80) < 40, roof, ground)
    warped = left.copy()
    left[:, 40:42] += np.array([600.0, 60.0])  # what the optics bring over
    disparity = np.where(np.arange(80) < 40, 15.0, 0.0) * np.ones((80, 1))
    disparity[:, 39:41] = np.nan  # the edge itself has no label
    clear = apart_from_steps(disparity)
    assert not clear[:, 38:42].any() and clear[1:-1, 1:38].all() and clear[1:-1, 42:-1].all()
    warped[:, 39:41] = np.nan
    found = surface_correlation(left, warped, disparity, LEVEL, 9, clear)
    assert found[20:60, 41:46] == pytest.approx(1.0, abs=1e-4)


def contradicted_by(
    left: np.ndarray,
    right: np.ndarray,
    labels: Labels = fields.LEVEL,
    noise: float = 15.0,
    diachronic: bool = False,
) -> np.ndarray:
    """Pixels of a small field whose labels the images contradict; ``noise``: of both, DN."""
    comparison = Comparison(9, (noise**2, noise**2), diachronic)
    return contradicted(
        labels, fields.pair(left, right), comparison, fields.ALL, fields.GROUND
    ).changed


@pytest.mark.parametrize("diachronic", [False, True])
@pytest.mark.parametrize("noise", [4.0, 20.0])
def test_a_change_is_found_up_to_its_rim_and_nothing_else(noise: float, diachronic: bool) -> None:
    """A field in which the left image shows something else, and single pixels that noise spoils."""
    ground = fields.through_optics(0)
    right = fields.right_of(ground, np.full(ground.shape, 4))
    ground[fields.ROWS, fields.COLS][fields.FIELD] = fields.through_optics(5)[:40, :50]
    images = (fields.with_noise(image, noise, seed) for seed, image in enumerate((ground, right)))
    found = contradicted_by(*images, noise=noise, diachronic=diachronic)
    assert found[42:78, 52:98].mean() > 0.99  # 2 px inside
    found[37:83, 47:103] = False
    assert not found.any()


@pytest.mark.parametrize("size", [8, 10])
def test_what_is_small_is_found(size: int) -> None:
    """A hut amid agreeing ground."""
    ground = fields.through_optics(0)
    right = fields.right_of(ground, np.full(ground.shape, 4))
    hut = np.s_[50 : 50 + size, 60 : 60 + size]
    ground[fields.ROWS, fields.COLS][hut] = 1.5 * fields.through_optics(5)[:size, :size]
    images = (fields.with_noise(image, 4.0, seed) for seed, image in enumerate((ground, right)))
    found = contradicted_by(*images, noise=4.0)
    assert found[52 : 48 + size, 62 : 58 + size].all()
    found[47 : 53 + size, 57 : 63 + size] = False
    assert not found.any()


@pytest.mark.parametrize("contrast", [2.0, 7.0, 20.0])
def test_noise_is_no_change(contrast: float) -> None:
    """The same ground in noisy images keeps its labels, however weak its texture is."""
    ground = fields.through_optics(6, contrast, 1.5)
    right = fields.right_of(ground, np.full(ground.shape, 4))
    images = (fields.with_noise(image, 10.0, seed) for seed, image in enumerate((ground, right)))
    assert contradicted_by(*images, noise=10.0)[10:-10, 10:-10].mean() < 0.01


def test_change_shows_through_noise() -> None:
    """Other ground, of a contrast of twice the noise."""
    images = (fields.with_noise(fields.through_optics(s, 20.0, 1.5), 10.0, s) for s in (1, 2))
    assert contradicted_by(*images, noise=10.0)[10:-10, 10:-10].mean() > 0.95


@pytest.mark.parametrize("diachronic", [False, True])
def test_a_roof_that_is_blurred_into_the_ground_is_no_change(diachronic: bool) -> None:
    """A bright roof beside dull ground, which the other view shows beside more ground."""
    x = np.arange(260)
    ground, roof = 60 + 0.05 * fields.texture(), 2000 + fields.texture(1)
    left = np.where(x < 120, roof, ground)
    right = fields.right_of(left, np.where(x < 120, 15, 4) * np.ones((160, 1), int))
    left[:, 120:122] += np.array([600.0, 60.0])  # what the optics bring over
    disparity = np.where(x[fields.COLS] < 120, 15.0, 4.0) * np.ones(fields.SHAPE)
    disparity[:, 59:61] = np.nan  # the edge itself has no label
    labels = Labels(disparity, fields.LEVEL.slope, fields.LEVEL.variance)
    found = contradicted_by(left, right, labels, diachronic=diachronic)
    assert not (found & np.isfinite(disparity))[20:-20, 20:-20].any()
