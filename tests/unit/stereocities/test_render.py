"""Rendered views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from scipy.ndimage import map_coordinates, uniform_filter

from stereocities.render import _shade_rows, prepare
from stereocities.truth import open_truth

from ...synthetic.small_cities import GROUND, ROOF, TOWN


def test_views_look_alike_where_both_see_the_surface(town: Path) -> None:
    """9 x 9 correlation of left and right at the true correspondences, as the paper's filter."""
    truth = open_truth(town / "truth.zarr")
    with rasterio.open(town / "left.tif") as image:
        left = image.read(1).astype(float)
    with rasterio.open(town / "right.tif") as image:
        right = image.read(1).astype(float)
    assert 150 < np.median(left) < 600 and left.max() <= 2047
    seen = truth.visible_right.values == 1
    at = np.stack([truth.right_row.values, truth.right_col.values])
    warped = map_coordinates(right, np.nan_to_num(at, nan=-99), order=3)

    def mean(a: np.ndarray) -> np.ndarray:
        return uniform_filter(a, 9)

    spread_left = mean(left**2) - mean(left) ** 2
    spread = spread_left * (mean(warped**2) - mean(warped) ** 2)
    covariance = mean(left * warped) - mean(left) * mean(warped)
    correlation = covariance / np.sqrt(np.maximum(spread, 1e-6))
    whole = mean(seen.astype(float)) > 0.999
    surface = truth.surface.values
    for kind in (GROUND, ROOF):
        values = correlation[whole & (surface == kind)]
        assert len(values) > 1000
        assert np.median(values) > 0.9 and np.mean(values > 0.5) > 0.97
    hidden = (surface > 0) & ~seen
    assert 0.005 < hidden.mean() < 0.3
    assert np.median(correlation[hidden]) < 0.6


def test_a_row_is_the_same_whatever_rows_are_beside_it() -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    camera = ready.left
    shown = [np.empty((rows, 2 * camera.cols), np.float32) for rows in (24, 11)]
    for half, first in zip(shown, (100.0, 102.5)):
        _shade_rows(camera.surfaces, camera.horizon, camera.shown, camera.cam, first, half)
    np.testing.assert_array_equal(shown[1], shown[0][5 : 5 + len(shown[1])])
    assert shown[0].std() > 0.01
