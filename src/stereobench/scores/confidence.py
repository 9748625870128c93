"""Stated standard uncertainties held against the errors that methods really make.

Sparsification: the pixels of the largest stated uncertainty are taken away, share by share, and
the mean absolute error of the rest is drawn over the share; beside it, that of an oracle which
takes away the pixels of the largest error. The area between the two, over shares of 0 to 1, is the
area under the sparsification error (AUSE), px: 0 for the oracle, and for uncertainties that know
nothing the mean error less the oracle's area. Pixels of equal uncertainty go in no order: what is
left of them has their mean error.

Intervals of disparity ± k σ, k that of a normal distribution: the share of pixels whose truth lies
within (coverage), beside the nominal one, and their mean width. The calibration factor is what all
uncertainties would have to be multiplied by for one σ to hold 68.27 % of the pixels: 1 of
calibrated ones, above 1 of ones that are too small; to 0.5 %.

Errors and uncertainties are counted in ``BINS`` logarithmic bins, so that pixels of any number of
tiles pool; what falls into one bin (0.5 % wide) is taken as equal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from stereotruth.core.numerics.arrays import Floats

SMALLEST_PX, LARGEST_PX = 1e-4, 1e4
BINS = 4096
SPAN = float(np.log(LARGEST_PX / SMALLEST_PX))
ONE_SIGMA = 0.6827
LEVELS = (0.5, 0.6827, 0.9, 0.95, 0.99)  # nominal coverage
SHARES = np.linspace(0.0, 0.99, 100)  # of the pixels, taken away; none would be left at 1


class Confidence:
    """Sums of errors by error and by stated uncertainty, to which tiles are added."""

    def __init__(self) -> None:
        # number of pixels, and sum of their errors, from the smallest to the largest bin
        self._by_sigma, self._by_error = np.zeros((2, BINS)), np.zeros((2, BINS))
        self._within = np.zeros(len(LEVELS))
        self._ratio = np.zeros(BINS)  # errors in units of their uncertainty
        self._sigma = 0.0

    @property
    def count(self) -> int:
        """Pixels so far."""
        return int(self._by_error[0].sum())

    def add(
        self,
        disparity: NDArray[np.floating[Any]],
        sigma: NDArray[np.floating[Any]],
        truth: NDArray[np.floating[Any]],
    ) -> None:
        """Count pixels that have all three (px, one shape); NaN where there is none."""
        known = np.isfinite(disparity) & np.isfinite(sigma) & np.isfinite(truth)
        stated = sigma[known].astype(np.float64)
        error = np.abs(disparity[known].astype(np.float64) - truth[known])
        for sums, by in ((self._by_sigma, stated), (self._by_error, error)):
            place = _bins(by)
            sums += [np.bincount(place, weights=w, minlength=BINS) for w in (None, error)]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(error > 0, error / stated, 0.0)
        self._ratio += np.bincount(_bins(ratio), minlength=BINS)
        self._within += [np.count_nonzero(error <= _k(level) * stated) for level in LEVELS]
        self._sigma += stated.sum()

    def curves(self) -> tuple[Floats, Floats]:
        """Mean error (px) of what is left at each of :data:`SHARES`: as stated, and the oracle."""
        return _left(self._by_sigma), _left(self._by_error)

    def figures(self) -> dict[str, float | None]:
        """AUSE (px; and as a share of that of uncertainties that know nothing), and intervals."""
        if not self.count:
            return {"pixels": 0}
        stated, oracle = (_area(sums) for sums in (self._by_sigma, self._by_error))
        mean = self._by_error[1].sum() / self.count
        # the error in units of its uncertainty that ONE_SIGMA of the pixels are below
        place = np.searchsorted(np.cumsum(self._ratio), ONE_SIGMA * self.count)
        factor = float(SMALLEST_PX * np.exp((place + 0.5) * SPAN / BINS))
        width = self._sigma / self.count
        row: dict[str, float | None] = {
            "pixels": self.count,
            "epe_px": round(mean, 6),
            "ause_px": round(stated - oracle, 6),
            "ause_random_px": round(mean - oracle, 6),
            "ause_share_of_random": round((stated - oracle) / (mean - oracle), 6)
            if mean > oracle
            else None,
            "mean_uncertainty_px": round(width, 6),
            "calibration_factor": round(factor, 6),
        }
        for level, within in zip(LEVELS, self._within):
            name = f"interval_{100 * level:g}_percent"
            row[f"{name}_coverage_share"] = round(within / self.count, 6)
            row[f"{name}_mean_width_px"] = round(2 * _k(level) * width, 6)
        return row


def _k(level: float) -> float:
    """Half the width of the interval of a normal distribution, in standard deviations."""
    return float(ndtri(0.5 + level / 2))


def _bins(values: Floats) -> NDArray[np.intp]:
    within = np.clip(values, SMALLEST_PX, LARGEST_PX)
    place = np.log(within / SMALLEST_PX) * (BINS / SPAN)
    return np.minimum(place.astype(np.intp), BINS - 1)


def _kept(sums: Floats) -> tuple[Floats, Floats]:
    """Share of the pixels up to each bin, and the sum of their errors by the number of all."""
    count, error = (np.concatenate([[0.0], np.cumsum(of)]) for of in sums)
    return count / count[-1], error / count[-1]


def _left(sums: Floats) -> Floats:
    kept, error = _kept(sums)
    return np.interp(1 - SHARES, kept, error) / (1 - SHARES)


def _area(sums: Floats) -> float:
    """Integral over all shares kept of the mean error of what is kept.

    Between two bins the sum of errors grows along a line, error = a + b kept, so that the mean
    is a / kept + b.
    """
    kept, error = _kept(sums)
    some = np.diff(kept) > 0
    low, high = kept[:-1][some], kept[1:][some]
    slope = np.diff(error)[some] / (high - low)
    start = error[:-1][some] - slope * low
    first = low == 0  # there start is 0
    ratio = np.log(high / np.where(first, high, low))
    return float(np.sum(np.where(first, 0.0, start) * ratio + slope * (high - low)))
