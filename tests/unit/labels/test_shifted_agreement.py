"""Images that agree better at another disparity than at the labels', on small made fields."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.surface_windows import apart_from_steps, surface_correlation, surface_mean
from stereotruth.labels.change_probability import Comparison, contradicted
from stereotruth.labels.pair_window import PairWindow
from stereotruth.labels.pixel_labels import Labels
from stereotruth.labels.shifted_agreement import SHIFTS_PX, ShiftedAgreement, shifted_agreement

from ...synthetic.textured_fields import (
    ALL,
    FIELD,
    GROUND,
    LEVEL,
    SHAPE,
    pair,
    right_of,
    texture,
    through_optics,
)

NOISE = 15.0**2, 15.0**2  # a tenth of the contrast of the fields


def grown(by: int) -> PairWindow:
    """Of labels of 4 px: a field that is higher by so many px."""
    left, disparity = texture(), np.full((160, 260), 4)
    disparity[20:140, 60:200][FIELD] += by
    return pair(left, right_of(left, disparity))


def shadowed() -> PairWindow:
    """Unchanged, with stripes of shadow in the right image."""
    left = texture()
    right = right_of(left, np.full((160, 260), 4))
    dark = np.arange(260) // 25 % 2 == 1
    return pair(left, np.round(np.where(dark, right * 0.2, right)))


def at(window: PairWindow, noise: float = 0.0, reach: int = 8) -> ShiftedAgreement:
    return shifted_agreement(LEVEL, window, (noise, noise), 9, reach, ALL)


@pytest.mark.parametrize("by", [-3, 2, 5])
@pytest.mark.parametrize("reach", [4, 8])
def test_what_has_grown_agrees_at_another_disparity(by: int, reach: int) -> None:
    found = at(grown(by), reach=reach)
    inner, outside = np.zeros(SHAPE, np.bool_), np.ones(SHAPE, np.bool_)
    inner[47:73, 58:92] = True
    outside[32:88, 35:115] = False
    assert found.is_shifted[inner].all()
    assert (found.shift[inner] == by).mean() > 0.99
    assert not found.is_shifted[outside].any()


@pytest.mark.parametrize("diachronic", [False, True])
def test_shadows_are_changes_of_one_light_alone(diachronic: bool) -> None:
    """Where images share no light, their brightness tells nothing."""
    comparison = Comparison(9, NOISE, diachronic)
    changed = contradicted(LEVEL, shadowed(), comparison, ALL, GROUND).changed
    assert changed.any() != diachronic


def test_a_change_is_found_under_another_sun() -> None:
    window = grown(3)
    window.right.pixels[:, 60:] *= 0.2
    comparison = Comparison(9, NOISE, True)
    changed = contradicted(LEVEL, window, comparison, ALL, GROUND).changed
    assert changed[47:73, 58:92].all() and not changed[:30].any()


def test_noise_is_no_evidence() -> None:
    """Two images that show nothing but noise contradict no label."""
    rng = np.random.default_rng(3)
    images = (np.round(rng.normal(900.0, 20.0, (160, 260))) for _ in range(2))
    assert at(pair(*images), 400.0).is_shifted.mean() < 0.01


def test_only_what_is_wanted_is_compared() -> None:
    """And it is the same whatever else is."""
    window, wanted = grown(3), np.zeros(SHAPE, np.bool_)
    wanted[60:75, 60:110] = True
    whole, part = at(window), shifted_agreement(LEVEL, window, (0.0, 0.0), 9, 8, wanted)
    for name in ("here", "elsewhere", "shift", "signal"):
        values = getattr(part, name)
        assert np.isnan(values[~wanted]).all()
        assert (values[wanted] == getattr(whole, name)[wanted]).all()


@pytest.mark.parametrize("diachronic", [False, True])
def test_a_small_crown_that_was_felled(diachronic: bool) -> None:
    """The images show the ground below it."""
    crown, tree = np.s_[55:68, 70:83], 5
    disparity, classes = np.full(SHAPE, 4.0), GROUND.copy()
    disparity[crown], classes[crown] = 8.0, tree
    labels = Labels(disparity, LEVEL.slope, LEVEL.variance)
    left = through_optics(0)
    window = pair(left, right_of(left, np.full((160, 260), 4)))
    comparison = Comparison(9, NOISE, diachronic)
    changed = contradicted(labels, window, comparison, ALL, classes).changed
    assert changed[57:66, 72:81].all()
    changed[crown] = False
    assert not changed.any()


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


@pytest.mark.parametrize("diachronic", [False, True])
def test_beside_a_young_crown_labels_are_confirmed(diachronic: bool) -> None:
    """A crown of 3 px in the LiDAR has grown to 9 px; one that has not keeps its surroundings."""
    grown, still, tree = np.s_[56:65, 66:75], np.s_[30:33, 20:23], 5
    classes, disparity = GROUND.copy(), np.full((160, 260), 4)
    classes[59:62, 69:72] = classes[still] = tree
    disparity[20:140, 60:200][grown] += 3
    left = texture()
    window = pair(left, right_of(left, disparity))
    comparison = Comparison(9, NOISE, diachronic)
    changed = contradicted(LEVEL, window, comparison, ALL, classes).changed
    assert changed[grown].mean() > 0.9
    assert not changed[25:38, 15:28].any()


def test_labels_that_two_lights_do_not_confirm_are_less_certain() -> None:
    """The more, the less the images agree; those of images of one light are as they were."""
    apart = Comparison(9, NOISE, diachronic=True)
    left = texture()
    right = right_of(left, np.full((160, 260), 4))
    blank = np.full_like(left, 700.0)
    sure, unsure = (
        contradicted(LEVEL, pair(*images), how, ALL, GROUND).variance
        for images, how in (
            ((left, right), apart),
            ((blank, blank), apart._replace(noise=(4.0, 4.0))),
        )
    )
    inner = np.s_[20:-20, 20:-20]
    assert (sure[inner] < 0.002).all() and (unsure[inner] >= 0.02).all()
    same = Comparison(9, NOISE)
    assert contradicted(LEVEL, pair(left, right), same, ALL, GROUND).variance == 0.0


def test_correlations_at_all_shifts_are_those_of_the_warped_images() -> None:
    """Means over the surface of what :func:`surface_correlation` says of each shift by itself."""
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
