"""How probable a change is, and which labels both images contradict, on small made fields."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.labels.change_evidence import (
    ASKED,
    LabelledWindow,
    beyond_counts,
    beyond_learned,
    learned,
)
from stereotruth.labels.change_probability import (
    CHANGED,
    Contradicted,
    change_probability,
    contradicted,
)
from stereotruth.labels.pair_window import Labels, PairWindow, read_patch

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
    texture,
    through_optics,
    with_noise,
)

NOISE = 15.0  # DN: a tenth of the contrast of the fields
INNER = np.s_[20:-20, 20:-20]
FLAT = np.full((160, 260), 4)  # px
TREE = 5  # ASPRS
LIGHTS = pytest.mark.parametrize("diachronic", [False, True])


def compared(window: PairWindow, noise: float = NOISE) -> LabelledWindow:
    return LabelledWindow(window, LEVEL, ALL, GROUND, (noise**2, noise**2))


def probability(window: PairWindow, diachronic: bool, noise: float = NOISE) -> np.ndarray:
    return change_probability(compared(window, noise), diachronic).probability


def by_images(
    window: PairWindow,
    diachronic: bool = False,
    noise: float = NOISE,
    labels: Labels = LEVEL,
    classes: np.ndarray = GROUND,
) -> Contradicted:
    of = LabelledWindow(window, labels, ALL, classes, (noise**2, noise**2))
    return contradicted(of, diachronic)


def noisy(left: np.ndarray, right: np.ndarray, noise: float) -> PairWindow:
    return pair(*(with_noise(image, noise, seed) for seed, image in enumerate((left, right))))


@pytest.mark.parametrize(("noise", "diachronic"), [(4.0, False), (20.0, True)])
def test_a_change_is_found_up_to_its_rim_and_nothing_else(noise: float, diachronic: bool) -> None:
    """A field in which the left image shows something else, and single pixels that noise spoils."""
    left = through_optics(0)
    right = right_of(left, FLAT)
    left[ROWS, COLS][FIELD] = through_optics(5)[:40, :50]
    changed = by_images(noisy(left, right, noise), diachronic, noise).changed
    assert changed[42:78, 52:98].mean() > 0.99  # 2 px inside
    changed[37:83, 47:103] = False
    assert not changed.any()


@pytest.mark.parametrize("contrast", [2.0, 20.0])
def test_noise_is_no_change(contrast: float) -> None:
    """The same ground in noisy images keeps its labels, however weak its texture is."""
    left = through_optics(6, contrast, 1.5)
    changed = by_images(noisy(left, right_of(left, FLAT), 10.0), noise=10.0).changed
    assert changed[10:-10, 10:-10].mean() < 0.01


def test_change_shows_through_noise() -> None:
    """Other ground, of a contrast of twice the noise."""
    window = noisy(*(through_optics(s, 20.0, 1.5) for s in (1, 2)), 10.0)
    assert by_images(window, noise=10.0).changed[10:-10, 10:-10].mean() > 0.95


@LIGHTS
def test_a_roof_that_is_blurred_into_the_ground_is_no_change(diachronic: bool) -> None:
    """A bright roof beside dull ground, which the other view shows beside more ground."""
    x = np.arange(260)
    left = np.where(x < 120, 2000 + texture(1), 60 + 0.05 * texture())
    right = right_of(left, np.where(x < 120, 15, 4) * np.ones((160, 1), int))
    left[:, 120:122] += np.array([600.0, 60.0])  # what the optics bring over
    disparity = np.where(x[COLS] < 120, 15.0, 4.0) * np.ones(SHAPE)
    disparity[:, 59:61] = np.nan  # the edge itself has no label
    labels = Labels(disparity, LEVEL.slope, LEVEL.variance)
    changed = by_images(pair(left, right), diachronic, labels=labels).changed
    assert not (changed & np.isfinite(disparity))[INNER].any()


@LIGHTS
def test_a_new_roof_has_changed_and_the_ground_up_to_it_has_not(diachronic: bool) -> None:
    values = probability(built(), diachronic)
    assert (values[FIELD] > CHANGED).mean() > 0.97
    rim = np.ones(SHAPE, np.bool_)
    rim[34:86, 44:106] = False  # 6 px around the roof
    assert (values[rim] < CHANGED).all()


def test_shadows_are_changes_of_one_light_alone() -> None:
    """Where images share no light, their brightness tells nothing."""
    left = texture()
    right, dark = right_of(left, FLAT), np.arange(260) // 25 % 2 == 1
    window = pair(left, np.round(np.where(dark, right * 0.2, right)))
    assert by_images(window).changed.any() and not by_images(window, diachronic=True).changed.any()


def test_a_change_is_found_under_another_sun() -> None:
    left, disparity = texture(), FLAT.copy()
    disparity[ROWS, COLS][FIELD] += 3
    window = pair(left, right_of(left, disparity))
    window.right.pixels[:, 60:] *= 0.2
    changed = by_images(window, diachronic=True).changed
    assert changed[47:73, 58:92].all() and not changed[:30].any()


@LIGHTS
def test_a_small_crown_that_was_felled(diachronic: bool) -> None:
    """The images show the ground below it."""
    crown = np.s_[55:68, 70:83]
    disparity, classes = np.full(SHAPE, 4.0), GROUND.copy()
    disparity[crown], classes[crown] = 8.0, TREE
    left = through_optics(0)
    labels = Labels(disparity, LEVEL.slope, LEVEL.variance)
    window = pair(left, right_of(left, FLAT))
    changed = by_images(window, diachronic, labels=labels, classes=classes).changed
    assert changed[57:66, 72:81].all()
    changed[crown] = False
    assert not changed.any()


@LIGHTS
def test_beside_a_young_crown_labels_are_confirmed(diachronic: bool) -> None:
    """A crown of 3 px in the LiDAR has grown to 9 px; one that has not keeps its surroundings."""
    grown, still = np.s_[56:65, 66:75], np.s_[30:33, 20:23]
    classes, disparity = GROUND.copy(), FLAT.copy()
    classes[59:62, 69:72] = classes[still] = TREE
    disparity[ROWS, COLS][grown] += 3
    left = texture()
    changed = by_images(pair(left, right_of(left, disparity)), diachronic, classes=classes).changed
    assert changed[grown].mean() > 0.9
    assert not changed[25:38, 15:28].any()


def test_no_window_changes_it() -> None:
    """The same bytes from a window of other borders."""
    left, disparity = ground(0), FLAT.copy()
    disparity[ROWS, COLS][FIELD] += 5
    right = right_of(left, disparity)
    whole = probability(pair(left, right), True)
    rows, cols = slice(ROWS.start + 11, ROWS.stop - 7), slice(COLS.start + 13, COLS.stop - 9)
    shape = rows.stop - rows.start, cols.stop - cols.start
    window = PairWindow(
        rows, cols, 0, read_patch(left, rows, cols, 1), read_patch(right, rows, slice(20, 240), 1)
    )
    labels = Labels(np.full(shape, 4.0), np.zeros((2, *shape)), np.zeros(shape))
    every, classes = np.ones(shape, np.bool_), np.full(shape, 2, np.uint8)
    of = LabelledWindow(window, labels, every, classes, (NOISE**2, NOISE**2))
    part = change_probability(of, True).probability
    inner = np.s_[30:-30, 30:-30]
    assert np.array_equal(whole[11:-7, 13:-9][inner], part[inner])


def test_what_is_left_to_doubt_goes_into_the_variance() -> None:
    """A label of two lights counts as off by a pixel with that probability: the more, the less the
    images agree; those of images of one light are as they were."""
    told, values = by_images(built(), True), probability(built(), True)
    assert np.array_equal(told.variance, values)
    assert np.array_equal(told.changed, values > CHANGED)
    left, blank = texture(), np.full((160, 260), 700.0)
    agreeing = pair(left, right_of(left, FLAT))
    assert (by_images(agreeing, True).variance[INNER] < 0.002).all()
    assert (by_images(pair(blank, blank), True, 2.0).variance[INNER] >= 0.02).all()
    assert by_images(agreeing).variance == 0.0


def test_what_was_never_learned_is_counted_by_figure() -> None:
    low, high = learned(True).astype(np.float32)
    middle = (low + high) / 2
    figures = np.stack([middle, high + 1, np.where(np.arange(low.size) == 3, low - 1, middle)])
    figures[0, 0] = np.nan  # nothing was told
    beyond = beyond_learned(figures.T, True)
    assert (beyond & ASKED == ASKED).all()
    assert beyond_counts(beyond).tolist() == [3, 1, 1, 1, 2, *[1] * (low.size - 4)]
    assert beyond_counts(np.append(beyond, np.uint32(0)))[0] == 3  # agrees closely
