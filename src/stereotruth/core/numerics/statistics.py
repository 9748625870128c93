"""Robust scale, weights and least squares; and error statistics that add up block by block."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels import inner
from .arrays import Floats

TO_SIGMA = 1.4826  # standard deviation over median absolute deviation, of a normal distribution
TUKEY = 4.685  # standard deviations at which the biweight is 0: 95 % efficient for normal errors
HUBER = 1.345  # standard deviations up to which Huber's weight is 1: the same efficiency

LIMITS = (0.5, 1.0, 3.0)  # px
SMALLEST_SIGMA = 1e-4  # px
SIGMA_STEP = 0.01  # in ln: resolution of the deciles of uncertainties
SIGMA_BINS = 1400  # up to 120 px; what is beyond counts into the outer bins


@inner
def robust_sigma(residuals: Floats, least: float) -> float:
    """Standard deviation about zero by the median absolute residual, ``least`` at least."""
    return max(TO_SIGMA * np.median(np.abs(residuals)), least)


def median_and_nmad(errors: Floats) -> tuple[float, float]:
    """Median and normalised median absolute deviation (1.4826 MAD) of errors."""
    median = float(np.median(errors))
    return median, TO_SIGMA * float(np.median(np.abs(errors - median)))


@inner
def biweight(t: float) -> float:
    """Tukey's weight of a residual, or of each of an array: (1 - t²)², 0 from |t| = 1 on."""
    return np.fmax(1.0 - t * t, 0.0) ** 2


def tukey_weights(residuals: Floats) -> Floats:
    """The biweight of residuals in standard deviations."""
    return biweight(residuals / TUKEY)


def huber_weights(residuals: Floats) -> Floats:
    """Huber's weights of residuals in standard deviations: 1, and HUBER / \\|r\\| beyond."""
    return HUBER / np.maximum(np.abs(residuals), HUBER)


def reweighted_fit(
    design: Floats,
    values: Floats,
    weights_of: Callable[[Floats], Floats],
    *,
    least_sigma: float,
    start: Floats | None = None,
    rounds: int = 50,
) -> Floats:
    """Coefficients [p] of ``values`` [n] on ``design`` [n, p] by reweighted least squares.

    ``weights_of`` the residuals in standard deviations: :func:`tukey_weights`, which needs a
    ``start`` near the result, or :func:`huber_weights`. The deviation is that of the residuals
    about zero, ``least_sigma`` at least. Ends when a step is below 1e-6 of the deviation.
    """
    found = np.zeros(design.shape[1]) if start is None else np.array(start, np.float64)
    for _ in range(rounds):
        residuals = values - design @ found
        sigma = robust_sigma(residuals, least_sigma)
        root = np.sqrt(weights_of(residuals / sigma))
        step = np.linalg.lstsq(design * root[:, None], residuals * root, rcond=None)[0]
        found += step
        if np.abs(step).max() < 1e-6 * sigma:
            break
    return found


@dataclass(frozen=True)
class Scale:
    """The ``limits`` beyond which errors are counted, and bins of the histogram (an odd number).

    All in the unit of the errors. What is beyond the outer bins counts into these.
    """

    limits: tuple[float, ...]
    bin: float
    bins: int

    @property
    def middle(self) -> int:
        """The bin of no error."""
        return self.bins // 2


PIXELS = Scale(LIMITS, 0.002, 16_001)  # from -16 to 16 px


