"""Small pairs of random texture, with labels of one level for all of it."""

from __future__ import annotations

import numpy as np

from stereotruth.disparity.image_patches import read_patch
from stereotruth.disparity.pair_window import PairWindow
from stereotruth.disparity.pixel_labels import Labels

ROWS, COLS = slice(20, 140), slice(60, 200)
SHAPE = ROWS.stop - ROWS.start, COLS.stop - COLS.start
FIELD = np.s_[40:80, 50:100]  # of the window
LEVEL = Labels(np.full(SHAPE, 4.0), np.zeros((2, *SHAPE)), np.zeros(SHAPE))
ALL = np.ones(SHAPE, np.bool_)
GROUND = np.full(SHAPE, 2, np.uint8)  # ASPRS


def texture(seed: int = 0, low: float = 200.0, high: float = 1200.0) -> np.ndarray:
    """Whole DN of an image."""
    return np.round(np.random.default_rng(seed).uniform(low, high, (160, 260)))


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
