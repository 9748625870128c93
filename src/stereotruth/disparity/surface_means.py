"""The right image brought to the left by the labels, and means over the labels' surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..epipolar.surface_correlation import (
    BLOCK,
    columns_inside,
    surface_of_row,
    tolerance_px,
    wanted_runs,
)
from ..epipolar.warping import warp_rows
from ..kernels import kernel
from .image_patches import Patch
from .pair_window import PairWindow

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]

VOTE_PX = 12  # pixels up to here vote,
VOTE_STEP = 3  # every so many: 81 votes at most


def warp_to_left(right: Patch, rows: slice, cols: slice, disparity: Floats) -> Floats:
    """Right image at (x - disparity, y) of every pixel of a window of the left grid, float64[h, w].

    NaN where there is no disparity, or the right image has no value. The patch holds all rows.
    """
    top = rows.start - right.row
    image = right.pixels[top : top + len(disparity), : right.usable.shape[1]]
    return warp_rows(image, np.arange(cols.start, cols.stop) - disparity - right.col)


def left_and_warped(window: PairWindow, disparity: Floats) -> tuple[Singles, Floats]:
    """Left image of a window, and the right one brought to it by the ``disparity`` (px) [h, w]."""
    rows, cols = disparity.shape
    top, side = window.rows.start - window.left.row, window.cols.start - window.left.col
    left = window.left.pixels[top : top + rows, side : side + cols]
    return left, warp_to_left(window.right, window.rows, window.cols, disparity)


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


@kernel
def _voters(values: NDArray, disparity: Singles, known: Singles, voters: Singles) -> None:
    """Fills ``known`` with the ``values`` [h, w], 0 for none; ``voters`` with the disparity of
    those that have one."""
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            value = values[y, x]
            has_value = np.isfinite(value)
            known[y, x] = value if has_value else 0.0
            voters[y, x] = disparity[y, x] if has_value else np.float32(np.nan)


@kernel
def _surface_mean(
    values: Singles,
    disparity: Singles,
    voters: Singles,
    slope: Singles,
    reach: int,
    every: int,
    runs: Steps,
    out: Singles,
) -> None:
    """``voters``: disparity of the pixels that count, else NaN; ``runs`` of wanted pixels, outside
    of which all is NaN."""
    rows, cols = disparity.shape
    out[:] = np.nan
    surface = np.empty(3 * BLOCK, np.float32)
    sums = np.empty(2 * BLOCK, np.float32)
    one, zero = np.float32(1.0), np.float32(0.0)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        surface_of_row(disparity, slope, y, x0, size, surface)
        sums[:] = zero
        for step_down in range(-reach, reach + 1, every):
            b = y + step_down
            if b < 0 or b >= rows:
                continue
            down = np.float32(step_down)
            for step in range(-reach, reach + 1, every):
                across, tolerance = np.float32(step), tolerance_px(step_down, step)
                first, end = columns_inside(x0, size, cols, step)
                d = voters[b, x0 + step + first : x0 + step + end]
                value = values[b, x0 + step + first : x0 + step + end]
                p, s = surface[first:], sums[first:]
                for k in range(d.size):
                    plane = p[k] + across * p[BLOCK + k] + down * p[2 * BLOCK + k]
                    same = one if abs(d[k] - plane) <= tolerance else zero
                    s[k] += same
                    s[BLOCK + k] += same * value[k]
        for k in range(size):
            out[y, x0 + k] = sums[BLOCK + k] / sums[k]


def surface_mean(
    values: NDArray[np.floating],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    reach: int = VOTE_PX,
    every: int = VOTE_STEP,
    runs: Steps | None = None,
) -> Singles:
    """Mean over the pixels of each pixel's surface around it of ``values`` [h, w]; NaN for none.

    ``disparity`` (px) and its ``slope`` [2, h, w] decide what belongs to a surface. Pixels up to
    ``reach`` px off count, one of so many (``every``) along each axis, if they have a value. Of the
    pixels of ``runs`` (:func:`.wanted_runs`) alone where these are given.
    """
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    known, voters, out = np.empty((3, *disparity.shape), np.float32)
    _voters(values, disparity, known, voters)
    slope = np.ascontiguousarray(slope, dtype=np.float32)
    if runs is None:
        runs = wanted_runs(np.isfinite(disparity))
    _surface_mean(known, disparity, voters, slope, reach, every, runs, out)
    return out
