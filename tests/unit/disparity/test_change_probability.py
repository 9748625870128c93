"""How probable a change is, by images of two lights, on small made fields."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.disparity.change_probability import (
    CHANGED,
    FAR_PX,
    UNKNOWN,
    Evidence,
    change_evidence,
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
    assert np.median(found[INNER]) == UNKNOWN
    blank = np.full((160, 260), 700.0)
    nothing = probability_of_change(LEVEL, pair(blank, blank), 9, (4.0, 4.0), ALL)
    assert (nothing[INNER] == UNKNOWN).all()


def test_evidence_is_of_the_pixels_that_do_not_agree_fully() -> None:
    doubtful, evidence = change_evidence(LEVEL, built(), 9, NO_NOISE, ALL)
    assert doubtful[FIELD].mean() > 0.95
    assert not doubtful[20:25, 20:120].any()
    assert all(values.shape == (doubtful.sum(),) for values in evidence)
    inside = np.zeros(SHAPE, np.bool_)
    inside[48:72, 58:92] = True  # no window reaches beyond the roof
    of_roof = Evidence(*(values[inside[doubtful]] for values in evidence))
    assert np.abs(of_roof.agreement).max() < 0.2
    assert (of_roof.from_step == FAR_PX).all() and (of_roof.slope == 0.0).all()
    # uniform of half a width of 50 DN, in units of the rounding; three times as bright
    expected = 50.0 / np.sqrt(3.0) * np.sqrt(12.0)
    assert np.median(of_roof.contrast_left) == pytest.approx(expected, rel=0.1)
    assert np.median(of_roof.contrast_right) == pytest.approx(3.0 * expected, rel=0.1)


def test_gain_is_what_brightness_differs_by_from_that_around() -> None:
    left = ground(0)
    right = right_of(left, np.full((160, 260), 4))
    plain = change_evidence(LEVEL, pair(left, 2.0 * right), 9, NO_NOISE, ALL)
    assert not plain[0][INNER].any()
    right[ROWS, slice(COLS.start - 4, COLS.stop - 4)][56:64, 71:79] *= 2.0 * ground(1)[:8, :8] / 500
    doubtful, evidence = change_evidence(LEVEL, pair(left, right), 9, NO_NOISE, ALL)
    at = np.full(SHAPE, np.nan)
    at[doubtful] = evidence.gain
    share = 64 / 81  # of the means of 9 x 9 px, and of those up to 16 px off one in 81 every 4 px
    assert at[59, 74] == pytest.approx(np.log(2.0) * (share - 4 / 81), abs=0.05)


def test_steps_of_the_surface_are_told_by_their_distance() -> None:
    level = np.full(SHAPE, 4.0)
    level[:, 80:] = 9.0
    images = pair(texture(0), texture(1))
    labels = Labels(level, np.zeros((2, *SHAPE)), np.zeros(SHAPE))
    doubtful, evidence = change_evidence(labels, images, 9, NO_NOISE, ALL)
    at = np.full(SHAPE, np.nan)
    at[doubtful] = evidence.from_step
    found = [at[60, x] for x in (80, 81, 84, 88, 95)]
    assert found == [0, 1, 4, 8, 8]


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
