"""Which of the surfaces around an open pixel it shows, or none of them: told by both images.

Open pixels lie between points where heights step. Nearly always one of the surfaces around goes on
there (99 % in a city): what is missing is its outline. So

1. candidates of a pixel are the planes of the labels around it, at most REACH pixels off, and the
   smooth triangle that it shows if no step hides it. A value is the LiDAR's plane, never a match;
2. each is judged by the logarithm of a likelihood ratio: how well left and right pixel agree
   by it, measured by how well they do on the labels of that surface nearby (their offset and
   variance), against how well any two pixels there would agree. So noise, gain and bare texture
   need no thresholds: where images cannot tell, the ratio is near one;
3. the ratios are pooled over neighbours that show the same plane, in ROUNDS rounds of mean-field
   updates of a Potts model, in which labels are fixed and *none of them* is one more candidate.

A pixel is labelled if the winner's probability is at least SURE, and if the ratios of its plane in
the pixels around say so without their neighbours' help. All is computed in a fixed order
from the pixels around each pixel alone, so that results do not depend on windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..epipolar.warping import warp_rows
from ..kernels import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]

REACH = 12  # px: labels whose planes are candidates,
AROUND = 10  # and that tell how well images agree on a surface
LEAST = 12  # of them at least
MOST = 4  # candidates
ROUNDS = 10
PULL = 0.8  # of a neighbour that shows the same plane, in units of the log-likelihood
CAP = 3.0  # of a pixel's log-likelihood ratio
SURE = 0.999
BACKERS = 2  # px around a pixel whose
BACKED = 4.0  # log-likelihood ratios must say so, too: neighbours alone prove nothing
MARGIN = REACH + AROUND + ROUNDS + BACKERS  # px around a pixel that have a say
_STEPS = ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1))


@kernel
def _candidates(
    row: Steps, col: Steps, known: Floats, slope: Floats, own: Floats, own_slope: Floats,
    highest: Floats, plane: Floats, source: Steps, number: Steps,
) -> None:  # fmt: skip
    """Planes of each open pixel: ``plane`` [n, MOST, 3] disparity, slopes; ``source`` [n, MOST, 2]
    (row, col) of the label, the pixel itself for its own triangle."""
    rows, cols = known.shape
    for i in range(row.size):
        y, x = row[i], col[i]
        n = 0
        if np.isfinite(own[y, x]):
            plane[i, 0, 0] = own[y, x]
            plane[i, 0, 1], plane[i, 0, 2] = own_slope[0, y, x], own_slope[1, y, x]
            source[i, 0, 0], source[i, 0, 1] = y, x
            n = 1
        for far in range(1, REACH + 1):  # the nearest labels first
            for down, across in _STEPS:
                b, a = y + down * far, x + across * far
                if b < 0 or a < 0 or b >= rows or a >= cols or not np.isfinite(known[b, a]):
                    continue
                gx, gy = slope[0, b, a], slope[1, b, a]
                d = known[b, a] - gx * across * far - gy * down * far
                # nothing lies between the camera and what it is known to see at the most
                if d > highest[y, x] + SURFACE_PX or d < own[y, x] - SURFACE_PX:
                    continue
                new = n < MOST
                for k in range(n):
                    if abs(plane[i, k, 0] - d) <= SURFACE_PX:
                        new = False
                if new:
                    plane[i, n, 0], plane[i, n, 1], plane[i, n, 2] = d, gx, gy
                    source[i, n, 0], source[i, n, 1] = b, a
                    n += 1
        number[i] = n


@kernel
def _evidence(
    row: Steps, col: Steps, left: Floats, there: Floats, known: Floats, residual: Floats,
    spread: Floats, plane: Floats, number: Steps, ratio: Floats,
) -> None:  # fmt: skip
    """Log-likelihood ratio [n, MOST] of each candidate; NaN where nothing can be said.

    ``there`` [n, MOST]: right image by each candidate; ``residual``: left less right image at
    labels; ``spread``: variance of such a difference of any two pixels around.
    """
    rows, cols = known.shape
    for i in range(row.size):
        y, x = row[i], col[i]
        for k in range(number[i]):
            ratio[i, k] = np.nan
            if np.isnan(there[i, k]):
                continue
            count, total, square = 0, 0.0, 0.0
            for b in range(max(y - AROUND, 0), min(y + AROUND + 1, rows)):
                base = plane[i, k, 0] + plane[i, k, 2] * (b - y)
                for a in range(max(x - AROUND, 0), min(x + AROUND + 1, cols)):
                    r = residual[b, a]
                    if np.isnan(r):
                        continue
                    if abs(known[b, a] - base - plane[i, k, 1] * (a - x)) <= SURFACE_PX:
                        count += 1
                        total += r
                        square += r * r
            if count < LEAST:
                continue
            mean = total / count
            variance = max((square - total * mean) / (count - 1), 1.0)
            wide = max(spread[y, x], variance)
            off = left[y, x] - there[i, k] - mean
            value = 0.5 * (off * off * (1.0 / wide - 1.0 / variance) + np.log(wide / variance))
            ratio[i, k] = min(max(value, -CAP), CAP)


@kernel
def _settle(
    row: Steps, col: Steps, index: Steps, known: Floats, plane: Floats,
    number: Steps, ratio: Floats, belief: Floats, spare: Floats,
) -> None:  # fmt: skip
    """Mean-field rounds; ``belief`` [n, MOST + 1], the last of *none*."""
    rows, cols = known.shape
    for i in range(row.size):
        total = 1.0
        for k in range(number[i]):
            belief[i, k] = 0.0 if np.isnan(ratio[i, k]) else np.exp(ratio[i, k])
            total += belief[i, k]
        for k in range(number[i]):
            belief[i, k] /= total
        belief[i, MOST] = 1.0 / total
    for _ in range(ROUNDS):
        for i in range(row.size):
            y, x = row[i], col[i]
            none = 0.0
            for k in range(number[i]):
                spare[i, k] = 0.0
            for down, across in _STEPS:
                b, a = y + down, x + across
                if b < 0 or a < 0 or b >= rows or a >= cols:
                    continue
                j = index[b, a]
                if j >= 0:
                    none += belief[j, MOST]
                    for k in range(number[i]):
                        at = plane[i, k, 0] + plane[i, k, 1] * across + plane[i, k, 2] * down
                        for m in range(number[j]):
                            if abs(plane[j, m, 0] - at) <= SURFACE_PX:
                                spare[i, k] += belief[j, m]
                elif np.isfinite(known[b, a]):
                    for k in range(number[i]):
                        at = plane[i, k, 0] + plane[i, k, 1] * across + plane[i, k, 2] * down
                        if abs(known[b, a] - at) <= SURFACE_PX:
                            spare[i, k] += 1.0
            top = PULL * none
            spare[i, MOST] = top
            for k in range(number[i]):
                if np.isnan(ratio[i, k]):
                    spare[i, k] = -np.inf
                    continue
                spare[i, k] = PULL * spare[i, k] + ratio[i, k]
                top = max(top, spare[i, k])
            total = np.exp(spare[i, MOST] - top)
            spare[i, MOST] = total
            for k in range(number[i]):
                spare[i, k] = np.exp(spare[i, k] - top)
                total += spare[i, k]
            for k in range(number[i]):
                spare[i, k] /= total
            spare[i, MOST] /= total
        belief[:] = spare


@kernel
def _backed(
    row: Steps, col: Steps, best: Ints, index: Steps, plane: Floats, number: Steps, ratio: Floats,
    out: Floats,
) -> None:  # fmt: skip
    """Sum of the log-likelihood ratios of the winner's plane in the open pixels around."""
    rows, cols = index.shape
    for i in range(row.size):
        y, x, k = row[i], col[i], best[i]
        out[i] = 0.0
        for b in range(max(y - BACKERS, 0), min(y + BACKERS + 1, rows)):
            for a in range(max(x - BACKERS, 0), min(x + BACKERS + 1, cols)):
                j = index[b, a]
                if j < 0:
                    continue
                at = plane[i, k, 0] + plane[i, k, 1] * (a - x) + plane[i, k, 2] * (b - y)
                for m in range(number[j]):
                    if abs(plane[j, m, 0] - at) <= SURFACE_PX and not np.isnan(ratio[j, m]):
                        out[i] += ratio[j, m]
                        break


