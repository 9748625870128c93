"""Least-squares matching of one window to sub-pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..epipolar.resampling import RADIUS, sample, tap_weights
from ..kernels import inner, kernel
from .window_fit import gain_and_correlation, shift, weighted_mean

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]


HALF = 10  # px: windows of 21 x 21
ITERATIONS = 12
CONVERGED = 0.003  # px


@kernel
def warp_patch(
    source: Picture, col: float, row: float, carry: Floats, scale: tuple[float, float], out: Picture
) -> None:
    """Fill ``out`` [odd, odd] by the source at (col, row) + carry · (offset from the middle)."""
    across = np.empty(2 * int(np.ceil(RADIUS * scale[0])))
    down = np.empty(2 * int(np.ceil(RADIUS * scale[1])))
    half_rows, half_cols = out.shape[0] // 2, out.shape[1] // 2
    for j in range(out.shape[0]):
        v = j - half_rows
        for i in range(out.shape[1]):
            u = i - half_cols
            c = col + carry[0, 0] * u + carry[0, 1] * v
            r = row + carry[1, 0] * u + carry[1, 1] * v
            first_col = int(np.floor(c)) + 1 - across.size // 2
            first_row = int(np.floor(r)) + 1 - down.size // 2
            tap_weights(c, first_col, scale[0], across)
            tap_weights(r, first_row, scale[1], down)
            out[j, i] = sample(source, first_row, first_col, down, across)


@inner
def _inner(picture: Picture, window: Floats) -> None:
    """Fill a window [n, 3] by the values and slopes of a picture inside its margin of one px."""
    k = 0
    for j in range(1, picture.shape[0] - 1):
        for i in range(1, picture.shape[1] - 1):
            window[k, 0] = picture[j, i]
            window[k, 1] = 0.5 * (picture[j, i + 1] - picture[j, i - 1])
            window[k, 2] = 0.5 * (picture[j + 1, i] - picture[j - 1, i])
            k += 1


@kernel
def least_squares_match(
    template: Picture,
    source: Picture,
    col: float,
    row: float,
    carry: Floats,
    scale: tuple[float, float],
    start: Floats,
    result: Floats,
) -> None:
    """Fill ``result`` with the shift (x, y) in template px, its sigma, and the correlation.

    ``template`` has a margin of one px for the slopes. Unknowns are the shift, gain and offset;
    the slopes are the mean of both windows', so that noise does not draw the shift. NaN where the
    match leaves the picture or does not converge.
    """
    count = (template.shape[0] - 2) ** 2
    warped = np.empty(template.shape, np.float32)
    left, right, weight = np.empty((count, 3)), np.empty((count, 3)), np.ones(count)
    result[:] = np.nan
    _inner(template, left)
    mean_left = weighted_mean(left, weight)
    x, y = start[0], start[1]
    for _ in range(ITERATIONS):
        c = col + carry[0, 0] * x + carry[0, 1] * y
        r = row + carry[1, 0] * x + carry[1, 1] * y
        warp_patch(source, c, r, carry, scale, warped)
        _inner(warped, right)
        mean_right = weighted_mean(right, weight)
        gain, correlation = gain_and_correlation(left, right, weight, mean_left, mean_right)
        if np.isnan(gain):
            return
        dx, dy, sigma = shift(left, right, weight, mean_left, mean_right, gain, False)
        if np.isnan(dx):
            return
        x += dx
        y += dy
        if abs(x - start[0]) > 2.0 or abs(y - start[1]) > 2.0:
            return
        if max(abs(dx), abs(dy)) < CONVERGED:
            result[0], result[1] = x, y
            result[2] = sigma
            result[3] = correlation
            return
