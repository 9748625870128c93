"""The convex hull of points in a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def corners_of_hull(x: Floats, y: Floats) -> list[int]:
    """Which points are corners of the convex hull of all, counterclockwise.

    Andrew's monotone chain. SciPy's hull takes a quarter of a job's start-up to import.
    """
    order = np.lexsort((y, x)).tolist()
    xs, ys = x.tolist(), y.tolist()
    corners: list[int] = []
    for points in (order, order[::-1]):  # the lower side, then the upper
        side: list[int] = []
        for k in points:
            while len(side) > 1:
                i, j = side[-2:]
                if (xs[j] - xs[i]) * (ys[k] - ys[i]) > (ys[j] - ys[i]) * (xs[k] - xs[i]):
                    break
                side.pop()
            side.append(k)
        corners += side[:-1]
    return corners
