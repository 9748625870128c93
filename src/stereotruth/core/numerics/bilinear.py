"""Bilinear interpolation between the four samples around a place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels import inlined

Floats = NDArray[np.float64]


@inlined
def between_four(
    upper_left: float,
    upper_right: float,
    lower_left: float,
    lower_right: float,
    right: float,
    down: float,
) -> float:
    """Value ``right`` and ``down`` in [0, 1] of a cell from its upper left corner; or arrays."""
    upper = (1.0 - right) * upper_left + right * upper_right
    return (1.0 - down) * upper + down * ((1.0 - right) * lower_left + right * lower_right)


def bilinear(grid: NDArray[np.floating], col: ArrayLike, row: ArrayLike) -> Floats:
    """Values of a ``grid`` [h, w] at places (col, row) of any shape, whole numbers at its samples.

    NaN outside of the grid, and where one of the four samples around is NaN.
    """
    col, row = np.asarray(col, np.float64), np.asarray(row, np.float64)
    height, width = grid.shape
    inside = (row >= 0) & (col >= 0) & (row <= height - 1) & (col <= width - 1)  # not NaN
    col, row = np.where(inside, col, 0.0), np.where(inside, row, 0.0)
    i, j = col.astype(np.intp), row.astype(np.intp)
    below, beside = np.minimum(j + 1, height - 1), np.minimum(i + 1, width - 1)
    corners = grid[j, i], grid[j, beside], grid[below, i], grid[below, beside]
    return np.where(inside, between_four(*corners, col - i, row - j), np.nan)
