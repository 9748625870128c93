"""The part of the ground whose triangles are wanted: those of a surface's blocks are more than a
window sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from .scale import PART_BITS
from .vertices import Vertices

Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

SQUARE_BITS = PART_BITS + 4  # of parts of a cell: squares of 16 cells


@kernel
def _touching(x: Ints, y: Ints, corner: Steps, start: int, squares: Bools) -> Bools:
    """Which triangles' bounding boxes touch one of the ``squares``."""
    out = np.zeros(len(corner), np.bool_)
    for t in range(len(corner)):
        a, b, c = start + corner[t, 0], start + corner[t, 1], start + corner[t, 2]
        west, east = min(x[a], x[b], x[c]) >> SQUARE_BITS, max(x[a], x[b], x[c]) >> SQUARE_BITS
        south, north = min(y[a], y[b], y[c]) >> SQUARE_BITS, max(y[a], y[b], y[c]) >> SQUARE_BITS
        for j in range(south, north + 1):
            for i in range(west, east + 1):
                out[t] |= squares[j, i]
    return out


@dataclass(frozen=True, eq=False)
class Region:
    """``squares`` bool [rows, cols] of the ground, from the vertices' origin, that are wanted."""

    squares: Bools

    def touching(self, vertices: Vertices, corner: Steps, start: int) -> Bools:
        """Which triangles [m, 3] lie in the region at least in part; their corners count from the
        vertex ``start``."""
        return _touching(vertices.x, vertices.y, corner, start, self.squares)
