"""What labels lie on, classes of tiles, heights above the ground: on made towns."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.tiles.label_surfaces import (
    GROUND_CODE,
    GUARD_PX,
    Buildings,
    LabelSurface,
    buildings_by_shape,
    ground_cells,
    heights_above_ground,
    label_surfaces,
)

SIDE = 120
HOUSE = slice(30, 70)
TREES = slice(80, 100)
SURE = np.full((SIDE, SIDE), 0.01)


def town() -> tuple[np.ndarray, np.ndarray]:
    """Labels and classes: sloping ground, a house, rough trees."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(float)
    rng = np.random.default_rng(2)
    disparity = 3.0 + 0.02 * x + 0.01 * y + rng.normal(0, 0.03, (SIDE, SIDE))
    codes = np.full((SIDE, SIDE), 2, np.uint8)
    disparity[HOUSE, HOUSE] += 8.0
    codes[HOUSE, HOUSE] = 6
    disparity[TREES, TREES] += rng.uniform(2, 6, (20, 20))
    codes[TREES, TREES] = 5
    return disparity, codes


def test_surfaces_are_told_away_from_edges():
    disparity, codes = town()
    disparity[5:8, 100:103] = np.nan
    found = label_surfaces(disparity, SURE, codes, codes == 6)
    half = GUARD_PX // 2
    core = slice(HOUSE.start + half, HOUSE.stop - half)
    assert (found[core, core] == LabelSurface.ROOFS).all()
    assert (found == LabelSurface.ROOFS).sum() == (core.stop - core.start) ** 2
    wide = slice(TREES.start - half, TREES.stop + half)
    assert (found[wide, wide] == LabelSurface.CROWNS).all()
    assert (found == LabelSurface.CROWNS).sum() == (wide.stop - wide.start) ** 2
    assert (found[10:22, 10:90] == LabelSurface.OPEN_GROUND).all()
    wide = slice(HOUSE.start - half, HOUSE.stop + half)
    assert not (found[wide, wide] == LabelSurface.OPEN_GROUND).any()
    assert (found[3:10, 98:105] == LabelSurface.NEAR_EDGES).all()


def test_without_classes_what_is_rough_is_crowns():
    disparity, codes = town()
    unknown = np.zeros_like(codes)
    found = label_surfaces(disparity, SURE, unknown, codes == 6)
    assert (found[TREES, TREES] == LabelSurface.CROWNS).mean() > 0.95
    assert (found[40:60, 40:60] == LabelSurface.ROOFS).all()
    assert (found[10:22, 10:90] == LabelSurface.OPEN_GROUND).all()


def test_labels_that_are_less_sure_than_the_others_are_no_open_ground():
    disparity, codes = town()
    sigma = SURE + 0.15  # what all share does not count
    assert label_surfaces(disparity, sigma, codes, codes == 6)[15, 15] == LabelSurface.OPEN_GROUND
    sigma[10:20, 10:20] = 0.5
    found = label_surfaces(disparity, sigma, codes, codes == 6)
    assert (found[8:22, 8:22] == LabelSurface.NEAR_EDGES).all()
    assert (found[10:22, 40:90] == LabelSurface.OPEN_GROUND).all()


# ------------------------------------------------------------------ classes


def heights(slope: float = 0.0) -> np.ndarray:
    y, x = np.mgrid[:300, :300].astype(float)
    return 1900.0 + slope * x + 0.3 * slope * y


def kind(codes: np.ndarray, height: np.ndarray, share: float) -> str:
    here = slice(0, len(codes)), slice(0, len(codes))
    return Buildings.of_tile(codes, height, here).tile_class(share)


def test_class_by_the_classes_of_the_lidar():
    codes = np.full((100, 100), 2, np.uint8)
    codes[:20] = 0  # unlabelled pixels do not count
    codes[20:60] = 5
    codes[60:63, :80] = 6
    assert kind(codes, heights()[:100, :100], 0.031) == "vegetation"
    assert kind(codes, heights()[:100, :100], 0.029) == "building"


