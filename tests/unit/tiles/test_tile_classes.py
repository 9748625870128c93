"""The class of a tile."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.tiles import tile_classes

# -------------------------------------------------------------------------------------- classes


def heights(slope: float = 0.0) -> np.ndarray:
    y, x = np.mgrid[:300, :300].astype(float)
    return 1900.0 + slope * x + 0.3 * slope * y


def kind(codes: np.ndarray, height: np.ndarray, share: float) -> str:
    here = slice(0, len(codes)), slice(0, len(codes))
    return tile_classes.Buildings.of_tile(codes, height, here).tile_class(share)


def test_class_by_the_classes_of_the_lidar():
    codes = np.full((100, 100), 2, np.uint8)
    codes[:20] = 0  # unlabelled pixels do not count
    codes[20:60] = 5
    codes[60:63, :80] = 6
    assert kind(codes, heights()[:100, :100], 0.031) == "vegetation"
    assert kind(codes, heights()[:100, :100], 0.029) == "building"


@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_class_by_shape_where_the_lidar_has_no_classes(slope):
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
    found = tile_classes.buildings_by_shape(houses)
    assert found[105:135, 55:105].mean() > 0.9  # of which 5 % are not known
    assert kind(unknown, houses, 0.02) == "building"
    corner = slice(60, 100), slice(20, 60)  # the house is beside it
    beside = tile_classes.Buildings.of_tile(unknown[corner], houses, corner)
    assert beside.tile_class(0.02) == "vegetation"
    assert not tile_classes.buildings_by_shape(np.full((50, 50), np.nan)).any()