@dataclass(frozen=True, eq=False)
class Found:
    """Open pixels that show a surface: ``row``, ``col`` [n]; its ``disparity`` and ``slope``
    [2, n] there; ``source`` [n, 2]: the label (row, col) that tells it, the pixel itself for its
    own triangle."""

    row: Steps
    col: Steps
    disparity: Floats
    slope: Floats
    source: Steps


def _variance(image: Floats) -> Floats:
    """Variance of an image in a window of AROUND pixels around each pixel, nodata (0) apart."""
    sums = []
    whole = image.astype(np.int64)  # sums are exact, and so the same for any window
    for values in ((whole > 0).astype(np.int64), whole, whole * whole):
        total = np.zeros((values.shape[0] + 1, values.shape[1] + 1), np.int64)
        np.cumsum(np.cumsum(values, axis=0), axis=1, out=total[1:, 1:])
        first = [np.maximum(np.arange(n) - AROUND, 0) for n in values.shape]
        last = [np.minimum(np.arange(n) + AROUND + 1, n) for n in values.shape]
        sums.append(
            total[np.ix_(last[0], last[1])]
            - total[np.ix_(first[0], last[1])]
            - total[np.ix_(last[0], first[1])]
            + total[np.ix_(first[0], first[1])]
        )
    n = np.maximum(sums[0], 1)
    return np.maximum(sums[2] / n - (sums[1] / n) ** 2, 0.0)


