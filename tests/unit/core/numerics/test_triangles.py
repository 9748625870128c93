"""Triangles against exact areas, and pixels between two of them."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.geometry import edge_crossing, plane_slopes, row_span


def covered(x, y, size: int) -> np.ndarray:
    """How often each pixel's centre lies in the triangle."""
    found = np.zeros((size, size), int)
    for row in range(size):
        low, high = row_span(x, y, float(row))
        if low <= high:
            found[row, max(int(np.ceil(low)), 0) : int(np.floor(high)) + 1] += 1
    return found


def test_a_span_is_where_a_triangle_meets_a_row():
    x, y = (1.0, 5.0, 3.0), (0.0, 0.0, 4.0)
    assert row_span(x, y, 0.0) == (1.0, 5.0)
    assert row_span(x, y, 2.0) == (2.0, 4.0)
    assert row_span(x, y, 4.0) == (3.0, 3.0)
    assert row_span(x, y, 4.5) == (np.inf, -np.inf)


def test_triangles_of_a_fan_share_no_pixel_and_lose_none():
    rng = np.random.default_rng(4)
    for _ in range(20):
        cx, cy = rng.uniform(20, 40, 2)
        corners = [(-0.5, -0.5), (60.5, -0.5), (60.5, 60.5), (-0.5, 60.5)]
        total = np.zeros((61, 61), int)
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1]):
            total += covered((ax, bx, cx), (ay, by, cy), 61)
        assert (total == 1).all()


def test_an_edge_is_the_same_from_both_sides():
    rng = np.random.default_rng(5)
    for a, b in rng.uniform(0, 100, (200, 2, 2)):
        y = rng.uniform(*sorted((a[1], b[1])))
        assert edge_crossing(*a, *b, y) == edge_crossing(*b, *a, y)


def test_slopes_are_those_of_the_plane():
    x, y = (1.0, 7.5, 3.0), (2.0, 3.0, 9.0)
    values = tuple(4.0 + 0.3 * u - 1.5 * v for u, v in zip(x, y))
    assert plane_slopes(x, y, values) == pytest.approx((0.3, -1.5))
    with np.errstate(all="ignore"):
        in_line = plane_slopes(tuple(map(np.float64, (0, 1, 2))), (0.0, 1.0, 2.0), (0.0, 1.0, 2.0))
    assert not np.isfinite(sum(in_line))
