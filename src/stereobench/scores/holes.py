"""Invalid pixels of a disparity map, filled so that methods with and without holes compare.

As in the KITTI benchmark's development kit: along each row, an invalid pixel takes the disparity of
the nearest valid pixels on its two sides, of two that of the one further down, since most
invalid pixels are hidden behind what is higher; beside the outermost valid pixels there is only
one. Rows without a valid pixel take those of the nearest row that has one, of two the upper; a map
without a valid pixel is filled with one value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Disparity = NDArray[np.float32]


def fill_holes(
    disparity: Disparity, default: float = 0.0, *, grows_with_height: bool = True
) -> Disparity:
    """A copy of a disparity map [h, w] without NaN.

    ``grows_with_height``: whether of two disparities the larger is the higher one. ``default``:
    the value of a map that has none.
    """
    rows = np.isfinite(disparity).any(axis=1)
    if not rows.any():
        return np.full_like(disparity, default)
    before, after = _along_rows(disparity), _along_rows(disparity[:, ::-1])[:, ::-1]
    lower = np.fmin if grows_with_height else np.fmax  # these pass NaN over
    filled = lower(before, after)
    return filled[_nearest(rows)]


def _along_rows(disparity: Disparity) -> Disparity:
    """The last valid disparity up to each pixel of a row; NaN before the first."""
    column = np.arange(disparity.shape[1])
    last = np.maximum.accumulate(np.where(np.isfinite(disparity), column, 0), axis=1)
    return np.take_along_axis(disparity, last, axis=1)


def _nearest(chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Index of the chosen element nearest to each; of two the first."""
    index = np.flatnonzero(chosen)
    position = np.arange(chosen.size)
    after = np.minimum(np.searchsorted(index, position), index.size - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(index[before] - position) <= np.abs(index[after] - position)
    return np.where(nearer, index[before], index[after])
