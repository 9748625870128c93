"""A surface store: the triangles of a site's ground, block by block, for all images that show it.

A folder:

=================  =========================================================================
``groups/R_C.bin`` the blocks of a group, one after the other: first all columns of ``vertices``,
                   then those of the triangles (:data:`COLUMNS`), not compressed; each kind
                   begins at a multiple of 8 bytes
``blocks.npy``     a row for each block that has triangles (:data:`TABLE`): its number, box and
                   heights, its group, where it begins there, how many records it has of each
                   kind, checksums of its vertices and of its triangles
``surface.json``   ``scale`` of the surface, ``side`` of its blocks in ground cells, the checksum
                   of ``blocks.npy``, the meaning of the columns; and a digest
=================  =========================================================================

A block (R, C) has the triangles whose first vertex lies in it. Blocks lie on the global lattice.
What a window of an image shows follows from the blocks whose boxes it sees
(:meth:`SurfaceStore.blocks`), taken in their order.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Ints
from ..core.products.files import damaged_store, read_sealed
from ..lidar.lattice import LATTICE_DEG
from .delaunay import height_ranges
from .scale import PART, PART_BITS, SurfaceScale
from .surface import GroundSurface, RoughTops
from .vertices import Vertices, whole_quotient

Steps = NDArray[np.int32]

SQUARE_BITS = PART_BITS + 4  # of parts of a cell: squares of 16 cells

FORMAT = 4
ATTRIBUTES, BLOCKS, GROUPS = "surface.json", "blocks.npy", "groups"
CORNER = ("corner", "<i4", (3,))
COLUMNS = {  # by falling size of their items, so that each begins where these may
    "vertices": (
        ("lon", "<i4", ()), ("lat", "<i4", ()), ("height", "<i4", ()),
        ("count", "<u2", ()), ("day", "<u2", ()), ("surface_class", "u1", ()),
    ),
    "facets": (CORNER, ("variance", "<f4", ()), ("bulge", "<f4", ())),
    "whole": (CORNER,),
    "strips": (CORNER, ("height_range", "<i4", (2,))),
    "tops": (CORNER, ("residual", "<f4", ()), ("is_gentle", "?", ())),
}  # fmt: skip
VERTICES, TRIANGLES = ("vertices",), ("facets", "whole", "strips", "tops")
CONTENTS = {
    "vertices": "lon, lat from the block's south-west corner, 1e-9 degree; height above the WGS 84 "
    "ellipsoid, 1e-4 m; count of points that it is the mean of, 65535 stands for more, too; day "
    "since 1970-01-01 (0 not known) and surface_class (ASPRS) of the highest of these",
    "facets": "corner: vertices; variance of a point's height there, (1e-4 m)²; bulge of the "
    "surface above it, 1e-4 m",
    "whole": "undecided triangles; corner: vertices",
    "strips": "triangles along breaklines; corner: vertices; height_range: lowest and highest "
    "surface in each, 1e-4 m",
    "tops": "triangles of rough surfaces' tops; corner: vertices; residual: rms of the tops to the "
    "planes beside, 1e-4 m, NaN for none; is_gentle: neither steep nor alone",
}
TABLE = np.dtype(
    [("number", "<i8", 2), ("box", "<i8", 4), ("heights", "<i8", 2), ("group", "<i8", 2),
     ("begin", "<i8"), ("sizes", "<i8", len(COLUMNS)), ("crc32", "<u4", 2)]
)  # fmt: skip
Box = tuple[float, float, float, float]
Columns = dict[str, NDArray]  # of one kind, by their names


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


class Block(NamedTuple):
    """A block that has triangles: number (row, col), box of its vertices (west, south, east, north,
    lattice steps), heights of these (lowest, highest, steps), checksum of its bytes."""

    row: int
    col: int
    box: tuple[int, int, int, int]
    heights: tuple[int, int]
    checksum: str


def _columns(kinds: Sequence[str], sizes: Sequence[int], data: NDArray[np.uint8]) -> list[Columns]:
    """The columns of some ``kinds``, of so many records each, as views of ``data``."""
    out, begin = [], 0
    for kind, size in zip(kinds, sizes):
        columns = {}
        for name, dtype, shape in COLUMNS[kind]:
            end = begin + size * np.dtype(dtype).itemsize * int(np.prod(shape))
            columns[name] = data[begin:end].view(dtype).reshape(size, *shape)
            begin = end
        out.append(columns)
        begin += -begin % 8
    return out


def _bytes(kinds: Sequence[str], sizes: Sequence[int]) -> int:
    """That the columns of some ``kinds`` take, of so many records each."""
    records = [
        sum(np.dtype((dtype, shape)).itemsize for _, dtype, shape in COLUMNS[k]) for k in kinds
    ]
    return sum(size * record + -(size * record) % 8 for size, record in zip(sizes, records))


# -------------------------------------------------------------------------------------- writing


@kernel
def _number_used(corner: Steps, number: Steps, whole: int) -> Steps:
    """The vertices of triangles ``corner`` [m, 3] in their order; ``corner`` gets their numbers in
    it.

    ``number``: one for each vertex there is, all -1 before and after. Of those from ``whole`` on,
    which cut triangles have, each is that of one triangle.
    """
    low, high, low_cut, high_cut = whole, 0, number.size, whole
    used = 0
    for t in range(len(corner)):
        for i in range(3):
            v = corner[t, i]
            used += number[v] < 0
            number[v] = 0
            if v < whole:
                low, high = min(low, v), max(high, v + 1)
            else:
                low_cut, high_cut = min(low_cut, v), max(high_cut, v + 1)
    out = np.empty(used, np.int32)
    n = 0
    for first, end in ((low, high), (low_cut, high_cut)):
        for v in range(first, end):
            if number[v] == 0:
                out[n] = v
                n += 1
    for n in range(out.size):
        number[out[n]] = n
    for t in range(len(corner)):
        for i in range(3):
            corner[t, i] = number[corner[t, i]]
    for v in out:
        number[v] = -1
    return out


@kernel
def _fill_vertices(
    vertices: Vertices,
    taken: Steps,
    corner: tuple[int, int],
    lon: Steps,
    lat: Steps,
    height: Steps,
    count: NDArray[np.uint16],
    day: NDArray[np.uint16],
    surface_class: NDArray[np.uint8],
) -> tuple[Ints, Ints]:
    """The ``taken`` vertices from a block's south-west ``corner`` (lon, lat) on; least and greatest
    (lon, lat, height) of them."""
    low, high = np.full(3, np.iinfo(np.int64).max), np.full(3, np.iinfo(np.int64).min)
    for n in range(taken.size):
        v = taken[n]
        at = vertices.lon_q[v], vertices.lat_q[v], vertices.h_q[v]
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], at[axis]), max(high[axis], at[axis])
        lon[n], lat[n], height[n] = at[0] - corner[0], at[1] - corner[1], at[2]
        count[n], day[n] = min(vertices.count[v], 65535), vertices.day[v]
        surface_class[n] = vertices.surface_class[v]
    return low, high


class GroupWriter:
    """Writes the blocks of a ``group`` (row, col of the first one) to an open file; ``rows``: of
    each one, as in :data:`TABLE`.

    All blocks have triangles of the vertices of one surface, of which the first ``whole`` are
    those of uncut triangles.
    """

    def __init__(self, stream: BinaryIO, group: tuple[int, int], vertices: int, whole: int) -> None:
        self.stream, self.group, self.whole = stream, group, whole
        self.number = np.full(vertices, -1, np.int32)
        self.rows: list[list] = []
        self.begin = 0

    def write(
        self, number: tuple[int, int], surface: GroundSurface, corner: tuple[int, int]
    ) -> None:
        """The triangles of block ``number``, one at least, whose south-west ``corner`` lies at
        (lon, lat), lattice steps."""
        undecided, tops, strips = surface.undecided, surface.tops, surface.strips
        corners = [surface.facet, undecided[: surface.whole], undecided[strips], tops.corner]
        every = np.concatenate(corners)
        taken = _number_used(every, self.number, self.whole)
        sizes = [taken.size, *map(len, corners)]
        middle, end = _bytes(VERTICES, sizes), _bytes(tuple(COLUMNS), sizes)
        data = np.zeros(end, np.uint8)
        (into,) = _columns(VERTICES, sizes, data)
        low, high = _fill_vertices(surface.vertices, taken, corner, *into.values())
        facets, whole, strip, top = _columns(TRIANGLES, sizes[1:], data[middle:])
        ends = np.cumsum(sizes[1:-1])
        for columns, own in zip((facets, whole, strip, top), np.split(every, ends)):
            columns["corner"][:] = own
        facets["variance"][:], facets["bulge"][:] = surface.variance, surface.bulge
        strip["height_range"][:] = surface.height_range[strips]
        top["residual"][:], top["is_gentle"][:] = tops.residual, tops.is_gentle
        self.stream.write(data)
        crc32 = [zlib.crc32(part) for part in (data[:middle], data[middle:])]
        box = [*low[:2].tolist(), *high[:2].tolist()]
        heights = [int(low[2]), int(high[2])]
        self.rows.append([[*number], box, heights, [*self.group], self.begin, sizes, crc32])
        self.begin += end


def table_of(rows: Sequence[Sequence]) -> NDArray[np.void]:
    """The rows of all blocks of a store, by their number."""
    table = np.array([tuple(row) for row in rows], TABLE)
    return table[np.lexsort(table["number"].T[::-1])]


# -------------------------------------------------------------------------------------- reading


@dataclass(frozen=True, eq=False)
class WindowSurface:
    """What a window may see of a surface: the ``blocks`` of a ``store``, and all their
    ``vertices``, of which ``x``, ``y`` count from ``first``, (lon, lat) number of a cell."""

    store: SurfaceStore
    blocks: tuple[Block, ...]
    vertices: Vertices
    first: tuple[int, int]

    def surface(self, region: Region) -> GroundSurface:
        """The triangles that touch a ``region``, with all vertices."""
        parts: dict[str, list[Columns]] = {name: [] for name in TRIANGLES}
        start = 0
        for block in self.blocks:
            for name, columns in self.store.triangles(block).items():
                touching = region.touching(self.vertices, columns["corner"], start)
                chosen = np.flatnonzero(touching)  # a fourth of a mask's time
                taken = {field: values.take(chosen, axis=0) for field, values in columns.items()}
                taken["corner"] += np.int32(start)
                parts[name].append(taken)
            start += self.store.vertex_count(block)
        every = {
            name: {field: np.concatenate([one[field] for one in part]) for field in part[0]}
            for name, part in parts.items()
        }
        return _surface(self.vertices, every)


def _surface(vertices: Vertices, triangles: Mapping[str, Columns]) -> GroundSurface:
    """Of columns by the names of COLUMNS."""
    facets, whole, strips, tops = (triangles[name] for name in TRIANGLES)
    top_range = height_ranges(vertices.h_q, tops["corner"])
    heights = height_ranges(vertices.h_q, whole["corner"]), strips["height_range"].astype(np.int64)
    undecided = np.concatenate([whole["corner"], strips["corner"]])
    return GroundSurface(
        vertices=vertices,
        facet=facets["corner"],
        variance=facets["variance"],
        bulge=facets["bulge"],
        undecided=undecided,
        height_range=np.concatenate(heights),
        whole=len(whole["corner"]),
        tops=RoughTops(
            tops["corner"],
            tops["residual"].astype(np.float64),
            top_range[:, 1] - top_range[:, 0],
            tops["is_gentle"],
        ),
        facet_origin=facets["corner"][:, 0],
        undecided_origin=undecided[:, 0],
    )


@kernel
def _fill_window(
    lon: Steps,
    lat: Steps,
    height: Steps,
    count: NDArray[np.uint16],
    corner: tuple[int, int],
    first: tuple[int, int],
    cell: tuple[int, int],
    start: int,
    out: Vertices,
) -> None:
    """Positions and counts of a block's vertices, which lie from its ``corner`` (lon, lat) on, to
    ``out`` from ``start`` on; x and y count from the ``first`` cell."""
    west, south = first[0] * cell[0], first[1] * cell[1]
    wide, tall = 1.0 / cell[0], 1.0 / cell[1]
    for n in range(lon.size):
        k = start + n
        east, north = lon[n] + corner[0], lat[n] + corner[1]
        out.lon_q[k], out.lat_q[k], out.h_q[k] = east, north, height[n]
        out.x[k] = whole_quotient((east - west) * PART, wide)
        out.y[k] = whole_quotient((north - south) * PART, tall)
        out.count[k] = count[n]


class SurfaceStore:
    """A finished surface store, open for windows. Raises InputError if it is missing or damaged."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            self.attrs = read_sealed(self.path / ATTRIBUTES)
        except FileNotFoundError as error:
            raise InputError(
                "no such surface", file=self.path, remedy="run the stage that makes it"
            ) from error
        if self.attrs.get("kind") != "surface" or self.attrs.get("format") != FORMAT:
            raise InputError(
                f"no surface of format {FORMAT}",
                file=self.path,
                remedy="delete it and run the workflow again",
            )
        scale = dict(self.attrs["scale"])
        self.scale = SurfaceScale(**scale | {"cell": tuple(scale["cell"])})
        self.side = int(self.attrs["side"])
        try:
            table = (self.path / BLOCKS).read_bytes()
        except OSError as error:
            raise damaged_store(self.path, BLOCKS) from error
        if zlib.crc32(table) != self.attrs["blocks_crc32"]:
            raise damaged_store(self.path, BLOCKS)
        self._table = np.load(BytesIO(table))
        self._row = {tuple(number): k for k, number in enumerate(self._table["number"].tolist())}

    @property
    def points_per_m2(self) -> float:
        """Of the points that it is made of, over the ground that they cover."""
        return self.attrs["points_per_m2"]

    @cached_property
    def every(self) -> tuple[Block, ...]:
        """All blocks, by their number."""
        return self._blocks(self._table)

    def _blocks(self, table: NDArray[np.void]) -> tuple[Block, ...]:
        names = "number", "box", "heights", "crc32"
        return tuple(
            Block(*number, tuple(box), tuple(heights), "{:08x}{:08x}".format(*crc32))
            for number, box, heights, crc32 in zip(*(table[name].tolist() for name in names))
        )

    def blocks(self, box: Box) -> tuple[Block, ...]:
        """The blocks that may have triangles in a box (west, south, east, north, degrees)."""
        west, south, east, north = (edge / LATTICE_DEG for edge in box)
        own = self._table["box"]
        inside = (own[:, 0] <= east) & (own[:, 2] >= west)
        inside &= (own[:, 1] <= north) & (own[:, 3] >= south)
        return self._blocks(self._table[inside])

    def _of(self, block: Block) -> NDArray[np.void]:
        return self._table[self._row[block.row, block.col]]

    def vertex_count(self, block: Block) -> int:
        """How many vertices a block has."""
        return int(self._of(block)["sizes"][0])

    def _read(self, block: Block, kinds: Sequence[str]) -> list[Columns]:
        """Columns of the vertices or of the triangles of a block. Raises InputError if they are not
        what was written."""
        row = self._of(block)
        sizes, begin = row["sizes"].tolist(), int(row["begin"])
        if kinds == TRIANGLES:
            begin, sizes = begin + _bytes(VERTICES, sizes), sizes[1:]
        data = np.empty(_bytes(kinds, sizes), np.uint8)
        name = "{}/{}_{}.bin".format(GROUPS, *row["group"])
        try:
            with (self.path / name).open("rb", buffering=0) as stream:
                stream.seek(begin)
                stream.readinto(data)
        except OSError as error:
            raise damaged_store(self.path, name) from error
        if zlib.crc32(data) != row["crc32"][int(kinds == TRIANGLES)]:
            raise damaged_store(self.path, name)
        return _columns(kinds, sizes, data)

    def vertices(self, block: Block) -> Columns:
        """Columns of a block's vertices."""
        return self._read(block, VERTICES)[0]

    def triangles(self, block: Block) -> dict[str, Columns]:
        """Columns of a block's triangles, by their kind."""
        return dict(zip(TRIANGLES, self._read(block, TRIANGLES)))

    def window(self, blocks: Sequence[Block]) -> WindowSurface:
        """Of some blocks, one at least."""
        cell = self.scale.cell
        corners = np.array([block.box[:2] for block in blocks]).min(axis=0)
        first = tuple(int(q) // side for q, side in zip(corners, cell))
        size = sum(map(self.vertex_count, blocks))
        whole = Vertices.empty(size)
        start = 0
        for block in blocks:
            own = self.vertices(block)
            corner = tuple(k * self.side * step for k, step in zip((block.col, block.row), cell))
            end = start + len(own["lon"])
            whole.surface_class[start:end], whole.day[start:end] = own["surface_class"], own["day"]
            values = own["lon"], own["lat"], own["height"], own["count"]
            _fill_window(*values, corner, first, cell, start, whole)
            start = end
        return WindowSurface(self, tuple(blocks), whole, first)
