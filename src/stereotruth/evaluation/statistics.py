"""Error statistics that can be added up block by block, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
LIMITS = (0.5, 1.0, 3.0)  # px
BIN = 0.002  # px: resolution of the medians
BINS = 16001  # from -16 to 16 px; what is beyond counts into the outer bins


@dataclass
class ErrorSum:
    """Sums over errors in px, and their histogram, from which medians are taken.

    Errors are added in a fixed order by the callers, so that equal input gives equal bits.
    """

    count: int = 0
    total: float = 0.0
    absolute: float = 0.0
    square: float = 0.0
    maximum: float = 0.0
    beyond: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(LIMITS), np.int64))
    histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))

    def add(self, errors: ArrayLike) -> None:
        """Add errors in px; all must be finite."""
        errors = np.asarray(errors, dtype=np.float64).ravel()
        if not errors.size:
            return
        size = np.abs(errors)
        self.count += errors.size
        self.total += float(errors.sum())
        self.absolute += float(size.sum())
        self.square += float(np.square(errors).sum())
        self.maximum = max(self.maximum, float(size.max()))
        self.beyond += [int((size > limit).sum()) for limit in LIMITS]
        index = np.clip(np.rint(errors / BIN) + BINS // 2, 0, BINS - 1).astype(np.int64)
        self.histogram += np.bincount(index, minlength=BINS)

    def merge(self, other: ErrorSum) -> None:
        """Add another sum to this one."""
        self.count += other.count
        self.total += other.total
        self.absolute += other.absolute
        self.square += other.square
        self.maximum = max(self.maximum, other.maximum)
        self.beyond += other.beyond
        self.histogram += other.histogram

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready figures; px, shares 0 … 1. Medians are good to 0.001 px, within ±16 px."""
        n = self.count
        names = [f"share_over_{limit:g}_px" for limit in LIMITS]
        if not n:
            empty = ("mean_absolute", "median", "median_absolute", "bias", "rms", "max", *names)
            return {"count": 0, **dict.fromkeys(empty)}
        middle = BINS // 2
        folded = self.histogram[middle:].copy()
        folded[1:] += self.histogram[:middle][::-1]
        values = {
            "mean_absolute": self.absolute / n,
            "median": (_median_bin(self.histogram) - middle) * BIN,
            "median_absolute": _median_bin(folded) * BIN,
            "bias": self.total / n,
            "rms": float(np.sqrt(self.square / n)),
            "max": self.maximum,
            **{name: int(k) / n for name, k in zip(names, self.beyond)},
        }
        return {"count": n, **{name: round(value, 6) for name, value in values.items()}}


def _median_bin(histogram: NDArray[np.int64]) -> int:
    total = np.cumsum(histogram)
    return int(np.searchsorted(total, (total[-1] + 1) // 2))


def median_and_nmad(errors: Floats) -> tuple[float, float]:
    """Median and normalised median absolute deviation (1.4826 MAD) of errors."""
    median = float(np.median(errors))
    return median, 1.4826 * float(np.median(np.abs(errors - median)))
