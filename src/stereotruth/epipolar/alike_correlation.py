"""Correlation of two images over the pixels that are alike: of one surface, and as bright as the
centre in either image.

A window that holds a shadow's edge, or a roof of one image beside ground that both show, mixes what
agrees with what does not. Pixels as bright as the centre in both images lie on one side of such
edges, so that windows of them reach up to the edge: adaptive support (Yoon and Kweon 2006), with
the brightness of both images in place of one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from .surface_correlation import (
    BLOCK,
    DECIDED,
    Singles,
    Steps,
    about_means,
    columns_inside,
    is_near,
    surface_of_row,
    tolerance_px,
)

ALIKE = 0.1  # share of the centre's brightness by which that of a pixel may differ
# Standard deviations of the noise: two means of 3 x 3 px differ by 0.5 (of white noise) to 0.9 (of
# noise whose neighbours correlate by 0.4).
NOISY = 1.5
LEAST_PIXELS = 12  # fewer correlate by chance


def brightness(image: NDArray[np.floating]) -> Singles:
    """Mean of the pixels up to 1 px around each one of an image [h, w] that have a value, NaN where
    it has none itself.

    Added in one order, whatever part of an image is given.
    """
    rows, cols = image.shape
    has_value = np.isfinite(image)
    values = np.pad(np.where(has_value, image, 0.0).astype(np.float32), 1)
    counted = np.pad(has_value.astype(np.float32), 1)
    total, count = np.zeros((2, rows, cols), np.float32)
    for down in range(3):
        for across in range(3):
            total += values[down : down + rows, across : across + cols]
            count += counted[down : down + rows, across : across + cols]
    return np.where(has_value, total / np.maximum(count, np.float32(1.0)), np.float32(np.nan))


def brightness_of_pair(
    left: NDArray[np.floating], warped: NDArray[np.floating]
) -> tuple[Singles, Singles]:
    """:func:`brightness` of both images [h, w]; ``left`` is 0 and ``warped`` NaN where an image has
    no value."""
    return brightness(np.where(left != 0.0, left, np.nan)), brightness(warped)


@inner
def alike_of_row(
    level: Singles,
    level_warped: Singles,
    share: float,
    noise: tuple[float, float],
    y: int,
    x0: int,
    size: int,
    c: Singles,
) -> None:
    """``c`` [4 * BLOCK]: brightness of both images of ``size`` pixels of a row, and by how much
    that of a pixel may differ to be alike, see :func:`is_alike`: by the ``share`` of each, or by
    NOISY standard deviations of the ``noise`` (variances)."""
    least = np.float32(NOISY * np.sqrt(noise[0]))
    least_warped = np.float32(NOISY * np.sqrt(noise[1]))
    for k in range(size):
        c[k], c[BLOCK + k] = level[y, x0 + k], level_warped[y, x0 + k]
        c[2 * BLOCK + k] = max(share * level[y, x0 + k], least)
        c[3 * BLOCK + k] = max(share * level_warped[y, x0 + k], least_warped)


@inner
def is_alike(level: float, level_warped: float, c: Singles, k: int) -> float:
    """1 of a pixel as bright in both images as pixel ``k`` of :func:`alike_of_row`, else 0."""
    one, zero = np.float32(1.0), np.float32(0.0)
    same = one if abs(level - c[k]) <= c[2 * BLOCK + k] else zero
    return same * (one if abs(level_warped - c[BLOCK + k]) <= c[3 * BLOCK + k] else zero)


@kernel
def _alike_correlation(
    left: Singles,
    warped: Singles,
    level: Singles,
    level_warped: Singles,
    disparity: Singles,
    slope: Singles,
    reach: int,
    noise: tuple[float, float],
    runs: Steps,
    out: Singles,
) -> None:
    """``level``, ``level_warped``: brightness of both images; the latter is NaN where a pixel does
    not count. ``runs`` of wanted pixels, outside of which all is NaN."""
    rows, cols = left.shape
    out[:] = np.nan
    surface = np.empty(3 * BLOCK, np.float32)
    bright, centre = np.empty(4 * BLOCK, np.float32), np.empty(2 * BLOCK, np.float32)
    sums = np.empty(6 * BLOCK, np.float32)
    one, zero, share = np.float32(1.0), np.float32(0.0), np.float32(ALIKE)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        surface_of_row(disparity, slope, y, x0, size, surface)
        alike_of_row(level, level_warped, share, noise, y, x0, size, bright)
        for k in range(size):
            centre[k], centre[BLOCK + k] = left[y, x0 + k], warped[y, x0 + k]
        sums[:] = zero
        for b in range(max(y - reach, 0), min(y + reach + 1, rows)):
            down = np.float32(b - y)
            for step in range(-reach, reach + 1):
                across, tolerance = np.float32(step), tolerance_px(b - y, step)
                first, end = columns_inside(x0, size, cols, step)
                d, uu, vv, ll, ww = (
                    disparity[b, x0 + step + first : x0 + step + end],
                    left[b, x0 + step + first : x0 + step + end],
                    warped[b, x0 + step + first : x0 + step + end],
                    level[b, x0 + step + first : x0 + step + end],
                    level_warped[b, x0 + step + first : x0 + step + end],
                )
                p, q, c, s = surface[first:], bright[first:], centre[first:], sums[first:]
                for k in range(d.size):
                    plane = p[k] + across * p[BLOCK + k] + down * p[2 * BLOCK + k]
                    same = is_near(d[k], plane, tolerance) * is_alike(ll[k], ww[k], q, k)
                    u = (uu[k] - c[k]) * same
                    v = (vv[k] - c[BLOCK + k]) * same
                    s[k] += same
                    s[BLOCK + k] += u
                    s[2 * BLOCK + k] += v
                    s[3 * BLOCK + k] += u * u
                    s[4 * BLOCK + k] += v * v
                    s[5 * BLOCK + k] += u * v
        for k in range(size):
            n = sums[k]
            if n < LEAST_PIXELS:
                continue
            suu, svv, suv = about_means(sums, k)
            here, there = noise[0] * (n - one), noise[1] * (n - one)
            signal = max(suu - here, zero) * max(svv - there, zero)
            if signal <= zero:
                continue
            expected = np.sqrt(signal / (suu * svv))
            if expected * np.sqrt(n) >= DECIDED:
                out[y, x0 + k] = min(suv / np.sqrt(signal), one)


def alike_correlation(
    left: NDArray[np.floating],
    warped: NDArray[np.floating],
    brightness: tuple[Singles, Singles],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    reach: int,
    noise: tuple[float, float],
    runs: Steps,
) -> Singles:
    """Correlation of two images [h, w] over the pixels up to ``reach`` px around that are alike.

    These lie on the surface of the pixel, by ``disparity`` (px) and its ``slope`` [2, h, w], and
    are as bright as it in both images, by their ``brightness`` (:func:`brightness_of_pair`), within
    the share ALIKE or by NOISY standard deviations of the noise. ``left`` is 0 and
    ``warped`` NaN where an image has no value. The coefficient is as it would be without ``noise``
    (variances of both images), 1 at most. NaN with fewer than LEAST_PIXELS, and where noise leaves
    so little that chance may do as well. Of the pixels of ``runs`` (:func:`.wanted_runs`) alone.
    """
    level, level_warped = brightness
    known = np.isfinite(level_warped) & np.isfinite(disparity) & (left != 0.0)
    level_warped = np.where(known, level_warped, np.float32(np.nan))
    single = [
        np.ascontiguousarray(values, dtype=np.float32)
        for values in (left, np.where(known, warped, 0.0))
    ]
    out = np.empty(left.shape, np.float32)
    surface = (np.ascontiguousarray(values, dtype=np.float32) for values in (disparity, slope))
    _alike_correlation(*single, level, level_warped, *surface, reach, noise, runs, out)
    return out
