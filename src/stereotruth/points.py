"""LiDAR files to spatially ordered point stores, and exact box queries on these.

Every point lies on one global lattice: longitude and latitude in steps of 1e-9° (0.1 mm), height in
steps of 1e-4 m. Sums over lattice integers are exact, so that nothing later depends on the order
of files or points. Points are stored by square cells of 2**20 steps (0.00105°, 117 m along a
meridian), cells in row-major order (south to north, west to east), inside a cell in the order of
the file. The store of a file is the same to the byte whatever the size of the reading chunks.

Layout of a store (Zarr v3, sharded; n points, m cells):

===========================  =============  ==================================================
``position``                 int32 [3, n]   lon, lat: steps from the cell's south-west corner;
                                            height: steps above the WGS 84 ellipsoid
``attributes``               uint8 [3, n]   classification, return_number, number_of_returns
``cell_row``, ``cell_col``   int32 [m]      lattice latitude, longitude >> 20
``cell_start``               int64 [m]      first point of the cell
``cell_min``, ``cell_max``   int32 [m]      lowest and highest height in the cell
===========================  =============  ==================================================

One array for all that is read together: queries are nearly twice as fast as with one each.

What ingest does to a point costs less than half of decoding it: kernels take the records apart,
bring them to the lattice and sort them by cell without an intermediate copy of the points.
"""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
import zarr
from numba import njit
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle

from .crs import DEGREE_M, ToWGS84, check_area, to_wgs84
from .errors import InputError
from .grid_store import building, require_complete
from .runlog import progress

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

log = logging.getLogger("stereotruth")
logging.getLogger("laspy").addHandler(logging.NullHandler())  # its remarks name no file

LATTICE_DEG = 1e-9
LATTICE_M = 1e-4
_PER_DEG = 10**9
_PER_M = 10**4
CELL_BITS = 20
CHUNK_POINTS = 1 << 17  # points per Zarr chunk
SHARD_POINTS = 1 << 21  # points per shard file
_ATTRIBUTES = ("classification", "return_number", "number_of_returns")
_RECORD_BYTES = 16  # of a point before it has its final place: position and attributes
SCRATCH_POINTS = 1 << 24  # of these kept in memory, 256 MiB
# A fifth of the time of zstd, level 3, to write and a third to read, for a tenth more bytes (7.1
# instead of 6.4 a point): a store is written once and read once or twice.
_CODEC = BloscCodec(cname="lz4", clevel=5, shuffle=BloscShuffle.shuffle)
_ATTRS = {
    "position": {
        "units": "1e-9 degree, 1e-9 degree, 1e-4 m",
        "long_name": "longitude and latitude from the south-west corner of the cell, "
        "height above the WGS 84 ellipsoid",
        "components": ["lon", "lat", "height"],
    },
    "attributes": {
        "units": "1",
        "long_name": "LAS attributes of the points",
        "components": list(_ATTRIBUTES),
    },
    "cell_row": {"units": "1", "long_name": "latitude of the cell's south edge / cell size"},
    "cell_col": {"units": "1", "long_name": "longitude of the cell's west edge / cell size"},
    "cell_start": {"units": "1", "long_name": "index of the cell's first point"},
    "cell_min": {"units": "1e-4 m", "long_name": "lowest height of the cell's points"},
    "cell_max": {"units": "1e-4 m", "long_name": "highest height of the cell's points"},
}
COARSEST_STEP_M = 0.5  # coordinates stored in coarser steps are refused: a pixel is 0.3-1 m
SAMPLE_POINTS = 100_000  # first points of a file, on which quantised coordinates are looked for
FARTHEST_M = 2e5  # heights beyond are no heights


# ------------------------------------------------------------------ reading LAS

_UNREADABLE = (
    laspy.errors.LaspyException,
    lazrs.LazrsError,
    struct.error,
    EOFError,
    IndexError,
    KeyError,
    OSError,
    ValueError,
)


def _wrong_count(file: Path, announced: int, held: str, error: object = "") -> InputError:
    return InputError(
        f"truncated or damaged: the header announces {announced} points, {held}"
        + (f" ({error})" if error else ""),
        file=file,
        remedy="fetch or write the file again",
    )


