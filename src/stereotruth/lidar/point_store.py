"""A point store: its files, and reading of its points by box.

A folder with plain arrays, which NumPy opens (little-endian; n points, m cells of the lattice):

==============  ============  =====================================================================
``points.npy``  uint32[n, 3]  a point in 96 bits, cell after cell:

                              longitude from the cell's west edge, steps (bits 0 to 19), class
                              (20 to 27), return number (28 to 31);

                              latitude from the cell's south edge, steps (0 to 19), number of
                              returns (20 to 23), code of the day (24 to 31, :mod:`.point_fields`);

                              height above the WGS 84 ellipsoid, steps (32 bits, signed)
``cells.npy``   CELL[m]       ``row``, ``col``: lattice latitude, longitude >> 20; ``first``: index
                              of the cell's first point; ``lowest``, ``highest``: heights of its
                              points, steps; ``crc32`` of its points as they lie in the file
``strips.npy``  uint16[n]     code of the strip that each point was measured in, of files with more
                              than one (:mod:`.point_fields`)
``store.json``                attributes, with ``cells_crc32`` of ``cells.npy`` and a digest
==============  ============  =====================================================================

Points are written once and read once or twice, so that they are neither compressed nor cut into
chunks. They are read by hand: pages of a memory map count as memory of the process, and a process
dies of a mapped file that is cut short. What is read of a cell is held against its checksum.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.kernels import kernel
from ..core.numerics.arrays import Bytes, Ints, Words
from ..core.products.files import damaged_store, read_record
from .lattice import CELL_BITS, PER_DEG, PER_M, Footprint, apart, cell_key, lattice_box
from .point_fields import Days, days_by_code

FORMAT = 5  # of the files
ASSUMED = "ellipsoidal (assumed)"  # of heights that nothing declares
POINTS, CELLS, STRIPS, ATTRIBUTES = "points.npy", "cells.npy", "strips.npy", "store.json"
SQUARES = 16  # of a cell along each side, that its points are counted by
WORDS = 3  # of 32 bits, of a point
POINT_BYTES = 4 * WORDS
CELL = np.dtype(
    [
        ("row", "<i4"),
        ("col", "<i4"),
        ("first", "<i8"),
        ("lowest", "<i4"),
        ("highest", "<i4"),
        ("crc32", "<u4"),
        ("squares", "<u2", (SQUARES, SQUARES)),
    ]
)
ARRAYS = {  # what the files' attributes would say if they had any
    POINTS: {
        "units": "1e-9 degree, 1e-9 degree, 1e-4 m",
        "long_name": "longitude and latitude from the south-west corner of the cell, height above "
        "the WGS 84 ellipsoid (signed); LAS attributes above bit 19",
        "components": [
            "lon + (class << 20) + (return number << 28)",
            "lat + (number of returns << 20) + (code of the day << 24)",
            "height",
        ],
    },
    CELLS: {
        "units": "row, col: cell size; lowest, highest: 1e-4 m",
        "long_name": "south-west corner, first point, lowest and highest height of each cell, "
        "CRC-32 of its points; squares: points in each of its 16 x 16 squares, from south and west "
        "(65535 stands for more, too)",
    },
    STRIPS: {"long_name": "code of the strip that each point was measured in"},
}
WATER_CLASS, VEGETATION_CLASSES = 9, (3, 4, 5)  # ASPRS
_PIECE = 1 << 16  # points that are read at once, so that they stay in the cache


@dataclass(frozen=True)
class Points:
    """Points of a query, [n] each: lattice coordinates (int64), LAS attributes (uint8), and the
    ``day`` that each was measured on (uint16, since 1970-01-01; 0: not known)."""

    lon_q: np.ndarray
    lat_q: np.ndarray
    h_q: np.ndarray
    classification: np.ndarray
    return_number: np.ndarray
    number_of_returns: np.ndarray
    day: np.ndarray

    def __len__(self) -> int:
        return self.lon_q.size

    @cached_property
    def lon(self) -> np.ndarray:
        """Longitude, degrees, float64[n]."""
        return self.lon_q / PER_DEG

    @cached_property
    def lat(self) -> np.ndarray:
        """Latitude, degrees, float64[n]."""
        return self.lat_q / PER_DEG

    @cached_property
    def height(self) -> np.ndarray:
        """Ellipsoidal height, m, float64[n]."""
        return self.h_q / PER_M

    @classmethod
    def concatenate(cls, parts: Sequence[Points]) -> Points:
        """Points of all parts, in their order."""
        if not parts:
            q, u = np.empty(0, np.int64), np.empty(0, np.uint8)
            return cls(q, q, q, u, u, u, np.empty(0, np.uint16))
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@kernel
def _select(
    stored: Words,
    start: Ints,
    corner: Ints,
    box: Ints,
    days: Days,
    lon: Ints,
    lat: Ints,
    height: Ints,
    out: Bytes,
    day: Days,
) -> int:
    """Fill lon, lat, height, day [n] and out [3, n] with the stored points in a box; how many there
    are.

    ``start`` [m + 1] of the cells' points among the ``stored``, ``corner`` [2, m] their south-west
    corners (lon, lat); ``days`` [256] by code.
    """
    kept = 0
    west, south, east, north = box[0], box[1], box[2], box[3]
    inside = (1 << CELL_BITS) - 1
    for cell in range(start.size - 1):
        col, row = corner[0, cell], corner[1, cell]
        for i in range(start[cell], start[cell + 1]):
            first, second = np.int64(stored[i, 0]), np.int64(stored[i, 1])
            x, y = (first & inside) + col, (second & inside) + row
            lon[kept], lat[kept], height[kept] = x, y, np.int32(stored[i, 2])
            out[0, kept] = first >> CELL_BITS & 255
            out[1, kept] = first >> 28
            out[2, kept] = second >> CELL_BITS & 15
            day[kept] = days[second >> 24]
            kept += (x >= west) & (y >= south) & (x <= east) & (y <= north)
    return kept


class PointStore:
    """A finished point store, open for queries.

    ``bounds`` = (lon_min, lat_min, lon_max, lat_max, h_min, h_max), ``count`` points, ``attrs`` of
    the store. Raises InputError if the store is missing, of another kind or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.attrs = read_record(
            self.path / ATTRIBUTES, self._checked, what="point store", stage="ingest"
        )
        try:
            data = (self.path / CELLS).read_bytes()
        except OSError as error:
            raise damaged_store(self.path, CELLS) from error
        if zlib.crc32(data) != self.attrs["cells_crc32"]:
            raise damaged_store(self.path, CELLS)
        cells = np.load(BytesIO(data))
        self.bounds: tuple[float, ...] = tuple(map(float, self.attrs["bounds"]))
        self.count = int(self.attrs["points"]["kept"])
        self.cell_row = cells["row"].astype(np.int64)
        self.cell_col = cells["col"].astype(np.int64)
        self.cell_heights = np.stack([cells["lowest"], cells["highest"]], axis=1)
        self.square_counts = cells["squares"]
        self._crc32 = cells["crc32"].tolist()
        self._start = np.append(cells["first"], self.count)
        self._key = cell_key(self.cell_row, self.cell_col)
        self._first_of_row = np.flatnonzero(np.diff(self.cell_row, prepend=-(1 << 40)))
        self._offset = self._first_byte(POINTS, (self.count, WORDS), "<u4")

    def _checked(self, attrs: dict[str, Any]) -> dict[str, Any]:
        if attrs["kind"] != "points":
            raise ValueError(f"a {attrs['kind']}")
        if attrs["format"] != FORMAT:
            raise InputError(
                f"a point store of format {attrs['format']}, not {FORMAT}",
                file=self.path,
                remedy="delete it and run the workflow again",
            )
        return attrs

    def _first_byte(self, name: str, shape: tuple[int, ...], kind: str) -> int:
        """Where an array begins in its file, which has the size that it should have."""
        file, size = self.path / name, int(np.prod(shape)) * np.dtype(kind).itemsize
        try:
            with file.open("rb") as stream:
                np.lib.format.read_magic(stream)
                found, _, dtype = np.lib.format.read_array_header_1_0(stream)
                right = (found, dtype) == (shape, np.dtype(kind))
                if right and file.stat().st_size - stream.tell() == size:
                    return stream.tell()
        except Exception as error:  # NumPy reads the header as Python, which fails in many ways
            raise damaged_store(self.path, name) from error
        raise damaged_store(self.path, name)

    @cached_property
    def footprint(self) -> Footprint | None:
        """The ground whose points it has; None: all of its file."""
        runs = self.attrs.get("footprint")
        return None if runs is None else Footprint.of_runs(runs)

    @cached_property
    def days(self) -> Days:
        """The day that each code of a point stands for [256]; 0: not known."""
        return days_by_code(self.attrs["days"], self.attrs["acquired"])

    @property
    def has_assumed_heights(self) -> bool:
        """Whether nothing declares what the heights of its file count from."""
        return str(self.attrs["crs"]["heights"]).startswith(ASSUMED)

    @property
    def cell_counts(self) -> Ints:
        """Points in each cell."""
        return np.diff(self._start)

    def cell_at(self, row: int, col: int) -> int | None:
        """The number of the cell at a place of the lattice, if there is one."""
        key, wanted = self._key, cell_key(row, col)
        at = int(np.searchsorted(key, wanted))
        return at if at < key.size and key[at] == wanted else None

    def _cells(self, box: tuple[int, int, int, int]) -> list[tuple[int, int]]:
        """Ranges [first, end) of cells that a lattice box touches, in order."""
        low_col, low_row, high_col, high_row = (value >> CELL_BITS for value in box)
        rows = self.cell_row[self._first_of_row]
        rows = rows[(rows >= low_row) & (rows <= high_row)]
        first = np.searchsorted(self._key, cell_key(rows, np.full(rows.shape, low_col)))
        end = np.searchsorted(self._key, cell_key(rows, np.full(rows.shape, high_col)), "right")
        return [(int(a), int(b)) for a, b in zip(first, end) if a < b]

    def height_range(
        self, lon_min: float, lat_min: float, lon_max: float, lat_max: float
    ) -> tuple[float, float] | None:
        """Lowest and highest height (m) of the cells that a box touches, without reading points.

        None where there is no cell.
        """
        if apart(self.bounds[:4], (lon_min, lat_min, lon_max, lat_max)):
            return None
        box = lattice_box(lon_min, lat_min, lon_max, lat_max)
        heights = [self.cell_heights[a:b] for a, b in self._cells(box)]
        if not heights:
            return None
        heights = np.concatenate(heights)
        return float(heights[:, 0].min()) / PER_M, float(heights[:, 1].max()) / PER_M

    def query(self, lon_min: float, lat_min: float, lon_max: float, lat_max: float) -> Points:
        """Points with lon_min <= lon <= lon_max and lat_min <= lat <= lat_max, in stored order.

        Raises InputError if they are not what was written.
        """
        box = lattice_box(lon_min, lat_min, lon_max, lat_max)
        return self._points(self._cells(box), box)

    def points_of(self, cell: int) -> Points:
        """All points of a cell, in stored order. InputError if damaged."""
        west, south = (int(of[cell]) << CELL_BITS for of in (self.cell_col, self.cell_row))
        side = (1 << CELL_BITS) - 1
        return self._points([(cell, cell + 1)], (west, south, west + side, south + side))

    def _points(self, ranges: list[tuple[int, int]], box: tuple[int, int, int, int]) -> Points:
        """Points of ranges of cells that lie in a lattice box."""
        total = int(sum(self._start[end] - self._start[first] for first, end in ranges))
        lattice, attributes = np.empty((3, total), np.int64), np.empty((3, total), np.uint8)
        day = np.empty(total, np.uint16)
        limits, kept = np.array(box), 0
        for stored, start, cells in self._stored(ranges):
            corner = np.stack([self.cell_col[cells], self.cell_row[cells]]) << CELL_BITS
            out = (*lattice[:, kept:], attributes[:, kept:], day[kept:])
            kept += _select(stored, start, corner, limits, self.days, *out)
        return Points(*lattice[:, :kept], *attributes[:, :kept], day[:kept])

    @property
    def strips_by(self) -> str:
        """What tells the strips of its points."""
        return str(self.attrs["strips"]["by"])

    @property
    def strip_counts(self) -> dict[int, int]:
        """Points by the code of their strip."""
        return {int(code): count for code, count in self.attrs["strips"]["points"].items()}

    def strips_of(self, cell: int) -> NDArray[np.uint16]:
        """Codes of the strips of a cell's points, in stored order. InputError if damaged."""
        told, count = self.attrs["strips"], int(self.cell_counts[cell])
        if len(self.strip_counts) == 1:
            return np.full(count, next(iter(self.strip_counts)), np.uint16)
        place = self._strips_offset + 2 * int(self._start[cell])
        with (self.path / STRIPS).open("rb") as file:
            file.seek(place)
            data = file.read(2 * count)
        if zlib.crc32(data) != told["crc32"][cell]:
            raise damaged_store(self.path, STRIPS)
        return np.frombuffer(data, "<u2")

    def words_of(self, cell: int) -> Words:
        """The points of a cell as they are stored, [n, 3]. InputError if damaged."""
        parts = [stored.copy() for stored, _, _ in self._stored([(cell, cell + 1)])]
        return np.concatenate([np.empty((0, WORDS), np.uint32), *parts])

    @cached_property
    def _strips_offset(self) -> int:
        return self._first_byte(STRIPS, (self.count,), "<u2")

    def _stored(self, ranges: Iterable[tuple[int, int]]) -> Iterator[tuple[Words, Ints, slice]]:
        """Points of ranges of cells as they are stored, [n, 3], a piece at a time.

        With the cells that a piece is of, and where the points of each begin in it.
        """
        buffer = np.empty((_PIECE, WORDS), "<u4")
        with (self.path / POINTS).open("rb", buffering=0) as file:
            for first, end in ranges:
                begin, last = int(self._start[first]), int(self._start[end])
                file.seek(self._offset + begin * POINT_BYTES)
                found, cell = 0, first
                for at in range(begin, last, _PIECE):
                    stored = buffer[: min(_PIECE, last - at)]
                    if file.readinto(stored.data.cast("B")) != stored.nbytes:
                        raise damaged_store(self.path, POINTS)
                    stop = at + len(stored)
                    of = cell
                    while cell < end and self._start[cell] < stop:
                        part = stored[max(self._start[cell] - at, 0) : self._start[cell + 1] - at]
                        found = zlib.crc32(part, found)
                        if self._start[cell + 1] > stop:
                            break
                        if found != self._crc32[cell]:
                            raise damaged_store(self.path, POINTS)
                        found, cell = 0, cell + 1
                    cells = slice(of, min(cell + 1, end))
                    bounds = self._start[cells.start : cells.stop + 1]
                    yield stored, np.clip(bounds - at, 0, len(stored)), cells


