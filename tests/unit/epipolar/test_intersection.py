"""Rays of matching pixels meet on the surface; pixels of a grid lie where their heights are."""

from __future__ import annotations

import re
from importlib.metadata import version

import numpy as np
import pyproj
import pytest
import xarray as xr
from scipy.optimize import least_squares

from stereotruth.core.errors import InputError
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.intersection import PLACE, coarse_place, intersect, with_ground
from stereotruth.epipolar.model import EpipolarModel

from ...synthetic.cameras import HEIGHT, LAT, LON
from ...synthetic.flat_model import disparity_of, make_model, plane
from ...synthetic.truth_scene import SIZE, sensor


@pytest.fixture(scope="module")
def model() -> EpipolarModel:
    return make_model()


@pytest.fixture(scope="module")
def of_plane(model) -> np.ndarray:
    return disparity_of(model, plane)


def test_intersections_project_back_and_lie_on_the_surface(model, of_plane):
    d = of_plane.copy()
    d[10:14, 20:30] = np.nan
    d[200:, 300:] += 40.0  # a jump
    lon, lat, h = intersect(model, d[5:], row=5)
    assert np.array_equal(np.isfinite(h), np.isfinite(d[5:]))
    y, x = np.mgrid[5 : model.shape[0], : model.shape[1]]
    xl, yl, xr, yr = model.ground_to_epipolar(lon, lat, h).reshape(4, *h.shape)
    known = np.isfinite(h)
    for found, wanted in ((xl, x), (xr, x - d[5:].astype(float)), (yl, y), (yr, y)):
        assert np.abs(found - wanted)[known].max() < 1e-4
    flat = known.copy()
    flat[195:, 300:] = False
    assert np.abs(h - plane(lon, lat))[flat].max() < 1e-4


def test_rays_that_miss_are_brought_together_by_least_squares(model):
    """Against a general solver, at places where the epipolar rows were moved apart."""
    moved = model.right_image.shifted(0.0, -0.7)
    apart = EpipolarModel(**{**vars_of(model), "right_image": moved})
    for row, col, d in ((40, 50, 3.0), (200, 200, -20.0), (300, 120, 60.0)):
        found = intersect(apart, np.full((1, 1), d, np.float32), row, col)[:, 0, 0]
        places = np.array(
            [*model.left_image.inverse(col, row), *moved.inverse(col - d, row)]
        ).ravel()

        def residuals(p, places=places):
            lon, lat = LON + p[0] * 1e-5, LAT + p[1] * 1e-5
            both = [*model.left.project(lon, lat, p[2]), *model.right.project(lon, lat, p[2])]
            return np.array(both).ravel() - places

        best = least_squares(residuals, [0.0, 0.0, HEIGHT], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        wanted = np.array([LON + best.x[0] * 1e-5, LAT + best.x[1] * 1e-5, best.x[2]])
        assert np.abs(best.fun).max() > 0.1
        assert np.abs((found - wanted) * (1e5, 1e5, 1.0)).max() < 2e-3


def vars_of(model: EpipolarModel) -> dict:
    return {name: getattr(model, name) for name in EpipolarModel.__dataclass_fields__}


# ------------------------------------------------------------------ grids


@pytest.fixture(scope="module")
def of_scene():
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


def test_pixels_lie_where_their_rays_meet_their_heights(of_scene):
    grid, lon, lat = grid_of(of_scene, "left")
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


def test_pixels_of_the_right_view_lie_where_their_disparities_lead(of_scene):
    grid, _, _ = grid_of(of_scene, "right")
    found = with_ground(grid)
    of_left = grid["x"].values + grid["disparity"].values
    y = np.broadcast_to(grid["y"].values[:, None], of_left.shape)
    lon, lat = of_scene.epipolar_to_ground(of_left, y, grid["height"].values)
    assert found.lon.values == pytest.approx(np.reshape(lon, of_left.shape), abs=1e-12)
    assert found.lat.values == pytest.approx(np.reshape(lat, of_left.shape), abs=1e-12)


def test_a_grid_without_heights_is_refused(of_scene):
    grid, _, _ = grid_of(of_scene, "left")
    with pytest.raises(InputError, match="height"):
        with_ground(grid.drop_vars("height"))
    with pytest.raises(InputError, match="epipolar"):
        with_ground(grid.drop_attrs())


@pytest.mark.parametrize("view", ["left", "right"])
def test_maps_show_a_grid_within_the_stated_distance(of_scene, view):
    """At the centres of pixels, at the reference height and over all heights of the model."""
    attrs = coarse_place(of_scene, view)
    assert tuple(sorted(attrs)) == tuple(sorted(PLACE))
    of_map = pyproj.Transformer.from_crs(attrs["proj:code"], "EPSG:4326", always_xy=True)
    a, b, c, d, e, f = attrs["spatial:transform"]
    near, far = (float(m) for m in re.findall(r"([\d.]+) m (?:at|from)", attrs["place"]))
    assert near < 1.0 < far
    rows, cols = of_scene.shape
    y, x = np.mgrid[5 : rows - 5 : 50, 5 : cols - 5 : 50].astype(float)
    shown = (p * (x + 0.5) + q * (y + 0.5) + r for p, q, r in ((a, b, c), (d, e, f)))
    shown_lon, shown_lat = of_map.transform(*shown)
    image, sensor_of = getattr(of_scene, f"{view}_image"), getattr(of_scene, view)
    least, greatest = of_scene.height_range
    levels = {least: far + 1.0, greatest: far + 1.0, of_scene.reference_height: near + 0.1}
    for height, stated in levels.items():
        lon, lat = sensor_of.localize(*image.inverse(x, y), height)
        off = pyproj.Geod(ellps="WGS84").inv(lon, lat, shown_lon, shown_lat)[2]
        assert np.nanmax(off) <= stated
    west, south, east, north = of_map.transform_bounds(*attrs["spatial:bbox"])
    assert west < np.nanmin(lon) < np.nanmax(lon) < east
    assert south < np.nanmin(lat) < np.nanmax(lat) < north


def test_rioxarray_reads_the_place(of_scene):
    rioxarray = pytest.importorskip("rioxarray")
    if tuple(map(int, version("rioxarray").split(".")[:2])) < (0, 22):
        pytest.skip(f"rioxarray {rioxarray.__version__} does not know the conventions of GeoZarr")
    attrs = coarse_place(of_scene)
    grid = xr.Dataset({"disparity": (("y", "x"), np.ones((4, 6)))}, attrs=attrs)
    assert f"EPSG:{grid.rio.crs.to_epsg()}" == attrs["proj:code"]
    assert list(grid.rio.transform())[:6] == attrs["spatial:transform"]
