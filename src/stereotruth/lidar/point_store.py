"""A point store: its layout on disk, and reading of its points by box."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle

from ..errors import InputError
from ..kernels import kernel
from ..products.grids import require_complete
from .lattice import CELL_BITS, PER_DEG, PER_M, cell_key, lattice_box

Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]


CHUNK_POINTS = 1 << 17  # points per Zarr chunk
SHARD_POINTS = 1 << 21  # points per shard file
ATTRIBUTES = ("classification", "return_number", "number_of_returns")
# A fifth of the time of zstd, level 3, to write and a third to read, for a tenth more bytes (7.1
# instead of 6.4 a point): a store is written once and read once or twice.
CODEC = BloscCodec(cname="lz4", clevel=5, shuffle=BloscShuffle.shuffle)
STORE_ATTRS = {
    "position": {
        "units": "1e-9 degree, 1e-9 degree, 1e-4 m",
        "long_name": "longitude and latitude from the south-west corner of the cell, "
        "height above the WGS 84 ellipsoid",
        "components": ["lon", "lat", "height"],
    },
    "attributes": {
        "units": "1",
        "long_name": "LAS attributes of the points",
        "components": list(ATTRIBUTES),
    },
    "cell_row": {"units": "1", "long_name": "latitude of the cell's south edge / cell size"},
    "cell_col": {"units": "1", "long_name": "longitude of the cell's west edge / cell size"},
    "cell_start": {"units": "1", "long_name": "index of the cell's first point"},
    "cell_min": {"units": "1e-4 m", "long_name": "lowest height of the cell's points"},
    "cell_max": {"units": "1e-4 m", "long_name": "highest height of the cell's points"},
}


@dataclass(frozen=True)
class Points:
    """Points of a query, [n] each: lattice coordinates (int64) and LAS attributes (uint8)."""

    lon_q: np.ndarray
    lat_q: np.ndarray
    h_q: np.ndarray
    classification: np.ndarray
    return_number: np.ndarray
    number_of_returns: np.ndarray

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
            return cls(q, q, q, u, u, u)
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@kernel
def _select(
    position: NDArray[np.int32],
    attributes: Bytes,
    start: Integers,
    corner: Integers,
    box: Integers,
    lon: Integers,
    lat: Integers,
    height: Integers,
    out: Bytes,
) -> int:
    """Fill lon, lat, height [n] and out [3, n] with the stored points in a box; how many there are.

    ``start`` [m + 1] of the cells' points, ``corner`` [2, m] their south-west corners (lon, lat).
    """
    kept = 0
    for cell in range(start.size - 1):
        west, south, east, north = box[0], box[1], box[2], box[3]
        col, row = corner[0, cell], corner[1, cell]
        for i in range(start[cell], start[cell + 1]):
            x, y = position[0, i] + col, position[1, i] + row
            lon[kept], lat[kept], height[kept] = x, y, position[2, i]
            for k in range(3):
                out[k, kept] = attributes[k, i]
            kept += (x >= west) & (y >= south) & (x <= east) & (y <= north)
    return kept


class PointStore:
    """A finished point store, open for queries.

    ``bounds`` = (lon_min, lat_min, lon_max, lat_max, h_min, h_max), ``count`` points, ``attrs`` of
    the store. Raises InputError if the store is missing, unfinished or of another kind.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        group = require_complete(path)
        if group.attrs.get("kind") != "points":
            raise InputError("no point store", file=path, remedy="give a store made by ingest")
        self.attrs: dict[str, Any] = dict(group.attrs)
        self.bounds: tuple[float, ...] = tuple(self.attrs["bounds"])
        self._position, self._attributes = group["position"], group["attributes"]
        self.count = int(self._position.shape[1])
        self.cell_row = group["cell_row"][:].astype(np.int64)
        self.cell_col = group["cell_col"][:].astype(np.int64)
        self.cell_heights = np.stack([group["cell_min"][:], group["cell_max"][:]], axis=1)
        self._start = np.append(group["cell_start"][:], self.count)
        self._key = cell_key(self.cell_row, self.cell_col)
        self._first_of_row = np.flatnonzero(np.diff(self.cell_row, prepend=self.cell_row[0] - 1))

    @property
    def cell_counts(self) -> Integers:
        """Points in each cell."""
        return np.diff(self._start)

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
        west, south, east, north = self.bounds[:4]
        if lon_max < west or lon_min > east or lat_max < south or lat_min > north:
            return None
        box = lattice_box(lon_min, lat_min, lon_max, lat_max)
        heights = [self.cell_heights[a:b] for a, b in self._cells(box)]
        if not heights:
            return None
        heights = np.concatenate(heights)
        return float(heights[:, 0].min()) / PER_M, float(heights[:, 1].max()) / PER_M

    def query(self, lon_min: float, lat_min: float, lon_max: float, lat_max: float) -> Points:
        """Points with lon_min <= lon <= lon_max and lat_min <= lat <= lat_max, in stored order."""
        ranges: list[tuple[int, int]] = []
        box = lattice_box(lon_min, lat_min, lon_max, lat_max)
        for first, end in self._cells(box):
            # Rows less than a chunk apart share it: one read for both.
            if ranges and self._start[first] - self._start[ranges[-1][1]] < CHUNK_POINTS:
                ranges[-1] = (ranges[-1][0], end)
            else:
                ranges.append((first, end))
        return Points.concatenate([self._read(first, end, box) for first, end in ranges])

    def _read(self, first: int, end: int, box: tuple[int, int, int, int]) -> Points:
        where = slice(int(self._start[first]), int(self._start[end]))
        stored = self._position[:, where], self._attributes[:, where]
        total = where.stop - where.start
        lattice, attributes = np.empty((3, total), np.int64), np.empty((3, total), np.uint8)
        start = self._start[first : end + 1] - where.start
        corner = np.stack([self.cell_col[first:end], self.cell_row[first:end]]) << CELL_BITS
        kept = _select(*stored, start, corner, np.array(box), *lattice, attributes)
        return Points(*lattice[:, :kept], *attributes[:, :kept])


