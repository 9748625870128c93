"""Degrees against geodesics, hulls against Qhull, and pixels between triangles."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from scipy.spatial import ConvexHull

from stereotruth.core.numerics.geometry import (
    corners_of_hull,
    edge_crossing,
    exact_metres_per_degree,
    metres_per_degree,
    plane_slopes,
    row_span,
)

WGS84 = pyproj.Geod(ellps="WGS84")


@pytest.mark.parametrize("lat", [-60.0, 0.0, 75.0])
def test_metres_of_a_degree_are_those_of_geodesics(lat):
    step = 1e-4
    east = WGS84.inv(0.0, lat, step, lat)[2] / step
    north = WGS84.inv(0.0, lat - step / 2, 0.0, lat + step / 2)[2] / step
    assert exact_metres_per_degree(lat, 0.0) == pytest.approx([east, north], rel=1e-6)
    assert metres_per_degree(lat) == pytest.approx([east, north], rel=0.007)
    turn = np.radians(1.0) * 1000.0
    higher = exact_metres_per_degree(lat, 1000.0) - exact_metres_per_degree(lat, 0.0)
    assert higher == pytest.approx([turn * np.cos(np.radians(lat)), turn])


@pytest.mark.parametrize("n", [3, 50, 400])
def test_the_hull_is_that_of_qhull(n) -> None:
    points = np.random.default_rng(n).normal(size=(2, n)) * [[1e-3], [2e-4]] + [[114.0], [30.0]]
    found, expected = corners_of_hull(*points), ConvexHull(points.T).vertices.tolist()
    start = expected.index(found[0])
    assert found == expected[start:] + expected[:start]  # counterclockwise, as Qhull's


def test_points_on_a_side_and_twins_are_no_corners() -> None:
    x, y = np.array([(0, 0), (2, 0), (1, 0), (2, 2), (0, 2), (0, 2), (1, 1), (0, 1)], float).T
    assert [(x[k], y[k]) for k in corners_of_hull(x, y)] == [(0, 0), (2, 0), (2, 2), (0, 2)]


def covered(x, y, size: int) -> np.ndarray:
    """How often each pixel's centre lies in the triangle."""
    found = np.zeros((size, size), int)
    for row in range(size):
        low, high = row_span(x, y, float(row))
        if low <= high:
            found[row, max(int(np.ceil(low)), 0) : int(np.floor(high)) + 1] += 1
    return found


def test_triangles_of_a_fan_share_no_pixel_and_lose_none():
    rng = np.random.default_rng(4)
    for _ in range(20):
        cx, cy = rng.uniform(20, 40, 2)
        corners = [(-0.5, -0.5), (60.5, -0.5), (60.5, 60.5), (-0.5, 60.5)]
        total = np.zeros((61, 61), int)
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1]):
            total += covered((ax, bx, cx), (ay, by, cy), 61)
        assert (total == 1).all()
    for a, b in rng.uniform(0, 100, (200, 2, 2)):  # an edge is the same from both sides
        y = rng.uniform(*sorted((a[1], b[1])))
        assert edge_crossing(*a, *b, y) == edge_crossing(*b, *a, y)


def test_slopes_are_those_of_the_plane():
    x, y = (1.0, 7.5, 3.0), (2.0, 3.0, 9.0)
    values = tuple(4.0 + 0.3 * u - 1.5 * v for u, v in zip(x, y))
    assert plane_slopes(x, y, values) == pytest.approx((0.3, -1.5))
    with np.errstate(all="ignore"):
        in_line = plane_slopes(tuple(map(np.float64, (0, 1, 2))), (0.0, 1.0, 2.0), (0.0, 1.0, 2.0))
    assert not np.isfinite(sum(in_line))
