"""How a scene is cut into overlapping blocks, and the pieces of both images that a block sees."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Place = tuple[int, int]
Window = tuple[slice, slice]
DisparityRange = tuple[int, int]


BLOCK_PX = 1024
OVERLAP_PX = 64
PHASE_PX = 64  # parts begin at multiples: networks, on reduced grids, see all tiles in one phase


@dataclass(frozen=True)
class Tiling:
    """Blocks of ``block`` px over a grid of ``shape``; tiles reach ``overlap`` px further.

    Places (i, j) count blocks along rows and columns. Raises ValueError if the overlap is more
    than half a block: no more than two tiles may meet along an axis.
    """

    shape: tuple[int, int]
    block: int = BLOCK_PX
    overlap: int = OVERLAP_PX

    def __post_init__(self) -> None:
        if not 0 <= 2 * self.overlap <= self.block:
            raise ValueError(f"overlap of {self.overlap} px for blocks of {self.block} px")

    @property
    def count(self) -> tuple[int, int]:
        """Number of blocks along rows and columns."""
        return -(-self.shape[0] // self.block), -(-self.shape[1] // self.block)

    @property
    def side(self) -> int:
        """Of a tile, px."""
        return self.block + 2 * self.overlap

    def places(self) -> Iterator[Place]:
        """All (i, j) in row-major order."""
        return ((i, j) for i in range(self.count[0]) for j in range(self.count[1]))

    def around(self, place: Place) -> list[Place]:
        """The places whose tiles reach into a block, its own among them."""
        ranges = (range(max(k - 1, 0), min(k + 2, n)) for k, n in zip(place, self.count))
        rows, cols = ranges
        return [(i, j) for i in rows for j in cols]

    def block_window(self, place: Place) -> Window:
        """[row, col] of a block."""
        starts = [k * self.block for k in place]
        return tuple(slice(s, min(s + self.block, n)) for s, n in zip(starts, self.shape))

    def common_window(self, place: Place, other: Place) -> Window:
        """[row, col] of what the tiles at two places have in common."""
        both = zip(self.tile_window(place), self.tile_window(other), self.shape)
        return tuple(slice(max(a.start, b.start, 0), min(a.stop, b.stop, n)) for a, b, n in both)

    def tile_window(self, place: Place) -> Window:
        """[row, col] of a tile; it may reach beyond the grid."""
        starts = [k * self.block - self.overlap for k in place]
        return tuple(slice(s, s + self.side) for s in starts)


@dataclass(frozen=True)
class View:
    """What a method needs to see of both images, [row, col] of each; the same shape.

    ``left`` may reach beyond the left image and ``right`` beyond the right one. ``inner`` is the
    wanted window within it.
    """

    left: Window
    right: Window
    inner: Window


def view_of(
    shape: tuple[int, int],
    window: Window,
    margin: int,
    disparity_range: DisparityRange,
    offset: int,
) -> View:
    """The view for a window of the left grid, cut to where one of the images has pixels."""
    rows, cols = window
    low, high = disparity_range
    top, bottom = max(rows.start - margin, 0), min(rows.stop + margin, shape[0])
    first = max(cols.start - margin - max(high, 0), min(0, offset))
    top, first = (start // PHASE_PX * PHASE_PX for start in (top, first))
    last = min(cols.stop + margin + max(-low, 0), shape[1] + max(0, offset))
    return View(
        left=(slice(top, bottom), slice(first, last)),
        right=(slice(top, bottom), slice(first - offset, last - offset)),
        inner=(
            slice(max(rows.start, 0) - top, min(rows.stop, shape[0]) - top),
            slice(max(cols.start, 0) - first, min(cols.stop, shape[1]) - first),
        ),
    )


def inside(image: Any, window: Window) -> Any:
    """The part of an image [h, w] or [h, w, bands] (NumPy, Dask, Zarr) that a window meets."""
    rows, cols = window
    return image[
        max(rows.start, 0) : max(min(rows.stop, image.shape[0]), 0),
        max(cols.start, 0) : max(min(cols.stop, image.shape[1]), 0),
    ]


def extent_of(weights: NDArray[np.float64]) -> slice | None:
    """Where the weights are not 0."""
    found = np.flatnonzero(weights > 0.0)
    return slice(int(found[0]), int(found[-1]) + 1) if found.size else None
