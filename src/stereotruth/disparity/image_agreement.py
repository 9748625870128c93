"""Do the images agree with the labels? What a pixel's own surface says, not a square window.

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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..epipolar.surface_correlation import BLOCK, columns_inside, surface_of_row, tolerance_px
from ..epipolar.warping import warp_rows
from ..kernels import kernel
from .image_patches import Patch

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


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

    ``disparity`` (px) and its ``slope`` [2, h, w] tell what belongs to a surface. Pixels up to
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
    [h, w] and its ``slope`` [2, h, w] tell what belongs to a surface. With less than ``threshold``
    a pixel fails. ``trust`` (0 to 1): how far the points miss nothing.
    """

    correlation: NDArray[np.floating]
    disparity: NDArray[np.floating]
    slope: NDArray[np.floating]
    threshold: float
    trust: float = 1.0

    def outvoted(self) -> Bools:
        """Pixels [h, w] around which most of their surface fails."""
        known = np.isfinite(self.correlation)
        against = np.where(known, self.correlation < self.threshold, np.nan)
        return surface_mean(against, self.disparity, self.slope) > 0.5

    def _usual(self, correlation: NDArray[np.floating]) -> Singles:
        """What pixels [h, w] correlate by at least if they are as usual on their surface around
        them, by the ``correlation`` [h, w] there.

        That is the threshold, or more: the share USUAL of the mean up to VOTE_PX off, since noise
        lowers both. With less trust more is asked for.
        """
        usual = 1.0 - (1.0 - USUAL) * self.trust
        mean = surface_mean(correlation, self.disparity, self.slope)
        return np.fmax(usual * mean, self.threshold)

    def outvoted_nearby(self) -> Bools:
        """Pixels [h, w] within NEARBY_PX of which NEARBY_SHARE correlate less than is usual there.

        Small things are found that :meth:`outvoted` lets their surroundings outvote. With less
        trust fewer failures are enough.
        """
        least = self._usual(self.correlation)
        against = np.where(np.isfinite(self.correlation), self.correlation < least, np.nan)
        share = NEARBY_SHARE * float(np.sqrt(self.trust))
        return surface_mean(against, self.disparity, self.slope, NEARBY_PX, 1) > share

    def beside(self, changed: Bools) -> Bools:
        """Pixels [h, w] no more than NEARBY_PX from ``changed`` ones that correlate less than is
        usual among those that are not.

        Of the hidden pixels that had labels at 4 points/m² in a city two thirds lay so, on ground
        that a building hides which only the images have.
        """
        if not changed.any():
            return changed.copy()
        size = 2 * NEARBY_PX + 1
        sums = np.pad(changed.astype(np.int32), ((NEARBY_PX + 1, NEARBY_PX),) * 2)
        sums = sums.cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
        near = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size]
        unchanged = np.where(changed, np.nan, self.correlation)
        return (near > 0) & (self.correlation < self._usual(unchanged))
