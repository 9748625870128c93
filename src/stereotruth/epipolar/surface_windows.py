"""Do two images agree over the pixels of one surface? Correlations, and means over such pixels.

Where heights step, a square window mixes surfaces and fails although the disparity is right. The
windows here (:mod:`.window_sums`) hold the pixels of one surface. Where such a window holds a
shadow's edge, or a roof of one image beside ground that both show, it still mixes what agrees with
what does not. Pixels as bright as the centre in both images lie on one side of such edges, so that
windows of those that are alike reach up to the edge: adaptive support (Yoon and Kweon 2006), with
the brightness of both images in place of one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from .window_sums import (
    ANY_BRIGHTNESS,
    SURFACE_PX,
    Bools,
    Floats,
    Image,
    Runs,
    Singles,
    correlate,
    correlate_shifted,
    members_of,
    padded,
    take_means,
    wanted_runs,
)

# Shares of the centre's brightness by which that of a pixel may differ: where images are
# correlated, and where means are taken.
ALIKE, AS_BRIGHT = 0.1, 0.2
# Standard deviations of the noise: two means of 3 x 3 px differ by 0.5 (of white noise) to 0.9 (of
# noise whose neighbours correlate by 0.4).
NOISY = 1.5
LEAST_ALIKE = 12  # fewer pixels that are alike correlate by chance
DECIDED = 2.0  # standard deviations of a chance correlation that an expected one must reach


@kernel
def apart_from_steps(disparity: Floats) -> Bools:
    """Pixels [h, w] whose eight neighbours all have a disparity within SURFACE_PX of theirs."""
    rows, cols = disparity.shape
    out = np.zeros(disparity.shape, np.bool_)
    for j in range(1, rows - 1):
        for i in range(1, cols - 1):
            apart = True
            for b in range(j - 1, j + 2):
                for a in range(i - 1, i + 2):
                    # also false for NaN
                    apart &= abs(disparity[b, a] - disparity[j, i]) <= SURFACE_PX
            out[j, i] = apart
    return out


def correlations(
    left: Image,
    warped: Image,
    disparity: Image,
    slope: Image,
    counts: Bools,
    window: int,
    runs: Runs,
) -> Singles:
    """Correlation [n, h, w] of an image with several that are ``warped`` [n, h, w] to it.

    Over the neighbours that ``counts`` [h, w] chooses, in which all have a value, in windows
    ``window`` (odd, px) wide. NaN beside ``runs`` and where fewer pixels belong to a window than it
    is wide: a few correlate by chance. 0 where either image is constant.
    """
    windows = disparity, slope, counts, window // 2
    out, _ = _correlations(left, warped, windows, ANY_BRIGHTNESS, window, runs)
    return out


def _correlations(
    left: Image,
    warped: Image,
    windows: tuple[Image, Image, Bools, int],
    bright: Singles,
    least: int,
    runs: Runs,
) -> tuple[Singles, Singles]:
    """Of :func:`.window_sums.correlate`; ``windows``: arguments of :func:`.window_sums.members_of`,
    ``bright`` [4, h, w]."""
    members = members_of(*windows)
    reach, count = members.reach, len(warped)
    out = np.empty((count + 4, *left.shape), np.float32)
    if len(bright):
        bright = padded(bright, np.nan, reach)
    (wide,), others = padded(left[None], 0.0, reach), padded(warped, 0.0, reach)
    correlate(members, bright, wide, others, least, runs, out[:count], out[count:])
    return out[:count], out[count:]


@kernel
def _expected(moments: Singles, noise: tuple[float, float], out: Singles) -> None:
    """Correlation [h, w] that images of the same ground have on the average, by ``moments`` [4, h,
    w] and the images' ``noise``; see :func:`correlation_and_expected`."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            count = moments[0, y, x]
            left, warped = noise[0] * (count - 1), noise[1] * (count - 1)
            signal = max(moments[1, y, x] * warped, moments[2, y, x] * left) - left * warped
            share = signal / (signal + left * warped) if signal > 0 else 0.0
            if left * warped == 0.0:
                share = 1.0
            decided = share * np.sqrt(count) >= DECIDED  # false for NaN
            out[y, x] = share if decided else np.nan