def _points_in_chunk_table(stream: BinaryIO, header: laspy.LasHeader) -> tuple[int, int]:
    """Least and most number of points that the chunk table of a LAZ file accounts for."""
    vlr = lazrs.LazVlr(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    stream.seek(header.offset_to_point_data)
    table = lazrs.read_chunk_table(stream, vlr) or []
    most = sum(points for points, _ in table)
    if vlr.uses_variable_size_chunks() or not table:
        return most, most
    return most - table[-1][0] + 1, most  # only the last chunk of a fixed size may be shorter


def read_header(file: str | Path) -> laspy.LasHeader:
    """Header of a LAS or LAZ file whose number of points agrees with what the file holds.

    Raises InputError: missing, no LAS, empty, truncated (both counts are named).
    """
    file = Path(file)
    if not file.is_file():
        raise InputError("no such LiDAR file", file=file, remedy="correct the path in scenes.tsv")
    try:
        with file.open("rb") as stream:
            header = laspy.LasHeader.read_from(stream, read_evlrs=False)
    except _UNREADABLE as error:
        raise InputError(
            f"no readable LAS or LAZ file ({error})", file=file, remedy="check or replace the file"
        ) from error
    announced = header.point_count
    room = max(0, file.stat().st_size - header.offset_to_point_data)
    with file.open("rb") as stream:
        if header.are_points_compressed:
            try:
                least, most = _points_in_chunk_table(stream, header) if announced else (0, 0)
            except _UNREADABLE as error:
                held = "0 can be read, as its chunk table is missing"
                raise _wrong_count(file, announced, held, error) from error
            if not least <= announced <= most:
                raise _wrong_count(file, announced, f"its chunks hold {most}")
        elif room // header.point_format.size < announced:
            raise _wrong_count(
                file, announced, f"the file holds {room // header.point_format.size}"
            )
        if announced == 0:
            raise InputError(
                "the header announces 0 points"
                + (f", {room} bytes follow it: it was never completed" if room > 100 else ""),
                file=file,
                remedy="remove the file, or write it again",
            )
        try:
            header.read_evlrs(stream)
        except _UNREADABLE as error:
            raise InputError(
                f"its extended variable length records cannot be read ({error})",
                file=file,
                remedy="fetch or write the file again",
            ) from error
    return header


def _surplus(header: laspy.LasHeader, file: Path) -> str | None:
    """Remark on points after the last that the header counts (a stale header), or None."""
    if header.are_points_compressed or header.version.minor == 3:  # 1.3: waveforms may follow
        return None
    end = header.start_of_first_evlr if header.number_of_evlrs else file.stat().st_size
    held = (end - header.offset_to_point_data) // header.point_format.size
    if held <= header.point_count:
        return None
    return f"the header announces {header.point_count} points, which are read; {held} would fit"


def _chunks(
    file: Path, header: laspy.LasHeader, size: int
) -> Iterator[laspy.ScaleAwarePointRecord]:
    """All points of a file in its order, at most ``size`` at a time, with the fields needed here.

    COPC is read like any LAZ, through its chunk table: whole, whatever its hierarchy pages.
    """
    fields = laspy.DecompressionSelection
    done = 0
    with laspy.open(
        file,
        laz_backend=laspy.LazBackend.Lazrs,  # the parallel one takes all cores there are
        read_evlrs=False,
        decompression_selection=fields.XY_RETURNS_CHANNEL
        | fields.Z
        | fields.CLASSIFICATION
        | fields.FLAGS,
    ) as reader:
        while done < header.point_count:
            wanted = min(size, header.point_count - done)
            try:
                points = reader.read_points(wanted)
            except _UNREADABLE as error:
                held = f"decoding failed after {done}"
                raise _wrong_count(file, header.point_count, held, error) from error
            done += len(points)
            if len(points) < wanted:
                raise _wrong_count(file, header.point_count, f"{done} were read")
            yield points


def _ahead(items: Iterator) -> Iterator:
    """The same items, each made in a thread while the one before is in use."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


# ------------------------------------------------------------------ ingest


def _no_limits() -> np.ndarray:
    return np.array([[np.iinfo(np.int64).max] * 3, [np.iinfo(np.int64).min] * 3])


@dataclass
class _Tally:
    """What is counted and checked along the way; nothing in it depends on the chunks."""

    counts: Integers = field(default_factory=lambda: np.zeros((2, 257), np.int64))  # see _unpack
    file_limits: Integers = field(default_factory=_no_limits)  # [2, 3], stored integers
    lattice_limits: Integers = field(default_factory=_no_limits)  # [2, 3], kept points
    sample: list[np.ndarray] = field(default_factory=list)
    sampled: int = 0

    def take(
        self,
        points: laspy.ScaleAwarePointRecord,
        header: laspy.LasHeader,
        drop_classes: Sequence[int],
    ) -> tuple[Floats, NDArray[np.uint32]]:
        """Coordinates [3, n] and attributes [n], see _unpack, of the points to keep."""
        unwanted = np.isin(np.arange(256), drop_classes)
        raw = np.frombuffer(points.array, np.uint8).reshape(len(points), -1)
        xyz, attributes = np.empty((3, len(points))), np.empty(len(points), np.uint32)
        kept = _unpack(
            raw,
            header.point_format.id >= 6,
            unwanted,
            np.asarray(header.scales, np.float64),
            np.asarray(header.offsets, np.float64),
            xyz,
            attributes,
            self.counts,
            self.file_limits,
        )
        return xyz[:, :kept], attributes[:kept]

    @property
    def read(self) -> int:
        return int(self.counts.sum())

    def dropped(self, drop_classes: Sequence[int]) -> dict[str, int]:
        """Dropped points by reason; each counts under its first."""
        by_class = {f"class {c}": int(self.counts[1, c]) for c in drop_classes if 0 <= c < 256}
        return {"withheld": int(self.counts[1, 256])} | by_class

    def compare_bounds(self, header: laspy.LasHeader, file: Path) -> str | None:
        """Refuse points far outside of the header's bounds: a damaged LAZ decodes into noise.

        Returns a remark where they lie outside at all.
        """
        scale, offset = np.asarray(header.scales), np.asarray(header.offsets)
        mins, maxs = np.asarray(header.mins), np.asarray(header.maxs)
        size = maxs - mins
        if not (np.isfinite(size).all() and size.max() > 0):
            return None  # never filled in
        low, high = self.file_limits * scale + offset
        beyond = np.maximum(mins - low, high - maxs)
        if (beyond <= 2 * scale).all():
            return None
        text = (
            f"points reach from {_triple(low)} to {_triple(high)}, "
            f"the header says from {_triple(mins)} to {_triple(maxs)}"
        )
        if (beyond[:2] > size[:2].max() + 1000).any():
            raise InputError(f"damaged: {text}", file=file, remedy="fetch or write the file again")
        return text

    def look(self, lattice: Integers) -> None:
        """Keep the first points for :meth:`refuse_quantised`."""
        if (missing := SAMPLE_POINTS - self.sampled) > 0:
            # 32 bits each: 4.3 degrees, more than a file covers
            low = lattice[:2, :missing] & 0xFFFFFFFF
            self.sample.append(low[0] << 32 | low[1])
            self.sampled += len(self.sample[-1])

    def refuse_quantised(self, file: Path) -> None:
        sample = np.concatenate(self.sample)
        positions = len(np.unique(sample))
        if len(sample) >= 1000 and positions < 0.1 * len(sample):
            raise InputError(
                f"coordinates are quantised: {len(sample)} points lie on {positions} positions",
                file=file,
                remedy="write the file again with a finer scale (0.01 m, or 1e-7 degree)",
            )


def _refuse_coarse(header: laspy.LasHeader, transform: ToWGS84, file: Path) -> None:
    step = float(max(header.scales[:2])) * transform.system.horizontal_unit_m
    if step > COARSEST_STEP_M:
        raise InputError(
            f"coordinates are stored in steps of {max(header.scales[:2]):g}, "
            f"{step:.4g} m on the ground",
            file=file,
            remedy="write the file again with a finer scale (0.01 m, or 1e-7 degree)",
        )


# Kernels free the GIL; nothing in them depends on how the points are cut into chunks.


@njit(cache=True, nogil=True, error_model="numpy")
def _integer(raw: Bytes, i: int, at: int) -> int:
    value = np.int64(raw[i, at]) | np.int64(raw[i, at + 1]) << 8
    value |= np.int64(raw[i, at + 2]) << 16 | np.int64(raw[i, at + 3]) << 24
    return np.int64(np.int32(value))


@njit(cache=True, nogil=True, error_model="numpy")
def _unpack(
    raw: Bytes,
    extended: bool,
    unwanted: NDArray[np.bool_],
    scale: Floats,
    offset: Floats,
    xyz: Floats,
    attributes: NDArray[np.uint32],
    counts: Integers,
    limits: Integers,
) -> int:
    """Fill ``xyz`` [3, n] and ``attributes`` [n] with the points to keep; returns their number.

    ``raw`` [n, size] are point data records; ``extended``: of formats 6 to 10. The places of fields
    in them are those of LAS 1.4 R16, "Point Data Record Format 0" and "6". ``unwanted`` [256] by
    class. Attributes are class + 256 return number + 65536 number of returns. ``counts`` [2, 257]:
    of kept and of dropped points by class, the last of withheld ones. ``limits`` [2, 3]: lowest
    and highest stored coordinates of all points.
    """
    kept = 0
    low_x, low_y, low_z = limits[0]
    high_x, high_y, high_z = limits[1]
    for i in range(raw.shape[0]):
        x, y, z = _integer(raw, i, 0), _integer(raw, i, 4), _integer(raw, i, 8)
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
        returns, flags = np.int64(raw[i, 14]), np.int64(raw[i, 15])
        if extended:
            kind, withheld = np.int64(raw[i, 16]), flags >> 2 & 1
            returns = (returns & 15) << 8 | (returns >> 4) << 16
        else:
            kind, withheld = flags & 31, flags >> 7
            returns = (returns & 7) << 8 | (returns >> 3 & 7) << 16
        drop = withheld | np.int64(unwanted[kind])
        counts[drop, 256 if withheld == 1 else kind] += 1
        xyz[0, kept] = x * scale[0] + offset[0]
        xyz[1, kept] = y * scale[1] + offset[1]
        xyz[2, kept] = z * scale[2] + offset[2]
        attributes[kept] = kind | returns
        kept += 1 - drop
    limits[0] = low_x, low_y, low_z
    limits[1] = high_x, high_y, high_z
    return kept


@njit(cache=True, nogil=True, error_model="numpy")
def _round(lon: Floats, lat: Floats, height: Floats, out: Integers, limits: Integers) -> bool:
    """Fill ``out`` [3, n] with lattice coordinates and widen ``limits`` [2, 3] by them.

    False if there is a point that has no place on Earth; then ``out`` is not whole.
    """
    for k, (values, steps, farthest) in enumerate(
        ((lon, _PER_DEG, np.inf), (lat, _PER_DEG, np.inf), (height, _PER_M, FARTHEST_M))
    ):
        good = True
        low, high = limits[0, k], limits[1, k]
        for i in range(values.size):
            good &= abs(values[i]) < farthest
            q = np.int64(np.rint(values[i] * steps))
            low, high = min(low, q), max(high, q)
            out[k, i] = q
        if not good:
            return False
        limits[0, k], limits[1, k] = low, high
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _number_cells(lattice: Integers, row: int, col: int, width: int, out: Integers) -> None:
    """Number of the cell of each point in a raster of cells, its first cell at row, col."""
    for i in range(out.size):
        out[i] = ((lattice[1, i] >> CELL_BITS) - row) * width + (lattice[0, i] >> CELL_BITS) - col


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(
    lattice: Integers,
    attributes: NDArray[np.uint32],
    cell: Integers,
    end: Integers,
    limits: NDArray[np.int32],
    run: NDArray[np.int32],
) -> None:
    """Fill ``run`` [n, 4] with the points as scratch records, by cell, in their order in a cell.

    ``cell`` [n] is the number of each point's cell; ``end`` [m], zeros, gets the end of each cell
    in the run, ``limits`` [m, 2] its lowest and highest height.
    """
    for i in range(cell.size):
        end[cell[i]] += 1
    total = 0
    for c in range(end.size):
        number = end[c]
        end[c] = total
        total += number
        limits[c, 0], limits[c, 1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    inside = (1 << CELL_BITS) - 1
    for i in range(cell.size):
        c = cell[i]
        at = end[c]
        end[c] += 1
        height = np.int32(lattice[2, i])
        run[at, 0] = lattice[0, i] & inside
        run[at, 1] = lattice[1, i] & inside
        run[at, 2] = height
        run[at, 3] = attributes[i]
        limits[c, 0], limits[c, 1] = min(limits[c, 0], height), max(limits[c, 1], height)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(
    records: NDArray[np.int32],
    pieces: Integers,
    position: NDArray[np.int32],
    attributes: Bytes,
) -> None:
    """Fill position [3, n] and attributes [3, n] from pieces of scratch records [k, 4].

    ``pieces`` [m, 2]: first record and number of records of each.
    """
    done = 0
    for piece in range(pieces.shape[0]):
        first, number = pieces[piece]
        for k in range(3):
            target, low = position[k, done : done + number], attributes[k, done : done + number]
            for i in range(number):
                target[i] = records[first + i, k]
                low[i] = records[first + i, 3] >> 8 * k & 255
        done += number


def _to_lattice(transform: ToWGS84, xyz: Floats, limits: Integers, file: Path) -> NDArray[np.int64]:
    """Lattice longitude, latitude, height (int64[3, n]) of file coordinates; widens ``limits``."""
    try:
        lon, lat, height = transform(*xyz)
    except InputError as error:  # of the geoid grid, which does not know the file
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    out = np.empty(xyz.shape, np.int64)
    if not _round(lon, lat, height, out, limits):
        good = np.isfinite(lon) & np.isfinite(lat) & (np.abs(height) < FARTHEST_M)
        bad = np.flatnonzero(~good)
        raise InputError(
            f"{bad.size} points have no place on Earth in '{transform.system.name}', the first at "
            "({:.3f}, {:.3f}, {:.3f})".format(*xyz[:, bad[0]]),
            file=file,
            remedy="correct lidar_crs or the file's coordinate system, or remove these points",
        )
    return out


def _cell_key(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """One int64 that sorts cells by row, then column."""
    return (np.asarray(row, np.int64) << 32) + (np.asarray(col, np.int64) + (1 << 30))


def _cells(lattice: Integers) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys of cells [m], sorted, and the number among these of each point's cell [n]."""
    low_col, low_row = lattice[:2].min(axis=1) >> CELL_BITS
    high_col, high_row = lattice[:2].max(axis=1) >> CELL_BITS
    width, height = int(high_col - low_col) + 1, int(high_row - low_row) + 1
    if width * height > 1 << 16:  # far apart
        key = _cell_key(lattice[1] >> CELL_BITS, lattice[0] >> CELL_BITS)
        return np.unique(key, return_inverse=True)
    row, col = np.divmod(np.arange(width * height), width)
    cell = np.empty(lattice.shape[1], np.int64)
    _number_cells(lattice, low_row, low_col, width, cell)
    return _cell_key(row + low_row, col + low_col), cell


@dataclass
class _Runs:
    """External sort by cell: each chunk becomes one sorted run, a part of the scratch.

    A segment is what one run holds of one cell; segments of a cell, in the order of the runs, are
    its points in the order of the file. Runs are in ``memory`` [k, 4]; where that is full, it is
    moved to ``disk``.
    """

    memory: NDArray[np.int32]
    disk: BinaryIO
    written: int = 0
    held: int = 0  # in memory
    segments: list[np.ndarray] = field(default_factory=list)  # int64 [k, 3]: key, start, count
    limits: list[np.ndarray] = field(default_factory=list)  # int32 [k, 2]: lowest, highest

    def add(self, lattice: NDArray[np.int64], attributes: NDArray[np.uint32]) -> None:
        """Take in a chunk's points: lattice coordinates [3, n], attributes [n] as of _unpack."""
        size = attributes.size
        if not size:
            return
        if self.held + size > len(self.memory):
            self.spill()
        key, cell = _cells(lattice)
        end, limits = np.zeros(key.size, np.int64), np.empty((key.size, 2), np.int32)
        run = self.memory[self.held : self.held + size]
        _sort(lattice, attributes, cell, end, limits, run)
        count = np.diff(end, prepend=0)
        here = count > 0
        segments = np.stack([key, end - count + self.written, count], axis=1)
        self.segments.append(segments[here])
        self.limits.append(limits[here])
        self.held += size
        self.written += size

    def spill(self) -> None:
        self.disk.write(self.memory[: self.held])  # unlike ndarray.tofile it says why it fails
        self.held = 0

    def take(self, pieces: list[tuple[int, int]]) -> tuple[NDArray[np.int32], Bytes]:
        """Position [3, n] and attributes [3, n] of pieces of runs: first record, number."""
        where = np.array(pieces, np.int64).reshape(-1, 2)
        total = int(where[:, 1].sum())
        position, attributes = np.empty((3, total), np.int32), np.empty((3, total), np.uint8)
        records = self.memory
        if self.written > self.held:
            # Read by hand: pages of a memory map would count as this process's memory.
            records, done = np.empty((total, 4), np.int32), 0
            for first, number in pieces:
                self.disk.seek(first * _RECORD_BYTES)
                target = memoryview(records[done : done + number]).cast("B")
                if self.disk.readinto(target) != number * _RECORD_BYTES:
                    raise OSError("the scratch file of the points is cut short")
                done += number
            where = np.array([[0, total]])
        _gather(records, where, position, attributes)
        return position, attributes

    def write(self, group: zarr.Group) -> None:
        """Write points and cell table in final order."""
        segments, limits = np.concatenate(self.segments), np.concatenate(self.limits)
        order = np.argsort(segments[:, 0], kind="stable")
        segments, limits = segments[order], limits[order]
        key, first = np.unique(segments[:, 0], return_index=True)
        start_of = np.concatenate([[0], np.cumsum(segments[:, 2])])  # of segments, sorted
        table = {
            "cell_row": (key >> 32).astype("i4"),
            "cell_col": ((key & 0xFFFFFFFF) - (1 << 30)).astype("i4"),
            "cell_start": start_of[first].astype("i8"),
            "cell_min": np.minimum.reduceat(limits[:, 0], first),
            "cell_max": np.maximum.reduceat(limits[:, 1], first),
        }
        for name, values in table.items():
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                chunks=values.shape,
                compressors=_CODEC,
                dimension_names=("cell",),
                attributes=_ATTRS[name],
            )
            array[:] = values
        arrays = {
            name: group.create_array(
                name,
                shape=(3, self.written),
                dtype=dtype,
                chunks=(3, CHUNK_POINTS),
                shards=(3, SHARD_POINTS),
                compressors=_CODEC,
                dimension_names=("component", "point"),
                attributes=_ATTRS[name],
                config={"write_empty_chunks": True},  # does not look whether they are
            )
            for name, dtype in (("position", "i4"), ("attributes", "u1"))
        }
        if self.written > self.held:
            self.spill()
        for begin in range(0, self.written, SHARD_POINTS):
            end = min(begin + SHARD_POINTS, self.written)
            at = int(np.searchsorted(start_of, begin, side="right")) - 1
            pieces, done = [], begin
            while done < end:
                _, start, count = segments[at].tolist()
                skip = done - int(start_of[at])
                pieces.append((start + skip, min(count - skip, end - done)))
                done += pieces[-1][1]
                at += 1
            position, attributes = self.take(pieces)
            arrays["position"][:, begin:end] = position
            arrays["attributes"][:, begin:end] = attributes


