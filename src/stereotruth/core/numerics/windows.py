"""Sums and greatest values over squares of a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..kernels import kernel


def summed_area(values: NDArray[Any]) -> NDArray[Any]:
    """Table [h + 1, w + 1] of the sums of ``values`` [h, w] above and to the left of each corner.

    Whole numbers and booleans are summed as int64 and exactly, others as float64.
    """
    shape = values.shape[0] + 1, values.shape[1] + 1
    table = np.zeros(shape, np.int64 if _is_whole(values) else np.float64)
    np.cumsum(values, axis=0, out=table[1:, 1:])
    np.cumsum(table[1:, 1:], axis=1, out=table[1:, 1:])
    return table


def _is_whole(values: NDArray[Any]) -> bool:
    return np.issubdtype(values.dtype, np.integer) or values.dtype == np.bool_


@kernel
def _running_sums(values: NDArray[Any], size: int, out: NDArray[np.int64]) -> None:
    """Fills ``out`` with the sums of all squares of whole numbers."""
    rows, cols = values.shape
    of_column = np.zeros(cols, np.int64)
    for y in range(rows):
        for x in range(cols):
            of_column[x] += values[y, x]
        if y >= size:
            for x in range(cols):
                of_column[x] -= values[y - size, x]
        if y < size - 1:
            continue
        total, sums = np.int64(0), out[y - size + 1]
        for x in range(size - 1):
            total += of_column[x]
        for x in range(sums.size):
            total += of_column[x + size - 1]
            sums[x] = total
            total -= of_column[x]


def window_sums(values: NDArray[Any], size: int) -> NDArray[Any]:
    """Sums [h - size + 1, w - size + 1] of all squares of ``size`` x ``size`` values.

    Empty along an axis that is shorter than a square.
    """
    rows, cols = (max(n - size + 1, 0) for n in values.shape)
    if _is_whole(values):
        out = np.empty((rows, cols), np.int64)
        if out.size:
            _running_sums(values, size, out)
        return out
    table = summed_area(values)
    upper, lower = table[:rows], table[size : size + rows]
    left, right = np.s_[:, :cols], np.s_[:, size : size + cols]
    return lower[right] - upper[right] - lower[left] + upper[left]


def box_max(values: NDArray[Any], reach: int) -> NDArray[Any]:
    """Maximum [h, w] over squares of 2 * reach + 1 of ``values`` [h, w], cut off at the edges.

    By doubling: each step takes the maximum of two runs of rows.
    """
    size = 2 * reach + 1
    for axis in (0, 1):
        # what is repeated beyond an edge lies in the same squares as the edge
        pad = [(reach, reach) if a == axis else (0, 0) for a in (0, 1)]
        out = np.moveaxis(np.pad(values, pad, mode="edge"), axis, 0)
        width = 1
        while width < size:
            step = min(width, size - width)
            out = np.maximum(out[:-step], out[step:])
            width += step
        values = np.moveaxis(out, 0, axis)
    return np.ascontiguousarray(values)
