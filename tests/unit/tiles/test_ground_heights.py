from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.tiles.ground_heights import GROUND_CLASS, ground_cells, heights_above_ground

ROWS, COLS, PX = 160, 200, 0.6


def town() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ground [3, h, w], LAS classes, and the exact height above the ground: slope and two roofs."""
    y, x = np.mgrid[:ROWS, :COLS] * PX
    above = np.zeros((ROWS, COLS))
    above[40:80, 60:110] = 12.0
    above[100:130, 20:60] = 6.0
    ground = 900.0 + 0.12 * x - 0.05 * y
    lat = 30.0 + y / DEGREE_M
    lon = 115.0 + x / DEGREE_M / np.cos(np.radians(30.0))
    classes = np.where(above > 0, 6, GROUND_CLASS).astype(np.uint8)
    return np.stack([lon, lat, ground + above]), classes, above


def test_heights_stand_on_the_ground_of_the_lidar_s_class():
    ground, classes, above = town()
    found = heights_above_ground(ground, classes)
    np.testing.assert_allclose(found, above, atol=0.2)
    assert np.abs(found - above)[classes == 6].mean() < 0.1


def test_without_classes_a_filter_finds_the_ground():
    ground, classes, above = town()
    found = heights_above_ground(ground, np.zeros_like(classes))
    inside = np.s_[20:-20, 20:-20]
    error = np.abs(found - above)[inside]
    assert np.quantile(error, 0.95) < 0.5
    assert error[above[inside] > 0].mean() < 0.5


def test_what_has_no_height_has_none_above_the_ground():
    ground, classes, above = town()
    ground[:, 50:55] = np.nan
    classes[50:55] = 0
    found = heights_above_ground(ground, classes)
    assert np.isnan(found[50:55]).all()
    rest = np.r_[0:50, 55:ROWS]
    np.testing.assert_allclose(found[rest], above[rest], atol=0.3)
    nothing = heights_above_ground(np.full((3, 8, 8), np.nan), np.zeros((8, 8), np.uint8))
    assert np.isnan(nothing).all()


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.19])
def test_slopes_are_ground_and_boxes_are_not(slope):
    low = np.tile(np.arange(60) * slope, (60, 1))
    assert ground_cells(low, 1.0)[5:-5, 5:-5].all()
    low[20:35, 20:35] += 8.0
    found = ground_cells(low, 1.0)
    assert not found[20:35, 20:35].any()
    low[0, 0] = np.inf
    assert not ground_cells(low, 1.0)[0, 0]
