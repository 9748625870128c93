"""Where the pixels of a grid lie, against the ground that they were made from."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
import xarray as xr

from stereotruth.core.errors import InputError
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.intersection import with_ground

from ...synthetic.truth_scene import SIZE, sensor


@pytest.fixture(scope="module")
def model():
    return fit_epipolar(sensor("left"), sensor("right"), SIZE["left"], SIZE["right"], 65.0)


def grid_of(model, view: str) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
    """A grid of ground points at whole pixels of a view, and their longitudes and latitudes."""
    y, x = np.mgrid[100:104, 150:156].astype(float)
    height = 60.0 + 0.2 * x + 0.1 * y
    lon, lat = (np.reshape(v, x.shape) for v in model.epipolar_to_ground(x, y, height))
    x_left, _, x_right, _ = model.ground_to_epipolar(lon, lat, height).reshape(4, *x.shape)
    disparity = x_left - x_right
    arrays = {"height": (("y", "x"), height), "disparity": (("y", "x"), disparity)}
    coordinates = {"x": np.arange(150, 156), "y": np.arange(100, 104)}
    attrs = {"epipolar": model.to_dict(), "view": view}
    return xr.Dataset(arrays, coordinates, attrs), lon, lat


def test_pixels_lie_where_their_rays_meet_their_heights(model):
    grid, lon, lat = grid_of(model, "left")
    grid["height"][2, 3] = np.nan
    found = with_ground(grid)
    assert np.argwhere(np.isnan(found.lon.values)).tolist() == [[2, 3]]
    assert np.nanmax(np.abs(found.lon - lon)) < 1e-10
    assert np.nanmax(np.abs(found.lat - lat)) < 1e-10
    assert found.lon.dims == ("y", "x") and found.lat.attrs["units"] == "degrees_north"
    assert pyproj.CRS.from_cf(found["crs"].attrs) == pyproj.CRS("EPSG:4979")
    assert found["height"].attrs["grid_mapping"] == "crs"
    window = with_ground(grid.isel(y=slice(1, 3), x=slice(2, 5)))
    assert np.array_equal(window.lon, found.lon[1:3, 2:5], equal_nan=True)


def test_pixels_of_the_right_view_lie_where_their_disparities_lead(model):
    grid, _, _ = grid_of(model, "right")
    found = with_ground(grid)
    of_left = grid["x"].values + grid["disparity"].values
    y = np.broadcast_to(grid["y"].values[:, None], of_left.shape)
    lon, lat = model.epipolar_to_ground(of_left, y, grid["height"].values)
    assert found.lon.values == pytest.approx(np.reshape(lon, of_left.shape), abs=1e-12)
    assert found.lat.values == pytest.approx(np.reshape(lat, of_left.shape), abs=1e-12)


def test_a_grid_without_heights_is_refused(model):
    grid, _, _ = grid_of(model, "left")
    with pytest.raises(InputError, match="without 'height'"):
        with_ground(grid.drop_vars("height"))
    with pytest.raises(InputError, match="without 'epipolar'"):
        with_ground(grid.drop_attrs())
