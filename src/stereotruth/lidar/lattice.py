"""The global lattice of the points, its cells, and ground as whole cells.

The lattice has steps of 1e-9 degree and 1e-4 m. Point stores keep points by square cells of it
(:mod:`.ingest`). The store of a footprint is that of the whole file without the cells outside, to
the byte: so nothing that is read from a cell depends on how much of the file was read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ..core.errors import InputError
from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.geometry import DEGREE_M, metres_per_degree

Box = tuple[float, float, float, float]

LATTICE_DEG = 1e-9
LATTICE_M = 1e-4
PER_DEG = 10**9
PER_M = 10**4
CELL_BITS = 20
CELL_DEG = (1 << CELL_BITS) * LATTICE_DEG
FAR = 0.5  # degrees; no survey lies that far from the images that it was ordered for


def cell_key(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """One int64 that sorts cells by row, then column."""
    return (np.asarray(row, np.int64) << 32) + (np.asarray(col, np.int64) + (1 << 30))


def lattice_box(
    lon_min: float, lat_min: float, lon_max: float, lat_max: float
) -> tuple[int, int, int, int]:
    """The lattice points q with minimum <= q / 1e9 <= maximum (in float64), as inclusive limits."""

    def lowest(limit: float) -> int:
        q = math.ceil(limit * PER_DEG)
        while (q - 1) / PER_DEG >= limit:
            q -= 1
        while q / PER_DEG < limit:
            q += 1
        return q

    west, south, east, north = (
        min(max(float(value), -1000.0), 1000.0) for value in (lon_min, lat_min, lon_max, lat_max)
    )
    return lowest(west), lowest(south), -lowest(-east), -lowest(-north)


@dataclass(frozen=True, eq=False)
class Footprint:
    """Ground whose points can have a say in labels.

    Cells of the lattice: ``held`` bool[rows, cols], the first of them at ``row``, ``col``.
    """

    row: int
    col: int
    held: Bools

    @classmethod
    def around(cls, outlines: Iterable[Floats], margin_m: float) -> Footprint:
        """The cells that lie within a margin of convex outlines, [2, n] lon and lat (degrees).

        Raises ValueError if there is no outline.
        """
        runs = []
        for outline in outlines:
            margin = margin_m / metres_per_degree(np.abs(outline[1]).max())
            runs += _runs(outline, *margin.tolist())
        return cls.of_runs(runs)

    @classmethod
    def of_runs(cls, runs: Sequence[Sequence[int]]) -> Footprint:
        """Of runs of cells: row, first and last column each. Raises ValueError without any."""
        table = np.array(runs, np.int64).reshape(-1, 3)
        if not table.size:
            raise ValueError("no cell")
        row, col = int(table[:, 0].min()), int(table[:, 1].min())
        shape = int(table[:, 0].max()) - row + 1, int(table[:, 2].max()) - col + 1
        held = np.zeros(shape, np.bool_)
        for at, first, last in table.tolist():
            held[at - row, first - col : last - col + 1] = True
        return cls(row, col, held)

    @property
    def runs(self) -> list[list[int]]:
        """The cells as runs of a row: row, first and last column each."""
        edges = np.diff(np.pad(self.held, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        rows, first = np.nonzero(edges == 1)
        _, behind = np.nonzero(edges == -1)
        return np.stack([rows + self.row, first + self.col, behind - 1 + self.col], axis=1).tolist()

    @property
    def area_m2(self) -> float:
        """Ground of its cells."""
        return float(self.held.sum(axis=1) @ self.cell_m2)

    @property
    def cell_m2(self) -> Floats:
        """Ground of a cell of each row, m²."""
        row = self.row + np.arange(self.held.shape[0])
        return (CELL_DEG * DEGREE_M) ** 2 * np.cos(np.radians((row + 0.5) * CELL_DEG))

    @cached_property
    def _sums(self) -> Ints:
        """Summed-area table of the cells."""
        return np.pad(self.held, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)

    def contains(self, lattice: Ints) -> Bools:
        """Which points lie in it: lattice longitude and latitude [2 or more, n]."""
        inside = np.empty(lattice.shape[1], np.bool_)
        _mark(lattice, self.held, self.row, self.col, inside)
        return inside

    def touches(self, boxes: Floats) -> Bools:
        """Which boxes [n, 4] (west, south, east, north, degrees) share a cell with it."""
        return self._count(boxes)[0] > 0

    def beyond_m2(self, boxes: Floats) -> float:
        """Ground of the cells of boxes [n, 4] that are not its own, each box of one row of cells.

        Boxes with a cell in common count it twice.
        """
        count, cells = self._count(boxes)
        lat = np.asarray(boxes)[:, 1]
        each = (CELL_DEG * DEGREE_M) ** 2 * np.cos(np.radians(lat))
        return float((cells - count) @ each)

    def _count(self, boxes: Floats) -> tuple[Ints, Ints]:
        """How many cells of boxes are its own, and how many there are."""
        at = np.floor(np.asarray(boxes, np.float64).reshape(-1, 4) / CELL_DEG)
        at = np.clip(at, -(2**31), 2**31).astype(np.int64)
        first, behind = at[:, [1, 0]].T, at[:, [3, 2]].T + 1  # row, column
        corner, shape = np.array([[self.row], [self.col]]), np.array([self.held.shape]).T
        low, high = (np.clip(of - corner, 0, shape) for of in (first, behind))
        s = self._sums
        count = s[high[0], high[1]] - s[low[0], high[1]] - s[high[0], low[1]] + s[low[0], low[1]]
        return count, np.prod(behind - first, axis=0)


def _runs(outline: Floats, east: float, north: float) -> list[list[int]]:
    """Runs of the cells that a convex outline touches, widened by degrees to all sides."""
    after = np.roll(outline, -1, axis=1)
    rise = after[1] - outline[1]
    slope = (after[0] - outline[0]) / np.where(rise == 0.0, np.inf, rise)
    low, high = outline[1].min() - north, outline[1].max() + north
    runs = []
    for row in range(int(np.floor(low / CELL_DEG)), int(np.floor(high / CELL_DEG)) + 1):
        south, top = row * CELL_DEG - north, (row + 1) * CELL_DEG + north
        meets = np.minimum(outline[1], after[1]) <= top
        meets &= np.maximum(outline[1], after[1]) >= south
        ends = np.clip([outline[1], after[1]], south, top)
        lon = np.where(
            rise == 0.0, [outline[0], after[0]], outline[0] + slope * (ends - outline[1])
        )
        lon = lon[:, meets]
        west, last = (lon.min() - east) / CELL_DEG, (lon.max() + east) / CELL_DEG
        runs.append([row, int(np.floor(west)), int(np.floor(last))])
    return runs


@kernel
def _mark(lattice: Ints, held: Bools, row: int, col: int, inside: Bools) -> None:
    """Set ``inside`` to whether the cell of each point is held."""
    for i in range(inside.size):
        y, x = (lattice[1, i] >> CELL_BITS) - row, (lattice[0, i] >> CELL_BITS) - col
        good = (y >= 0) & (x >= 0) & (y < held.shape[0]) & (x < held.shape[1])
        inside[i] = good and held[y, x]


def apart(a: Box, b: Box) -> bool:
    """Whether two boxes (west, south, east, north) share nothing."""
    return a[0] > b[2] or b[0] > a[2] or a[1] > b[3] or b[1] > a[3]


def refuse_apart(lidar: Box, images: Box, heights: tuple[float, float], file: Path) -> None:
    """Raise InputError for points that lie elsewhere, or are in a wrong coordinate system."""
    covered = [
        f"longitude {box[0]:.5f} to {box[2]:.5f}, latitude {box[1]:.5f} to {box[3]:.5f}"
        for box in (lidar, images)
    ]
    facts = (
        f"the LiDAR covers {covered[0]} (heights {heights[0]:.1f} to {heights[1]:.1f} m), the "
        f"images {covered[1]}"
    )
    gap = max(max(lidar[k] - images[k + 2], images[k] - lidar[k + 2]) for k in (0, 1))
    if not apart((lidar[1], lidar[0], lidar[3], lidar[2]), images):
        problem = "wrong coordinate system: longitude and latitude are swapped"
        remedy = "set lidar_crs in scenes.tsv to the system that the files are in"
    elif gap > FAR:
        problem = f"wrong coordinate system: the points lie {gap:.1f} degrees away from the images"
        remedy = (
            "check lidar_crs (zone, hemisphere) in scenes.tsv and the files' own CRS, and that the "
            "scene's row names the right LiDAR"
        )
    else:
        problem = "no overlap between LiDAR and images"
        remedy = (
            "give the LiDAR files of this scene (column lidar of scenes.tsv); if they are, check "
            "lidar_crs and the RPCs"
        )
    raise InputError(f"{problem}; {facts}", file=file, remedy=remedy)
