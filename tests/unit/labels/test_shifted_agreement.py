"""Images that agree better at another disparity than at the labels', on small made fields."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.surface_windows import apart_from_steps, surface_correlation, surface_mean
from stereotruth.labels.pair_window import PairWindow
from stereotruth.labels.shifted_agreement import SHIFTS_PX, ShiftedAgreement, shifted_agreement

from ...synthetic.textured_fields import (
    ALL,
    FIELD,
    LEVEL,
    SHAPE,
    pair,
    right_of,
    texture,
)


def grown(by: int) -> PairWindow:
    """Of labels of 4 px: a field that is higher by so many px."""
    left, disparity = texture(), np.full((160, 260), 4)
    disparity[20:140, 60:200][FIELD] += by
    return pair(left, right_of(left, disparity))


def at(window: PairWindow, noise: float = 0.0, reach: int = 8) -> ShiftedAgreement:
    return shifted_agreement(LEVEL, window, (noise, noise), 9, reach, ALL)


@pytest.mark.parametrize(("by", "reach"), [(-3, 8), (2, 4), (5, 8)])
def test_what_has_grown_agrees_at_another_disparity(by: int, reach: int) -> None:
    found = at(grown(by), reach=reach)
    inner, outside = np.zeros(SHAPE, np.bool_), np.ones(SHAPE, np.bool_)
    inner[47:73, 58:92] = True
    outside[32:88, 35:115] = False
    assert found.is_shifted[inner].all()
    assert (found.shift[inner] == by).mean() > 0.99
    assert not found.is_shifted[outside].any()


@pytest.mark.parametrize("share", [0.002, 0.3])
def test_wanted_pixels_have_the_values_that_all_together_have(share):
    """At the borders, too, and where a run of them is shorter than the correlation's window."""
    wanted = np.random.default_rng(2).uniform(size=SHAPE) < share
    wanted[[0, 0, -1, -1, 50, 51], [0, -1, 0, -1, 1, -2]] = True
    window = grown(3)
    every = shifted_agreement(LEVEL, window, (0.0, 0.0), 9, 4, ALL)
    few = shifted_agreement(LEVEL, window, (0.0, 0.0), 9, 4, wanted)
    for name in ("here", "elsewhere", "shift", "signal"):
        one, other = getattr(every, name), getattr(few, name)
        assert np.array_equal(one[wanted], other[wanted], equal_nan=True), name
        assert np.isnan(other[~wanted]).all(), name


def test_correlations_at_all_shifts_are_those_of_the_warped_images() -> None:
    """Means over the surface of what :func:`.surface_windows.surface_correlation` says of each
    shift by itself."""
    window = grown(3)
    left, right = (detail.patch for detail in window.details((0.0, 0.0)))
    (top, side), (rows, cols) = window.first, SHAPE
    own = left.pixels[top - left.row :, side - left.col :][:rows, :cols]
    surface = LEVEL.disparity, LEVEL.slope
    clear = apart_from_steps(LEVEL.disparity)
    whole = tuple(shift for shift in SHIFTS_PX if shift % 1.0 == 0.0)
    found, means = shifted_agreement(LEVEL, window, (0.0, 0.0), 9, 8, ALL, whole), []
    for shift in (0, *map(int, whole)):
        there = right.pixels[top - right.row :, side - 4 - shift - right.col :][:rows, :cols]
        alone = surface_correlation(own, there, *surface, 9, clear)
        means.append(surface_mean(alone, *surface, 8, 4, None, top))
    inside = np.s_[30:-30, 30:-30]
    assert np.allclose(found.here[inside], means[0][inside], atol=1e-5)
    assert np.allclose(found.elsewhere[inside], np.max(means[1:], axis=0)[inside], atol=1e-5)
