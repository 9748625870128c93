"""Do the images agree better at another disparity than at that of the labels?

What has grown, been felled or been raised between LiDAR and images is seen by both images, at
another disparity. So the detail of both images (:mod:`stereotruth.sensor.image_noise`) is
correlated over each pixel's surface at the labels' disparity and at shifted ones, and averaged over
the surface around it. That is positive evidence: shadows that have moved between the images, or
noise, lower the correlation at all disparities alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Floats, Singles
from ..core.numerics.windows import box_max
from ..epipolar.surface_windows import apart_from_steps, correlations, surface_mean, surface_means
from ..epipolar.warping import values_in_row
from ..epipolar.window_sums import BLOCK, Runs, wanted_runs
from .pair_window import Detail, Labels, PairWindow

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
AT_ONCE = 11  # shifts that are worked on together: which pixels count is the same for all
TILE_PX = 512  # side of the parts of a window that are worked on as far as any of it is wanted


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
    every, far_px = max(reach // 2, 1), FAR * reach
    averaged = box_max(wanted, far_px)
    compared = np.where(box_max(averaged, window_px // 2), disparity, np.nan)
    compared[original == 0.0] = np.nan
    known = np.isfinite(compared)
    averaged[np.arange(row, row + rows) % every != 0] = False  # no others are asked for
    to_compare, to_average = wanted_runs(averaged & known), wanted_runs(wanted)
    level, slope = (np.ascontiguousarray(array, np.float32) for array in (disparity, slope))
    strip = right.pixels[row - right.row :, : right.usable.shape[1]]
    at = np.arange(col, col + cols) - compared - right.col
    runs, warped = wanted_runs(known), np.full((AT_ONCE, rows, cols), np.nan, np.float32)
    means = np.full((5, rows, cols), np.nan, np.float32)
    here, elsewhere, shifted, here_far, elsewhere_far = means
    shifted_far = np.empty_like(shifted)
    of_shifts = np.array([0.0, *shifts])
    for first in range(0, of_shifts.size, AT_ONCE):
        several = of_shifts[first : first + AT_ONCE]
        there = warped[: several.size]
        _warp_shifted(strip, at, several, runs, there)
        if first == 0:  # what has a match counts at all shifts
            known = np.isfinite(warped[0])
            centres = np.where(known, level, np.float32(np.nan))
        correlation = correlations(
            original, there, centres, slope, known & clear, window_px, to_compare
        )
        near = surface_means(correlation, level, slope, reach, every, to_average, row)
        far = surface_means(correlation, level, slope, far_px, FAR * every, to_average, row)
        if first == 0:
            here[:], here_far[:] = near[0], far[0]
        _keep_greatest(near, several, to_average, elsewhere, shifted)
        _keep_greatest(far, several, to_average, elsewhere_far, shifted_far)
    signal = _signal(images, row, col, disparity)
    around_it = surface_mean(signal, level, slope, reach, every, to_average, row)
    return here, elsewhere, shifted, np.fmin(signal, around_it), here_far, elsewhere_far


@kernel
def _warp_shifted(right: Singles, at: Floats, shifts: Floats, runs: Runs, out: Singles) -> None:
    """Values of the rows of an image ``right`` [h or more, w'] at columns ``at`` [h, w] less each
    of several shifts (px) to ``out`` [n, h, w], NaN for none; of the pixels of ``runs`` alone."""
    column, taps = np.empty(BLOCK), np.empty((4, BLOCK), right.dtype)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        for n in range(shifts.size):
            for k in range(size):
                column[k] = at[y, x0 + k] - shifts[n]
            values_in_row(right[y], column[:size], taps, out[n, y, x0:])


@kernel
def _keep_greatest(
    means: Singles, shifts: Floats, runs: Runs, greatest: Singles, shift: Singles
) -> None:
    """Takes the greatest of the ``means`` [n, h, w] of shifts other than 0, and its shift."""
    for run in runs:
        y, x0, end = run[0], run[1], run[2]
        most, at = greatest[y, x0:end], shift[y, x0:end]
        for n in range(shifts.size):
            if shifts[n] == 0.0:
                continue
            mean = means[n, y, x0:end]
            for k in range(mean.size):
                better = np.isnan(most[k]) or mean[k] > most[k]
                at[k] = (np.nan if np.isnan(mean[k]) else shifts[n]) if better else at[k]
                most[k] = mean[k] if better else most[k]


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
