"""Compiled least-squares matches of windows of two cubic B-splines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...alignment.window_fit import (
    gain_and_correlation,
    mean_slopes,
    misfit,
    shift,
    weighted_mean,
)
from ...kernels import inner, kernel
from ...numerics.b_spline import cubic_slopes, cubic_weights

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]


ITERATIONS = 15
CONVERGED = 0.002  # px
MOVE_PX = 1.5  # that a match may move from where SIFT has it
STEEPEST = 0.6  # px of disparity per px
LABELLED = 0.6  # of a window, by weight, where labels are held against a match
LABEL_MOVE_PX = 3.0  # by which that may move the match: a window's middle may stand out


@inner
def _sample(c: Picture, x: float, y: float, out: Floats, k: int) -> bool:
    """Fill ``out[k]`` by value and slopes of a spline; False next to its border and outside."""
    if not (x >= 2.0 and y >= 2.0 and x <= c.shape[1] - 4.0 and y <= c.shape[0] - 4.0):
        return False
    i, j = int(np.floor(x)), int(np.floor(y))
    across, across_slope = cubic_weights(x - i), cubic_slopes(x - i)
    weight, slope = cubic_weights(y - j), cubic_slopes(y - j)
    value, along, down = 0.0, 0.0, 0.0
    for b in range(4):
        v, s = 0.0, 0.0
        for a in range(4):
            p = c[j - 1 + b, i - 1 + a]
            v += across[a] * p
            s += across_slope[a] * p
        value += weight[b] * v
        along += weight[b] * s
        down += slope[b] * v
    out[k, 0], out[k, 1], out[k, 2] = value, along, down
    return True


@inner
def _solve(a: Floats, b: Floats) -> bool:
    """Solve a @ p = b, positive definite, in place: p in ``b``, the inverse in ``a``."""
    n = b.size
    for k in range(n):
        pivot = a[k, k]
        if not pivot > 1e-12:
            return False
        a[k, k] = 1.0
        for j in range(n):
            a[k, j] /= pivot
        b[k] /= pivot
        for i in range(n):
            if i != k:
                factor = a[i, k]
                a[i, k] = 0.0
                for j in range(n):
                    a[i, j] -= factor * a[k, j]
                b[i] -= factor * b[k]
    return True


@inner
def _match(
    left: Picture, right: Picture, weight: Floats, x0: int, y0: int, d: float, p: float, out: Floats
) -> None:
    """Fill ``out`` [6] by disparity, its slopes, parallax, sigma and correlation, or NaN.

    ``left``, ``right``: splines; starts from disparity ``d`` and parallax ``p``.
    """
    side = weight.shape[0]
    half, n = side // 2, side * side
    out[:] = np.nan
    a, b, weights = np.empty((n, 3)), np.empty((n, 3)), weight.reshape(-1)
    u, v = np.empty(n), np.empty(n)  # from the middle pixel
    total = 0.0
    for k in range(n):
        u[k], v[k] = k % side - half, k // side - half
        if not _sample(left, x0 + u[k], y0 + v[k], a, k):
            return
        total += weights[k]
    mean_a = weighted_mean(a, weights)
    at = np.array([d, 0.0, 0.0, p])
    design, middle = np.empty(4), np.empty(4)
    for _ in range(ITERATIONS):
        for k in range(n):
            x = x0 + u[k] - (at[0] + at[1] * u[k] + at[2] * v[k])
            if not _sample(right, x, y0 + v[k] + at[3], b, k):
                return
        mean_b = weighted_mean(b, weights)
        gain, correlation = gain_and_correlation(a, b, weights, mean_a, mean_b)
        if np.isnan(gain):
            return
        normal, rhs = np.zeros((4, 4)), np.zeros(4)
        middle[:] = 0.0
        squared = 0.0
        for k in range(n):
            w = weights[k]
            gx, gy = mean_slopes(a, b, gain, k)
            design[0], design[3] = -gx, gy
            design[1], design[2] = -gx * u[k], -gx * v[k]
            miss = misfit(a, b, mean_a, mean_b, gain, k)
            squared += w * miss * miss
            for m in range(4):
                middle[m] += w * design[m]
                rhs[m] += w * design[m] * miss
                for q in range(4):
                    normal[m, q] += w * design[m] * design[q]
        for m in range(4):  # the means of the windows are taken out: so are those of the design
            for q in range(4):
                normal[m, q] -= middle[m] * middle[q] / total
        if not _solve(normal, rhs):
            return
        at += rhs
        if abs(at[0] - d) > MOVE_PX or abs(at[3] - p) > MOVE_PX:
            return
        if max(abs(at[1]), abs(at[2])) > STEEPEST:
            return
        if max(abs(rhs[0]), abs(rhs[3])) < CONVERGED:
            out[:4] = at
            out[4] = np.sqrt(squared / (total - 4.0) * normal[0, 0])
            out[5] = correlation
            return


@kernel
def match_all(left: Picture, right: Picture, weight: Floats, start: Floats, out: Floats) -> None:
    """:func:`_match` from each ``start`` [n, 4]: x, y, disparity, parallax; ``out`` is [n, 6]."""
    for k in range(start.shape[0]):
        x0, y0 = int(start[k, 0]), int(start[k, 1])
        _match(left, right, weight, x0, y0, start[k, 2], start[k, 3], out[k])


@inner
def _offset(
    left: Picture,
    right: Picture,
    labels: Picture,
    weight: Floats,
    x0: int,
    y0: int,
    d: float,
    p: float,
    out: Floats,
) -> None:
    """Fill ``out`` [2] by label less disparity and correlation, or NaN; starts as :func:`_match`.

    Unknowns are one offset of all labels of the window, and the parallax.
    """
    half = weight.shape[0] // 2
    out[:] = np.nan
    rows, cols = left.shape
    if x0 - half < 2 or y0 - half < 2 or x0 + half > cols - 4 or y0 + half > rows - 4:
        return
    if np.isnan(labels[y0, x0]):
        return
    place, a, b = np.empty((weight.size, 2)), np.empty((weight.size, 3)), np.empty((weight.size, 3))
    some = np.empty(weight.size)
    n, total, whole = 0, 0.0, 0.0
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            x, y = x0 + i - half, y0 + j - half
            whole += weight[j, i]
            if np.isnan(labels[y, x]):
                continue
            place[n, 0], place[n, 1] = x - labels[y, x], y
            _sample(left, float(x), float(y), a, n)
            some[n] = weight[j, i]
            total += weight[j, i]
            n += 1
    if total < LABELLED * whole:
        return
    weights = some[:n]
    mean_a = weighted_mean(a, weights)
    first = labels[y0, x0] - d
    offset, parallax = first, p
    for _ in range(ITERATIONS):
        for k in range(n):
            if not _sample(right, place[k, 0] + offset, place[k, 1] + parallax, b, k):
                return
        mean_b = weighted_mean(b, weights)
        gain, correlation = gain_and_correlation(a, b, weights, mean_a, mean_b)
        if np.isnan(gain):
            return
        along, down, _ = shift(a, b, weights, mean_a, mean_b, gain, True)
        if np.isnan(along):
            return
        offset += along
        parallax += down
        if abs(offset - first) > LABEL_MOVE_PX or abs(parallax - p) > MOVE_PX:
            return
        if max(abs(along), abs(down)) < CONVERGED:
            out[0], out[1] = offset, correlation
            return


@kernel
def offset_all(
    left: Picture, right: Picture, labels: Picture, weight: Floats, start: Floats, out: Floats
) -> None:
    """:func:`_offset` from each ``start`` [n, 4]: x, y, disparity, parallax; ``out`` is [n, 2]."""
    for k in range(start.shape[0]):
        x0, y0 = int(start[k, 0]), int(start[k, 1])
        _offset(left, right, labels, weight, x0, y0, start[k, 2], start[k, 3], out[k])
