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
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
import zarr

from .crs import DEGREE_M, ToWGS84, check_area, to_wgs84
from .errors import InputError
from .grid_store import building, compressor, require_complete
from .runlog import progress

log = logging.getLogger("stereotruth")
logging.getLogger("laspy").addHandler(logging.NullHandler())  # its remarks name no file

LATTICE_DEG = 1e-9
LATTICE_M = 1e-4
_PER_DEG = 10**9
_PER_M = 10**4
CELL_BITS = 20
CHUNK_POINTS = 1 << 16  # points per Zarr chunk
SHARD_POINTS = 1 << 21  # points per shard file
_ATTRIBUTES = ("classification", "return_number", "number_of_returns")
_RECORD = np.dtype([("position", "<i4", 3), ("attributes", "u1", 3)])  # 15 bytes
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


@dataclass
class _Tally:
    """What is counted and checked along the way; nothing in it depends on the chunks."""

    read: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    classes: np.ndarray = field(default_factory=lambda: np.zeros(256, np.int64))
    sample: list[np.ndarray] = field(default_factory=list)
    sampled: int = 0
    low: np.ndarray = field(default_factory=lambda: np.full(3, np.iinfo(np.int64).max))
    high: np.ndarray = field(default_factory=lambda: np.full(3, np.iinfo(np.int64).min))

    def reach(self, points: laspy.ScaleAwarePointRecord) -> None:
        """Take in all points of a chunk as they are in the file, dropped ones included."""
        self.read += len(points)
        stored = [points.array[axis] for axis in "XYZ"]
        self.low = np.minimum(self.low, [values.min() for values in stored])
        self.high = np.maximum(self.high, [values.max() for values in stored])

    def compare_bounds(self, header: laspy.LasHeader, file: Path) -> str | None:
        """Refuse points far outside of the header's bounds: a damaged LAZ decodes into noise.

        Returns a remark where they lie outside at all.
        """
        scale, offset = np.asarray(header.scales), np.asarray(header.offsets)
        mins, maxs = np.asarray(header.mins), np.asarray(header.maxs)
        size = maxs - mins
        if not (np.isfinite(size).all() and size.max() > 0):
            return None  # never filled in
        low, high = self.low * scale + offset, self.high * scale + offset
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

    def drop(self, reason: str, number: int) -> None:
        self.dropped[reason] = self.dropped.get(reason, 0) + number

    def keep(self, classification: np.ndarray, lon_q: np.ndarray, lat_q: np.ndarray) -> None:
        self.classes += np.bincount(classification, minlength=256)
        if (missing := SAMPLE_POINTS - self.sampled) > 0:
            self.sample.append(np.stack([lon_q[:missing], lat_q[:missing]], axis=1))
            self.sampled += len(self.sample[-1])

    def refuse_quantised(self, file: Path) -> None:
        sample = np.concatenate(self.sample)
        positions = len(np.unique(sample, axis=0))
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


def _kept(
    points: laspy.ScaleAwarePointRecord, drop_classes: Sequence[int], tally: _Tally
) -> np.ndarray:
    """Mask of the points to keep; each dropped point is counted under its first reason."""
    classification = np.asarray(points.classification)
    keep = np.asarray(points.withheld) == 0
    tally.drop("withheld", int(len(keep) - keep.sum()))
    for number in drop_classes:
        hit = keep & (classification == number)
        tally.drop(f"class {number}", int(hit.sum()))
        keep &= ~hit
    return keep


