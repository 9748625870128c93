"""The convex hull, held against Qhull."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from stereotruth.core.numerics.geometry import corners_of_hull


@pytest.mark.parametrize("n", [3, 4, 50, 400])
def test_the_hull_is_that_of_qhull(n) -> None:
    points = np.random.default_rng(n).normal(size=(2, n)) * [[1e-3], [2e-4]] + [[114.0], [30.0]]
    found, expected = corners_of_hull(*points), ConvexHull(points.T).vertices.tolist()
    start = expected.index(found[0])
    assert found == expected[start:] + expected[:start]  # counterclockwise, as Qhull's


def test_points_on_a_side_and_twins_are_no_corners() -> None:
    x, y = np.array([(0, 0), (2, 0), (1, 0), (2, 2), (0, 2), (0, 2), (1, 1), (0, 1)], float).T
    assert [(x[k], y[k]) for k in corners_of_hull(x, y)] == [(0, 0), (2, 0), (2, 2), (0, 2)]
