"""Ground that images see, by polygons and heights: which points and boxes belong to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels import kernel

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Footprint:
    """Ground that the images see, in the coordinate system and units of the points.

    ``rings``: float64[n, 2] each, the corners of a polygon without holes, in either direction; a
    point lies in the footprint if it lies in any of them and from ``lowest`` to ``highest``.
    """

    rings: tuple[Floats, ...]
    lowest: float = -np.inf
    highest: float = np.inf

    def touches(self, low: Floats, high: Floats) -> bool:
        """Whether a box of corners ``low`` and ``high`` [3] has a place in common with it."""
        if high[2] < self.lowest or low[2] > self.highest:
            return False
        return any(_touches(ring, low[0], low[1], high[0], high[1]) for ring in self.rings)

    def contains(self, xyz: Floats) -> NDArray[np.bool_]:
        """Which of the points [3, n] lie in it."""
        inside = np.zeros(xyz.shape[1], np.bool_)
        for ring in self.rings:
            _mark(np.ascontiguousarray(ring, np.float64), xyz[0], xyz[1], inside)
        return inside & (xyz[2] >= self.lowest) & (xyz[2] <= self.highest)


@kernel
def _mark(ring: Floats, x: Floats, y: Floats, inside: NDArray[np.bool_]) -> None:
    """Set ``inside`` where an odd number of the ring's sides lies to the right of a point."""
    n = ring.shape[0]
    west, south, east, north = ring[0, 0], ring[0, 1], ring[0, 0], ring[0, 1]
    for i in range(n):
        west, east = min(west, ring[i, 0]), max(east, ring[i, 0])
        south, north = min(south, ring[i, 1]), max(north, ring[i, 1])
    for k in range(x.size):
        if x[k] < west or x[k] > east or y[k] < south or y[k] > north:
            continue
        odd = False
        j = n - 1
        for i in range(n):
            ax, ay, bx, by = ring[i, 0], ring[i, 1], ring[j, 0], ring[j, 1]
            if (ay > y[k]) != (by > y[k]) and x[k] < (bx - ax) * (y[k] - ay) / (by - ay) + ax:
                odd = not odd
            j = i
        inside[k] |= odd


def _touches(ring: Floats, west: float, south: float, east: float, north: float) -> bool:
    """Whether a polygon and a box have a point in common; their borders belong to them."""
    x, y = ring.T
    if x.max() < west or x.min() > east or y.max() < south or y.min() > north:
        return False
    if ((x >= west) & (x <= east) & (y >= south) & (y <= north)).any():
        return True
    inside = np.zeros(1, np.bool_)
    corner = np.array([west]), np.array([south])
    _mark(np.ascontiguousarray(ring, np.float64), *corner, inside)
    return bool(inside[0]) or _sides_cross(x, y, west, south, east, north)


def _sides_cross(
    x: Floats, y: Floats, west: float, south: float, east: float, north: float
) -> bool:
    """Whether a side of a polygon crosses a box: the part of it within the box is not empty."""
    ax, ay = np.roll(x, 1), np.roll(y, 1)
    first, last = np.zeros(x.size), np.ones(x.size)
    for start, step, low, high in ((ax, x - ax, west, east), (ay, y - ay, south, north)):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sort([(low - start) / step, (high - start) / step], axis=0)
        along = step == 0
        within = (start >= low) & (start <= high)
        first = np.maximum(first, np.where(along, np.where(within, 0, np.inf), t[0]))
        last = np.minimum(last, np.where(along, np.where(within, 1, -np.inf), t[1]))
    return bool((first <= last).any())
