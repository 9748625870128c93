"""Do the images agree with the labels? What a pixel's own surface says, not a square window.

The paper's filter (:mod:`stereotruth.correlation`) compares square windows around each point. Where
heights step, such a window mixes surfaces and fails although the label is right. Here the right
image is brought to the left by the labels themselves, and windows hold the pixels of one surface
only:

- :func:`surface_correlation`: correlation coefficient of the left and the warped right image in a
  window around each pixel, over the pixels of its surface;
- :func:`outvoted`: whether most pixels of the same surface around a pixel fail the threshold. A
  building that only the LiDAR or only the images have fails as a whole; single failures among
  agreeing pixels, by noise or in shadow, do not;
- :func:`supported`: whether enough of the eight neighbours carry the same surface. Which surface
  the centre of a pixel sees is least certain where neighbours differ.

All is computed in a fixed order from the pixels around each pixel alone, so that results do not
depend on blocks.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .correlation import Patch
from .occlusion import SURFACE_PX

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Pixels belong to one surface if a disparity is off the plane through the other by no more than
# SURFACE_PX, and BEND px for each pixel between them.
BEND = 0.1
VOTE_PX = 12  # pixels up to here vote,
VOTE_STEP = 3  # every so many: 81 votes at most
SUPPORT = 0.6  # share of the neighbours with points that must carry the surface


@njit(cache=True, nogil=True, error_model="numpy")
def _warp(image: NDArray, at: Floats, out: Floats) -> None:
    rows, cols = at.shape
    for y in range(rows):
        for k in range(cols):
            out[y, k] = np.nan
            x = at[y, k]
            if not (x >= 1.0 and x <= image.shape[1] - 3.0):
                continue
            i = int(x)
            f = x - i
            a, b, c, d = image[y, i - 1], image[y, i], image[y, i + 1], image[y, i + 2]
            if a == 0.0 or b == 0.0 or c == 0.0 or d == 0.0:
                continue
            out[y, k] = b + 0.5 * f * (
                c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a))
            )


def warp_rows(image: NDArray[np.floating], x: Floats) -> Floats:
    """Values float64[h, w] of an image [h, W] at columns ``x`` [h, w] of the same rows.

    Cubic convolution (Keys, a = -1/2). NaN where x is NaN, where one of the four columns is nodata
    (0) or outside the image.
    """
    out = np.empty(x.shape)
    _warp(image, x, out)
    return out


def warp_to_left(right: Patch, rows: slice, cols: slice, disparity: Floats) -> Floats:
    """Right image at (x - disparity, y) of every pixel of a window of the left grid, float64[h, w].

    NaN where there is no disparity, or the right image has no value. The patch holds all rows.
    """
    top = rows.start - right.row
    image = right.pixels[top : top + len(disparity), : right.usable.shape[1]]
    return warp_rows(image, np.arange(cols.start, cols.stop) - disparity - right.col)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _same(disparity, slope, y, x, b, a):
    plane = disparity[y, x] + slope[0, y, x] * (a - x) + slope[1, y, x] * (b - y)
    return abs(disparity[b, a] - plane) <= SURFACE_PX + BEND * max(abs(b - y), abs(a - x))


@njit(cache=True, nogil=True, error_model="numpy")
def _correlation(
    left: Floats, warped: Floats, disparity: Floats, slope: Floats, half: int, out: Floats
) -> None:
    rows, cols = left.shape
    for y in range(rows):
        for x in range(cols):
            out[y, x] = np.nan
            if not np.isfinite(warped[y, x]):
                continue
            u0, v0 = left[y, x], warped[y, x]
            n = 0
            su = sv = suu = svv = suv = 0.0
            for b in range(max(y - half, 0), min(y + half + 1, rows)):
                for a in range(max(x - half, 0), min(x + half + 1, cols)):
                    if np.isfinite(warped[b, a]) and _same(disparity, slope, y, x, b, a):
                        u, v = left[b, a] - u0, warped[b, a] - v0
                        n += 1
                        su += u
                        sv += v
                        suu += u * u
                        svv += v * v
                        suv += u * v
            uu, vv = suu - su * su / n, svv - sv * sv / n
            # A few pixels correlate by chance: they neither agree nor disagree.
            if n < 2 * half + 1:
                continue
            out[y, x] = (suv - su * sv / n) / np.sqrt(uu * vv) if uu > 0.0 and vv > 0.0 else 0.0


def surface_correlation(
    left: Floats, warped: Floats, disparity: Floats, slope: Floats, window: int
) -> Floats:
    """Correlation of two images [h, w] over the pixels of each pixel's surface in its window.

    ``warped`` is NaN and ``disparity`` (px), with its ``slope`` [2, h, w] along x and y, anything
    where there is no label. NaN where there is no label or fewer pixels than the ``window`` (odd,
    px) is wide; 0 where either image is constant.
    """
    out = np.empty(left.shape)
    _correlation(left, warped, disparity, slope, window // 2, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _outvoted(
    correlation: Floats, disparity: Floats, slope: Floats, threshold: float, out: Bools
) -> None:
    rows, cols = correlation.shape
    for y in range(rows):
        for x in range(cols):
            out[y, x] = False
            if not np.isfinite(disparity[y, x]):
                continue
            votes = 0
            against = 0
            for down in range(-VOTE_PX, VOTE_PX + 1, VOTE_STEP):
                for across in range(-VOTE_PX, VOTE_PX + 1, VOTE_STEP):
                    b, a = y + down, x + across
                    if not (0 <= b < rows and 0 <= a < cols and np.isfinite(correlation[b, a])):
                        continue
                    if _same(disparity, slope, y, x, b, a):
                        votes += 1
                        against += correlation[b, a] < threshold
            out[y, x] = 2 * against > votes


def outvoted(correlation: Floats, disparity: Floats, slope: Floats, threshold: float) -> Bools:
    """Pixels [h, w] around which most of their surface correlates by less than ``threshold``.

    ``disparity`` (px) and its ``slope`` [2, h, w] tell what belongs to a surface.
    """
    out = np.empty(correlation.shape, dtype=np.bool_)
    _outvoted(correlation, disparity, slope, threshold, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _supported(disparity: Floats, with_points: Bools, share: float, out: Bools) -> None:
    rows, cols = disparity.shape
    for y in range(rows):
        for x in range(cols):
            out[y, x] = False
            here = disparity[y, x]
            if not np.isfinite(here):
                continue
            others = 0
            same = 0
            for b in range(max(y - 1, 0), min(y + 2, rows)):
                for a in range(max(x - 1, 0), min(x + 2, cols)):
                    if (a != x or b != y) and with_points[b, a]:
                        others += 1
                        same += abs(disparity[b, a] - here) <= SURFACE_PX
            out[y, x] = same >= share * others


def supported(disparity: Floats, with_points: Bools) -> Bools:
    """Pixels [h, w] of whose neighbours with points a share of SUPPORT has the same surface.

    ``disparity`` (px) is NaN where a pixel carries no label.
    """
    out = np.empty(disparity.shape, dtype=np.bool_)
    _supported(disparity, with_points, SUPPORT, out)
    return out
