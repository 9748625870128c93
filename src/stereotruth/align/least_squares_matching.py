"""Least-squares matching of one window to sub-pixel (Gruen 1985).

A window is a list of n pixels [n, 3]: grey value, and its slopes along columns and rows in px.
Grey values of two windows differ by a gain and an offset, which are taken out, and by where the
pixels lie. The slopes are the mean of both windows', so that noise draws nothing.
"""

from __future__ import annotations

import numpy as np

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Floats, Singles
from ..core.numerics.interpolation import SIX_POINT_RADIUS, six_point_weights
from ..core.numerics.statistics import TUKEY, biweight, robust_sigma
from ..epipolar.resampling import sample

ITERATIONS = 20
CONVERGED = 0.003  # px
PARTS = 3  # along each side of a window, whose shifts are compared


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
def _shift(
    left: Floats,
    right: Floats,
    weight: Floats,
    mean_left: float,
    mean_right: float,
    gain: float,
) -> tuple[float, float, float]:
    """By how much the right window must move along (columns, rows) to look like the left one.

    Also the sigma of the worse of both, by the misfits; NaN where the window does not tell.
    """
    total, squared = 0.0, 0.0
    xx, xy, yy, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        w = weight[k]
        gx, gy = mean_slopes(left, right, gain, k)
        miss = misfit(left, right, mean_left, mean_right, gain, k)
        total += w
        xx += w * gx * gx
        xy += w * gx * gy
        yy += w * gy * gy
        bx += w * gx * miss
        by += w * gy * miss
        squared += w * miss * miss
    det = xx * yy - xy * xy
    if not det > 0.0:
        return np.nan, np.nan, np.nan
    sigma = np.sqrt(squared / (total - 4.0) * max(xx, yy) / det)
    return (yy * bx - xy * by) / det, (xx * by - xy * bx) / det, sigma


@kernel
def warp_patch(
    source: Singles, col: float, row: float, carry: Floats, scale: tuple[float, float], out: Singles
) -> None:
    """Fill ``out`` [h, w] by the source at (col, row) + carry · (columns, rows from the pixel
    [h // 2, w // 2]), by cubic convolution."""
    across = np.empty(2 * int(np.ceil(SIX_POINT_RADIUS * scale[0])))
    down = np.empty(2 * int(np.ceil(SIX_POINT_RADIUS * scale[1])))
    half_rows, half_cols = out.shape[0] // 2, out.shape[1] // 2
    for j in range(out.shape[0]):
        v = j - half_rows
        for i in range(out.shape[1]):
            u = i - half_cols
            c = col + carry[0, 0] * u + carry[0, 1] * v
            r = row + carry[1, 0] * u + carry[1, 1] * v
            first_col = int(np.floor(c)) + 1 - across.size // 2
            first_row = int(np.floor(r)) + 1 - down.size // 2
            six_point_weights(c, first_col, scale[0], across)
            six_point_weights(r, first_row, scale[1], down)
            out[j, i] = sample(source, first_row, first_col, down, across)


@inner
def _inner(picture: Singles, window: Floats) -> None:
    """Fill a window [n, 3] by the values and slopes of a picture inside its margin of one px."""
    k = 0
    for j in range(1, picture.shape[0] - 1):
        for i in range(1, picture.shape[1] - 1):
            window[k, 0] = picture[j, i]
            window[k, 1] = 0.5 * (picture[j, i + 1] - picture[j, i - 1])
            window[k, 2] = 0.5 * (picture[j + 1, i] - picture[j - 1, i])
            k += 1


@inner
def _weigh(
    left: Floats,
    right: Floats,
    clear: Floats,
    means: tuple[float, float],
    gain: float,
    weight: Floats,
    scratch: Floats,
) -> float:
    """Fill ``weight`` [n] of the pixels; standard deviation of their misfits, robust.

    No pixel counts for more than its neighbours because it stands out: the weight falls with the
    slope of the grey values, and the pixel's information about the shift saturates where the slope
    is the median one. Pixels that do not fit (moved, shaded) lose theirs (Tukey's biweight).
    """
    n = 0
    for k in range(clear.size):
        if clear[k] > 0.0:
            gx, gy = mean_slopes(left, right, gain, k)
            scratch[n] = gx * gx + gy * gy
            n += 1
    median_slope2 = np.median(scratch[:n])
    n = 0
    for k in range(clear.size):
        if clear[k] > 0.0:
            gx, gy = mean_slopes(left, right, gain, k)
            weight[k] = median_slope2 / (median_slope2 + gx * gx + gy * gy)
            miss = misfit(left, right, means[0], means[1], gain, k)
            scratch[n] = abs(miss) * np.sqrt(weight[k])
            n += 1
    scale = robust_sigma(scratch[:n], 1e-6 * np.sqrt(median_slope2))
    n = 0
    for k in range(clear.size):
        if clear[k] > 0.0:
            weight[k] *= biweight(scratch[n] / (TUKEY * scale))
            n += 1
    return scale


