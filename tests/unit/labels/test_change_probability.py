"""How probable a change is, on small made fields."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.labels.change_evidence import LabelledWindow
from stereotruth.labels.change_probability import (
    ASKED,
    CHANGED,
    Comparison,
    beyond_counts,
    beyond_learned,
    change_probability,
    contradicted,
    learned,
)
from stereotruth.labels.pair_window import PairWindow, read_patch
from stereotruth.labels.pixel_labels import Labels

from ...synthetic.textured_fields import (
    ALL,
    COLS,
    FIELD,
    GROUND,
    LEVEL,
    ROWS,
    SHAPE,
    built,
    ground,
    pair,
    right_of,
)

NOISE = 15.0**2, 15.0**2  # a tenth of the contrast of the fields
INNER = np.s_[20:-20, 20:-20]


def probability(
    window: PairWindow, noise: tuple[float, float] = NOISE, diachronic: bool = True
) -> np.ndarray:
    of = LabelledWindow(window, LEVEL, ALL, GROUND, noise)
    return change_probability(of, diachronic).probability


LIGHTS = pytest.mark.parametrize("diachronic", [False, True])


@LIGHTS
def test_a_new_roof_has_changed_and_the_ground_up_to_it_has_not(diachronic: bool) -> None:
    found = probability(built(), diachronic=diachronic)
    assert (found[FIELD] > CHANGED).mean() > 0.97
    rim = np.ones(SHAPE, np.bool_)
    rim[34:86, 44:106] = False  # 6 px around the roof
    assert (found[rim] < CHANGED).all()


@LIGHTS
def test_what_images_agree_on_has_hardly_changed(diachronic: bool) -> None:
    left = ground(0)
    found = probability(pair(left, right_of(left, np.full((160, 260), 4))), diachronic=diachronic)
    assert found[INNER].max() < 0.01


@LIGHTS
def test_images_of_noise_alone_tell_nothing(diachronic: bool) -> None:
    rng = np.random.default_rng(3)
    images = (np.round(rng.normal(900.0, 20.0, (160, 260))) for _ in range(2))
    found = probability(pair(*images), (400.0, 400.0), diachronic)
    assert (found[INNER] > CHANGED).mean() < 0.05
    blank = np.full((160, 260), 700.0)
    nothing = probability(pair(blank, blank), (4.0, 4.0), diachronic)
    assert (nothing[INNER] < CHANGED).all()


@LIGHTS
def test_no_window_changes_it(diachronic: bool) -> None:
    """The same bytes from a window of other borders."""
    left = ground(0)
    disparity = np.full((160, 260), 4)
    disparity[ROWS, COLS][FIELD] += 5
    right = right_of(left, disparity)
    whole = probability(pair(left, right), diachronic=diachronic)
    rows, cols = slice(ROWS.start + 11, ROWS.stop - 7), slice(COLS.start + 13, COLS.stop - 9)
    shape = rows.stop - rows.start, cols.stop - cols.start
    window = PairWindow(
        rows, cols, 0, read_patch(left, rows, cols, 1), read_patch(right, rows, slice(20, 240), 1)
    )
    labels = Labels(np.full(shape, 4.0), np.zeros((2, *shape)), np.zeros(shape))
    of = LabelledWindow(
        window, labels, np.ones(shape, np.bool_), np.full(shape, 2, np.uint8), NOISE
    )
    part = change_probability(of, diachronic).probability
    inner = np.s_[30:-30, 30:-30]
    assert np.array_equal(whole[11:-7, 13:-9][inner], part[inner])


def test_what_is_left_to_doubt_goes_into_the_variance() -> None:
    """A label counts as off by a pixel with that probability."""
    apart = Comparison(9, NOISE, diachronic=True)
    window = built()
    found = contradicted(LEVEL, window, apart, ALL, GROUND)
    expected = probability(window)
    assert np.array_equal(found.variance, expected)
    assert np.array_equal(found.changed, expected > CHANGED)


@LIGHTS
def test_what_was_never_learned_is_counted_by_figure(diachronic: bool) -> None:
    low, high = learned(diachronic).astype(np.float32)
    middle = (low + high) / 2
    figures = np.stack([middle, high + 1, np.where(np.arange(low.size) == 3, low - 1, middle)])
    figures[0, 0] = np.nan  # nothing was told
    beyond = beyond_learned(figures.T, diachronic)
    assert (beyond & ASKED == ASKED).all()
    assert beyond_counts(beyond).tolist() == [3, 1, 1, 1, 2, *[1] * (low.size - 4)]
    assert beyond_counts(np.append(beyond, np.uint32(0)))[0] == 3  # agrees closely