def surfaces_by_images(
    open_pixels: Bools,
    known: Floats,
    slope: Floats,
    own: Floats,
    own_slope: Floats,
    highest: Floats,
    left: Floats,
    right: Floats,
    first_col: int,
    behind: Callable[[Steps, Steps, Floats], Bools],
) -> Found:
    """Which surface the ``open_pixels`` [h, w] show.

    ``known``: disparity of labels (NaN for none), ``slope`` [2, h, w]; ``own``, ``own_slope``: the
    smooth triangle that a pixel shows unless something nearer hides it, whose disparity is
    ``highest`` at most. ``left`` [h, w], ``right`` [h, W]: images, of which the first column of the
    right one has the number ``first_col`` in the left one. ``behind`` (row, col, disparity) [n]:
    what a smooth triangle hides from the right camera.
    """
    row, col = (v.astype(np.int32) for v in np.nonzero(open_pixels))
    n = row.size
    plane, source = np.zeros((n, MOST, 3)), np.zeros((n, MOST, 2), np.int32)
    number = np.zeros(n, np.int32)
    _candidates(row, col, known, slope, own, own_slope, highest, plane, source, number)
    columns = np.arange(known.shape[1]) - first_col
    residual = left - warp_rows(right, columns - known)
    residual[left == 0.0] = np.nan
    there = np.full((n, MOST), np.nan)
    which, place = np.nonzero(np.arange(MOST) < number[:, None])
    hidden = np.zeros((n, MOST), np.bool_)
    hidden[which, place] = behind(row[which], col[which], plane[which, place, 0])
    for k in range(MOST):
        seen = np.flatnonzero((number > k) & ~hidden[:, k])
        at = np.full(known.shape, np.nan)
        at[row[seen], col[seen]] = col[seen] - first_col - plane[seen, k, 0]
        there[:, k] = warp_rows(right, at)[row, col]
    spread = 2.0 * _variance(left)
    ratio = np.full((n, MOST), np.nan)
    _evidence(row, col, left, there, known, residual, spread, plane, number, ratio)
    index = np.full(known.shape, -1, np.int32)
    index[row, col] = np.arange(n, dtype=np.int32)
    belief, spare = np.zeros((n, MOST + 1)), np.zeros((n, MOST + 1))
    _settle(row, col, index, known, plane, number, ratio, belief, spare)
    best = belief[:, :MOST].argmax(axis=1)
    backed = np.zeros(n)
    _backed(row, col, best, index, plane, number, ratio, backed)
    take = np.flatnonzero((belief[np.arange(n), best] >= SURE) & (backed >= BACKED))
    k = best[take]
    return Found(row[take], col[take], plane[take, k, 0], plane[take, k, 1:].T, source[take, k])
