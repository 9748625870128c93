"""Least-squares matching of one window to sub-pixel."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..epipolar.resampling import RADIUS, sample, tap_weights

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]


HALF = 10  # px: windows of 21 x 21
ITERATIONS = 12
CONVERGED = 0.003  # px


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
    n = template.shape[0] - 2
    x, y = start[0], start[1]
    window = np.empty(template.shape, np.float32)
    result[:] = np.nan
    count = n * n
    mean_left = 0.0
    for j in range(1, n + 1):
        for i in range(1, n + 1):
            mean_left += template[j, i]
    mean_left /= count
    for _ in range(ITERATIONS):
        c = col + carry[0, 0] * x + carry[0, 1] * y
        r = row + carry[1, 0] * x + carry[1, 1] * y
        warp_patch(source, c, r, carry, scale, window)
        mean_right = 0.0
        for j in range(1, n + 1):
            for i in range(1, n + 1):
                mean_right += window[j, i]
        mean_right /= count
        if np.isnan(mean_right):
            return
        ll, lr, rr = 0.0, 0.0, 0.0
        for j in range(1, n + 1):
            for i in range(1, n + 1):
                a, b = template[j, i] - mean_left, window[j, i] - mean_right
                ll += a * a
                lr += a * b
                rr += b * b
        if ll <= 0.0 or rr <= 0.0 or lr <= 0.0:
            return
        gain = np.sqrt(ll / rr)
        xx, xy, yy, bx, by, misfit = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(1, n + 1):
            for i in range(1, n + 1):
                miss = template[j, i] - mean_left - gain * (window[j, i] - mean_right)
                gx = 0.25 * (
                    template[j, i + 1]
                    - template[j, i - 1]
                    + gain * (window[j, i + 1] - window[j, i - 1])
                )
                gy = 0.25 * (
                    template[j + 1, i]
                    - template[j - 1, i]
                    + gain * (window[j + 1, i] - window[j - 1, i])
                )
                xx += gx * gx
                xy += gx * gy
                yy += gy * gy
                bx += gx * miss
                by += gy * miss
                misfit += miss * miss
        det = xx * yy - xy * xy
        if not det > 0.0:
            return
        dx, dy = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
        x += dx
        y += dy
        if abs(x - start[0]) > 2.0 or abs(y - start[1]) > 2.0:
            return
        if max(abs(dx), abs(dy)) < CONVERGED:
            result[0], result[1] = x, y
            result[2] = np.sqrt(misfit / (count - 4) * max(xx, yy) / det)
            result[3] = lr / np.sqrt(ll * rr)
            return
