"""Interpolation on a grid: bilinear, cubic convolution, and uniform cubic B-splines.

Cubic convolution (Keys 1981, IEEE TASSP 29): with four samples (section IV, a = -1/2) quadratic
polynomials come out exactly, with six (section VI) cubic ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels import inlined, inner
from .arrays import Floats, Singles

SIX_POINT_RADIUS = 3  # samples on either side that the six-point kernel weighs
# Rows are taps, columns powers 3 to 0 of f: the kernel at f + 2, f + 1, f, 1 - f, 2 - f, 3 - f
TAP_POLYNOMIALS = (
    np.array(
        [
            [1, -2, 1, 0],
            [-7, 15, -8, 0],
            [16, -28, 0, 12],
            [-16, 20, 8, 0],
            [7, -6, -1, 0],
            [-1, 1, 0, 0],
        ]
    )
    / 12
).astype(np.float32)

Four = tuple[float, float, float, float]


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


@inlined
def four_point_value(a: float, b: float, c: float, d: float, f: float) -> float:
    """Value ``f`` samples after ``b`` of four samples in a row; ``f`` in [0, 1]."""
    return b + 0.5 * f * (
        c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a))
    )


@inner
def four_point_weights(f: float, weights: Floats) -> None:
    """Fill ``weights`` [4] of the samples of :func:`four_point_value`: its values of unit samples.

    For who takes values of many rows at one ``f``.
    """
    weights[0] = four_point_value(1.0, 0.0, 0.0, 0.0, f)
    weights[1] = four_point_value(0.0, 1.0, 0.0, 0.0, f)
    weights[2] = four_point_value(0.0, 0.0, 1.0, 0.0, f)
    weights[3] = four_point_value(0.0, 0.0, 0.0, 1.0, f)


@inner
def six_point_kernel(s: float) -> float:
    """Weight of a sample ``s`` samples away, before and after; 0 from SIX_POINT_RADIUS on."""
    s = abs(s)
    if s < 1.0:
        return (4.0 * s - 7.0) * s * s / 3.0 + 1.0
    if s < 2.0:
        return ((-7.0 * s + 36.0) * s - 59.0) * s / 12.0 + 2.5
    if s < 3.0:
        return ((s - 8.0) * s + 21.0) * s / 12.0 - 1.5
    return 0.0


@inner
def six_point_weights(at: float, first: int, scale: float, weights: Floats) -> None:
    """Fill ``weights`` of the samples first, first + 1, … for the value at ``at``; their sum is 1.

    ``scale``: by how much the kernel is widened, 1 for none; ``weights`` then has six.
    """
    if scale == 1.0:  # the same without branches
        f = at - first - 2.0
        e = 1.0 - f
        weights[0] = (((f - 2.0) * f + 1.0) * f) / 12.0
        weights[5] = (((e - 2.0) * e + 1.0) * e) / 12.0
        weights[1] = (((-7.0 * f + 15.0) * f - 8.0) * f) / 12.0
        weights[4] = (((-7.0 * e + 15.0) * e - 8.0) * e) / 12.0
        weights[2] = (4.0 * f - 7.0) * f * f / 3.0 + 1.0
        weights[3] = (4.0 * e - 7.0) * e * e / 3.0 + 1.0
        return
    total = 0.0
    for k in range(weights.size):
        weights[k] = six_point_kernel((at - (first + k)) / scale)
        total += weights[k]
    for k in range(weights.size):
        weights[k] /= total


@inner
def six_point_weights_of_row(f: Singles, weights: Singles) -> None:
    """Fill ``weights`` [6, n] for n values, each of which lies ``f`` in [0, 1] past its third tap.

    One loop for each tap, which is vectorised.
    """
    for tap in range(6):
        a, b, c, d = TAP_POLYNOMIALS[tap]
        for k in range(f.size):
            weights[tap, k] = ((a * f[k] + b) * f[k] + c) * f[k] + d


@inlined
def cubic_weights(f: float) -> Four:
    """Weights of the four coefficients around a place ``f`` in [0, 1] of a cell; their sum is 1."""
    e = 1.0 - f
    return (
        e * e * e / 6.0,
        ((3.0 * f - 6.0) * f * f + 4.0) / 6.0,
        ((3.0 * e - 6.0) * e * e + 4.0) / 6.0,
        f * f * f / 6.0,
    )


@inlined
def cubic_slopes(f: float) -> Four:
    """Derivatives of :func:`cubic_weights` by ``f``; their sum is 0."""
    e = 1.0 - f
    return -0.5 * e * e, (1.5 * f - 2.0) * f, (2.0 - 1.5 * e) * e, 0.5 * f * f