def _to_lattice(
    transform: ToWGS84, x: np.ndarray, y: np.ndarray, z: np.ndarray, file: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lattice longitude, latitude, height (int64[n]) of file coordinates."""
    try:
        lon, lat, height = transform(x, y, z)
    except InputError as error:  # of the geoid grid, which does not know the file
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    good = np.isfinite(lon) & np.isfinite(lat) & (np.abs(height) < 2e5)
    if not good.all():
        bad = np.flatnonzero(~good)
        raise InputError(
            f"{bad.size} points have no place on Earth in '{transform.system.name}', the first at "
            f"({x[bad[0]]:.3f}, {y[bad[0]]:.3f}, {z[bad[0]]:.3f})",
            file=file,
            remedy="correct lidar_crs or the file's coordinate system, or remove these points",
        )
    return (
        np.rint(lon * _PER_DEG).astype(np.int64),
        np.rint(lat * _PER_DEG).astype(np.int64),
        np.rint(height * _PER_M).astype(np.int64),
    )


def _cell_key(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """One int64 that sorts cells by row, then column."""
    return (np.asarray(row, np.int64) << 32) + (np.asarray(col, np.int64) + (1 << 30))


def _order_by_cell(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Stable order by cell. Few cells sort as uint16, which NumPy does by radix."""
    width = int(col.max() - col.min()) + 1
    local = (row - row.min()) * width + (col - col.min())
    if (int(row.max() - row.min()) + 1) * width <= 1 << 16:
        local = local.astype(np.uint16)
    return np.argsort(local, kind="stable")


@dataclass
class _Runs:
    """External sort by cell: each chunk becomes one sorted run in a scratch file.

    A segment is what one run holds of one cell; segments of a cell, in the order of the runs, are
    its points in the order of the file.
    """

    scratch: Path
    written: int = 0
    segments: list[np.ndarray] = field(default_factory=list)  # int64 [k, 3]: key, start, count
    limits: list[np.ndarray] = field(default_factory=list)  # int32 [k, 2]: lowest, highest
    low: np.ndarray = field(default_factory=lambda: np.full(3, np.iinfo(np.int64).max))
    high: np.ndarray = field(default_factory=lambda: np.full(3, np.iinfo(np.int64).min))

    def add(
        self,
        lattice: tuple[np.ndarray, np.ndarray, np.ndarray],
        attributes: Sequence[np.ndarray],
    ) -> None:
        lon_q, lat_q, height_q = lattice
        if not lon_q.size:
            return
        self.low = np.minimum(self.low, [q.min() for q in lattice])
        self.high = np.maximum(self.high, [q.max() for q in lattice])
        row, col = lat_q >> CELL_BITS, lon_q >> CELL_BITS
        order = _order_by_cell(row, col)
        key = _cell_key(row, col)[order]
        start = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        count = np.diff(np.append(start, key.size))
        run = np.empty(lon_q.size, _RECORD)
        height = height_q[order].astype(np.int32)
        run["position"][:, 0] = (lon_q - (col << CELL_BITS))[order]
        run["position"][:, 1] = (lat_q - (row << CELL_BITS))[order]
        run["position"][:, 2] = height
        for k, values in enumerate(attributes):
            run["attributes"][:, k] = values[order]
        self.segments.append(np.stack([key[start], start + self.written, count], axis=1))
        self.limits.append(
            np.stack(
                [np.minimum.reduceat(height, start), np.maximum.reduceat(height, start)], axis=1
            )
        )
        with self.scratch.open("ab") as stream:
            run.tofile(stream)
        self.written += lon_q.size

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
                compressors=compressor(),
                dimension_names=("cell",),
                attributes=_ATTRS[name],
            )
            array[:] = values
        arrays = {
            name: group.create_array(
                name,
                shape=(3, self.written),
                dtype=_RECORD[name].base,
                chunks=(3, CHUNK_POINTS),
                shards=(3, SHARD_POINTS),
                compressors=compressor(),
                dimension_names=("component", "point"),
                attributes=_ATTRS[name],
            )
            for name in _RECORD.names
        }
        # Read by hand: pages of a memory map would count as this process's memory.
        with self.scratch.open("rb", buffering=0) as runs:
            for begin in range(0, self.written, SHARD_POINTS):
                end = min(begin + SHARD_POINTS, self.written)
                shard = np.empty(end - begin, _RECORD)
                target = memoryview(shard).cast("B")
                at = int(np.searchsorted(start_of, begin, side="right")) - 1
                done = begin
                while done < end:
                    _, start, count = segments[at].tolist()
                    skip = done - int(start_of[at])
                    take = min(count - skip, end - done)
                    runs.seek((start + skip) * _RECORD.itemsize)
                    where = slice(
                        (done - begin) * _RECORD.itemsize, (done - begin + take) * _RECORD.itemsize
                    )
                    if runs.readinto(target[where]) != take * _RECORD.itemsize:
                        raise OSError(f"{self.scratch}: scratch file cut short")
                    done += take
                    at += 1
                for name, array in arrays.items():
                    array[:, begin:end] = np.ascontiguousarray(shard[name].T)


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
    chunk_points: int = 250_000,
    workers: int = 1,
) -> dict[str, Any]:
    """Bring one LAS, LAZ or COPC file (1.0 to 1.4, any point format) into a point store.

    Memory is that of one reading chunk and one shard, whatever the size of the file; a scratch file
    of 15 bytes per point lies inside the unfinished store.

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
    scale, offset = np.asarray(header.scales), np.asarray(header.offsets)
    with building(store) as unfinished:
        group = zarr.open_group(unfinished, mode="w", zarr_format=3)
        runs = _Runs(unfinished / "runs.scratch")
        chunks = _chunks(file, header, chunk_points)
        if workers > 1:
            chunks = _ahead(chunks)
        total = -(-header.point_count // chunk_points)
        for points in progress(chunks, total, f"{file.name}: chunks of points read"):
            tally.reach(points)
            keep = _kept(points, drop_classes, tally)
            x, y, z = (
                points.array[axis][keep] * scale[k] + offset[k] for k, axis in enumerate("XYZ")
            )
            lattice = _to_lattice(transform, x, y, z, file)
            attributes = [np.asarray(getattr(points, name))[keep] for name in _ATTRIBUTES]
            tally.keep(attributes[0], lattice[0], lattice[1])
            runs.add(lattice, attributes)
        if remark := tally.compare_bounds(header, file):
            notes.append(remark)
        if runs.written == 0:
            raise InputError(
                f"no point is left of {tally.read}: {_listed(tally.dropped)}",
                file=file,
                remedy="remove the file, or drop fewer classes",
            )
        tally.refuse_quantised(file)
        bounds = _bounds(runs.low, runs.high)
        lon, lat = (bounds[0], bounds[2]), (bounds[1], bounds[3])
        if remark := check_area(transform.system, lon, lat, file):
            notes.append(remark)
        if bounds[4] < -600 or bounds[5] > 9500:
            notes.append(f"heights from {bounds[4]:.1f} to {bounds[5]:.1f} m are implausible")
        runs.write(group)
        runs.scratch.unlink()
        summary = {
            "points": {
                "header": header.point_count,
                "read": tally.read,
                "kept": runs.written,
                "dropped": tally.dropped,
            },
            "classes": {str(c): int(n) for c, n in enumerate(tally.classes) if n},
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
        _listed(tally.dropped),
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
        counts = np.diff(self._start[first : end + 1])
        position = self._position[:, where]
        lon_q = np.repeat(self.cell_col[first:end] << CELL_BITS, counts)
        lon_q += position[0]
        lat_q = np.repeat(self.cell_row[first:end] << CELL_BITS, counts)
        lat_q += position[1]
        values = (lon_q, lat_q, position[2].astype(np.int64), *self._attributes[:, where])
        inside = (lon_q >= box[0]) & (lat_q >= box[1]) & (lon_q <= box[2]) & (lat_q <= box[3])
        if not inside.all():
            values = tuple(value[inside] for value in values)
        return Points(*values)


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
