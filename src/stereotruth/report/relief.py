"""The surface of a tile's labels as the grid that the page's 3-D view draws."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TOP = 255  # of the values of a grid; 0 is no label


@dataclass(frozen=True)
class Relief:
    """Heights of a tile, for the page.

    ``values``: base64 of uint8[side, side], 0 without a label, else 1 at the lowest label to 255 at
    the highest. ``height``: between these two, in widths of the tile.
    """

    values: str
    side: int
    height: float

    @classmethod
    def of(cls, disparity: NDArray[np.floating], base_to_height: float, side: int) -> Relief:
        """Of disparity[rows, cols] in px, NaN without a label, at ``side`` places along each axis.

        Labels beyond the permille at either end are drawn there.
        """
        rows, cols = (np.linspace(0, n - 1, side).round().astype(int) for n in disparity.shape)
        known = np.isfinite(disparity)
        low, high = (float(v) for v in np.percentile(disparity[known], (0.1, 99.9)))
        span = max(high - low, 1e-6)
        share = np.clip((np.nan_to_num(disparity[np.ix_(rows, cols)]) - low) / span, 0.0, 1.0)
        values = np.where(known[np.ix_(rows, cols)], np.rint(1 + (TOP - 1) * share), 0)
        text = base64.b64encode(values.astype(np.uint8).tobytes()).decode("ascii")
        return cls(text, side, (high - low) / base_to_height / disparity.shape[1])
