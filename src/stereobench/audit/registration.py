"""Do the labels lie on the pixels that they belong to?

Labels moved by a pixel or two against their image hardly change where surfaces are smooth: no match
tells. They do beside steps. There, the left image is compared with the right one as brought to it
by the labels, and by the labels moved up, down, left and right: the squared difference is least
where the labels belong.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereotruth.core.kernels import kernel

from .estimates import NOTHING, Estimate, cells, ratio

Picture = NDArray[np.float32]
Floats = NDArray[np.float64]


STEP_PX = 1.5  # of labels within NEAR_PX of a pixel
NEAR_PX = 3
FARTHEST_PX = 3
MIN_PIXELS = 2000
SHIFTS = [
    (x, y)
    for far in range(1, FARTHEST_PX + 1)
    for x, y in ((far, 0), (-far, 0), (0, far), (0, -far))
]


def _near_steps(labels: Picture) -> NDArray[np.bool_]:
    known = np.isfinite(labels)
    kernel = np.ones((2 * NEAR_PX + 1,) * 2, np.uint8)
    high = cv2.dilate(np.where(known, labels, np.float32(-1e6)), kernel)
    low = cv2.erode(np.where(known, labels, np.float32(1e6)), kernel)
    return known & (high - low >= STEP_PX)


def _alike(image: Picture) -> Picture:
    """Of mean 0 and unit standard deviation."""
    found = (image - image.mean()) / max(float(image.std()), 1e-6)
    return np.ascontiguousarray(found, np.float32)


@kernel
def _miss(
    left: Picture, right: Picture, labels: Picture, at: NDArray, x: int, y: int, out: Floats
) -> None:
    """Squared differences of left and warped right image at pixels (row, col) ``at`` [n, 2].

    The labels are moved x px to the right and y px down; NaN where there is none.
    """
    rows, cols = left.shape
    for k in range(at.shape[0]):
        out[k] = np.nan
        row, col = at[k, 0], at[k, 1]
        if row - y < 0 or row - y >= rows or col - x < 0 or col - x >= cols:
            continue
        place = col - labels[row - y, col - x]
        if not (place >= 1.0 and place <= cols - 3.0):
            continue
        i = int(place)
        f = place - i
        a, b, c, d = right[row, i - 1], right[row, i], right[row, i + 1], right[row, i + 2]
        there = b + 0.5 * f * (
            c - a + f * (2.0 * a - 5.0 * b + 4.0 * c - d + f * (3.0 * (b - c) + d - a))
        )
        out[k] = (left[row, col] - there) ** 2


def better_place(
    left: NDArray[np.float32], right: NDArray[np.float32], labels: NDArray[Any]
) -> tuple[tuple[int, int], Estimate]:
    """The best move (x, y) of the labels other than none, and what it takes off the difference.

    The latter as share of the squared difference without a move: below zero where labels belong.
    ``left``, ``right``: smoothed, their rows correspond. Unknown where there are too few steps.
    """
    labels = np.ascontiguousarray(labels, np.float32)
    left, right = _alike(left), _alike(right)
    at = np.argwhere(_near_steps(labels))
    here, there = np.empty(len(at)), np.empty(len(at))
    _miss(left, right, labels, at, 0, 0, here)
    best, gain = (0, 0), NOTHING
    for x, y in SHIFTS:
        _miss(left, right, labels, at, x, y, there)
        known = np.isfinite(here) & np.isfinite(there)
        if known.sum() < MIN_PIXELS:
            continue
        rows, cols = at[known].T.astype(float)
        a, b = here[known], there[known]
        # a car or a shadow that only one image has must not decide
        top = np.percentile(a, 99)
        a, b = np.minimum(a, top), np.minimum(b, top)
        found = ratio(a - b, a, cells(cols, rows))
        if not found.value <= gain.value:
            best, gain = (x, y), found
    return best, gain
