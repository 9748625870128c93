"""The surface of a site, made once for all its pairs, block by block.

A block is a square of ground cells on the global lattice, and has the triangles whose first vertex
lies in it; of one that images show in part, those in the smallest box around what they may show
(:class:`ShownBlocks`). Its content follows from this part and the points up to
:attr:`.scale.SurfaceScale.halo_cells` around it, whatever blocks are made beside it, in which order
and by how many workers. Blocks are small, since windows read them whole, and are made by groups
that are wide against their halo; a group is a file. Finished groups outlive a killed job, and one
more LiDAR file leaves those that it does not touch
(:mod:`stereotruth.core.products.resumable_grids`).
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from io import BytesIO
from itertools import chain, product
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from ..core.job import progress
from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.products.files import atomic_file, atomic_folder, link, sealed
from ..core.products.grids import Strip
from ..core.products.making import FileLock, marks_of_inputs, refuse_replaced
from ..core.products.provenance import describe, digest
from ..core.products.resumable_grids import Ledger
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, LATTICE_M, refuse_apart
from ..lidar.point_statistics import points_per_m2
from ..lidar.point_store import Points, PointStore
from .scale import PART, SurfaceScale
from .surface import Core, Parts, ground_surface
from .surface_store import ATTRIBUTES, BLOCKS, CONTENTS, FORMAT, GROUPS, GroupWriter, table_of
from .vertices import VertexBuilder

log = logging.getLogger("stereotruth")
Number = tuple[int, int]  # of a block (row, col), of a cell (col, row)
Box = tuple[Number, Number]
Group = tuple[Number, ...]  # of blocks, in their order

BLOCK_SPACINGS = 128  # spacings of points along a block's side, at least,
BLOCK_CELLS = 256  # and cells
HALOS = 12  # a group is so many halos wide: these cost a third more
MOST_CELLS = 4096  # along a group's side


SQUARES = 8  # along the side of a block, each of which images show or not


def block_side(scale: SurfaceScale) -> int:
    """Cells along the side of a block: a power of two."""
    side = BLOCK_CELLS
    while side * PART < BLOCK_SPACINGS * scale.spacing and side < MOST_CELLS:
        side *= 2
    return side


def group_blocks(scale: SurfaceScale, side: int) -> int:
    """Blocks of ``side`` cells along the side of a group: a power of two."""
    blocks = 1
    while blocks * side < min(HALOS * scale.halo_cells, MOST_CELLS):
        blocks *= 2
    return blocks


@kernel
def _parts_of(x: Ints, y: Ints, origin: Ints, numbers: Ints, boxes: Ints, bits: int) -> Parts:
    """In which of ``boxes`` [k, 2, 2] (first (x, y), that after the last) each of n vertices lies;
    -1 for none.

    Box k lies in block ``numbers`` [k, 2] (row, col), a square of 1 << ``bits`` on the lattice,
    where vertices and boxes count from ``origin`` (x, y).
    """
    first, last = np.empty(2, np.int64), np.empty(2, np.int64)
    for axis in range(2):
        first[axis], last[axis] = numbers[:, axis].min(), numbers[:, axis].max()
    box = np.full((last[0] - first[0] + 1, last[1] - first[1] + 1), -1, np.int16)
    for k in range(len(numbers)):
        box[numbers[k, 0] - first[0], numbers[k, 1] - first[1]] = k
    out = np.full(x.size, -1, np.int16)
    for n in range(x.size):
        row = ((origin[1] + y[n]) >> bits) - first[0]
        col = ((origin[0] + x[n]) >> bits) - first[1]
        if 0 <= row < box.shape[0] and 0 <= col < box.shape[1] and box[row, col] >= 0:
            low, high = boxes[box[row, col], 0], boxes[box[row, col], 1]
            if low[0] <= x[n] < high[0] and low[1] <= y[n] < high[1]:
                out[n] = box[row, col]
    return out


@dataclass(frozen=True, eq=False)
class _Maker:
    """Makes blocks (row, col) of ``side`` cells of a surface, in a ``folder``."""

    scale: SurfaceScale
    side: int
    imaged: ShownBlocks
    stores: tuple[PointStore, ...]
    folder: Path
    code: str

    def file(self, group: Group) -> Path:
        """Of a group."""
        return self.folder / GROUPS / f"{_name(group)}.bin"

    def parts(self, group: Group) -> dict[Number, Box]:
        """What images show of blocks: the first (col, row) of their cells and that after the last
        one."""
        return {number: self.imaged.part(number) for number in group}

    def corners(self, parts: Iterable[Box]) -> Box:
        """Lattice (lon, lat) of the first and last point around that determine parts of blocks."""
        halo, cell = self.scale.halo_cells, self.scale.cell
        first, last = _around(parts)
        low = (first[0] - halo) * cell[0], (first[1] - halo) * cell[1]
        high = (last[0] + halo) * cell[0] - 1, (last[1] + halo) * cell[1] - 1
        return low, high

    def touched(self, parts: Mapping[Number, Box]) -> list[PointStore]:
        """The stores that may have points which determine parts of blocks."""
        ends = zip(chain(*self.corners(parts.values())), (-0.5, -0.5, 0.5, 0.5))
        box = [(q + off) * LATTICE_DEG for q, off in ends]
        return [store for store in self.stores if store.height_range(*box) is not None]

    def key(self, parts: Mapping[Number, Box]) -> str:
        """Digest of all that blocks follow from."""
        return digest(
            {
                "format": FORMAT,
                "scale": asdict(self.scale),
                "side": self.side,
                "blocks": list(parts.items()),
                "points": sorted(
                    (store.attrs["cells_crc32"], zlib.crc32(store.days))
                    for store in self.touched(parts)
                ),
                "code": self.code,
            }
        )

    def write(self, stream: BinaryIO, group: Group, parts: Mapping[Number, Box]) -> list[list]:
        """The triangles of each block that has any, and its row of the store's table."""
        low, high = self.corners(parts.values())
        if not (stores := self.touched(parts)):
            return []
        bounds = np.array([store.bounds[:4] for store in stores]) / LATTICE_DEG
        low = tuple(max(q, int(b) - 1) for q, b in zip(low, bounds[:, :2].min(axis=0)))
        high = tuple(min(q, int(b) + 1) for q, b in zip(high, bounds[:, 2:].max(axis=0)))
        if low[0] > high[0] or low[1] > high[1]:
            return []
        builder = VertexBuilder(self.scale, low, high)
        some = False
        for points in _points(stores, low, high):
            some |= points.lon_q.size > 0
            lattice = points.lon_q, points.lat_q, points.h_q
            builder.add(*lattice, points.classification, points.return_number, points.day)
        if not some:
            return []
        first = np.array([q // size for q, size in zip(low, self.scale.cell)])
        boxes = (np.array(list(parts.values())) - first) * PART
        around = Core(tuple(boxes[:, 0].min(axis=0)), tuple(boxes[:, 1].max(axis=0)))
        vertices = builder.built()
        every = ground_surface(vertices, self.scale, around)
        numbers, bits = np.array(list(parts)), (self.side * PART).bit_length() - 1
        part = _parts_of(vertices.x, vertices.y, first * PART, numbers, boxes, bits)
        writer = GroupWriter(stream, group[0], every.vertices.x.size, vertices.x.size)
        for number, surface in zip(parts, every.split(part, len(parts))):
            if len(surface.facet) + len(surface.undecided) + len(surface.tops.corner):
                corner = [k * self.side * size for k, size in zip(number[::-1], self.scale.cell)]
                writer.write(number, surface, (corner[0], corner[1]))
        return writer.rows

    def make(self, group: Group, parts: Mapping[Number, Box], key: str, done: Ledger) -> None:
        """A group and its record."""
        with atomic_file(self.file(group)) as scratch, scratch.open("wb") as stream:
            rows = self.write(stream, group, parts)
        refuse_replaced(marks_of_inputs())
        done.put(_name(group), key, {GROUPS: self.file(group)}, rows)


def _points(stores: Sequence[PointStore], low: Number, high: Number) -> Iterator[Points]:
    """The points of a box, row of the stores' cells by row."""
    west, east = (low[0] - 0.5) * LATTICE_DEG, (high[0] + 0.5) * LATTICE_DEG
    for row in range(low[1] >> CELL_BITS, (high[1] >> CELL_BITS) + 1):
        south = max(row << CELL_BITS, low[1])
        north = min(((row + 1) << CELL_BITS) - 1, high[1])
        edges = (south - 0.5) * LATTICE_DEG, (north + 0.5) * LATTICE_DEG
        for store in stores:
            if len(points := store.query(west, edges[0], east, edges[1])):
                yield points


def _around(boxes: Iterable[Box]) -> Box:
    """The box around some, one at least."""
    low, high = zip(*boxes)
    west, south = map(min, zip(*low))
    east, north = map(max, zip(*high))
    return (west, south), (east, north)


def _name(group: Group) -> str:
    return f"{group[0][0]}_{group[0][1]}"


def make_surface(
    stores: Sequence[PointStore],
    out: str | Path,
    *,
    cell: tuple[int, int],
    ground: ShownGround | None = None,
    blocks_at_once: int | None = None,
    workers: int = 1,
    made_of: Mapping[str, str] | None = None,
    code: str = "",
    strip: Strip | None = None,
) -> None:
    """Write the surface of the points of stores where images show the ground (see
    :mod:`.surface_store`).

    ``cell``: (lon, lat) size of a ground cell, lattice steps. ``ground``: by default all that has
    points. ``blocks_at_once`` along the side of a group, by default
    :func:`group_blocks`; ``made_of``, ``code``:
    digests of other input and of the source, for the provenance. ``strip``: make its groups only,
    and no store. Groups that an earlier call has left, made of the same, are taken over.

    Raises InputError where the images show no point.
    """
    out = Path(out).absolute()
    density = points_per_m2(stores, ground and ground.shows) or points_per_m2(stores)
    density = density or 1.0  # of no points any will do
    scale = SurfaceScale.of(density, cell)
    folder = out.with_name(f".{out.name}.work")
    side = block_side(scale)
    imaged = ShownBlocks.of(stores, scale, side, ground)
    maker = _Maker(scale, side, imaged, tuple(stores), folder, code)
    numbers = imaged.numbers()
    if ground is not None and not numbers:
        bounds = np.array([store.bounds for store in stores])
        box = (*bounds[:, :2].min(axis=0).tolist(), *bounds[:, 2:4].max(axis=0).tolist())
        heights = float(bounds[:, 4].min()), float(bounds[:, 5].max())
        refuse_apart(box, ground.box(heights), heights, stores[0].path)
    groups = _groups(numbers, blocks_at_once or group_blocks(scale, side))
    if strip:
        groups = strip.share(groups, list(map(len, groups)))
    lock, done = FileLock(folder / "lock"), Ledger(folder / "done")
    try:
        lock.take(out, shared=strip is not None)

        def one(group: Group) -> None:
            parts = maker.parts(group)
            key = maker.key(parts)
            if done.find(_name(group), key, {GROUPS: maker.file(group)}) is None:
                maker.make(group, parts, key, done)

        with ThreadPoolExecutor(workers) as pool:
            for _ in progress(pool.map(one, groups), len(groups), "parts of the surface"):
                pass
        if strip:
            return
        rows = {group: done.get(_name(group)).result for group in groups}
        table = BytesIO()
        np.save(table, table_of([row for of_group in rows.values() for row in of_group]))
        stores_made = {
            f"points/{s.path.name}": digest(dict(s.attrs.get("provenance", {}))) for s in stores
        }
        attrs = {
            "kind": "surface",
            "format": FORMAT,
            "conventions": "WGS 84 longitude and latitude, ellipsoidal height, on the lattice of "
            f"{LATTICE_DEG:g} degree and {LATTICE_M:g} m",
            "arrays": CONTENTS,
            "scale": asdict(scale),
            "side": side,
            "points_per_m2": round(density, 6),
            "blocks_crc32": zlib.crc32(table.getvalue()),
            "provenance": describe({**stores_made, **(made_of or {})}, {"cell": list(cell)}, code),
        }
        with atomic_folder(out) as unfinished:
            for group in filter(rows.get, groups):
                link(maker.file(group), unfinished / GROUPS / maker.file(group).name)
            (unfinished / BLOCKS).write_bytes(table.getvalue())
            (unfinished / ATTRIBUTES).write_text(sealed(attrs), encoding="utf-8")
    finally:
        lock.close()
    log.info(
        "%d blocks of %d cells of %.2f m, about %.2g points per m²",
        sum(map(len, rows.values())), side, scale.cell_m, density,
    )  # fmt: skip


def _groups(numbers: Sequence[Number], blocks: int) -> list[Group]:
    """Blocks by squares of so many ``blocks`` along each side."""
    groups: dict[Number, list[Number]] = {}
    for number in numbers:
        groups.setdefault((number[0] // blocks, number[1] // blocks), []).append(number)
    return [tuple(group) for group in groups.values()]


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

    ``heights`` of the lowest and the highest point, m, of each of the point stores' cells by its
    (col, row).
    """

    scale: SurfaceScale
    side: int
    ground: ShownGround | None
    heights: Mapping[Number, tuple[float, float]]

    @classmethod
    def of(
        cls,
        stores: Sequence[PointStore],
        scale: SurfaceScale,
        side: int,
        ground: ShownGround | None,
    ) -> ShownBlocks:
        """Of the points of stores."""
        heights: dict[Number, tuple[float, float]] = {}
        for store in stores:
            cells = np.stack([store.cell_col, store.cell_row], axis=1).tolist()
            own = (store.cell_heights * LATTICE_M).tolist()
            for cell, (low, high) in zip(map(tuple, cells), own):
                before = heights.get(cell, (low, high))
                heights[cell] = min(low, before[0]), max(high, before[1])
        return cls(scale, side, ground, heights)

    def numbers(self) -> list[Number]:
        """(row, col) of the blocks, in their order."""
        size = np.array(self.scale.cell) * self.side
        low = np.array(list(self.heights), np.int64).reshape(-1, 2) << CELL_BITS
        high = low + (1 << CELL_BITS) - 1
        every = sorted(set().union(*map(_numbers, low // size, high // size)))
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
        first, last = (v.astype(np.int64) >> CELL_BITS for v in (low.min(axis=0), high.max(axis=0)))
        cells = product(*(range(a, b + 1) for a, b in zip(first.tolist(), last.tolist())))
        lowest, highest = zip(*(self.heights[cell] for cell in cells if cell in self.heights))
        boxes = np.empty((len(corners), 6))
        boxes[:, :2], boxes[:, 3:5] = low * LATTICE_DEG, high * LATTICE_DEG
        boxes[:, 2], boxes[:, 5] = min(lowest), max(highest)
        return boxes


def _squares(squares: int) -> Ints:
    """(col, row) [n, 2] of the squares of a block."""
    return np.stack(np.mgrid[:squares, :squares], axis=-1).reshape(-1, 2)


def _numbers(first: Ints, last: Ints) -> Iterator[Number]:
    """Of blocks between two (col, row)."""
    for col in range(int(first[0]), int(last[0]) + 1):
        for row in range(int(first[1]), int(last[1]) + 1):
            yield row, col