def test_class_by_shape_where_the_lidar_has_no_classes():
    slope = 0.15
    rng = np.random.default_rng(1)
    ground = heights(slope) + rng.normal(0, 0.03, (300, 300))
    unknown = np.ones((300, 300), np.uint8)
    assert kind(unknown, ground, 0.02) == "vegetation"
    trees = ground.copy()
    y, x = np.mgrid[:300, :300]
    for cx, cy in rng.integers(10, 290, (150, 2)):
        crown = 9.0 * np.sqrt(np.maximum(1 - ((x - cx) ** 2 + (y - cy) ** 2) / 36.0, 0.0))
        trees = np.maximum(trees, ground + crown)
    assert kind(unknown, trees, 0.02) == "vegetation"
    houses = trees.copy()
    houses[100:140, 50:110] = ground[120, 80] + 18.0  # one of 26 by 39 m, 2.7 % of the tile
    houses[rng.random((300, 300)) < 0.05] = np.nan
    found = buildings_by_shape(houses)
    assert found[105:135, 55:105].mean() > 0.9  # of which 5 % are not known
    assert kind(unknown, houses, 0.02) == "building"
    corner = slice(60, 100), slice(20, 60)  # the house is beside it
    beside = Buildings.of_tile(unknown[corner], houses, corner)
    assert beside.tile_class(0.02) == "vegetation"
    assert not buildings_by_shape(np.full((50, 50), np.nan)).any()


# ------------------------------------------------------------------ heights above the ground


ROWS, COLS, PX = 160, 200, 0.6


def slope_with_roofs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ground [3, h, w], LAS classes, and the exact height above the ground: slope and two roofs."""
    y, x = np.mgrid[:ROWS, :COLS] * PX
    above = np.zeros((ROWS, COLS))
    above[40:80, 60:110] = 12.0
    above[100:130, 20:60] = 6.0
    ground = 900.0 + 0.12 * x - 0.05 * y
    lat = 30.0 + y / DEGREE_M
    lon = 115.0 + x / DEGREE_M / np.cos(np.radians(30.0))
    classes = np.where(above > 0, 6, GROUND_CODE).astype(np.uint8)
    return np.stack([lon, lat, ground + above]), classes, above


def test_heights_stand_on_the_ground_of_the_lidar_s_class():
    ground, classes, above = slope_with_roofs()
    found = heights_above_ground(ground, classes)
    np.testing.assert_allclose(found, above, atol=0.2)
    assert np.abs(found - above)[classes == 6].mean() < 0.1


def test_without_classes_a_filter_finds_the_ground():
    ground, classes, above = slope_with_roofs()
    found = heights_above_ground(ground, np.zeros_like(classes))
    inside = np.s_[20:-20, 20:-20]
    error = np.abs(found - above)[inside]
    assert np.quantile(error, 0.95) < 0.5
    assert error[above[inside] > 0].mean() < 0.5


def test_what_has_no_height_has_none_above_the_ground():
    ground, classes, above = slope_with_roofs()
    ground[:, 50:55] = np.nan
    classes[50:55] = 0
    found = heights_above_ground(ground, classes)
    assert np.isnan(found[50:55]).all()
    rest = np.r_[0:50, 55:ROWS]
    np.testing.assert_allclose(found[rest], above[rest], atol=0.3)
    nothing = heights_above_ground(np.full((3, 8, 8), np.nan), np.zeros((8, 8), np.uint8))
    assert np.isnan(nothing).all()


@pytest.mark.parametrize("slope", [0.0, 0.19])
def test_slopes_are_ground_and_boxes_are_not(slope):
    low = np.tile(np.arange(60) * slope, (60, 1))
    assert ground_cells(low, 1.0)[5:-5, 5:-5].all()
    low[20:35, 20:35] += 8.0
    found = ground_cells(low, 1.0)
    assert not found[20:35, 20:35].any()
    low[0, 0] = np.inf
    assert not ground_cells(low, 1.0)[0, 0]