@kernel
def _without_noise(moments: Singles, noise: tuple[float, float], out: Singles) -> None:
    """Correlation [h, w] as it would be without the images' ``noise``, 1 at most, by the
    ``moments`` of :func:`.window_sums.correlate`; NaN where chance may do as well."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            count, left, warped = moments[0, y, x], moments[1, y, x], moments[2, y, x]
            signal = max(left - noise[0] * (count - 1), 0.0)
            signal *= max(warped - noise[1] * (count - 1), 0.0)
            expected = np.sqrt(signal / (left * warped))
            decided = signal > 0.0 and expected * np.sqrt(count) >= DECIDED  # false for NaN
            out[y, x] = min(moments[3, y, x] / np.sqrt(signal), 1.0) if decided else np.nan


def correlation_and_expected(
    left: Image,
    warped: Image,
    disparity: Image,
    slope: Image,
    window: int,
    noise: tuple[float, float],
    clear: Bools | None = None,
    runs: Runs | None = None,
) -> tuple[Singles, Singles]:
    """:func:`surface_correlation`, and the one that images of the same ground have on the average.

    The latter [h, w] is in (0, 1], by the variances of the images' ``noise`` (DN²) and of the
    window in the image that varies more: the attenuation of a correlation by errors of measurement
    (Spearman 1904). NaN also where noise leaves so little of it that chance may do as well.
    """
    known = np.isfinite(warped)
    centres = np.where(known, disparity, np.nan)
    counts = known if clear is None else known & clear
    if runs is None:
        runs = wanted_runs(np.isfinite(centres))
    windows = centres, slope, counts, window // 2
    (out,), moments = _correlations(left, warped[None], windows, ANY_BRIGHTNESS, window, runs)
    expected = np.empty(left.shape, np.float32)
    _expected(moments, noise, expected)
    return out, expected


def surface_correlation(
    left: Image,
    warped: Image,
    disparity: Image,
    slope: Image,
    window: int,
    clear: Bools | None = None,
    runs: Runs | None = None,
) -> Singles:
    """Correlation of two images [h, w] over the pixels of each pixel's surface in its window.

    Of these, the ``clear`` [h, w] ones alone where that is given; of the pixels of ``runs``
    (:func:`.window_sums.wanted_runs`) alone where these are.

    ``warped`` is NaN and ``disparity`` (px), with its ``slope`` [2, h, w] along x and y, anything
    where there is no label. NaN where there is no label or fewer pixels than the ``window`` (odd,
    px) is wide; 0 where either image is constant.
    """
    none = 0.0, 0.0
    return correlation_and_expected(left, warped, disparity, slope, window, none, clear, runs)[0]


def brightness(image: Image) -> Singles:
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


def brightness_of_pair(left: Image, warped: Image) -> tuple[Singles, Singles]:
    """:func:`brightness` of both images [h, w]; ``left`` is 0 and ``warped`` NaN where an image has
    no value."""
    return brightness(np.where(left != 0.0, left, np.nan)), brightness(warped)


def _bright(
    brightness: tuple[Singles, Singles], share: float, noise: tuple[float, float]
) -> Singles:
    """Brightness of both images and by how much it may differ, [4, h, w]: by the ``share`` of the
    centre's, or by NOISY standard deviations of the ``noise`` (variances)."""
    limits = [
        np.maximum(np.float32(share) * level, np.float32(NOISY * np.sqrt(variance)))
        for level, variance in zip(brightness, noise)
    ]
    return np.stack([*brightness, *limits])


def alike_correlation(
    left: Image,
    warped: Image,
    brightness: tuple[Singles, Singles],
    disparity: Image,
    slope: Image,
    reach: int,
    noise: tuple[float, float],
    runs: Runs,
) -> Singles:
    """Correlation of two images [h, w] over the pixels up to ``reach`` px around that are alike.

    These lie on the surface of the pixel, by ``disparity`` (px) and its ``slope`` [2, h, w], and
    are as bright as it in both images, by their ``brightness`` (:func:`brightness_of_pair`), within
    the share ALIKE or by NOISY standard deviations of the noise. ``left`` is 0 and ``warped`` NaN
    where an image has no value. The coefficient is as it would be without ``noise`` (variances of
    both images), 1 at most. NaN with fewer than LEAST_ALIKE, and where noise leaves so little that
    chance may do as well. Of the pixels of ``runs`` (:func:`.window_sums.wanted_runs`) alone.
    """
    known = np.isfinite(brightness[1]) & np.isfinite(disparity) & (left != 0.0)
    bright = _bright(brightness, ALIKE, noise)
    bright[1, ~known] = np.nan
    windows = disparity, slope, known, reach
    _, moments = _correlations(left, warped[None], windows, bright, LEAST_ALIKE, runs)
    out = np.empty(left.shape, np.float32)
    _without_noise(moments, noise, out)
    return out


