"""Sums over all rectangles of a grid by one table of sums from its upper left corner."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def summed_area(values: NDArray[Any]) -> NDArray[Any]:
    """Table [h + 1, w + 1] of the sums of ``values`` [h, w] above and to the left of each corner.

    Whole numbers and booleans are summed as int64 and exactly, others as float64.
    """
    whole = np.issubdtype(values.dtype, np.integer) or values.dtype == np.bool_
    table = np.zeros((values.shape[0] + 1, values.shape[1] + 1), np.int64 if whole else np.float64)
    np.cumsum(values, axis=0, out=table[1:, 1:])
    np.cumsum(table[1:, 1:], axis=1, out=table[1:, 1:])
    return table


def window_sums(values: NDArray[Any], size: int) -> NDArray[Any]:
    """Sums [h - size + 1, w - size + 1] of all squares of ``size`` x ``size`` values.

    Empty along an axis that is shorter than a square.
    """
    table = summed_area(values)
    rows, cols = (max(n - size, 0) for n in table.shape)
    upper, lower = table[:rows], table[size : size + rows]
    left, right = np.s_[:, :cols], np.s_[:, size : size + cols]
    return lower[right] - upper[right] - lower[left] + upper[left]
