"""What has changed, on small made fields: each reason by what the LiDAR and both images show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereocities.changes import REASONS
from stereotruth.core.status import Reason, Status
from stereotruth.labels.change_probability import Comparison
from stereotruth.labels.change_reasons import REASON_PX, VEHICLE_M, is_common, with_reasons
from stereotruth.labels.pair_window import PairWindow, WindowLabels, read_patch
from stereotruth.labels.pixel_labels import Labels, OwnPoints
from stereotruth.labels.shifted_agreement import WIDE_SHIFTS_PX

IMAGE = 200, 300
ROWS, COLS = slice(10, 190), slice(50, 250)
SHAPE = ROWS.stop - ROWS.start, COLS.stop - COLS.start
LARGE, SMALL = np.s_[60:110, 60:120], np.s_[80:90, 90:106]  # of the window
GROUND, TREE, BUILDING, WATER = 2, 5, 6, 9  # ASPRS
DISPARITY, HEIGHT_M, PX_PER_M = 4, 50.0, 1.0
COMPARISON = Comparison(9, (0.0, 0.0))


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


def lidar(
    patch: tuple[slice, slice], surface_class: int, above_m: float
) -> tuple[WindowLabels, OwnPoints]:
    """Labels and points of a level ground on which the patch is of a class, so high above it, and
    has changed."""
    zeros, level = np.zeros(SHAPE), np.zeros((2, *SHAPE))
    status, classes = np.full(SHAPE, Status.LABELLED, np.uint8), np.full(SHAPE, GROUND, np.uint8)
    height, disparity = zeros + HEIGHT_M, zeros + DISPARITY
    status[patch], classes[patch] = Status.CHANGED, surface_class
    height[patch] += above_m
    disparity[patch] += above_m * PX_PER_M
    labels = Labels(disparity, level, zeros)
    count = np.ones(SHAPE, np.int64)
    nothing = np.zeros(SHAPE, np.uint8)
    found = WindowLabels(status, labels, height, classes, zeros, count, zeros, nothing, nothing)
    return found, OwnPoints(count, height, classes)


def reasons(
    patch: tuple[slice, slice], surface_class: int, above_m: float, now_m: int | None, **options
) -> np.ndarray:
    """Of a patch that stands ``above_m`` over the ground in the LiDAR and ``now_m`` in both
    images, or is another surface in each (None)."""
    labels, points = lidar(patch, surface_class, above_m)
    return at(labels, points, images(patch, now_m), **options)


def at(
    labels: WindowLabels,
    points: OwnPoints,
    window: PairWindow,
    *,
    rough: bool = False,
    comparison: Comparison = COMPARISON,
) -> np.ndarray:
    is_rough = np.full(labels.status.shape, rough)
    return with_reasons(labels, is_rough, points, window, comparison, PX_PER_M).change


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
    comparison = COMPARISON._replace(diachronic=True)
    change = reasons(LARGE, BUILDING, 6, now_m, comparison=comparison)
    assert (change[LARGE] == reason).mean() > 0.95


def test_a_chance_agreement_is_no_common_one() -> None:
    shift = np.random.default_rng(0).choice(WIDE_SHIFTS_PX, (80, 80))
    every = np.ones(shift.shape, bool)
    assert is_common(shift, every, 16).mean() < 0.01
    shift[:, 40:] = 5.0
    found = is_common(shift, every, 16)
    assert found[:, 50:].all() and found[:, :20].mean() < 0.01


def test_a_tree_that_has_grown_has_one_of_the_lidar_in_it() -> None:
    labels, points = lidar(SMALL, GROUND, 0)
    points.surface_class[84:87, 97:101] = TREE
    assert (at(labels, points, images(SMALL, None))[SMALL] == Reason.GROWN_OR_FELLED).all()


@pytest.mark.parametrize("beside_m, reason", [(-3.0, Reason.WATER), (-9.0, Reason.BUILT)])
def test_a_flood_reaches_what_is_low_beside_water(beside_m: float, reason: Reason) -> None:
    labels, points = lidar(LARGE, GROUND, 0)
    points.surface_class[:, 45:130] = WATER
    points.surface_class[LARGE] = GROUND
    points.highest[points.surface_class == WATER] += beside_m
    change = at(labels, points, images(LARGE, None))
    assert (change[62:108, 62:70] == reason).all()


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
    [(GROUND, 0, 6, False), (BUILDING, 6, 10, True), (BUILDING, 6, None, True)],
)
def test_reasons_follow_from_what_is_near(surface_class, above_m, now_m, diachronic) -> None:
    """A window has the reasons of a larger one, but within REASON_PX and the reach of the
    comparison of its rim."""
    comparison = COMPARISON._replace(diachronic=diachronic)
    labels, points = lidar(LARGE, surface_class, above_m)
    window = images(LARGE, now_m)
    whole = at(labels, points, window, comparison=comparison)
    part, margin = np.s_[30:150, 40:180], REASON_PX + 10
    cut = {name: getattr(points, name)[part] for name in OwnPoints.__dataclass_fields__}
    small = replace(
        window,
        rows=slice(ROWS.start + 30, ROWS.start + 150),
        cols=slice(COLS.start + 40, COLS.start + 180),
    )
    inner = np.s_[margin:-margin, margin:-margin]
    change = at(labels.within(part), OwnPoints(**cut), small, comparison=comparison)[inner]
    assert change.any() and np.array_equal(change, whole[part][inner])


def test_codes_are_those_of_the_simulator_but_for_texture() -> None:
    """A change of texture alone is none of height; where nothing tells, the reason is unknown."""
    names = [reason.name.lower() for reason in Reason]
    assert names[:-1] == REASONS.split()[:-1]
    assert (names[-1], REASONS.split()[-1]) == ("unknown", "texture")
