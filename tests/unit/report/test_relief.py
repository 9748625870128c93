"""The hillshade and the grid of the 3-D view."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from stereotruth.pages.pictures import NO_VALUE, hillshade
from stereotruth.report.relief import Relief


def test_planes_are_shaded_as_lambert_says():
    ratio = 0.5  # px of disparity for a px of height
    rows, cols = np.mgrid[:40, :60].astype(float)
    flat, towards = np.zeros((40, 60)), ratio * (rows + cols) / np.sqrt(2)  # faces the sun
    away = -2 * towards
    assert np.all(hillshade(flat, ratio) == round(255 * np.sqrt(0.5)))
    assert np.all(hillshade(towards, ratio) == 255)
    assert np.all(hillshade(away, ratio) == 0)


def test_what_has_no_slope_is_light_grey():
    disparity = np.zeros((9, 9))
    disparity[4, 4] = np.nan
    assert (hillshade(disparity, 1.0)[4, 3:6] == NO_VALUE).all()
    assert hillshade(disparity, 1.0)[0, 0, 0] == 180


def test_the_grid_has_the_heights_and_the_holes():
    disparity = np.tile(np.linspace(0, 20, 100), (50, 1))
    disparity[:, :10] = np.nan
    relief = Relief.of(disparity, 0.5, 20)
    grid = np.frombuffer(base64.b64decode(relief.values), np.uint8).reshape(20, 20)
    assert (grid[:, :2] == 0).all() and (grid[:, 2:] > 0).all()
    heights = (grid[0, 2:] - 1.0) / 254 * relief.height * 100  # px of the ground
    cols = np.linspace(0, 99, 20).round()[2:]
    np.testing.assert_allclose(heights, (cols - 10) * 20 / 99 / 0.5, atol=0.15)
    assert relief.height == pytest.approx(89 * 20 / 99 / 0.5 / 100)