def open_stores(paths: Iterable[str | Path]) -> tuple[PointStore, ...]:
    """The point stores of one scene, in the order given, but for those without a point.

    All of them, if none has a point: their bounds say where the points of their files are.

    Raises InputError, besides what PointStore raises, if two files of one datum were brought to
    WGS 84 by different transformations: a step of up to metres would run through the scene.
    """
    every = tuple(PointStore(path) for path in paths)
    stores = tuple(store for store in every if store.count) or every
    first: dict[str, tuple[str, PointStore]] = {}
    for store in stores if len(stores) > 1 else ():
        steps = store.attrs["crs"]["operation"].split(" + ")  # projections apart:
        steps = [step for step in steps if not step.startswith(("Inverse of ", "axis order"))]
        operation, datum = " + ".join(steps), _datum_name(store.attrs["crs"]["wkt"])
        other, there = first.setdefault(datum, (operation, store))
        if other != operation:
            raise InputError(
                f"it was brought from {datum} to WGS 84 by '{operation}', but {there.path.name} of "
                f"the same scene by '{other}'",
                file=store.path,
                remedy="make two scenes of the area, or transform the LiDAR files to a system on "
                "WGS 84 with one transformation for all",
            )
    return stores


@cache
def _datum_name(wkt: str) -> str:
    from pyproj import CRS  # which stores of one file do not need

    geodetic = CRS.from_wkt(wkt).geodetic_crs
    return "" if geodetic is None else geodetic.datum.name


def query_points(
    stores: Sequence[PointStore], lon_min: float, lat_min: float, lon_max: float, lat_max: float
) -> Points:
    """Points of a box (degrees, inclusive) in all stores, store after store."""
    box = (lon_min, lat_min, lon_max, lat_max)
    return Points.concatenate(
        [store.query(*box) for store in stores if not apart(store.bounds[:4], box)]
    )