def _bounds(low: np.ndarray, high: np.ndarray) -> list[float]:
    return [
        *(float(value) / _PER_DEG for value in (low[0], low[1], high[0], high[1])),
        float(low[2]) / _PER_M,
        float(high[2]) / _PER_M,
    ]


def ingest(
    lidar_file: str | Path,
    store: str | Path,
    *,
    lidar_crs: str | None = None,
    geoid: str | Path | None = None,
    drop_classes: Sequence[int] = (7, 18),
    scene: str = "",
    provenance: Mapping[str, Any] | None = None,
    chunk_points: int = 100_000,
    workers: int = 1,
) -> dict[str, Any]:
    """Bring one LAS, LAZ or COPC file (1.0 to 1.4, any point format) into a point store.

    Memory is that of one reading chunk, one shard and :data:`SCRATCH_POINTS`, whatever the size of
    the file; where it has more points, they pass through a scratch file without a name, 16 bytes
    each, on the disk of the store.

    Withheld points are dropped, and those of ``drop_classes``: by default noise, 7 (low) and 18
    (high). Synthetic points, overlap points and producers' own classes (65 and 67 mark artefacts in
    IGN's files) are kept unless listed. Coordinates: see :mod:`stereotruth.crs`. ``lidar_crs``
    (EPSG or WKT) and ``geoid`` (path of a grid) as in scenes.tsv; None or "" where not needed.
    With ``workers`` > 1 a thread decodes ahead (the result is the same).

    Returns what is also in the store's attributes: ``points`` (header, read, kept, dropped by
    reason), ``classes`` (kept points by class), ``bounds`` (lon_min, lat_min, lon_max, lat_max in
    degrees, h_min, h_max in m), ``crs`` and ``notes`` (remarks for the user, which are logged too).

    Raises InputError: missing, empty, truncated or unreadable file; no usable coordinate system;
    orthometric heights without a geoid; points off the geoid grid, off the Earth or far outside the
    area of the coordinate system; coordinates quantised too coarsely; no point left.
    """
    file = Path(lidar_file)
    header = read_header(file)
    transform = to_wgs84(header, file, lidar_crs=lidar_crs, geoid=geoid)
    _refuse_coarse(header, transform, file)
    notes = list(transform.notes)
    if remark := _surplus(header, file):
        notes.append(remark)
    tally = _Tally()
    with (
        building(store) as unfinished,
        TemporaryFile(dir=unfinished.parent) as disk,
    ):
        group = zarr.open_group(unfinished, mode="w", zarr_format=3)
        room = max(min(SCRATCH_POINTS, header.point_count), chunk_points)
        runs = _Runs(np.empty((room, 4), np.int32), disk)
        chunks = _chunks(file, header, chunk_points)
        if workers > 1:
            chunks = _ahead(chunks)
        total = -(-header.point_count // chunk_points)
        for points in progress(chunks, total, f"{file.name}: chunks of points read"):
            xyz, attributes = tally.take(points, header, drop_classes)
            tally.compare_bounds(header, file)
            lattice = _to_lattice(transform, xyz, tally.lattice_limits, file)
            tally.look(lattice)
            runs.add(lattice, attributes)
        if remark := tally.compare_bounds(header, file):
            notes.append(remark)
        if runs.written == 0:
            raise InputError(
                f"no point is left of {tally.read}: {_listed(tally.dropped(drop_classes))}",
                file=file,
                remedy="remove the file, or drop fewer classes",
            )
        tally.refuse_quantised(file)
        bounds = _bounds(*tally.lattice_limits)
        lon, lat = (bounds[0], bounds[2]), (bounds[1], bounds[3])
        if remark := check_area(transform.system, lon, lat, file):
            notes.append(remark)
        if bounds[4] < -600 or bounds[5] > 9500:
            notes.append(f"heights from {bounds[4]:.1f} to {bounds[5]:.1f} m are implausible")
        runs.write(group)
        summary = {
            "points": {
                "header": header.point_count,
                "read": tally.read,
                "kept": runs.written,
                "dropped": tally.dropped(drop_classes),
            },
            "classes": {str(c): int(n) for c, n in enumerate(tally.counts[0]) if n},
            "bounds": bounds,
            "crs": transform.describe(),
            "notes": notes,
        }
        group.attrs.update(
            {
                "kind": "points",
                "conventions": "WGS 84 longitude and latitude, ellipsoidal height, on the lattice "
                f"of {LATTICE_DEG:g} degree and {LATTICE_M:g} m; cells of 2**{CELL_BITS} steps, "
                "row-major; the order of the file inside a cell",
                "scene": scene,
                "source": file.name,
                "cell_bits": CELL_BITS,
                **summary,
                "provenance": dict(provenance or {}),
            }
        )
    for note in notes:
        log.warning("%s: %s", file.name, note)
    log.info(
        "%s: %d of %d points kept (%s); heights %.2f to %.2f m",
        file.name,
        runs.written,
        tally.read,
        _listed(tally.dropped(drop_classes)),
        *bounds[4:],
    )
    return summary


def _triple(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"


def _listed(dropped: Mapping[str, int]) -> str:
    return "dropped: " + (
        ", ".join(f"{n} {reason}" for reason, n in dropped.items() if n) or "none"
    )


# ------------------------------------------------------------------ queries


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
        return self.lon_q / _PER_DEG

    @cached_property
    def lat(self) -> np.ndarray:
        """Latitude, degrees, float64[n]."""
        return self.lat_q / _PER_DEG

    @cached_property
    def height(self) -> np.ndarray:
        """Ellipsoidal height, m, float64[n]."""
        return self.h_q / _PER_M

    @classmethod
    def concatenate(cls, parts: Sequence[Points]) -> Points:
        """Points of all parts, in their order."""
        if not parts:
            q, u = np.empty(0, np.int64), np.empty(0, np.uint8)
            return cls(q, q, q, u, u, u)
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


def _lattice_box(
    lon_min: float, lat_min: float, lon_max: float, lat_max: float
) -> tuple[int, int, int, int]:
    """The lattice points q with minimum <= q / 1e9 <= maximum (in float64), as inclusive limits."""

    def lowest(limit: float) -> int:
        q = math.ceil(limit * _PER_DEG)
        while (q - 1) / _PER_DEG >= limit:
            q -= 1
        while q / _PER_DEG < limit:
            q += 1
        return q

    west, south, east, north = (
        min(max(float(value), -1000.0), 1000.0) for value in (lon_min, lat_min, lon_max, lat_max)
    )
    return lowest(west), lowest(south), -lowest(-east), -lowest(-north)


@njit(cache=True, nogil=True, error_model="numpy")
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
        self._key = _cell_key(self.cell_row, self.cell_col)
        self._first_of_row = np.flatnonzero(np.diff(self.cell_row, prepend=self.cell_row[0] - 1))

    def _cells(self, box: tuple[int, int, int, int]) -> list[tuple[int, int]]:
        """Ranges [first, end) of cells that a lattice box touches, in order."""
        low_col, low_row, high_col, high_row = (value >> CELL_BITS for value in box)
        rows = self.cell_row[self._first_of_row]
        rows = rows[(rows >= low_row) & (rows <= high_row)]
        first = np.searchsorted(self._key, _cell_key(rows, np.full(rows.shape, low_col)))
        end = np.searchsorted(self._key, _cell_key(rows, np.full(rows.shape, high_col)), "right")
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
        box = _lattice_box(lon_min, lat_min, lon_max, lat_max)
        heights = [self.cell_heights[a:b] for a, b in self._cells(box)]
        if not heights:
            return None
        heights = np.concatenate(heights)
        return float(heights[:, 0].min()) / _PER_M, float(heights[:, 1].max()) / _PER_M

    def query(self, lon_min: float, lat_min: float, lon_max: float, lat_max: float) -> Points:
        """Points with lon_min <= lon <= lon_max and lat_min <= lat <= lat_max, in stored order."""
        ranges: list[tuple[int, int]] = []
        box = _lattice_box(lon_min, lat_min, lon_max, lat_max)
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


def coverage(stores: Sequence[PointStore]) -> np.ndarray:
    """Boxes of the cells that hold points: float64[m, 4] of lon_min, lat_min, lon_max, lat_max.

    Cells of different stores coincide (one global lattice); each is given once, south to north.
    """
    size = (1 << CELL_BITS) / _PER_DEG
    cells = np.unique(
        np.concatenate([np.stack([s.cell_row, s.cell_col], axis=1) for s in stores]), axis=0
    )
    corner = cells[:, ::-1] * size
    return np.hstack([corner, corner + size])


def summary(stores: Sequence[PointStore]) -> dict[str, Any]:
    """Counts, bounds and remarks over the stores of a scene.

    ``points`` (header, read, kept, dropped by reason), ``bounds`` as in :class:`PointStore`,
    ``covered_km2`` (area of the cells that hold points, rounded up to whole cells), ``notes`` by
    source file.
    """
    bounds = np.array([store.bounds for store in stores])
    points: dict[str, Any] = {"header": 0, "read": 0, "kept": 0, "dropped": {}}
    for store in stores:
        for name, value in store.attrs["points"].items():
            if name == "dropped":
                for reason, number in value.items():
                    points["dropped"][reason] = points["dropped"].get(reason, 0) + number
            else:
                points[name] += value
    boxes = coverage(stores)
    width = np.diff(boxes[:, [0, 2]])[:, 0] * np.cos(np.radians(boxes[:, 1]))
    return {
        "files": [store.attrs["source"] for store in stores],
        "points": points,
        "bounds": [
            *bounds[:, :2].min(0),
            *bounds[:, 2:4].max(0),
            bounds[:, 4].min(),
            bounds[:, 5].max(),
        ],
        "covered_km2": float(
            (width * np.diff(boxes[:, [1, 3]])[:, 0]).sum() * (DEGREE_M / 1e3) ** 2
        ),
        "notes": {store.attrs["source"]: store.attrs["notes"] for store in stores},
    }
