"""The detail of an image: what shadows leave, and what noise does."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.sensor.image_detail import GREATEST, MEAN, detail


def texture(seed: int = 0, spread: float = 150.0) -> np.ndarray:
    return np.round(np.random.default_rng(seed).normal(900.0, spread, (60, 70)))


def test_a_shadow_has_the_detail_of_the_lit_ground() -> None:
    """A fifth of the brightness and of the contrast; only beside its edge is the detail another."""
    lit = texture()
    shadowed = lit.copy()
    shadowed[:, 40:] = np.round(lit[:, 40:] / 5.0)
    expected, _ = detail(lit, 0.0)
    found, _ = detail(shadowed, 0.0)
    assert (found[:, :38] == expected[:, :38]).all()
    assert found[2:-2, 42:-2] == pytest.approx(expected[2:-2, 42:-2], abs=0.05)
    assert np.abs(found[2:-2, 2:-2] - MEAN).max() <= GREATEST


def test_there_is_none_beside_nodata() -> None:
    image = texture()
    image[30, 30] = 0.0
    found, _ = detail(image, 0.0)
    empty = np.zeros(image.shape, np.bool_)
    empty[28:33, 28:33] = empty[:2] = empty[-2:] = empty[:, :2] = empty[:, -2:] = True
    assert ((found == 0.0) == empty).all()


def test_signal_is_what_exceeds_the_noise() -> None:
    """White noise alone has no signal; texture of four times its deviation has 16 / 17."""
    inner = np.s_[6:-6, 6:-6]
    _, nothing = detail(texture(1, 20.0), 400.0)
    assert nothing[inner].mean() < 0.1
    _, some = detail(texture(2, 20.0 * np.sqrt(17.0)), 400.0)
    assert some[inner].mean() == pytest.approx(16.0 / 17.0, abs=0.02)


def test_no_block_changes_it() -> None:
    image = texture(3)
    whole, part = detail(image, 50.0), detail(image[10:50, 12:60], 50.0)
    for of_all, own in zip(whole, part):
        assert (own[6:-6, 6:-6] == of_all[16:44, 18:54]).all()