@inner
def _discord(
    left: Floats,
    right: Floats,
    weight: Floats,
    means: tuple[float, float],
    gain: float,
    along: Floats,
) -> float:
    """Standard deviation px of the mean shift, by how much the parts of a window differ.

    Along the direction ``along`` [2] in which heights move a point, each of PARTS² parts has a
    shift of its own; their variance beyond what the misfits explain is that between studies of a
    meta-analysis (DerSimonian & Laird 1986).
    """
    side = int(np.sqrt(weight.size))
    information, gradient = np.zeros(PARTS * PARTS), np.zeros(PARTS * PARTS)
    squared, total = 0.0, 0.0
    for k in range(weight.size):
        part = (k // side) * PARTS // side * PARTS + (k % side) * PARTS // side
        gx, gy = mean_slopes(left, right, gain, k)
        slope = gx * along[0] + gy * along[1]
        miss = misfit(left, right, means[0], means[1], gain, k)
        information[part] += weight[k] * slope * slope
        gradient[part] += weight[k] * slope * miss
        squared += weight[k] * miss * miss
        total += weight[k]
    variance = squared / total  # of a misfit of unit weight
    whole, squares, scatter, parts = 0.0, 0.0, 0.0, 0
    for p in range(information.size):
        if information[p] > 0.0:
            whole += information[p]
            squares += information[p] ** 2
            scatter += gradient[p] ** 2 / information[p] / variance
            parts += 1
    if parts < 3 or not whole > squares / whole:
        return np.inf
    between = max(scatter - (parts - 1.0), 0.0) * variance / (whole - squares / whole)
    return np.sqrt(between * squares) / whole


@kernel
def least_squares_match(
    template: Singles,
    clear: Floats,
    source: Singles,
    col: float,
    row: float,
    carry: Floats,
    scale: tuple[float, float],
    along: Floats,
    start: Floats,
    result: Floats,
) -> None:
    """Fill ``result`` [5] with the match of a window: a robust least-squares match.

    Shift (x, y) in template px; its sigma by the misfits; the correlation; the sigma by how much
    the window's parts disagree along ``along`` [2]. ``template`` has a margin of one px for the
    slopes; ``clear`` [n] is 1 for the pixels that take part. Unknowns are the shift, gain and
    offset; the slopes are the mean of both windows', so that noise does not draw the shift. NaN
    where the match leaves the picture or does not converge.
    """
    count = (template.shape[0] - 2) ** 2
    warped = np.empty(template.shape, np.float32)
    left, right = np.empty((count, 3)), np.empty((count, 3))
    weight, scratch = clear.copy(), np.empty(count)
    result[:] = np.nan
    _inner(template, left)
    for k in range(count):
        if clear[k] == 0.0:  # whatever lies there, nodata too, takes no part
            left[k] = 0.0
    x, y = start[0], start[1]
    for _ in range(ITERATIONS):
        c = col + carry[0, 0] * x + carry[0, 1] * y
        r = row + carry[1, 0] * x + carry[1, 1] * y
        warp_patch(source, c, r, carry, scale, warped)
        _inner(warped, right)
        for k in range(count):
            if clear[k] == 0.0:
                right[k] = 0.0
        means = weighted_mean(left, weight), weighted_mean(right, weight)
        gain, correlation = gain_and_correlation(left, right, weight, means[0], means[1])
        if np.isnan(gain):
            return
        scatter = _weigh(left, right, clear, means, gain, weight, scratch)
        if np.isnan(scatter):
            return
        means = weighted_mean(left, weight), weighted_mean(right, weight)
        gain, correlation = gain_and_correlation(left, right, weight, means[0], means[1])
        if np.isnan(gain):
            return
        dx, dy, sigma = _shift(left, right, weight, means[0], means[1], gain)
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
            result[4] = _discord(left, right, weight, means, gain, along)
            return
