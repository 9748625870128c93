"""Triangles over the ground against Qhull, and the same whatever the order and the window."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from stereotruth.surface.delaunay import MAX_PARTS, triangulate
from stereotruth.surface.scale import PART


def places(n: int, side: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Distinct integer places [<= n] in a square, sorted by (y, x)."""
    key = np.unique(np.random.default_rng(seed).integers(0, side * side, n))
    return key % side, key // side


def corners(triangles, x: np.ndarray, y: np.ndarray) -> set[frozenset[tuple[int, int]]]:
    """The triangles by the places of their corners."""
    points = list(zip(x.tolist(), y.tolist()))
    return {frozenset(points[v] for v in corner) for corner in triangles.corner.tolist()}


def test_triangles_are_those_of_qhull() -> None:
    x, y = places(3000, 4000)
    found = triangulate(x, y, 300.0)
    points = np.column_stack([x, y]).astype(float)
    expected = Delaunay(points).simplices
    a, b, c = (points[expected[:, k]] for k in range(3))
    sides = [np.hypot(*(p - q).T) for p, q in ((a, b), (b, c), (c, a))]
    area = np.abs(np.cross(b - a, c - a))
    radius = np.prod(sides, axis=0) / (2.0 * area)
    kept = expected[radius <= 300.0]
    whole = {frozenset(map(int, corner)) for corner in kept}
    assert {frozenset(map(int, corner)) for corner in found.corner} == whole
    assert np.sort(found.radius) == pytest.approx(np.sort(radius[radius <= 300.0]))


def test_triangles_turn_left_and_know_their_neighbours() -> None:
    x, y = places(500, 1000)
    found = triangulate(x, y, 100.0)
    for t, (corner, beside) in enumerate(zip(found.corner, found.neighbour)):
        a, b, c = corner
        assert (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]) > 0
        assert a < min(b, c)
        for k, other in enumerate(beside):
            if other >= 0:
                shared = set(corner.tolist()) - {int(corner[k])}
                assert shared <= set(found.corner[other].tolist())
                assert t in found.neighbour[other]


@pytest.mark.parametrize("gridded", [False, True])
def test_order_of_points_does_not_matter(gridded: bool) -> None:
    if gridded:  # all squares are cocircular
        y, x = (c.reshape(-1) * PART for c in np.mgrid[:40, :40])
    else:
        x, y = places(2000, 3000)
    order = np.random.default_rng(1).permutation(x.size)
    found, again = triangulate(x, y, 200.0), triangulate(x[order], y[order], 200.0)
    assert corners(found, x, y) == corners(again, x[order], y[order])
    if gridded:
        assert len(found.corner) == 2 * 39 * 39


@pytest.mark.parametrize("gridded", [False, True])
def test_a_window_has_the_triangles_of_the_whole(gridded: bool) -> None:
    if gridded:
        y, x = (c.reshape(-1) * PART for c in np.mgrid[:60, :60])
    else:
        x, y = places(4000, 2000)
    limit = 80.0
    low, high = 600, 1300
    near = (x >= low) & (x <= high) & (y >= low) & (y <= high)
    whole, part = triangulate(x, y, limit), triangulate(x[near] - low, y[near] - low, limit)
    halo = 2 * limit  # the circumcircle of a triangle in here lies in the window

    def inside(found: set[frozenset[tuple[int, int]]]) -> set[frozenset[tuple[int, int]]]:
        a, b = low + halo, high - halo
        return {t for t in found if all(a <= u <= b and a <= v <= b for u, v in t)}

    expected = inside(corners(whole, x, y))
    assert len(expected) > 100
    assert inside(corners(part, x[near], y[near])) == expected


def test_places_in_a_line_have_no_triangles() -> None:
    x = np.arange(10, dtype=np.int64) * 7
    assert len(triangulate(x, np.zeros_like(x), 50.0).corner) == 0
    none = np.empty(0, np.int64)
    assert len(triangulate(none, none, 50.0).corner) == 0


def test_too_wide_a_window_is_refused() -> None:
    x = np.array([0, MAX_PARTS], dtype=np.int64)
    with pytest.raises(ValueError, match="exact"):
        triangulate(x, x, 50.0)
