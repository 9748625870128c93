"""Which blocks of a surface the images of a site show, and what part of each.

A block is a square of ground cells on the global lattice. Of one that images show in part, the
surface has the triangles in the smallest box around what they may show.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..lidar.lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from ..lidar.point_store import PointStore
from .scale import PART, SurfaceScale

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Number = tuple[int, int]
Box = tuple[Number, Number]

SQUARES = 8  # along the side of a block, each of which images show or not


class ShownGround(Protocol):
    """The ground that the images of a site show."""

    def shows(self, lon: Floats, lat: Floats, height: Floats) -> Bools:
        """Whether an image shows places [n] (degrees, degrees, m)."""

    def may_show(self, boxes: Floats) -> Bools:
        """Whether an image may show something of boxes [n, 6] (west, south, lowest, east, north,
        highest)."""

    def box(self, heights: tuple[float, float]) -> tuple[float, float, float, float]:
        """West, south, east, north of what the images show between two heights, m."""


@dataclass(frozen=True, eq=False)
class ShownBlocks:
    """Blocks of ``side`` cells that images show of a ``ground``; without one, all that have points.

    ``low``, ``high`` int[n, 2]: first and last (lon, lat) of the point stores' cells, lattice
    steps; ``heights`` [n, 2]: of their lowest and highest point, m.
    """

    scale: SurfaceScale
    side: int
    ground: ShownGround | None
    low: Ints
    high: Ints
    heights: Floats

    @classmethod
    def of(
        cls,
        stores: Sequence[PointStore],
        scale: SurfaceScale,
        side: int,
        ground: ShownGround | None,
    ) -> ShownBlocks:
        """Of the points of stores."""
        cells = np.concatenate([np.stack([s.cell_col, s.cell_row], axis=1) for s in stores])
        heights = np.concatenate([s.cell_heights for s in stores]) * LATTICE_M
        low = cells << CELL_BITS
        return cls(scale, side, ground, low, low + (1 << CELL_BITS) - 1, heights)

    def numbers(self) -> list[Number]:
        """(row, col) of the blocks, in their order."""
        size = np.array(self.scale.cell) * self.side
        every = sorted(set().union(*map(_numbers, self.low // size, self.high // size)))
        if self.ground is None or not every:
            return every
        boxes = np.concatenate([self._boxes(number, 1) for number in every])
        return [number for number, visible in zip(every, self.ground.may_show(boxes)) if visible]

    def part(self, number: Number) -> Box:
        """Of a block that images may show: (col, row) of the first cell that they may show, and of
        that after the last one."""
        first = np.array(number[::-1]) * self.side
        low, high = first, first + self.side
        if self.ground is not None:
            visible = self.ground.may_show(self._boxes(number, SQUARES))
            corners = first + _squares(SQUARES)[visible] * (self.side // SQUARES)
            if len(corners):
                low, high = corners.min(axis=0), corners.max(axis=0) + self.side // SQUARES
        return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))

    def _boxes(self, number: Number, squares: int) -> Floats:
        """Boxes [n, 6] (as of :meth:`ShownGround.may_show`) of the triangles whose first vertex
        lies in each of the ``squares`` along the side of a block."""
        cell, size = np.array(self.scale.cell), self.side // squares
        reach = np.ceil(self.scale.height_reach / PART)
        corners = np.array(number[::-1]) * self.side + _squares(squares) * size
        low, high = (corners - reach) * cell, (corners + size + reach) * cell
        around = (self.low <= high.max(axis=0)) & (self.high >= low.min(axis=0))
        heights = self.heights[around.all(axis=1)]
        boxes = np.empty((len(corners), 6))
        boxes[:, :2], boxes[:, 3:5] = low * LATTICE_DEG, high * LATTICE_DEG
        boxes[:, 2], boxes[:, 5] = heights[:, 0].min(), heights[:, 1].max()
        return boxes


def _squares(squares: int) -> Ints:
    """(col, row) [n, 2] of the squares of a block."""
    return np.stack(np.mgrid[:squares, :squares], axis=-1).reshape(-1, 2)


def _numbers(first: Ints, last: Ints) -> Iterator[Number]:
    """Of blocks between two (col, row)."""
    for col in range(int(first[0]), int(last[0]) + 1):
        for row in range(int(first[1]), int(last[1]) + 1):
            yield row, col
