"""Robust least-squares matching: the ground decides, whatever stands out in the window."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from stereotruth.align.least_squares_matching import least_squares_match

SIDE, WIDE = 21, 61
ALONG = np.array([1.0, 0.0])
UNIT = np.eye(2)


def texture(rng: np.random.Generator, contrast: float) -> np.ndarray:
    noise = gaussian_filter(rng.normal(0, 1, (WIDE, WIDE)), 1.3)
    return 1000.0 + contrast * noise / noise.std()


def matched(template: np.ndarray, source: np.ndarray, clear: np.ndarray | None = None):
    """Shift (x, y), sigma, correlation, discord; from a start within half a pixel."""
    first = (WIDE - SIDE - 2) // 2
    window = template.astype(np.float32)[first : first + SIDE + 2, first : first + SIDE + 2]
    clear = np.ones(SIDE**2) if clear is None else clear.ravel().astype(np.float64)
    result = np.empty(5)
    middle = (WIDE - 1) / 2
    least_squares_match(
        window, clear, source.astype(np.float32), middle, middle, UNIT, (1.0, 1.0), ALONG,
        np.zeros(2), result,
    )  # fmt: skip
    return result


def dark_disc(picture: np.ndarray, col: float, row: float, radius: float, depth: float):
    y, x = np.mgrid[0:WIDE, 0:WIDE]
    inside = np.clip(radius - np.hypot(x - col, y - row) + 0.5, 0, 1)
    return picture - depth * inside


@pytest.mark.parametrize("seed", range(2))
def test_the_shift_of_one_surface_is_found(seed):
    rng = np.random.default_rng(seed)
    left = texture(rng, 60.0)
    right = 1.2 * shift(left, (-0.21, 0.34), order=5, mode="wrap") + 40.0
    right += rng.normal(0, 1.0, right.shape)
    x, y, sigma, correlation, discord = matched(left, right)
    assert (x, y) == pytest.approx((0.34, -0.21), abs=0.02)
    assert sigma < 0.02 and correlation > 0.99 and discord < 0.03


@pytest.mark.parametrize("seed", range(2))
def test_a_dark_crown_that_moves_by_its_parallax_does_not_draw_the_shift(seed):
    """30 times the contrast of the ground: plain least squares would follow the crown."""
    rng = np.random.default_rng(100 + seed)
    ground = texture(rng, 20.0)
    left = dark_disc(ground, 36.0, 30.0, 3.0, 600.0) + rng.normal(0, 1.0, ground.shape)
    moved = shift(ground, (0.0, 0.1), order=5, mode="wrap")
    right = dark_disc(moved, 37.0, 30.0, 3.0, 600.0) + rng.normal(0, 1.0, ground.shape)
    x, y, *_ = matched(left, right)
    assert (x, y) == pytest.approx((0.1, 0.0), abs=0.05)


def test_parts_that_disagree_say_so():
    rng = np.random.default_rng(5)
    left = texture(rng, 60.0)
    moved = [shift(left, (0.0, d), order=5, mode="wrap") for d in (-0.25, 0.25)]
    right = np.where(np.arange(WIDE)[None] < WIDE / 2, *moved) + rng.normal(0, 1.0, left.shape)
    one = shift(left, (0.0, 0.25), order=5, mode="wrap") + rng.normal(0, 1.0, left.shape)
    assert matched(left, right)[4] > 0.05 > 2 * matched(left, one)[4]


def test_pixels_that_are_not_clear_take_no_part():
    rng = np.random.default_rng(6)
    left = texture(rng, 60.0)
    right = shift(left, (0.0, 0.3), order=5, mode="wrap")
    clear = np.ones((SIDE, SIDE), bool)
    clear[:, :9] = False
    left[:, :29] = rng.normal(0, 5000.0, (WIDE, 29))
    first = matched(left, right, clear)
    left[:, :28] = np.nan
    again = matched(left, right, clear)
    assert first[:2] == pytest.approx((0.3, 0.0), abs=0.02)
    assert (first == again).all()
