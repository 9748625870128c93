"""Labels on pixels that the right view cannot see, by the labels' own geometry.

Along a row, x_right = x − d of a surface that both views see grows with x. Where it folds back, two
places of the left image meet on one column of the right, walls included, and the one in front hides
the other: with heights that grow with d, that is the pixel of larger d; it lies to the right. With
heights that fall with d (left and right views the other way round), it is that of smaller d, to the
left. Which of the two a dataset has, its images tell: what is hidden does not correlate.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.kernels import kernel
from stereotruth.epipolar.surface_windows import surface_correlation
from stereotruth.epipolar.warping import warp_rows

from .estimates import Estimate, cells, location

Bools = NDArray[np.bool_]


TOLERANCE_PX = 1.0  # labels that are right to some tenths of a px fold by less
WINDOW = 9  # px
CLEAR = 0.15  # of correlation: crowns fold, too, and what lies below them is seen as well or better
LARGER, SMALLER = "larger", "smaller"


@kernel
def _behind(labels: NDArray, tolerance: float, larger: bool, out: Bools) -> None:
    rows, cols = labels.shape
    for y in range(rows):
        reach = np.inf
        for k in range(cols):
            x = cols - 1 - k if larger else k
            d = labels[y, x]
            out[y, x] = False
            if np.isnan(d):
                continue
            at = x - d if larger else d - x
            out[y, x] = at > reach + tolerance
            reach = min(reach, at)


def hidden_labels(labels: NDArray[Any], nearer: str = LARGER) -> Bools:
    """Labels [h, w] (px, NaN: none) that others of their row hide from the right view.

    ``nearer``: whether larger or smaller disparities are in front.
    """
    out = np.empty(labels.shape, np.bool_)
    _behind(np.asarray(labels, np.float64), TOLERANCE_PX, nearer == LARGER, out)
    return out


def who_is_in_front(left: NDArray[Any], right: NDArray[Any], labels: NDArray[Any]) -> Estimate:
    """How much better the larger disparities of folds correlate than the smaller ones do.

    Above zero: larger disparities are in front. ``left``, ``right`` float32[h, w], 0 is nodata.
    Unknown where too few labels fold.
    """
    far, near = hidden_labels(labels, LARGER), hidden_labels(labels, SMALLER)
    far, near = far & ~near, near & ~far
    disparity = np.asarray(labels, np.float64)
    warped = warp_rows(right, np.arange(labels.shape[1])[None, :] - disparity)
    flat = np.zeros((2, *labels.shape), np.float32)
    correlation = surface_correlation(left, warped, disparity, flat, WINDOW)
    known = np.isfinite(correlation)
    y, x = np.nonzero((near | far) & known)
    group = cells(x.astype(float), y.astype(float))
    sign, value = np.where(near[y, x], 1.0, -1.0), correlation[y, x]
    shared = np.intersect1d(group[sign > 0], group[sign < 0])
    differences = [
        float(
            value[(group == cell) & (sign > 0)].mean() - value[(group == cell) & (sign < 0)].mean()
        )
        for cell in shared
    ]
    return location(np.array(differences), shared)
