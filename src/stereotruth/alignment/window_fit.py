"""A step of least-squares matching (Gruen 1985), for windows of any kind and any unknowns.

A window is a list of n pixels [n, 3]: grey value, and its slopes along columns and rows in px.
Grey values of two windows differ by a gain and an offset, which are taken out, and by where the
pixels lie. The slopes are the mean of both windows', so that noise draws nothing.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def weighted_mean(window: Floats, weight: Floats) -> float:
    """Mean grey value of a window."""
    mean, total = 0.0, 0.0
    for k in range(weight.size):
        mean += weight[k] * window[k, 0]
        total += weight[k]
    return mean / total


@njit(cache=True, nogil=True, error_model="numpy")
def gain_and_correlation(
    left: Floats, right: Floats, weight: Floats, mean_left: float, mean_right: float
) -> tuple[float, float]:
    """Contrast of the left window by the right one's, and their correlation.

    NaN where a window is flat or they do not correlate: there is nothing to match.
    """
    ll, lr, rr = 0.0, 0.0, 0.0
    for k in range(weight.size):
        w, s, t = weight[k], left[k, 0] - mean_left, right[k, 0] - mean_right
        ll += w * s * s
        lr += w * s * t
        rr += w * t * t
    if not (ll > 0.0 and rr > 0.0 and lr > 0.0):
        return np.nan, np.nan
    return np.sqrt(ll / rr), lr / np.sqrt(ll * rr)


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    left: Floats,
    right: Floats,
    weight: Floats,
    mean_left: float,
    mean_right: float,
    gain: float,
    moves: Floats,
    normal: Floats,
    rhs: Floats,
    middle: Floats,
) -> float:
    """Fill ``normal`` [m, m] and ``rhs`` [m] of m unknowns; returns the sum of squared misfits.

    ``moves`` [n, 2, m]: by how much each unknown moves each pixel along columns and rows of the
    right window. ``middle`` [m] is filled by the sums of the design, for :func:`centre`.
    """
    unknowns = rhs.size
    design = np.empty(unknowns)
    normal[:], rhs[:], middle[:] = 0.0, 0.0, 0.0
    misfit = 0.0
    for k in range(weight.size):
        w = weight[k]
        along = 0.5 * (left[k, 1] + gain * right[k, 1])
        down = 0.5 * (left[k, 2] + gain * right[k, 2])
        miss = left[k, 0] - mean_left - gain * (right[k, 0] - mean_right)
        misfit += w * miss * miss
        for m in range(unknowns):
            design[m] = along * moves[k, 0, m] + down * moves[k, 1, m]
        for m in range(unknowns):
            middle[m] += w * design[m]
            rhs[m] += w * design[m] * miss
            for n in range(unknowns):
                normal[m, n] += w * design[m] * design[n]
    return misfit


@njit(cache=True, nogil=True, error_model="numpy")
def centre(normal: Floats, middle: Floats, total: float) -> None:
    """Take the means of the design out of ``normal``, as those of the windows are."""
    for m in range(middle.size):
        for n in range(middle.size):
            normal[m, n] -= middle[m] * middle[n] / total


@njit(cache=True, nogil=True, error_model="numpy")
def solve_two(normal: Floats, rhs: Floats) -> tuple[float, float, float]:
    """Both unknowns, and the determinant; NaN where the window does not tell them apart."""
    det = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[0, 1]
    if not det > 0.0:
        return np.nan, np.nan, np.nan
    first = (normal[1, 1] * rhs[0] - normal[0, 1] * rhs[1]) / det
    return first, (normal[0, 0] * rhs[1] - normal[0, 1] * rhs[0]) / det, det


@njit(cache=True, nogil=True, error_model="numpy")
def solve(normal: Floats, rhs: Floats) -> bool:
    """Any number of unknowns, in place: they come in ``rhs``, the inverse in ``normal``.

    False where the matrix is not positive definite. Two unknowns by :func:`solve_two` differ in
    the last bits.
    """
    n = rhs.size
    for k in range(n):
        pivot = normal[k, k]
        if not pivot > 1e-12:
            return False
        normal[k, k] = 1.0
        for j in range(n):
            normal[k, j] /= pivot
        rhs[k] /= pivot
        for i in range(n):
            if i != k:
                factor = normal[i, k]
                normal[i, k] = 0.0
                for j in range(n):
                    normal[i, j] -= factor * normal[k, j]
                rhs[i] -= factor * rhs[k]
    return True