def _surface_means(
    values: Image,
    surface: tuple[Image, Image],
    steps: tuple[int, int, int],
    bright: Singles,
    runs: Runs,
) -> Singles:
    """Of :func:`.window_sums.take_means`; ``steps``: reach, every and first row of its members,
    ``bright`` [4, h, w]."""
    out = np.empty(values.shape, np.float32)
    members = members_of(*surface, np.isfinite(values[0]), *steps)
    if len(bright):
        bright = padded(bright, np.nan, *steps)
    take_means(members, bright, padded(values, 0.0, *steps), runs, out)
    return out


def surface_means(
    values: Image,
    disparity: Image,
    slope: Image,
    reach: int,
    every: int,
    runs: Runs | None = None,
    first_row: int = 0,
) -> Singles:
    """Means over the pixels of each pixel's surface around it of several images' ``values`` [n, h,
    w], which are NaN in all of them or in none; NaN where there are none.

    ``disparity`` (px) and its ``slope`` [2, h, w] decide what belongs to a surface. Pixels up to
    ``reach`` px off count, one of so many (``every``) along each axis, if they have a value. Those
    rows do whose number in the grid is a multiple of ``every``, so that values of others need not
    be known; ``first_row``: number of the first of the rows. Of the pixels of ``runs``
    (:func:`.window_sums.wanted_runs`) alone where these are given.
    """
    if runs is None:
        runs = wanted_runs(np.isfinite(disparity))
    return _surface_means(
        values, (disparity, slope), (reach, every, -first_row % every), ANY_BRIGHTNESS, runs
    )


def surface_mean(
    values: Image,
    disparity: Image,
    slope: Image,
    reach: int,
    every: int,
    runs: Runs | None = None,
    first_row: int = 0,
) -> Singles:
    """:func:`surface_means` of one image's ``values`` [h, w]."""
    return surface_means(values[None], disparity, slope, reach, every, runs, first_row)[0]


def alike_mean(
    values: Image,
    brightness: tuple[Singles, Singles],
    disparity: Image,
    slope: Image,
    reach: int,
    every: int,
    noise: tuple[float, float],
    runs: Runs,
) -> Singles:
    """Mean of ``values`` [h, w] over the pixels that are alike; NaN where there are none.

    As :func:`surface_mean`, of the pixels that are as bright as the centre in both images, by the
    ``brightness`` [h, w] of these (:func:`brightness_of_pair`), within the share AS_BRIGHT or NOISY
    standard deviations of the ``noise`` (variances). Rows are counted from the centre.
    """
    bright = _bright(brightness, AS_BRIGHT, noise)
    return _surface_means(values[None], (disparity, slope), (reach, every, -1), bright, runs)[0]


def shifted_correlations(
    left: Singles,
    right: Singles,
    disparity: Singles,
    places: NDArray[np.int64],
    limits: NDArray[np.int64],
    ahead: float = 0.0,
    *,
    half: int,
    least: int,
) -> Floats:
    """Correlation [n, odd] of few pixels' windows with those at whole columns from their match.

    The middle column is where the ``disparity`` [h, w] has the match, plus ``ahead`` px. ``places``
    [n, 3]: column and row of each pixel, and rows by which the right image is off; ``limits`` [n,
    2]: first and last shift that is asked for, columns. Over the pixels of the centre's surface up
    to ``half`` px off, as if it were level. NaN where nothing is asked, where the window leaves the
    right image, or holds less than ``least`` pixels; 0 where either image is constant.
    """
    out = np.empty((len(places), 2 * int(np.abs(limits).max(initial=0)) + 1))
    images = (np.ascontiguousarray(values, np.float32) for values in (left, right, disparity))
    correlate_shifted(*images, places, limits, ahead, half, least, out)
    return out
