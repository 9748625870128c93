"""Do the images agree with the labels? Correlation over a pixel's own surface, not a square window.

The paper's filter (:mod:`stereotruth.disparity.paper_correlation`) compares square windows around
each point. Where heights step, such a window mixes surfaces and fails although the label is right.
Here the right image is brought to the left by the labels themselves, and windows hold the pixels of
one surface only:

- :mod:`stereotruth.epipolar.surface_correlation`: correlation coefficient of the left and the
  warped right image in a window around each pixel, over the pixels of its surface;
- :func:`apart_from_steps`: of these, only those that no pixel of another surface touches. The
  optics blur a bright roof into the ground beside it, in one view into other ground than in the
  other, which made two thirds of what was taken for a change at 1 point/m²;
- :meth:`Agreement.outvoted`: whether most pixels of the same surface around a pixel fail the
  threshold. A building that only the LiDAR or only the images have fails as a whole; single
  failures among agreeing pixels, by noise or in shadow, do not;
- :meth:`Agreement.outvoted_nearby`: the same for what is smaller, by what is usual around it;
- :meth:`Agreement.beside`: the rim of such things, which most of its surroundings outvote.

All is computed in a fixed order from the pixels around each pixel alone, so that results do not
depend on blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..epipolar.surface_correlation import (
    BLOCK,
    columns_inside,
    surface_correlation,
    surface_of_row,
    tolerance_px,
)
from ..epipolar.warping import warp_rows
from ..kernels import kernel
from ..numerics.summed_area import window_sums
from .image_patches import Patch
from .pair_window import PairWindow, WindowLabels
from .pixel_labels import Labels
from .status import WATER_CLASS, Status, is_labelled

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


DENSE = 2.0  # points in a pixel, that miss nothing of a pixel's size
VOTE_PX = 12  # pixels up to here vote,
VOTE_STEP = 3  # every so many: 81 votes at most
NEARBY_PX = 8  # for what is small, pixels up to here vote,
NEARBY_SHARE = 0.35  # of which so many fail
USUAL = 0.8  # of the correlation around: with less, a pixel fails


def warp_to_left(right: Patch, rows: slice, cols: slice, disparity: Floats) -> Floats:
    """Right image at (x - disparity, y) of every pixel of a window of the left grid, float64[h, w].

    NaN where there is no disparity, or the right image has no value. The patch holds all rows.
    """
    top = rows.start - right.row
    image = right.pixels[top : top + len(disparity), : right.usable.shape[1]]
    return warp_rows(image, np.arange(cols.start, cols.stop) - disparity - right.col)


def apart_from_steps(disparity: Floats) -> Bools:
    """Pixels [h, w] whose neighbours all have a disparity within SURFACE_PX of theirs."""
    rows, cols = disparity.shape
    around = np.pad(disparity, 1, constant_values=np.nan)
    out = np.ones(disparity.shape, np.bool_)
    for down in range(3):
        for across in range(3):
            near = around[down : down + rows, across : across + cols]
            out &= np.abs(near - disparity) <= SURFACE_PX  # also false for NaN
    return out


@kernel
def _surface_mean(
    values: Singles,
    disparity: Singles,
    voters: Singles,
    slope: Singles,
    reach: int,
    every: int,
    out: Singles,
) -> None:
    """``voters``: disparity of the pixels that count, else NaN."""
    rows, cols = disparity.shape
    surface = np.empty(3 * BLOCK, np.float32)
    sums = np.empty(2 * BLOCK, np.float32)
    one, zero = np.float32(1.0), np.float32(0.0)
    for y in range(rows):
        for x0 in range(0, cols, BLOCK):
            size = min(BLOCK, cols - x0)
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
) -> Singles:
    """Mean over the pixels of each pixel's surface around it of ``values`` [h, w]; NaN for none.

    ``disparity`` (px) and its ``slope`` [2, h, w] decide what belongs to a surface. Pixels up to
    ``reach`` px off count, one of so many (``every``) along each axis, if they have a value.
    """
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    known = np.isfinite(values)
    out = np.empty(disparity.shape, dtype=np.float32)
    _surface_mean(
        np.where(known, values, 0).astype(np.float32),
        disparity,
        np.where(known, disparity, np.float32(np.nan)),
        np.ascontiguousarray(slope, dtype=np.float32),
        reach,
        every,
        out,
    )
    return out


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well left and right image agree over each pixel's surface; arrays of a window.

    ``correlation`` [h, w]: their coefficient around each pixel, NaN for none; ``disparity`` (px)
    [h, w] and its ``slope`` [2, h, w] decide what belongs to a surface. With less than
    ``threshold`` a pixel fails. ``weight`` in [0, 1] that no object fits between the points.
    """

    correlation: NDArray[np.floating]
    disparity: NDArray[np.floating]
    slope: NDArray[np.floating]
    threshold: float
    weight: float = 1.0

    def outvoted(self) -> Bools:
        """Pixels [h, w] around which most of their surface fails."""
        known = np.isfinite(self.correlation)
        against = np.where(known, self.correlation < self.threshold, np.nan)
        return surface_mean(against, self.disparity, self.slope) > 0.5

    def _usual(self, correlation: NDArray[np.floating]) -> Singles:
        """What pixels [h, w] correlate by at least if they are as usual on their surface around
        them, by the ``correlation`` [h, w] there.

        That is the threshold, or more: the share USUAL of the mean up to VOTE_PX off, since noise
        lowers both. With less weight the limit is higher.
        """
        usual = 1.0 - (1.0 - USUAL) * self.weight
        mean = surface_mean(correlation, self.disparity, self.slope)
        return np.fmax(usual * mean, self.threshold)

    def outvoted_nearby(self) -> Bools:
        """Pixels [h, w] within NEARBY_PX of which NEARBY_SHARE correlate less than is usual there.

        Small things are found that :meth:`outvoted` lets their surroundings outvote. With less
        weight fewer failures are enough.
        """
        least = self._usual(self.correlation)
        against = np.where(np.isfinite(self.correlation), self.correlation < least, np.nan)
        share = NEARBY_SHARE * float(np.sqrt(self.weight))
        return surface_mean(against, self.disparity, self.slope, NEARBY_PX, 1) > share

    def beside(self, changed: Bools) -> Bools:
        """Pixels [h, w] no more than NEARBY_PX from ``changed`` ones that correlate less than is
        usual among those that are not.

        Of the hidden pixels that had labels at 4 points/m² in a city two thirds lay so, on ground
        that a building hides which only the images have.
        """
        if not changed.any():
            return changed.copy()
        near = window_sums(np.pad(changed, NEARBY_PX), 2 * NEARBY_PX + 1)
        unchanged = np.where(changed, np.nan, self.correlation)
        return (near > 0) & (self.correlation < self._usual(unchanged))


