"""Open pixels around a roof over textured ground, whose surfaces and hidden part are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from stereotruth.disparity.open_pixels import surfaces_by_images

ROWS, COLS, FIRST = 90, 140, -20  # the right image begins 20 columns farther left
UP = 8.0  # px of disparity of the roof
ROOF = np.zeros((ROWS, COLS), np.bool_)
ROOF[25:65, 50:90] = True
HIDDEN = np.zeros((ROWS, COLS), np.bool_)
HIDDEN[25:65, 42:50] = True  # ground that the roof covers in the right image
OPEN = ndimage.binary_dilation(ROOF ^ ndimage.binary_erosion(ROOF), iterations=4) | HIDDEN
TRUTH = np.where(ROOF, UP, 0.0)


def texture(seed: int) -> np.ndarray:
    """Grey values of a surface, smooth over 1.5 px."""
    noise = np.random.default_rng(seed).normal(size=(ROWS, COLS + 40))
    fine = ndimage.gaussian_filter(noise, 1.5)
    return 1000.0 + 150.0 * fine / fine.std()


def images(contrast: float = 1.0, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Left and right image, whole grey values; noise with a gain field of 5 % in the right one."""
    ground, roof = (1000.0 + contrast * (texture(seed) - 1000.0) for seed in (1, 2))
    left = np.where(ROOF, roof[:, 20:160], ground[:, 20:160])
    in_right = np.zeros((ROWS, COLS + 40), np.bool_)
    in_right[:, 20 - int(UP) : 160 - int(UP)] = ROOF
    right = np.where(in_right, np.roll(roof, -int(UP), axis=1), ground)
    if noise:
        rng = np.random.default_rng(3)
        right = right * (1.0 + 0.05 * np.sin(np.arange(COLS + 40) / 25.0))
        left, right = (image + rng.normal(0.0, noise, image.shape) for image in (left, right))
    return np.rint(left), np.rint(right)


def told(left: np.ndarray, right: np.ndarray, rows=slice(None), cols=slice(None)) -> np.ndarray:
    """Disparity of open pixels of a part of the scene by its images, NaN where they stay open."""
    known = np.where(OPEN, np.nan, TRUTH)[rows, cols]
    nothing = np.full(known.shape, np.nan)
    at = cols.start or 0
    found = surfaces_by_images(
        OPEN[rows, cols],
        known,
        np.zeros((2, *known.shape)),
        nothing,
        np.zeros((2, *known.shape)),
        np.full(known.shape, np.inf),
        left[rows, cols],
        right[rows],
        FIRST - at,
        lambda row, col, disparity: np.zeros(row.size, np.bool_),
    )
    out = nothing.copy()
    out[found.row, found.col] = found.disparity
    return out


def shares(found: np.ndarray) -> tuple[float, float, float]:
    """Of the open visible pixels, those told and those told wrong; of the hidden ones, told."""
    visible = OPEN & ~HIDDEN
    wrong = np.abs(found - TRUTH) > 0.5
    return (
        np.isfinite(found)[visible].mean(),
        wrong[visible].mean(),
        np.isfinite(found)[HIDDEN].mean(),
    )


def test_images_tell_the_surface_of_open_pixels_and_leave_out_hidden_ones() -> None:
    seen, wrong, hidden = shares(told(*images()))
    assert seen > 0.7
    assert wrong < 0.01
    assert hidden < 0.02


@pytest.mark.parametrize("noise", [20.0, 60.0])
def test_noise_and_gain_leave_more_open_not_more_wrong(noise) -> None:
    seen, wrong, hidden = shares(told(*images(noise=noise)))
    assert seen > 0.1
    assert wrong < 0.02
    assert hidden < 0.04


def test_where_images_show_nothing_pixels_stay_open() -> None:
    found = told(*images(contrast=0.02, noise=20.0))
    assert np.isfinite(found).sum() < 0.02 * OPEN.sum()


def test_a_part_with_its_margin_tells_the_same_bits() -> None:
    from stereotruth.disparity.open_pixels import MARGIN

    left, right = images(noise=20.0)
    whole, cut = told(left, right), slice(50 - MARGIN, 85 + MARGIN)
    part = told(left, right, slice(None), cut)
    assert whole[:, 50:85].tobytes() == np.ascontiguousarray(part[:, MARGIN:-MARGIN]).tobytes()
    assert np.isfinite(whole[:, 50:85]).sum() > 100
