"""A step of least-squares matching (Gruen 1985), for windows of any kind.

A window is a list of n pixels [n, 3]: grey value, and its slopes along columns and rows in px.
Grey values of two windows differ by a gain and an offset, which are taken out, and by where the
pixels lie. The slopes are the mean of both windows', so that noise draws nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import inlined, inner

Floats = NDArray[np.float64]


@inner
def weighted_mean(window: Floats, weight: Floats) -> float:
    """Mean grey value of a window."""
    mean, total = 0.0, 0.0
    for k in range(weight.size):
        mean += weight[k] * window[k, 0]
        total += weight[k]
    return mean / total


@inner
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


@inlined
def mean_slopes(left: Floats, right: Floats, gain: float, k: int) -> tuple[float, float]:
    """Slopes of grey values along columns and rows at a pixel, of both windows."""
    return 0.5 * (left[k, 1] + gain * right[k, 1]), 0.5 * (left[k, 2] + gain * right[k, 2])


@inlined
def misfit(
    left: Floats, right: Floats, mean_left: float, mean_right: float, gain: float, k: int
) -> float:
    """By how much a pixel of the left window is brighter than that of the right one."""
    return left[k, 0] - mean_left - gain * (right[k, 0] - mean_right)


@inner
def shift(
    left: Floats,
    right: Floats,
    weight: Floats,
    mean_left: float,
    mean_right: float,
    gain: float,
    centred: bool,
) -> tuple[float, float, float]:
    """By how much the right window must move along (columns, rows) to look like the left one.

    Also the sigma of the worse of both, by the misfits; NaN where the window does not tell.
    ``centred``: the means of the slopes are taken out, as those of the grey values are.
    """
    total, squared = 0.0, 0.0
    sx, sy, xx, xy, yy, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        w = weight[k]
        gx, gy = mean_slopes(left, right, gain, k)
        miss = misfit(left, right, mean_left, mean_right, gain, k)
        total += w
        sx += w * gx
        sy += w * gy
        xx += w * gx * gx
        xy += w * gx * gy
        yy += w * gy * gy
        bx += w * gx * miss
        by += w * gy * miss
        squared += w * miss * miss
    if centred:
        xx, xy, yy = xx - sx * sx / total, xy - sx * sy / total, yy - sy * sy / total
    det = xx * yy - xy * xy
    if not det > 0.0:
        return np.nan, np.nan, np.nan
    sigma = np.sqrt(squared / (total - 4.0) * max(xx, yy) / det)
    return (yy * bx - xy * by) / det, (xx * by - xy * bx) / det, sigma
