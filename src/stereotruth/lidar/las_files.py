"""LAS, LAZ and COPC files: headers held against the file, points in chunks, what was read."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..errors import InputError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]


SAMPLE_POINTS = 100_000  # first points of a file, on which quantised coordinates are looked for

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


def surplus_of(header: laspy.LasHeader, file: Path) -> str | None:
    """Remark on points after the last that the header counts (a stale header), or None."""
    if header.are_points_compressed or header.version.minor == 3:  # 1.3: waveforms may follow
        return None
    end = header.start_of_first_evlr if header.number_of_evlrs else file.stat().st_size
    held = (end - header.offset_to_point_data) // header.point_format.size
    if held <= header.point_count:
        return None
    return f"the header announces {header.point_count} points, which are read; {held} would fit"


def read_chunks(
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


def read_ahead(items: Iterator) -> Iterator:
    """The same items, each made in a thread while the one before is in use."""
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = pool.submit(next, items, None)
            yield item


def _no_limits() -> np.ndarray:
    return np.array([[np.iinfo(np.int64).max] * 3, [np.iinfo(np.int64).min] * 3])


@dataclass
class PointTally:
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
        """Points read, dropped ones included."""
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
        """InputError if the file's first points share few positions."""
        sample = np.concatenate(self.sample)
        positions = len(np.unique(sample))
        if len(sample) >= 1000 and positions < 0.1 * len(sample):
            raise InputError(
                f"coordinates are quantised: {len(sample)} points lie on {positions} positions",
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


def _triple(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"
