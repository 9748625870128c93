"""Polynomials on patches against PROJ and the epipolar model themselves."""

from __future__ import annotations

import warnings

import numpy as np
import pyproj
import pytest
from pyproj.transformer import TransformerGroup

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.lidar.lattice import CELL_BITS
from stereotruth.lidar.smooth_maps import (
    TOLERANCE_DEG,
    TOLERANCE_M,
    TOLERANCE_PX,
    LocalProjection,
    PatchedTransform,
)

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, camera

SIZE = (320, 280)
MIDDLE = np.array([round(LON * 1e9), round(LAT * 1e9), round(HEIGHT * 1e4)])


def transformer(epsg: int) -> tuple[pyproj.Transformer, float]:
    system = pyproj.CRS(epsg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # better grids that are not installed
        group = TransformerGroup(system.to_3d(), "EPSG:4979", always_xy=True)
    return group.transformers[0], system.axis_info[0].unit_conversion_factor


SYSTEMS = [  # code, easting, northing in map units
    (32650, 347_000, 3_345_000),
    (21781, 600_000, 200_000),  # Bessel: place and height change with height
    (2992, 636_000, 849_000),  # feet
    (3857, 13_000_000, 3_500_000),
    (5514, -700_000, -1_050_000),
]


def scattered(x: float, y: float, unit: float, n: int = 20_000) -> np.ndarray:
    """Coordinates of points within 2 km, between -300 and 4500 m."""
    rng = np.random.default_rng(0)
    low, high = np.array([-2000.0, -2000, -300]), np.array([2000.0, 2000, 4500])
    return rng.uniform(low, high, (n, 3)).T / [[unit], [unit], [1]] + [[x], [y], [0]]


@pytest.mark.parametrize(("epsg", "x", "y"), SYSTEMS)
def test_agrees_with_proj(epsg, x, y) -> None:
    exact, unit = transformer(epsg)
    asked = []

    def counted(*xyz: np.ndarray):
        asked.append(len(xyz[0]))
        return exact.transform(*xyz)

    points = scattered(x, y, unit)
    patches = PatchedTransform(counted, unit)
    got, truth = np.array(patches(*points)), np.array(exact.transform(*points))
    np.testing.assert_allclose(got[:2], truth[:2], rtol=0, atol=TOLERANCE_DEG)
    np.testing.assert_allclose(got[2], truth[2], rtol=0, atol=TOLERANCE_M)
    asked.clear()
    patches(*points)
    assert asked == []  # PROJ has been asked for the patches only


def test_a_point_comes_out_the_same_in_any_company() -> None:
    exact, unit = transformer(21781)
    points = scattered(600_000, 200_000, unit, 3000)
    whole = np.array(PatchedTransform(exact.transform, unit)(*points))
    order = np.random.default_rng(1).permutation(3000)
    patches = PatchedTransform(exact.transform, unit)
    pieces = [np.array(patches(*points[:, part])) for part in np.array_split(order, 40)]
    assert np.array_equal(np.concatenate(pieces, axis=1), whole[:, order])
    for k in order[:5]:
        alone = PatchedTransform(exact.transform, unit)(*points[:, k : k + 1])
        assert np.array_equal(np.ravel(alone), whole[:, k])


def test_kinks_and_jumps_are_left_to_the_exact_way() -> None:
    """As of a datum grid whose cells meet at x = 1130: PROJ's own values there, to the bit."""

    def kinked(x, y, z):
        return x * 1e-5 + np.maximum(x - 1130, 0) * 1e-9, y * 1e-5, z + 1.0 * (y > 3300)

    points = scattered(1000, 3000, 1.0)
    got, truth = np.array(PatchedTransform(kinked, 1.0)(*points)), np.array(kinked(*points))
    np.testing.assert_allclose(got, truth, rtol=0, atol=1e-10)
    across = (np.floor(points[0] / 500) == 2) | (np.floor(points[1] / 500) == 6)
    assert np.array_equal(got[:, across], truth[:, across])


def test_places_that_proj_does_not_know() -> None:
    exact, unit = transformer(32650)
    x = np.array([500_000.0, 3e8, np.inf, np.nan, 1e300, 500_000.0, 500_000.0])
    y = np.array([3_300_000.0, 3e8, 0.0, 3_300_000.0, 0.0, 3_300_000.0, 3_300_000.0])
    z = np.array([10.0, 10, 10, 10, 10, np.inf, 1e7])
    got = PatchedTransform(exact.transform, unit)(x, y, z)
    good = np.isfinite(got).all(axis=0)
    assert good.tolist() == [True, False, False, False, False, False, True]
    assert got[2][6] == 1e7


@pytest.fixture(scope="module")
def model() -> EpipolarModel:
    sensors = [camera(tilt, size=SIZE) for tilt in (BACKWARD, FORWARD)]
    return fit_epipolar(*sensors, SIZE, SIZE, HEIGHT, height_range=(HEIGHT - 50, HEIGHT + 100))


def lattice_points(n: int) -> np.ndarray:
    """int64[3, n] of lattice points in some cubes around the scene."""
    spread = np.array([2, 2, 1]) << CELL_BITS
    return (MIDDLE + np.random.default_rng(0).integers(-spread, spread, (n, 3))).T.copy()


def exact(model, lattice: np.ndarray) -> np.ndarray:
    return model.ground_to_epipolar(lattice[0] / 1e9, lattice[1] / 1e9, lattice[2] / 1e4)


def test_points_are_where_the_model_has_them(model) -> None:
    """In boxes of any size, and without one, with the same bits."""
    lattice = lattice_points(5000)
    asked = []

    class Counted:
        def ground_to_epipolar(self, *ground: np.ndarray) -> np.ndarray:
            asked.append(ground[0].size)
            return model.ground_to_epipolar(*ground)

    local = LocalProjection.of(Counted(), lattice.min(axis=1), lattice.max(axis=1))
    asked.clear()
    xy = local.at_points(*lattice)
    assert asked == []  # the model has been asked for the cubes only
    assert np.array_equal(LocalProjection(model).at_points(*lattice), xy)
    assert np.abs(xy - exact(model, lattice)).max() < TOLERANCE_PX
    few = lattice[:, :7].copy()
    part = LocalProjection.of(model, few.min(axis=1), few.max(axis=1))
    assert np.array_equal(part.at_points(*few), xy[:, :7])


@pytest.mark.parametrize("rough", [False, True])
def test_the_rise_is_what_a_metre_of_height_changes(model, rough) -> None:
    model = Rough() if rough else model
    lattice = lattice_points(5000)
    lifted = np.random.default_rng(1).random(5000) < 0.4
    local = LocalProjection.of(model, lattice.min(axis=1), lattice.max(axis=1))
    xy, rise = local.with_rise(*lattice, lifted)
    assert np.array_equal(xy, local.at_points(*lattice))
    metre = np.array([[0], [0], [10_000]])
    by_metre = (exact(model, lattice + metre) - exact(model, lattice - metre)) / 2
    assert np.abs(rise[:, lifted] * 10_000 - by_metre[:, lifted]).max() < 1e-4
    assert np.abs(by_metre).max() > 0.3


class Rough:
    """A model with a kink, which no polynomial follows."""

    def ground_to_epipolar(self, lon, lat, height) -> np.ndarray:
        x = 1e6 * np.abs(lon - LON) + 1e5 * (lat - LAT)
        return np.stack([x, 1e5 * (lat - LAT), x - 2.0 * height, 1e5 * (lat - LAT)])


def test_where_no_polynomial_fits_the_model_is_taken() -> None:
    model, lattice = Rough(), lattice_points(3000)
    local = LocalProjection.of(model, lattice.min(axis=1), lattice.max(axis=1))
    assert np.abs(local.at_points(*lattice) - exact(model, lattice)).max() < TOLERANCE_PX
