"""The right image brought to the left by the labels, and means over the labels' surfaces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..epipolar.surface_correlation import (
    BLOCK,
    TOGETHER,
    is_near,
    surface_of_row,
    tolerance_px,
    wanted_runs,
)
from ..epipolar.warping import warp_rows
from ..kernels import inner, kernel
from .image_patches import Patch
from .pair_window import PairWindow

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]


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


class Voters(NamedTuple):
    """Pixels that have a say in the means of others, in several images.

    Arrays with ``reach`` columns more on the left, and ``reach`` + 2 ``every`` on the right, in
    which none has. ``value`` [n, h, w] in each image, 0 for none; ``disparity`` [h, w] of those
    that have one, else NaN. Of the columns and rows up to ``reach`` px off one in ``every``
    votes: columns are counted from the pixel itself, rows from the row ``first`` of the arrays.
    """

    value: Singles
    disparity: Singles
    reach: int
    every: int
    first: int

    @classmethod
    def of(cls, shape: tuple[int, int, int], reach: int, every: int, first_row: int) -> Voters:
        """None yet; ``first_row``: number in the grid of the first of the rows. Those whose number
        is a multiple of ``every`` vote, whatever the window."""
        wide = shape[1], shape[2] + 2 * (reach + every)
        value = np.zeros((shape[0], *wide), np.float32)
        return cls(value, np.full(wide, np.nan, np.float32), reach, every, -first_row % every)


@kernel
def fill_voters(values: NDArray, disparity: Singles, voters: Voters) -> None:
    """Fills the ``voters`` with the ``values`` [n, h, w] of pixels and their disparity. Who has a
    value in one image has one in all."""
    reach = voters.reach
    for y in range(voters.first, disparity.shape[0], voters.every):
        for x in range(disparity.shape[1]):
            has_value = np.isfinite(values[0, y, x])
            voters.disparity[y, reach + x] = disparity[y, x] if has_value else np.float32(np.nan)
            for n in range(len(values)):
                voters.value[n, y, reach + x] = values[n, y, x] if has_value else 0.0


@inner
def _tolerance_up_to(down: int, across: int, reach: int) -> float:
    """:func:`.tolerance_px` of a pixel up to ``reach`` px off, and less than 0 of others."""
    return tolerance_px(down, across) if across <= reach else np.float32(-1.0)


@kernel
def mean_of_runs(
    disparity: Singles, slope: Singles, voters: Voters, runs: Steps, out: Singles
) -> None:
    """Means [n, h, w] of the ``voters`` on the surface of each pixel of ``runs``; NaN outside of
    these."""
    rows, last = len(disparity), len(voters.value) - 1
    reach, every, first = voters.reach, voters.every, voters.first
    out[:] = np.nan
    surface = np.empty(3 * BLOCK, np.float32)
    sums = np.empty(5 * BLOCK, np.float32)  # of the first image, and then which voters count
    others = np.empty((last, BLOCK), np.float32)
    zero = np.float32(0.0)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        surface_of_row(disparity, slope, y, x0, size, surface)
        sums[: 2 * BLOCK], others[:] = zero, zero
        above = max(y - reach - first, 0)
        top = first + (above + every - 1) // every * every
        for b in range(top, min(y + reach + 1, rows), every):
            step_down = b - y
            down = np.float32(step_down)
            for step in range(-reach, reach + 1, TOGETHER * every):
                second, third = step + every, step + 2 * every
                across = np.float32(step), np.float32(second), np.float32(third)
                limit = (
                    _tolerance_up_to(step_down, step, reach),
                    _tolerance_up_to(step_down, second, reach),
                    _tolerance_up_to(step_down, third, reach),
                )
                at = reach + x0 + step
                d, v = voters.disparity[b, at:], voters.value[0, b, at:]
                dd, vv = d[every:], v[every:]
                ddd, vvv = dd[every:], vv[every:]
                p, s = surface, sums
                for k in range(size):
                    level, along, rise = p[k], p[BLOCK + k], down * p[2 * BLOCK + k]
                    e = is_near(d[k], level + across[0] * along + rise, limit[0])
                    f = is_near(dd[k], level + across[1] * along + rise, limit[1])
                    g = is_near(ddd[k], level + across[2] * along + rise, limit[2])
                    s[k] = s[k] + e + f + g
                    s[BLOCK + k] = s[BLOCK + k] + e * v[k] + f * vv[k] + g * vvv[k]
                    s[2 * BLOCK + k], s[3 * BLOCK + k], s[4 * BLOCK + k] = e, f, g
                for n in range(last):
                    o, v = others[n], voters.value[n + 1, b, at:]
                    vv = v[every:]
                    vvv = vv[every:]
                    for k in range(size):
                        e, f, g = s[2 * BLOCK + k], s[3 * BLOCK + k], s[4 * BLOCK + k]
                        o[k] = o[k] + e * v[k] + f * vv[k] + g * vvv[k]
        for k in range(size):
            out[0, y, x0 + k] = sums[BLOCK + k] / sums[k]
            for n in range(last):
                out[n + 1, y, x0 + k] = others[n, k] / sums[k]


def surface_mean(
    values: NDArray[np.floating],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    reach: int,
    every: int,
    runs: Steps | None = None,
    first_row: int = 0,
) -> Singles:
    """Mean over the pixels of each pixel's surface around it of ``values`` [h, w]; NaN for none.

    ``disparity`` (px) and its ``slope`` [2, h, w] decide what belongs to a surface. Pixels up to
    ``reach`` px off count, one of so many (``every``) along each axis, if they have a value; see
    :class:`Voters` for ``first_row``. Of the pixels of ``runs`` (:func:`.wanted_runs`) alone where
    these are given.
    """
    return surface_means(values[None], disparity, slope, reach, every, runs, first_row)[0]


def surface_means(
    values: NDArray[np.floating],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    reach: int,
    every: int,
    runs: Steps | None = None,
    first_row: int = 0,
) -> Singles:
    """:func:`surface_mean` of several images' ``values`` [n, h, w]: NaN in all of them or in
    none."""
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    slope = np.ascontiguousarray(slope, dtype=np.float32)
    voters = Voters.of(values.shape, reach, every, first_row)
    out = np.empty(values.shape, np.float32)
    fill_voters(values, disparity, voters)
    if runs is None:
        runs = wanted_runs(np.isfinite(disparity))
    mean_of_runs(disparity, slope, voters, runs, out)
    return out
