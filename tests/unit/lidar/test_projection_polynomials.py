"""Polynomials on patches against PROJ itself."""

from __future__ import annotations

import warnings

import numpy as np
import pyproj
import pytest
from pyproj.transformer import TransformerGroup

from stereotruth.lidar.projection_polynomials import TOLERANCE_DEG, TOLERANCE_M, PatchedTransform


def transformer(epsg: int) -> tuple[pyproj.Transformer, float]:
    system = pyproj.CRS(epsg)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # better grids that are not installed
        group = TransformerGroup(system.to_3d(), "EPSG:4979", always_xy=True)
    return group.transformers[0], system.axis_info[0].unit_conversion_factor


SYSTEMS = [  # code, easting, northing in map units
    (32650, 347_000, 3_345_000),
    (32719, 320_000, 6_250_000),
    (2154, 700_000, 6_600_000),
    (2975, 340_000, 7_650_000),
    (21781, 600_000, 200_000),  # Bessel: place and height change with height
    (28992, 120_000, 450_000),
    (2992, 636_000, 849_000),  # feet
    (2225, 6_000_000, 2_100_000),  # survey feet
    (3857, 13_000_000, 3_500_000),
    (3035, 4_300_000, 3_200_000),
    (5514, -700_000, -1_050_000),
    (2436, 500_000, 3_400_000),
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


def test_near_a_pole_of_the_map() -> None:
    exact, unit = transformer(3413)
    points = scattered(0, 0, unit, 2000)
    assert np.array_equal(
        np.array(PatchedTransform(exact.transform, unit)(*points)),
        np.array(exact.transform(*points)),
    )


def test_no_points() -> None:
    exact, unit = transformer(32650)
    got = PatchedTransform(exact.transform, unit)(*np.empty((3, 0)))
    assert [values.shape for values in got] == [(0,)] * 3
