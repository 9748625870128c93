"""What makes a method's results doubtful before their scores are read: sign, nodata, range."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.products.rasters import OFTEN

TURNED = 0.5  # EPE of −d to that of d, below which the sign is in doubt
OUTSIDE_SHARE = 0.01  # of the values
ONE_VALUE_SHARE = 0.5  # of the values outside the range, that are one and the same


@dataclass
class Doubts:
    """Sums over the pairs of a method. ``disparity_range``: px, [first, last)."""

    disparity_range: tuple[int, int]
    scored: int = 0
    error_px: float = 0.0
    turned_error_px: float = 0.0
    values: int = 0
    outside: int = 0
    repeated: Counter[float] = field(default_factory=Counter)
    zeros: int = 0
    near_zero: int = 0  # within a px, and not zero
    least: float = np.inf
    most: float = -np.inf

    def add(self, disparity: NDArray[np.float32], truth: NDArray[Any]) -> None:
        """Add a pair: disparity and truth [h, w] px, NaN where there is none."""
        both = np.isfinite(disparity) & np.isfinite(truth)
        found, exact = disparity[both].astype(np.float64), truth[both].astype(np.float64)
        self.scored += found.size
        self.error_px += float(np.abs(found - exact).sum())
        self.turned_error_px += float(np.abs(-found - exact).sum())
        values = disparity[np.isfinite(disparity)]
        if values.size:
            self.least = min(self.least, float(values.min()))
            self.most = max(self.most, float(values.max()))
        low, high = self.disparity_range
        outside = values[(values < low) | (values >= high)]
        self.values += values.size
        self.zeros += int((values == 0).sum())
        self.near_zero += int(((values != 0) & (np.abs(values) <= 1.0)).sum())
        self.outside += outside.size
        if outside.size:
            each, count = np.unique(outside, return_counts=True)
            self.repeated[float(each[count.argmax()])] += int(count.max())

    @property
    def constant_px(self) -> float | None:
        """The one disparity that a method returns everywhere; None of more than one."""
        return self.least if self.least == self.most else None

    def lines(self) -> list[str]:
        """A sentence for each doubt."""
        found = []
        if self.constant_px is not None:
            found.append(f"returns the constant {self.constant_px:g} px everywhere")
        if self.turned_error_px < TURNED * self.error_px:
            turned, epe = self.turned_error_px / self.scored, self.error_px / self.scored
            found.append(f"−d would score {turned:.3g} px, d scores {epe:.3g}: is the sign turned?")
        if self.outside > OUTSIDE_SHARE * self.values:
            low, high = self.disparity_range
            where = f"outside [{low}, {high}) px".replace("-", "−")
            value, count = self.repeated.most_common(1)[0]
            if count > ONE_VALUE_SHARE * self.outside:
                found.append(
                    f"{100 * count / self.values:.2g} % of the values are {value:g}, {where}: "
                    "is that nodata? Write NaN for it, or declare it as the dataset's nodata"
                )
            else:
                share = 100 * self.outside / self.values
                found.append(f"{share:.2g} % of the values lie {where}")
        if self.zeros > max(OUTSIDE_SHARE * self.values, OFTEN * self.near_zero):
            found.append(
                f"{100 * self.zeros / self.values:.2g} % of the values are exactly 0, and hardly "
                "any is near it: is that nodata? Write NaN for it"
            )
        return found
