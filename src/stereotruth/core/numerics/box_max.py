"""The greatest value of a grid up to some steps around each of its places."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


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