class Comparison(NamedTuple):
    """How both images are compared: side of the ``window_px``, ``threshold`` of the correlation,
    mean number of ``points_per_px``, ``weight`` in [0, 1] that no object fits between the
    points."""

    window_px: int
    threshold: float
    points_per_px: float
    weight: float


def window_agreement(labels: Labels, window: PairWindow, comparison: Comparison) -> Agreement:
    """Of both images of a window, over the surfaces of its ``labels``."""
    rows, cols = labels.disparity.shape
    warped = warp_to_left(window.right, window.rows, window.cols, labels.disparity)
    top, side = window.rows.start - window.left.row, window.cols.start - window.left.col
    left = window.left.pixels[top : top + rows, side : side + cols]
    surface = labels.disparity, labels.slope
    clear = apart_from_steps(labels.disparity)
    correlation = surface_correlation(left, warped, *surface, comparison.window_px, clear)
    return Agreement(correlation, *surface, comparison.threshold, comparison.weight)


def without_changes(
    labels: WindowLabels, window: PairWindow, comparison: Comparison
) -> WindowLabels:
    """Labels without those that the images contradict, and without water; with the correlation of
    the images over each pixel's surface."""
    agreement = window_agreement(labels.labels, window, comparison)
    status = labels.status.copy()
    changed = agreement.outvoted()
    rim = agreement.beside(changed)
    if comparison.points_per_px < DENSE:
        # Points far apart miss what is small: the pixels of one window vote once more.
        changed |= is_labelled(status) & agreement.outvoted_nearby()
    changed |= is_labelled(status) & rim
    changed |= is_labelled(status) & (labels.surface_class == WATER_CLASS)
    status[changed] = Status.CHANGED
    return replace(labels, status=status, correlation=agreement.correlation)
