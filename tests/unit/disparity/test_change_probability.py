"""How probable a change is, by images of two lights, on small made fields."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.change_probability import (
    CHANGED,
    WEIGHTS,
    WEIGHTS_LIT,
    Evidence,
    by_itself,
    probability_of_change,
)
from stereotruth.disparity.image_agreement import Comparison, contradicted
from stereotruth.disparity.image_patches import read_patch
from stereotruth.disparity.pair_window import PairWindow
from stereotruth.disparity.pixel_labels import Labels

from ...synthetic.textured_fields import (
    ALL,
    COLS,
    FIELD,
    GROUND,
    LEVEL,
    ROWS,
    SHAPE,
    pair,
    right_of,
    texture,
)

NO_NOISE = 0.0, 0.0
INNER = np.s_[20:-20, 20:-20]


def ground(seed: int) -> np.ndarray:
    """Of little contrast."""
    return texture(seed, 450.0, 550.0)


def probability(window: PairWindow) -> np.ndarray:
    return probability_of_change(LEVEL, window, 9, NO_NOISE, ALL)


def built(brightness: float = 3.0) -> PairWindow:
    """A bright roof, 12 px above the ground, in the right image alone."""
    left = ground(0)
    right = right_of(left, np.full((160, 260), 4))
    right[ROWS, slice(COLS.start - 4, COLS.stop - 4)][FIELD] = brightness * ground(1)[:40, :50]
    return pair(left, right)


def test_a_new_roof_has_changed_and_the_ground_up_to_it_has_not() -> None:
    found = probability(built())
    assert (found[FIELD] > CHANGED).mean() > 0.97
    rim = np.ones(SHAPE, np.bool_)
    rim[34:86, 44:106] = False  # 6 px around the roof
    assert (found[rim] < CHANGED).all()


def test_what_images_agree_on_has_hardly_changed() -> None:
    left = ground(0)
    found = probability(pair(left, right_of(left, np.full((160, 260), 4))))
    assert found[INNER].max() < 0.01


def test_images_of_noise_alone_tell_nothing() -> None:
    rng = np.random.default_rng(3)
    images = (np.round(rng.normal(900.0, 20.0, (160, 260))) for _ in range(2))
    found = probability_of_change(LEVEL, pair(*images), 9, (400.0, 400.0), ALL)
    assert (found[INNER] > CHANGED).mean() < 0.05
    blank = np.full((160, 260), 700.0)
    nothing = probability_of_change(LEVEL, pair(blank, blank), 9, (4.0, 4.0), ALL)
    assert (nothing[INNER] > 0.02).all() and (nothing[INNER] <= WEIGHTS.unknown).all()


@pytest.mark.parametrize("weights", [WEIGHTS, WEIGHTS_LIT])
def test_it_falls_with_agreement_and_grows_with_the_advantage_of_another_disparity(weights):
    agreement, advantage = np.meshgrid(np.linspace(-0.5, 1.4, 20), np.linspace(0.0, 1.0, 20))
    found = by_itself(Evidence(agreement, advantage, np.zeros((20, 20), np.bool_)), weights)
    assert (np.diff(found, axis=1) < 0.0).all()
    assert (np.diff(found, axis=0) > 0.0).all()
    assert found.min() > 0.0 and found.max() < 1.0


def test_weak_evidence_tells_no_more_than_none() -> None:
    agreement = np.array([[-0.5, 1.4]])
    weak = Evidence(agreement, np.zeros((1, 2)), np.ones((1, 2), np.bool_))
    low, high = by_itself(weak, WEIGHTS)[0]
    assert low == WEIGHTS.unknown
    assert high < 0.01


def test_no_window_changes_it() -> None:
    """The same bytes from a window of other borders."""
    left = ground(0)
    disparity = np.full((160, 260), 4)
    disparity[ROWS, COLS][FIELD] += 5
    right = right_of(left, disparity)
    whole = probability(pair(left, right))
    rows, cols = slice(ROWS.start + 11, ROWS.stop - 7), slice(COLS.start + 13, COLS.stop - 9)
    shape = rows.stop - rows.start, cols.stop - cols.start
    window = PairWindow(
        rows, cols, 0, read_patch(left, rows, cols, 1), read_patch(right, rows, slice(20, 240), 1)
    )
    labels = Labels(np.full(shape, 4.0), np.zeros((2, *shape)), np.zeros(shape))
    part = probability_of_change(labels, window, 9, NO_NOISE, np.ones(shape, np.bool_))
    inner = np.s_[30:-30, 30:-30]
    assert np.array_equal(whole[11:-7, 13:-9][inner], part[inner])


def test_what_is_left_to_doubt_goes_into_the_variance() -> None:
    """A label counts as off by a pixel with that probability."""
    apart = Comparison(9, 0.5, 2.0, 1.0, NO_NOISE, diachronic=True)
    window = built()
    found = contradicted(LEVEL, window, apart, ALL, GROUND)
    expected = probability(window)
    assert np.array_equal(found.variance, expected)
    assert np.array_equal(found.changed, expected > CHANGED)
