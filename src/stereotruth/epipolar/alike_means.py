"""Means over the pixels of one surface that are as bright as the centre, in either image.

What has changed ends where a roof or a shadow of either image does. Means over such pixels end
there, too, where those over a square take in both sides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import kernel
from .alike_correlation import alike_of_row, is_alike
from .surface_correlation import (
    BLOCK,
    Singles,
    Steps,
    columns_inside,
    is_near,
    surface_of_row,
    tolerance_px,
)

AS_BRIGHT = 0.2  # share of the centre's brightness by which that of a pixel may differ


@kernel
def _alike_mean(
    values: Singles,
    counted: Singles,
    level: Singles,
    level_warped: Singles,
    disparity: Singles,
    slope: Singles,
    around: tuple[int, int],
    noise: tuple[float, float],
    runs: Steps,
    out: Singles,
) -> None:
    """``counted``: disparity of the pixels that count, else NaN; ``level``, ``level_warped``:
    brightness of both images, by their ``noise``; ``around``: reach, and of how many one counts.
    ``runs`` of wanted pixels, outside of which all is NaN."""
    reach, every = around
    rows, cols = disparity.shape
    out[:] = np.nan
    surface = np.empty(3 * BLOCK, np.float32)
    bright = np.empty(4 * BLOCK, np.float32)
    sums = np.empty(2 * BLOCK, np.float32)
    zero, share = np.float32(0.0), np.float32(AS_BRIGHT)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        surface_of_row(disparity, slope, y, x0, size, surface)
        alike_of_row(level, level_warped, share, noise, y, x0, size, bright)
        sums[:] = zero
        for step_down in range(-reach, reach + 1, every):
            b = y + step_down
            if b < 0 or b >= rows:
                continue
            down = np.float32(step_down)
            for step in range(-reach, reach + 1, every):
                across, tolerance = np.float32(step), tolerance_px(step_down, step)
                first, end = columns_inside(x0, size, cols, step)
                d, value, ll, ww = (
                    counted[b, x0 + step + first : x0 + step + end],
                    values[b, x0 + step + first : x0 + step + end],
                    level[b, x0 + step + first : x0 + step + end],
                    level_warped[b, x0 + step + first : x0 + step + end],
                )
                p, q, s = surface[first:], bright[first:], sums[first:]
                for k in range(d.size):
                    plane = p[k] + across * p[BLOCK + k] + down * p[2 * BLOCK + k]
                    same = is_near(d[k], plane, tolerance) * is_alike(ll[k], ww[k], q, k)
                    s[k] += same
                    s[BLOCK + k] += same * value[k]
        for k in range(size):
            out[y, x0 + k] = sums[BLOCK + k] / sums[k]


def alike_mean(
    values: NDArray[np.floating],
    brightness: tuple[Singles, Singles],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    reach: int,
    every: int,
    noise: tuple[float, float],
    runs: Steps,
) -> Singles:
    """Mean of ``values`` [h, w] over the pixels that are alike; NaN where there are none.

    These lie up to ``reach`` px around, one of so many (``every``) along each axis, on the surface
    of the pixel, by ``disparity`` (px) and its ``slope`` [2, h, w], have a value, and are as bright
    as it in both images, by the ``brightness`` [h, w] of these (:func:`.brightness_of_pair`),
    within the share AS_BRIGHT or NOISY standard deviations of the ``noise`` (variances). Of the
    pixels of ``runs`` (:func:`.wanted_runs`) alone.
    """
    has_value = np.isfinite(values)
    single = [
        np.ascontiguousarray(array, dtype=np.float32)
        for array in (
            np.where(has_value, values, 0.0), np.where(has_value, disparity, np.nan),
            *brightness, disparity, slope,
        )
    ]  # fmt: skip
    out = np.empty(disparity.shape, np.float32)
    _alike_mean(*single, (reach, every), noise, runs, out)
    return out
