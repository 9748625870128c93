"""Do the images agree better at another disparity than at that of the labels?

What has grown, been felled or been raised between LiDAR and images is seen by both images, at
another disparity. So the detail of both images (:mod:`stereotruth.epipolar.image_detail`) is
correlated over each pixel's surface at the labels' disparity and at shifted ones, and averaged over
the surface around it. That is positive evidence: shadows that have moved between the images, or
noise, lower the correlation at all disparities alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.surface_correlation import BLOCK, correlate, padded_columns, wanted_runs
from ..epipolar.warping import value_in_row
from ..kernels import inner, kernel
from ..numerics.box_max import box_max
from .image_patches import Detail
from .pair_window import PairWindow
from .pixel_labels import Labels
from .surface_means import Voters, apart_from_steps, fill_voters, mean_of_runs, surface_mean

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]

SHIFTS_PX = (-15.0, -12.0, -10.0, -8.0, -6.5, -5.0, -4.0, -3.0, -2.0, -1.0)
SHIFTS_PX += (1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 15.0)
# of what has changed already, over the heights of buildings
WIDE_SHIFTS_PX = (-40.0, -34.0, -28.0, -23.0, -19.0, -15.0, -12.0, -10.0, -8.0, -6.5, -5.0, -4.0)
WIDE_SHIFTS_PX += (-3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.0, 15.0, 19.0)
# Fisher's z of a correlation of n independent pixels has the variance 1 / n, a difference of two
# has twice that. The optics leave one independent pixel of INDEPENDENT_PX2.
SIGNIFICANT = 3.0  # standard deviations of a difference; the greatest of all shifts reaches 2
INDEPENDENT_PX2 = 4.0
Z_LIMIT = 0.999
SHIFTED_PX = 52  # by which these, and what their windows take in, reach beyond a pixel's match
FAR = 2  # times as far off more of the surface is asked, which noise hides less
AT_ONCE = 4  # shifts that are worked on together: which pixels count is the same for all
TILE_PX = 256  # side of the parts of a window that are worked on as far as any of it is wanted


@dataclass(frozen=True, eq=False)
class ShiftedAgreement:
    """Mean correlation of both images' detail over the surface around each pixel [h, w].

    ``here``: at the labels' disparity; ``elsewhere``: the greatest of shifted ones, which is at
    ``shift`` px. NaN where nothing was asked, and where there is nothing to correlate. ``signal``:
    what the images of the same ground would correlate by, as their noise leaves it, the less of the
    pixel's own and its surface's; 0 where either has no value. ``here_far`` and ``elsewhere_far``:
    the same of the surface up to FAR times as many px. ``pixels``: that a mean of the first takes
    in, at most.
    """

    here: Singles
    elsewhere: Singles
    shift: Singles
    signal: Singles
    here_far: Singles
    elsewhere_far: Singles
    pixels: int

    @cached_property
    def is_shifted(self) -> Bools:
        """Where the images agree significantly better elsewhere [h, w]."""
        z_here, z_elsewhere = (
            np.arctanh(np.clip(value, -Z_LIMIT, Z_LIMIT)) for value in (self.here, self.elsewhere)
        )
        limit = SIGNIFICANT * np.sqrt(2.0 * INDEPENDENT_PX2 / self.pixels)
        return z_elsewhere - z_here > limit


def shifted_agreement(
    labels: Labels,
    window: PairWindow,
    noise: tuple[float, float],
    window_px: int,
    reach: int,
    wanted: Bools,
    shifts: tuple[float, ...] = SHIFTS_PX,
    apart: bool = True,
) -> ShiftedAgreement:
    """At the ``wanted`` pixels [h, w] of a window, over its ``labels``' surfaces.

    ``noise``: variances of both images, DN²; ``window_px``: side of the correlation's window;
    ``reach``: px up to which the surface is averaged; ``shifts`` of the disparity, px; ``apart``:
    whether pixels beside a step count for nothing.
    """
    shape = wanted.shape
    out = np.full((6, *shape), np.nan, np.float32)
    pad = FAR * reach + window_px // 2 + 1
    images: tuple[Detail, Detail] | None = None
    for top in range(0, shape[0], TILE_PX):
        for side in range(0, shape[1], TILE_PX):
            row, col = np.nonzero(wanted[top : top + TILE_PX, side : side + TILE_PX])
            if row.size == 0:
                continue
            if images is None:
                images = window.details(noise)
            rows = slice(top + row.min(), top + row.max() + 1)
            cols = slice(side + col.min(), side + col.max() + 1)
            first = max(rows.start - pad, 0), max(cols.start - pad, 0)
            around = np.s_[first[0] : rows.stop + pad, first[1] : cols.stop + pad]
            inside = np.s_[
                rows.start - first[0] : rows.stop - first[0],
                cols.start - first[1] : cols.stop - first[1],
            ]
            here = np.zeros_like(wanted[around])
            here[inside] = wanted[rows, cols]
            part = _means(labels, window, images, around, here, window_px, reach, shifts, apart)
            for k, values in enumerate(part):
                out[k, rows, cols] = np.where(wanted[rows, cols], values[inside], np.nan)
    return ShiftedAgreement(*out, (2 * reach + window_px) ** 2)


def _means(
    labels: Labels,
    window: PairWindow,
    images: tuple[Detail, Detail],
    around: tuple[slice, slice],
    wanted: Bools,
    window_px: int,
    reach: int,
    shifts: tuple[float, ...],
    apart: bool,
) -> tuple[Singles, ...]:
    """The arrays of :class:`ShiftedAgreement` of a part of a window, of which some pixels are
    ``wanted``."""
    left, right = (image.patch for image in images)
    disparity, slope = labels.disparity[around], labels.slope[:, *around]
    rows, cols = disparity.shape
    row, col = window.rows.start + around[0].start, window.cols.start + around[1].start
    original = left.pixels[row - left.row :, col - left.col :][:rows, :cols]
    clear = apart_from_steps(disparity) if apart else np.isfinite(disparity)
    every = max(reach // 2, 1)
    averaged = box_max(wanted, FAR * reach)
    compared = np.where(box_max(averaged, window_px // 2), disparity, np.nan)
    compared[original == 0.0] = np.nan
    known = np.isfinite(compared)
    voters = Voters.of((AT_ONCE, rows, cols), reach, every, row)
    far = Voters.of((AT_ONCE, rows, cols), FAR * reach, FAR * every, row)
    averaged[np.arange(rows) % every != voters.first] = False
    to_compare, to_average = wanted_runs(averaged & known), wanted_runs(wanted)
    surface = (np.ascontiguousarray(values, dtype=np.float32) for values in (disparity, slope))
    level, slope = surface
    means = np.full((5, rows, cols), np.nan, np.float32)
    part = _Compared(
        original, right.pixels[row - right.row :], right.usable.shape[1], (col, right.col),
        compared, wanted_runs(known), clear, level, slope,
    )  # fmt: skip
    of_shifts = np.array([0.0, *shifts])
    _means_at_shifts(part, window_px // 2, of_shifts, to_compare, (voters, far), to_average, means)
    here, elsewhere, shifted, here_far, elsewhere_far = means
    signal = _signal(images, row, col, disparity)
    around_it = surface_mean(signal, level, slope, reach, every, to_average, row)
    return here, elsewhere, shifted, np.fmin(signal, around_it), here_far, elsewhere_far


class _Compared(NamedTuple):
    """A part of a window in which both images are compared at several disparities; arrays [h, w].

    ``left`` image; ``right`` one [h or more, ``right_cols`` or more] from the same row on;
    ``first``: columns of both images' first pixels in their grids. ``compared``: disparity (px) of
    the pixels that are compared, NaN elsewhere, and the ``runs`` of these; ``clear``: those that
    count. ``level`` (px) and ``slope`` [2, h, w] of the disparity of all.
    """

    left: Singles
    right: Singles
    right_cols: int
    first: tuple[int, int]
    compared: Floats
    runs: Steps
    clear: Bools
    level: Singles
    slope: Singles


@inner
def _right_values(part: _Compared, run: Steps, shift: float, at: Floats, value: Singles) -> None:
    """Right image at the shifted disparity of a run, NaN for none, to ``value``; at columns
    ``at``."""
    y, x0, size = run[0], run[1], run[2] - run[1]
    right, compared = part.right[:, : part.right_cols], part.compared[y, x0:]
    for k in range(size):
        at[k] = part.first[0] + (x0 + k) - (compared[k] + shift) - part.first[1]
    for k in range(size):
        value[k] = value_in_row(right, y, at[k])


@kernel
def _warp_shifted(
    part: _Compared, shifts: Floats, half: int, known: Singles, counted: Singles, warped: Singles
) -> None:
    """Right image at the shifted disparities to ``warped`` [n, h, half + w or more], 0 for none.

    Where the first of the ``shifts`` (px) is 0, the disparity of pixels with a match to ``known``
    [h, w], and of those of them that count to ``counted`` [h, half + w or more].
    """
    none = np.float32(np.nan)
    at, value = np.empty(BLOCK), np.empty(BLOCK, np.float32)
    for run in part.runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        for n in range(shifts.size):
            _right_values(part, run, shifts[n], at, value)
            if shifts[n] == 0.0:
                for k in range(size):
                    level = part.level[y, x0 + k] if np.isfinite(value[k]) else none
                    known[y, x0 + k] = level
                    counted[y, half + x0 + k] = level if part.clear[y, x0 + k] else none
            for k in range(size):
                warped[n, y, half + x0 + k] = value[k] if np.isfinite(value[k]) else 0.0


@kernel
def _means_at_shifts(
    part: _Compared,
    half: int,
    shifts: Floats,
    to_compare: Steps,
    voters: tuple[Voters, Voters],
    to_average: Steps,
    out: Singles,
) -> None:
    """Mean correlation, by the first of the ``voters``, at the first of the ``shifts``, which is 0
    px, to ``out`` [5, h, w]; the greatest at the others, and which one that is; the first two by
    the other voters.

    What has a match counts at all shifts. Where the right image ends it has no detail.
    """
    rows, cols = part.left.shape
    wide = padded_columns(cols, half)
    left, warped = np.zeros((rows, wide), np.float32), np.zeros((AT_ONCE, rows, wide), np.float32)
    counted, known = np.empty((rows, wide), np.float32), np.empty((rows, cols), np.float32)
    counted[:], known[:] = np.nan, np.nan
    left[:, half : half + cols] = part.left
    correlation, mean = np.empty((2, AT_ONCE, rows, cols), np.float32)
    expected = np.empty((rows, cols), np.float32)
    for first in range(0, shifts.size, AT_ONCE):
        several = shifts[first : first + AT_ONCE]
        n = several.size
        _warp_shifted(part, several, half, known, counted, warped[:n])
        correlate(
            left, warped[:n], known, counted, part.slope, half, (0.0, 0.0), to_compare,
            correlation[:n], expected,
        )  # fmt: skip
        for far in range(2):
            which = voters[far]
            few = Voters(which.value[:n], which.disparity, which.reach, which.every, which.first)
            fill_voters(correlation[:n], part.level, few)
            mean_of_runs(part.level, part.slope, few, to_average, mean[:n])
            here, elsewhere = out[3 * far], out[3 * far + 1]
            for run in to_average:
                y = run[0]
                for k in range(n):
                    for x in range(run[1], run[2]):
                        if first + k == 0:
                            here[y, x] = mean[k, y, x]
                        elif np.isnan(elsewhere[y, x]) or mean[k, y, x] > elsewhere[y, x]:
                            elsewhere[y, x] = mean[k, y, x]
                            if far == 0:
                                shifted = np.nan if np.isnan(mean[k, y, x]) else several[k]
                                out[2, y, x] = shifted


def _signal(images: tuple[Detail, Detail], row: int, col: int, disparity: Floats) -> Singles:
    """Geometric mean of the shares of signal of both images, at pixels [h, w] from (row, col)."""
    rows, cols = disparity.shape
    left, right = images
    there = np.floor(np.arange(col, col + cols) - disparity + 0.5) - right.patch.col
    inside = (there >= 0) & (there < right.signal.shape[1])  # also false for NaN
    at = np.where(inside, there, 0).astype(np.int64)
    strip = right.signal[row - right.patch.row :][:rows]
    other = np.where(inside, np.take_along_axis(strip, at, axis=1), np.float32(0.0))
    own = left.signal[row - left.patch.row :, col - left.patch.col :][:rows, :cols]
    return np.sqrt(own * other)
