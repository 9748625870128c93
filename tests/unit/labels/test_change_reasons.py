"""What has changed, on small made fields: each reason by what the LiDAR and both images show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from stereocities.truth import REASONS
from stereotruth.core.status import Reason
from stereotruth.labels.change_evidence import LabelledWindow
from stereotruth.labels.change_reasons import (
    REASON_PX,
    VEHICLE_M,
    ChangedSurface,
    is_common,
    reasons_of,
)
from stereotruth.labels.pair_window import Labels, PairWindow, read_patch
from stereotruth.labels.shifted_agreement import WIDE_SHIFTS_PX

IMAGE = 200, 300
ROWS, COLS = slice(10, 190), slice(50, 250)
SHAPE = ROWS.stop - ROWS.start, COLS.stop - COLS.start
LARGE, SMALL = np.s_[60:110, 60:120], np.s_[80:90, 90:106]  # of the window
GROUND, TREE, BUILDING, WATER = 2, 5, 6, 9  # ASPRS
DISPARITY, HEIGHT_M, PX_PER_M = 4, 50.0, 1.0


def texture(seed: int) -> np.ndarray:
    return np.round(np.random.default_rng(seed).uniform(200, 1200, IMAGE))


def images(patch: tuple[slice, slice], rise_px: int | None) -> PairWindow:
    """A level ground of which a patch is higher in both images, or is another in each (None)."""
    left, right = texture(0), texture(1)
    disparity = np.full(IMAGE, DISPARITY)
    disparity[ROWS, COLS][patch] += rise_px or 0
    y, x = np.indices(IMAGE)
    match = x - disparity
    seen = (match >= 0) & (match < IMAGE[1])
    right[y[seen], match[seen]] = left[seen]
    if rise_px is None:
        left[ROWS, COLS][patch] = texture(2)[ROWS, COLS][patch]
    patches = read_patch(left, ROWS, COLS, 1), read_patch(right, ROWS, slice(0, 300), 1)
    return PairWindow(ROWS, COLS, 0, *patches)


@dataclass
class Seen:
    """What the LiDAR shows: whether pixels have changed, ``labels``, ``height`` (m) and class of
    the surface, and of the points."""

    changed: np.ndarray
    disparity: np.ndarray
    height: np.ndarray
    classes: np.ndarray
    highest: np.ndarray
    highest_class: np.ndarray

    def within(self, part: tuple[slice, slice]) -> Seen:
        return Seen(*(values[part] for values in vars(self).values()))

    def reasons(
        self, window: PairWindow, *, rough: bool = False, diachronic: bool = False
    ) -> np.ndarray:
        is_rough, zeros = np.full(self.changed.shape, rough), np.zeros(self.changed.shape)
        labels = Labels(self.disparity, np.zeros((2, *zeros.shape)), zeros)
        compared = LabelledWindow(window, labels, zeros == 0, self.classes, (0.0, 0.0))
        points = self.highest, self.highest_class
        surface = ChangedSurface(self.changed, self.height, self.classes, is_rough, *points)
        return reasons_of(surface, compared, PX_PER_M, diachronic)


def lidar(patch: tuple[slice, slice], surface_class: int, above_m: float) -> Seen:
    """A level ground on which the patch is of a class, so high above it, and has changed."""
    changed, classes = np.zeros(SHAPE, np.bool_), np.full(SHAPE, GROUND, np.uint8)
    height, disparity = np.full(SHAPE, HEIGHT_M), np.full(SHAPE, float(DISPARITY))
    changed[patch], classes[patch] = True, surface_class
    height[patch] += above_m
    disparity[patch] += above_m * PX_PER_M
    return Seen(changed, disparity, height, classes, height.copy(), classes.copy())


def reasons(
    patch: tuple[slice, slice], surface_class: int, above_m: float, now_m: int | None, **options
) -> np.ndarray:
    """Of a patch that stands ``above_m`` over the ground in the LiDAR and ``now_m`` in both
    images, or is another surface in each (None)."""
    return lidar(patch, surface_class, above_m).reasons(images(patch, now_m), **options)


@pytest.mark.parametrize(
    "patch, surface_class, above_m, now_m, reason",
    [
        (LARGE, GROUND, 0, 6, Reason.BUILT),
        (LARGE, BUILDING, 6, 10, Reason.BUILT),  # raised
        (LARGE, BUILDING, 8, 0, Reason.DEMOLISHED),
        (LARGE, TREE, 8, 0, Reason.GROWN_OR_FELLED),
        (SMALL, GROUND, 0, None, Reason.MOVED),
        (SMALL, BUILDING, 2, None, Reason.MOVED),  # a class that vehicles have
        (LARGE, WATER, 0, None, Reason.WATER),
        (LARGE, GROUND, 0, 2, Reason.GROUND),
        (LARGE, GROUND, 0, -2, Reason.GROUND),
        (LARGE, BUILDING, 8, None, Reason.UNKNOWN),
    ],
)
def test_the_reason_follows_from_lidar_and_images(patch, surface_class, above_m, now_m, reason):
    change = reasons(patch, surface_class, above_m, now_m)
    assert (change[patch] == reason).mean() > 0.95
    change[patch] = Reason.NONE
    assert not change.any()


@pytest.mark.parametrize(
    "now_m, reason", [(10, Reason.BUILT), (0, Reason.DEMOLISHED), (None, Reason.DEMOLISHED)]
)
def test_under_two_suns_a_building_that_agrees_nowhere_has_gone(now_m, reason) -> None:
    change = reasons(LARGE, BUILDING, 6, now_m, diachronic=True)
    assert (change[LARGE] == reason).mean() > 0.95


def test_a_chance_agreement_is_no_common_one() -> None:
    shift = np.random.default_rng(0).choice(WIDE_SHIFTS_PX, (80, 80))
    every = np.ones(shift.shape, bool)
    assert is_common(shift, every, 16).mean() < 0.01
    shift[:, 40:] = 5.0
    found = is_common(shift, every, 16)
    assert found[:, 50:].all() and found[:, :20].mean() < 0.01


def test_a_tree_that_has_grown_has_one_of_the_lidar_in_it() -> None:
    seen = lidar(SMALL, GROUND, 0)
    seen.highest_class[84:87, 97:101] = TREE
    assert (seen.reasons(images(SMALL, None))[SMALL] == Reason.GROWN_OR_FELLED).all()


@pytest.mark.parametrize("beside_m, reason", [(-3.0, Reason.WATER), (-9.0, Reason.BUILT)])
def test_a_flood_reaches_what_is_low_beside_water(beside_m: float, reason: Reason) -> None:
    seen = lidar(LARGE, GROUND, 0)
    seen.highest_class[:, 45:130] = WATER
    seen.highest_class[LARGE] = GROUND
    seen.highest[seen.highest_class == WATER] += beside_m
    assert (seen.reasons(images(LARGE, None))[62:108, 62:70] == reason).all()


@pytest.mark.parametrize(
    "above_m, rough, reason",
    [
        (8, False, Reason.DEMOLISHED),
        (8, True, Reason.GROWN_OR_FELLED),
    ],
)
def test_without_classes_roughness_and_height_decide(above_m, rough, reason) -> None:
    patch = np.s_[70:95, 80:110]  # so that the ground is near
    assert above_m > VEHICLE_M
    change = reasons(patch, 1, above_m, 0, rough=rough)
    assert (change[patch] == reason).mean() > 0.9


@pytest.mark.parametrize(
    "surface_class, above_m, now_m, diachronic",
    [(GROUND, 0, 6, False), (BUILDING, 6, None, True)],
)
def test_reasons_follow_from_what_is_near(surface_class, above_m, now_m, diachronic) -> None:
    """A window has the reasons of a larger one, but within REASON_PX and the reach of the
    comparison of its rim."""
    seen, window = lidar(LARGE, surface_class, above_m), images(LARGE, now_m)
    whole = seen.reasons(window, diachronic=diachronic)
    part, margin = np.s_[30:150, 40:180], REASON_PX + 10
    rows, cols = (slice(e.start + p.start, e.start + p.stop) for e, p in zip((ROWS, COLS), part))
    inner = np.s_[margin:-margin, margin:-margin]
    small = replace(window, rows=rows, cols=cols)
    change = seen.within(part).reasons(small, diachronic=diachronic)[inner]
    assert change.any() and np.array_equal(change, whole[part][inner])


def test_codes_are_those_of_the_simulator_but_for_texture() -> None:
    """A change of texture alone is none of height; where nothing tells, the reason is unknown."""
    names = [reason.name.lower() for reason in Reason]
    assert names[:-1] == REASONS.split()[:-1]
    assert (names[-1], REASONS.split()[-1]) == ("unknown", "texture")
