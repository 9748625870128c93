"""The spread of two results for the same pixels as a standard uncertainty."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

WINDOW_PX = 5


def spread(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """Standard uncertainty [h, w] px of either of two independent disparities [h, w] px.

    The difference of the two has a √2 times larger standard deviation than each; it is taken as the
    root mean square over windows of ``WINDOW_PX`` around each pixel, where both are finite. NaN
    where the first is, or no pixel of the window has both.
    """
    both = np.isfinite(first) & np.isfinite(second)
    square = np.where(both, first - second, np.float32(0)).astype(np.float32) ** 2
    size = (WINDOW_PX, WINDOW_PX)
    total, count = (
        cv2.boxFilter(
            of.astype(np.float32), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        for of in (square, both)
    )
    known = np.isfinite(first) & (count > 0.5)
    sigma = np.sqrt(np.maximum(total, 0) / (2 * np.maximum(count, 1)))
    return np.where(known, sigma, np.float32(np.nan)).astype(np.float32)
