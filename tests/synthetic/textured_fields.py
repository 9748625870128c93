"""Small pairs of random texture, with labels of one level for all of it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from stereotruth.labels.pair_window import Labels, PairWindow, read_patch

ROWS, COLS = slice(20, 140), slice(60, 200)
SHAPE = ROWS.stop - ROWS.start, COLS.stop - COLS.start
FIELD = np.s_[40:80, 50:100]  # of the window
LEVEL = Labels(np.full(SHAPE, 4.0), np.zeros((2, *SHAPE)), np.zeros(SHAPE))
ALL = np.ones(SHAPE, np.bool_)
GROUND = np.full(SHAPE, 2, np.uint8)  # ASPRS


def texture(seed: int = 0, low: float = 200.0, high: float = 1200.0) -> np.ndarray:
    """Whole DN of an image."""
    return np.round(np.random.default_rng(seed).uniform(low, high, (160, 260)))


def through_optics(seed: int, contrast: float = 100.0, blur: float = 1.0) -> np.ndarray:
    """An image of white texture behind optics that blur it by some px, of a standard deviation of
    the brightness, DN, about 700."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(160, 260)), blur)
    return np.round(700.0 + contrast * field / field.std())


def with_noise(image: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    """Whole DN of an image with white noise."""
    return np.round(image + np.random.default_rng(seed).normal(0.0, sigma, image.shape))


def right_of(left: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Where a pixel's match lies, the right image shows it."""
    right = texture(9)
    y, x = np.indices(left.shape)
    match = x - disparity.astype(int)
    inside = (match >= 0) & (match < left.shape[1])
    right[y[inside], match[inside]] = left[inside]
    return right


def pair(left: np.ndarray, right: np.ndarray) -> PairWindow:
    whole = slice(20, 240)
    patches = (read_patch(left, ROWS, COLS, 1), read_patch(right, ROWS, whole, 1))
    return PairWindow(ROWS, COLS, 0, *patches)


def ground(seed: int) -> np.ndarray:
    """Of little contrast."""
    return texture(seed, 450.0, 550.0)


def built(brightness: float = 3.0) -> PairWindow:
    """A bright roof, 12 px above the ground, in the right image alone."""
    left = ground(0)
    right = right_of(left, np.full((160, 260), 4))
    right[ROWS, slice(COLS.start - 4, COLS.stop - 4)][FIELD] = brightness * ground(1)[:40, :50]
    return pair(left, right)
