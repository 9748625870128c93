"""Robust location and trend of measurements over a tile, with the uncertainty that they have.

Matches close to each other share texture, surface and error: they are no independent evidence. A
tile is cut into cells; the variance is that of the cells' sums (cluster-robust, Liang & Zeger
1986), confidence limits are Student's with as many degrees of freedom as there are cells, less the
coefficients. The estimate is Tukey's biweight, started from the median, so that mismatches do no
harm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from stereotruth.core.numerics.arrays import Floats
from stereotruth.core.numerics.statistics import (
    TUKEY,
    biweight,
    median_and_nmad,
    reweighted_fit,
    robust_sigma,
    tukey_weights,
)

SMALLEST_SCALE = 0.02  # px: less is no noise of a match
CELLS = 8  # along the longer side of what was measured; each of
CELL_PX = (32, 128)  # at least and at most
MIN_CELLS = 4


@dataclass(frozen=True)
class Estimate:
    """A value with its standard error and the degrees of freedom behind it."""

    value: float
    error: float
    freedom: int

    def interval(self, alpha: float = 0.05) -> tuple[float, float]:
        """Two-sided confidence limits at level 1 − alpha."""
        if not np.isfinite(self.error):
            return -np.inf, np.inf
        reach = float(stats.t.ppf(1.0 - alpha / 2.0, self.freedom)) * self.error
        return self.value - reach, self.value + reach

    def beyond(self, tolerance: float, alpha: float) -> bool | None:
        """Whether the size is above a tolerance: True or False at level alpha, None undecided."""
        low, high = self.interval(alpha)
        if low > tolerance or high < -tolerance:
            return True
        if low >= -tolerance and high <= tolerance:
            return False
        return None


NOTHING = Estimate(float("nan"), float("inf"), 1)


def cells(x: Floats, y: Floats) -> NDArray[np.int64]:
    """Number of the cell of each position in px."""
    if not x.size:
        return np.empty(0, np.int64)
    size = np.clip(max(np.ptp(x), np.ptp(y)) / CELLS, *CELL_PX)
    return (np.floor(y / size) * 100_000 + np.floor(x / size)).astype(np.int64)


def scale_of(values: Floats) -> float:
    """Normalised median absolute deviation, no less than ``SMALLEST_SCALE``."""
    return max(median_and_nmad(values)[1], SMALLEST_SCALE)


def robust_fit(design: Floats, values: Floats, groups: NDArray[np.int64]) -> list[Estimate]:
    """Coefficients [p] of ``values`` [n] on ``design`` [n, p], whose first column is ones.

    ``groups`` [n]: the cells. Nothing is known (NaN, infinite error) with fewer than MIN_CELLS of
    them, or fewer values than three for each coefficient.
    """
    p = design.shape[1]
    names, group = np.unique(groups, return_inverse=True)
    freedom = names.size - p
    if names.size < MIN_CELLS or freedom < 1 or values.size < 3 * p:
        return [NOTHING] * p
    start = np.zeros(p)
    start[0] = np.median(values)
    at = reweighted_fit(design, values, tukey_weights, least_sigma=SMALLEST_SCALE, start=start)
    residual = values - design @ at
    u = residual / (TUKEY * robust_sigma(residual, SMALLEST_SCALE))
    inside = np.abs(u) < 1.0
    psi = residual * biweight(u)
    curvature = np.where(inside, (1.0 - u * u) * (1.0 - 5.0 * u * u), 0.0)
    bread = np.linalg.pinv((design * curvature[:, None]).T @ design)
    sums = np.zeros((names.size, p))
    np.add.at(sums, group, design * psi[:, None])
    meat = sums.T @ sums * names.size / (names.size - 1)
    variance = np.diag(bread @ meat @ bread)
    return [Estimate(float(v), float(np.sqrt(max(s, 0.0))), freedom) for v, s in zip(at, variance)]


def location(values: Floats, groups: NDArray[np.int64]) -> Estimate:
    """Robust location of values [n] in cells [n]."""
    return robust_fit(np.ones((values.size, 1)), values, groups)[0]


def share(hits: Floats, groups: NDArray[np.int64]) -> Estimate:
    """Mean of ``hits`` (0 or 1; or a difference of two such) of [n] samples in cells [n]."""
    return ratio(hits, np.ones(hits.size), groups)


def ratio(part: Floats, whole: Floats, groups: NDArray[np.int64]) -> Estimate:
    """Sum of ``part`` over sum of ``whole``, with the variance between cells."""
    names, group = np.unique(groups, return_inverse=True)
    if names.size < MIN_CELLS or whole.sum() <= 0:
        return NOTHING
    value = float(part.sum() / whole.sum())
    off = np.bincount(group, part - value * whole)
    n = names.size
    error = float(np.sqrt(n / (n - 1) * np.sum(off * off)) / whole.sum())
    return Estimate(value, error, n - 1)
