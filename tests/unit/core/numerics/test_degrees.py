"""Metres of a degree against geodesics on the ellipsoid."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from stereotruth.core.numerics.geometry import exact_metres_per_degree, metres_per_degree

WGS84 = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("lat", [-60.0, 0.0, 31.5, 75.0])
def test_metres_of_a_degree_are_those_of_geodesics(lat):
    step = 1e-4
    east = WGS84.inv(0.0, lat, step, lat)[2] / step
    north = WGS84.inv(0.0, lat - step / 2, 0.0, lat + step / 2)[2] / step
    assert exact_metres_per_degree(lat, 0.0) == pytest.approx([east, north], rel=1e-6)
    assert metres_per_degree(lat) == pytest.approx([east, north], rel=0.007)


def test_a_degree_grows_with_the_height():
    low, high = exact_metres_per_degree(40.0, 0.0), exact_metres_per_degree(40.0, 1000.0)
    turn = np.radians(1.0) * 1000.0
    assert high - low == pytest.approx([turn * np.cos(np.radians(40.0)), turn])
    assert metres_per_degree(np.array([0.0, 60.0]))[0] == pytest.approx([111_320, 55_660])