def _datum_and_operation(store: PointStore) -> tuple[str, str]:
    """The datum that a store's file was in, and what brought it to WGS 84, projections apart."""
    crs = store.attrs.get("crs", {})
    datum = re.search(r'(?:DATUM|ENSEMBLE)\["([^"]+)"', crs.get("wkt", ""))
    steps = crs.get("operation", "").split(" + ")
    steps = [step for step in steps if not step.startswith(("Inverse of ", "axis order change"))]
    return datum[1] if datum else "", " + ".join(steps)


def open_stores(paths: Iterable[str | Path]) -> tuple[PointStore, ...]:
    """The point stores of one scene, in the order given.

    Raises InputError, besides what PointStore raises, if two files of one datum were brought to
    WGS 84 by different transformations: a step of up to metres would run through the scene.
    """
    stores = tuple(PointStore(path) for path in paths)
    first: dict[str, tuple[str, PointStore]] = {}
    for store in stores:
        datum, operation = _datum_and_operation(store)
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


def query_points(
    stores: Sequence[PointStore | str | Path],
    lon_min: float,
    lat_min: float,
    lon_max: float,
    lat_max: float,
) -> Points:
    """Points of a box (degrees, inclusive) in all stores, store after store."""
    opened = [s if isinstance(s, PointStore) else PointStore(s) for s in stores]
    return Points.concatenate(
        [
            store.query(lon_min, lat_min, lon_max, lat_max)
            for store in opened
            if store.bounds[0] <= lon_max
            and store.bounds[2] >= lon_min
            and store.bounds[1] <= lat_max
            and store.bounds[3] >= lat_min
        ]
    )
