"""The points of a window in the order of its pixels.

Points arrive in the order of the store, are projected, and those in both frames are sorted by pixel
(a counting sort), so that all that follows goes through memory once, pixel by pixel, and finds the
points of a pixel's neighbours at once. Places in the images are integers of 2**-16 px from there
on (rounded by 8e-6 px at most): sums are exact and comparisons the same in every window.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from .image_patches import MASKED, USABLE, Patch

Ints = NDArray[np.int64]
Records = NDArray[np.void]
Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Counts = NDArray[np.int32]


BITS = 16
PX = 1 << BITS  # steps per px
_PART = 1 << 20  # points that are collected in one piece
POINT = np.dtype(
    [
        ("disparity", np.int32),  # steps
        ("lon", np.int32),  # lattice steps from the window's origin
        ("lat", np.int32),
        ("height", np.int32),  # lattice steps
        ("u", np.int16),  # steps from the pixel's centre, in the left image
        ("v", np.int16),
        ("parallax", np.int16),  # y_right - y_left, steps; half a pixel at most
        ("surface_class", np.uint8),
        ("day", np.uint8),  # number among the days of the scene's points
    ],
    align=True,  # 24 bytes
)


@dataclass(frozen=True, eq=False)
class PixelPoints:
    """Points of a window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``.

    ``points`` POINT[n] are those in both frames; pixel p (row-major) has those from ``start[p]`` to
    ``start[p + 1]``. ``outside`` [pixels]: number of points that are not in both frames;
    ``masked`` bool[pixels]: whether a mask hides one of them.
    ``origin``: lattice (lon, lat) from which the points count.
    """

    points: Records
    start: Ints
    outside: NDArray[np.int32]
    masked: NDArray[np.bool_]
    shape: tuple[int, int]
    first: tuple[int, int]
    origin: tuple[int, int]

    @cached_property
    def count(self) -> NDArray[np.int32]:
        """Number of points in both frames by pixel, [rows, cols]."""
        return np.diff(self.start).astype(np.int32).reshape(self.shape)


class _Block(NamedTuple):
    """Points [n]: lattice coordinates, ASPRS class, number of the day, ``xy`` [4, n] (px) in both
    images."""

    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    surface_class: Bytes
    day: Bytes
    xy: Floats


class _Frames(NamedTuple):
    """A window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``; lattice (lon,
    lat) ``origin`` from which points count; pixels of both patches that are ``usable``, and the
    pixel at the ``origin`` of each patch."""

    shape: tuple[int, int]
    first: tuple[int, int]
    origin: tuple[int, int]
    left: Bytes
    right: Bytes
    left_origin: tuple[int, int]
    right_origin: tuple[int, int]


class _Pixels(NamedTuple):
    """Per pixel: ``count`` [pixels + 1] of the points in both frames, from the second element on;
    number of those ``outside``, whether a mask hides one."""

    count: Counts
    outside: Counts
    masked: NDArray[np.bool_]


@kernel
def _take(block: _Block, frames: _Frames, points: Records, pixel: Counts, pixels: _Pixels) -> int:
    """Fills ``points`` and ``pixel`` with those in both frames; returns how many these are."""
    lon_q, lat_q, h_q, xy = block.lon_q, block.lat_q, block.h_q, block.xy
    surface_class, day = block.surface_class, block.day
    shape, first, origin = frames.shape, frames.first, frames.origin
    left, right = frames.left, frames.right
    left_origin, right_origin = frames.left_origin, frames.right_origin
    count, outside, masked = pixels.count, pixels.outside, pixels.masked
    n = 0
    half = PX // 2
    low_x, low_y = first[1] - 1.0, first[0] - 1.0
    high_x, high_y = float(first[1] + shape[1]), float(first[0] + shape[0])
    for k in range(lon_q.size):
        x, y, x_right, y_right = xy[0, k], xy[1, k], xy[2, k], xy[3, k]
        if not (low_x < x < high_x and low_y < y < high_y and np.isfinite(x_right)):
            continue
        u, v = np.int64(np.rint(x * PX)), np.int64(np.rint(y * PX))
        col, row = (u + half) >> BITS, (v + half) >> BITS
        i, j = col - first[1], row - first[0]
        if i < 0 or j < 0 or i >= shape[1] or j >= shape[0]:
            continue
        p = j * shape[1] + i
        # The test is of the places as rounded: what is read later lies in the frame.
        u_right = np.int64(np.rint(x_right * PX))
        shift = min(max(np.int64(np.rint(y_right * PX)) - v, -half), half - 1)
        # In line: as a function that takes arrays, it took 20 of 29 ns.
        c, r = (u >> BITS) - left_origin[1], (v >> BITS) - left_origin[0]
        d, q = (u_right >> BITS) - right_origin[1], (v + shift >> BITS) - right_origin[0]
        framed = 0 <= r < left.shape[0] and 0 <= c < left.shape[1]
        framed = framed and 0 <= q < right.shape[0] and 0 <= d < right.shape[1]
        if framed:
            in_left, in_right = left[np.uint64(r), np.uint64(c)], right[np.uint64(q), np.uint64(d)]
            framed = in_left & in_right == USABLE
            masked[p] |= (in_left | in_right) & MASKED != 0
        if not framed:
            outside[p] += 1
            continue
        point = points[n]
        point.disparity = u - u_right
        point.lon = lon_q[k] - origin[0]
        point.lat = lat_q[k] - origin[1]
        point.height = h_q[k]
        point.u = u - (col << BITS)
        point.v = v - (row << BITS)
        point.parallax = shift
        point.surface_class = surface_class[k]
        point.day = day[k]
        pixel[n] = p
        count[p + 1] += 1
        n += 1
    return n


@kernel
def _scatter(points: Records, pixel: Counts, cursor: Ints, out: Records) -> None:
    """Points [n] to the next free element of their ``pixel``, which ``cursor`` counts."""
    for k in range(pixel.size):
        out[cursor[pixel[k]]] = points[k]
        cursor[pixel[k]] += 1


@dataclass(eq=False)
class Collection:
    """Takes the points of a window, block by block."""

    shape: tuple[int, int]
    first: tuple[int, int]
    origin: tuple[int, int]
    left: Patch
    right: Patch
    parts: list[tuple[Records, NDArray[np.int32]]] = field(default_factory=list)
    taken: int = 0  # of the last part

    def __post_init__(self) -> None:
        size = self.shape[0] * self.shape[1]
        count, outside = (np.zeros(n, dtype=np.int32) for n in (size + 1, size))
        self.pixels = _Pixels(count, outside, np.zeros(size, dtype=np.bool_))
        self.frames = _Frames(
            self.shape,
            self.first,
            self.origin,
            self.left.usable,
            self.right.usable,
            (self.left.row, self.left.col),
            (self.right.row, self.right.col),
        )

    def add(
        self, lon_q: Ints, lat_q: Ints, h_q: Ints, surface_class: Bytes, day: Bytes, xy: Floats
    ) -> None:
        """Points by lattice coordinates, class and number of the day, and where they are seen:
        ``xy`` [4, n], px."""
        if not self.parts or self.taken + lon_q.size > self.parts[-1][1].size:
            self._close()
            size = max(_PART, lon_q.size)
            self.parts.append((np.empty(size, dtype=POINT), np.empty(size, dtype=np.int32)))
        points, pixel = (array[self.taken :] for array in self.parts[-1])
        block = _Block(lon_q, lat_q, h_q, surface_class, day, xy)
        self.taken += _take(block, self.frames, points, pixel, self.pixels)

    def _close(self) -> None:
        if self.parts:
            self.parts[-1] = tuple(array[: self.taken] for array in self.parts[-1])
        self.taken = 0

    def sorted(self) -> PixelPoints:
        """All that was taken; empties the collection."""
        self._close()
        start = np.cumsum(self.pixels.count, dtype=np.int64)
        points = np.empty(int(start[-1]), dtype=POINT)
        cursor = start[:-1].copy()
        for part in range(len(self.parts)):
            _scatter(*self.parts[part], cursor, points)
            self.parts[part] = None
        self.parts = []
        outside, masked = self.pixels.outside, self.pixels.masked
        return PixelPoints(points, start, outside, masked, self.shape, self.first, self.origin)