@dataclass
class ErrorSum:
    """Sums over errors, and their histogram, from which medians are taken.

    Errors are added in a fixed order by the callers, so that equal input gives equal bits.
    """

    scale: Scale = PIXELS
    count: int = 0
    total: float = 0.0
    absolute: float = 0.0
    square: float = 0.0
    maximum: float = 0.0
    beyond: NDArray[np.int64] = field(init=False)
    histogram: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.beyond = np.zeros(len(self.scale.limits), np.int64)
        self.histogram = np.zeros(self.scale.bins, np.int64)

    def add(self, errors: ArrayLike) -> None:
        """Add errors; all must be finite."""
        errors = np.asarray(errors, dtype=np.float64).ravel()
        if not errors.size:
            return
        size, last = np.abs(errors), self.scale.bins - 1
        self.count += errors.size
        self.total += float(errors.sum())
        self.absolute += float(size.sum())
        self.square += float(np.square(errors).sum())
        self.maximum = max(self.maximum, float(size.max()))
        self.beyond += [int((size > limit).sum()) for limit in self.scale.limits]
        index = np.clip(np.rint(errors / self.scale.bin) + self.scale.middle, 0, last)
        self.histogram += np.bincount(index.astype(np.int64), minlength=self.scale.bins)

    def merge(self, other: ErrorSum) -> None:
        """Add another sum of the same scale to this one."""
        self.count += other.count
        self.total += other.total
        self.absolute += other.absolute
        self.square += other.square
        self.maximum = max(self.maximum, other.maximum)
        self.beyond += other.beyond
        self.histogram += other.histogram

    # What follows needs one error at least.

    @property
    def bias(self) -> float:
        """Mean error."""
        return self.total / self.count

    @property
    def mean_absolute(self) -> float:
        """Mean size of an error."""
        return self.absolute / self.count

    @property
    def rms(self) -> float:
        """Root mean square error."""
        return (self.square / self.count) ** 0.5

    @property
    def median(self) -> float:
        """Median error, to half a bin."""
        return (quantile_bin(self.histogram, 0.5) - self.scale.middle) * self.scale.bin

    @property
    def nmad(self) -> float:
        """Normalised median absolute deviation from the median, to 1.5 bins."""
        median = quantile_bin(self.histogram, 0.5)
        return TO_SIGMA * quantile_bin(_folded(self.histogram, median), 0.5) * self.scale.bin

    def quantile_of_size(self, share: float) -> float:
        """The size that this share of the errors does not exceed, to half a bin."""
        return quantile_bin(_folded(self.histogram, self.scale.middle), share) * self.scale.bin

    def shares_beyond(self, unit: str) -> dict[str, float | None]:
        """Share of the errors beyond each limit, by a name with the unit; None without errors."""
        return {
            f"share_over_{limit:g}_{unit}": int(k) / self.count if self.count else None
            for limit, k in zip(self.scale.limits, self.beyond)
        }

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready figures of errors in px; shares 0 … 1.

        Medians are good to 0.001 px, within ±16 px; the NMAD to 0.003 px.
        """
        shares = self.shares_beyond("px")
        if not self.count:
            empty = ("mean_absolute", "median", "median_absolute", "nmad", "bias", "rms", "max")
            return {"count": 0, **dict.fromkeys(empty), **shares}
        values = {
            "mean_absolute": self.mean_absolute,
            "median": self.median,
            "median_absolute": self.quantile_of_size(0.5),
            "nmad": self.nmad,
            "bias": self.bias,
            "rms": self.rms,
            "max": self.maximum,
            **shares,
        }
        return {"count": self.count, **{name: round(value, 6) for name, value in values.items()}}


def _folded(histogram: NDArray[np.int64], middle: int) -> NDArray[np.int64]:
    """Histogram of the distances to the bin ``middle``."""
    above, below = histogram[middle:], histogram[:middle][::-1]
    folded = np.zeros(max(above.size, below.size + 1), dtype=np.int64)
    folded[: above.size] = above
    folded[1 : 1 + below.size] += below
    return folded


def quantile_bin(histogram: NDArray[np.int64], share: float) -> int:
    """The first bin up to which a share of what is counted lies."""
    total = np.cumsum(histogram)
    return int(np.searchsorted(total, share * total[-1]))


@dataclass
class Calibration:
    """Errors against the standard uncertainties stated for them, by size of the uncertainty.

    Of calibrated uncertainties, 68.3 % of the normally distributed errors are smaller than theirs
    and 95.4 % smaller than twice theirs.
    """

    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((3, SIGMA_BINS), np.int64))
    sums: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, SIGMA_BINS)))

    def add(self, errors: ArrayLike, uncertainty: ArrayLike) -> None:
        """Add errors and their uncertainties, px; all must be finite."""
        size = np.abs(np.asarray(errors, dtype=np.float64).ravel())
        sigma = np.asarray(uncertainty, dtype=np.float64).ravel()
        index = np.log(np.maximum(sigma, SMALLEST_SIGMA) / SMALLEST_SIGMA) / SIGMA_STEP
        index = np.minimum(index, SIGMA_BINS - 1).astype(np.int64)
        for row, chosen in enumerate((slice(None), size < sigma, size < 2 * sigma)):
            self.counts[row] += np.bincount(index[chosen], minlength=SIGMA_BINS)
        for row, weights in enumerate((sigma, size * size)):
            self.sums[row] += np.bincount(index, weights=weights, minlength=SIGMA_BINS)

    def merge(self, other: Calibration) -> None:
        """Add the sums over other errors."""
        self.counts += other.counts
        self.sums += other.sums

    def figures(self) -> dict[str, Any]:
        """JSON-ready: shares below one and two uncertainties, as a whole and by its deciles.

        Deciles are cut to 1 % of the uncertainty, so that they hold more or less than a tenth
        where many uncertainties are alike; empty ones are left out.
        """
        total = np.cumsum(self.counts[0])
        n = int(total[-1])
        if not n:
            return {"count": 0, "share_below_1": None, "share_below_2": None, "deciles": []}
        ends = np.searchsorted(total, n * np.arange(1, 11) / 10 - 0.5) + 1
        starts = np.concatenate([[0], ends[:-1]])
        parts = (slice(a, b) for a, b in zip(starts, ends))
        return {
            **self._shares(slice(None)),
            "deciles": [self._shares(part) for part in parts if self.counts[0, part].any()],
        }

    def _shares(self, part: slice) -> dict[str, float | int]:
        n, below_1, below_2 = (int(k) for k in self.counts[:, part].sum(axis=1))
        mean, square = self.sums[:, part].sum(axis=1) / n
        values = {
            "mean_uncertainty": mean,
            "rms_error": np.sqrt(square),
            "share_below_1": below_1 / n,
            "share_below_2": below_2 / n,
        }
        return {"count": n, **{name: round(float(value), 6) for name, value in values.items()}}
