"""The distribution of a method's errors: the share of pixels below each of many limits.

Counted are the pixels of the tables, all labelled ones with holes filled: at a threshold of D1 the
share is one less D1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

LIMITS_PX = (*np.arange(5, 100, 5) / 100, *np.arange(10, 50) / 10, *np.arange(10, 41) / 2)


class Cumulative:
    """Counts of absolute errors in px, to which tiles are added."""

    def __init__(self, thresholds_px: Sequence[float] = ()) -> None:
        self.limits = np.unique(np.round([*LIMITS_PX, *thresholds_px], 6))
        self._counts = np.zeros(self.limits.size + 1, np.int64)

    def add(self, error: NDArray[np.floating[Any]]) -> None:
        """Count absolute errors (px, all finite)."""
        place = np.searchsorted(self.limits, np.asarray(error).ravel(), side="left")
        self._counts += np.bincount(place, minlength=self._counts.size)

    def rows(self) -> list[dict[str, float]]:
        """Rows of ``cumulative.csv``: limit, share of the pixels whose error is not above it."""
        total = max(int(self._counts.sum()), 1)
        shares = np.cumsum(self._counts)[:-1] / total
        return [
            {"error_px": float(limit), "share": round(float(share), 6)}
            for limit, share in zip(self.limits, shares)
        ]
