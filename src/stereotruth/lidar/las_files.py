"""LAS and LAZ files: headers held against the file before a library believes it, points in chunks.

Decoders take memory and time by what a file announces: 68 GB by four bytes of a chunk table, hours
by a number of records. So whatever announces a number, a length or a place is looked at here
first. Sources: LAS 1.4 R16 (ASPRS), "Public Header Block", "Variable Length Records"; the LAZ
specification 1.4 R1 (ASPRS), "LASzip VLR", "Chunk Table", "Layered Chunks".
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.compression import DecompressionSelection

from ..core.errors import InputError
from ..core.numerics.arrays import Ints
from ..core.products.file_parts import GLANCE_BYTES, STREAM_BYTES, open_stream
from ..core.products.remote_files import size_of

HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375, 5: 393}  # by minor version
RECORD_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # by point data record format
VLR_BYTES, EVLR_BYTES = 54, 60
LASZIP = (b"laszip encoded", 22204)
CHUNKED, LAYERED = 2, 3  # kinds of compression that have a chunk table
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # by type of item; extra bytes (14) have one each
EXTRA_BYTES = 14
VARIABLE = 0xFFFFFFFF  # size of chunks that differ
SAMPLES = 16  # points all over a file that its header's bounds are held against
LAZ_CHUNK = 50_000  # points of a chunk, as all software writes it
FIELDS = (  # that are decoded
    DecompressionSelection.XY_RETURNS_CHANNEL
    | DecompressionSelection.Z
    | DecompressionSelection.CLASSIFICATION
    | DecompressionSelection.FLAGS
    | DecompressionSelection.POINT_SOURCE_ID
    | DecompressionSelection.GPS_TIME
)


def require(right: bool, problem: str) -> None:
    """Raise ValueError unless something is right."""
    if not right:
        raise ValueError(problem)


@contextmanager
def decoding(refusal: Callable[[BaseException], InputError]) -> Iterator[None]:
    """Whatever libraries raise on damaged bytes becomes a refusal.

    Panics of lazrs too, which are no Exception; want of memory not.
    """
    try:
        yield
    except (InputError, MemoryError):
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise refusal(error) from error


def wrong_count(file: Path, announced: int, held: str, error: object = "") -> InputError:
    """Refusal of a file whose header announces another number of points than is there."""
    return InputError(
        f"truncated or damaged: the header announces {announced} points, {held}"
        + (f" ({error})" if error else ""),
        file=file,
        remedy="fetch or write the file again",
    )


@dataclass(frozen=True)
class Packing:
    """A LASzip record: kind of compression, points of a chunk, number of a chunk's layers."""

    kind: int
    chunk_points: int
    layers: int
    record: bytes

    @classmethod
    def of(cls, record: bytes, record_bytes: int) -> Packing:
        """Of the bytes of a LASzip record. Raises ValueError if they cannot be."""
        require(len(record) >= 34, "its LASzip record is cut short")
        kind, chunk_points, count = (
            struct.unpack_from(form, record, at)[0]
            for form, at in (("<H", 0), ("<I", 12), ("<H", 32))
        )
        require(len(record) >= 34 + 6 * count, "its LASzip record is cut short")
        items = [struct.unpack_from("<HH", record, 34 + 6 * k) for k in range(count)]
        require(
            sum(size for _, size in items) == record_bytes,
            f"its LASzip record describes points of other than {record_bytes} bytes",
        )
        require(kind in (CHUNKED, LAYERED), f"compression of kind {kind} is not known")
        require(chunk_points > 0, "its chunks have no points")
        layers = sum(size if of == EXTRA_BYTES else LAYERS.get(of, 0) for of, size in items)
        return cls(kind, chunk_points, layers, record)


@dataclass
class Layout:
    """Counts that a header states, and places in bytes from the file's start.

    Of LAZ, ``packing`` and the ``chunks``: points and bytes [n, 2].
    """

    size: int
    minor: int
    header_bytes: int
    first_point: int
    vlrs: int
    compressed: bool
    format: int
    record_bytes: int
    points: int
    first_evlr: int = 0
    evlrs: int = 0
    packing: Packing | None = None
    chunks: Ints | None = None

    @classmethod
    def of(cls, stream: BinaryIO, size: int) -> Layout:
        """Of the first bytes of a file of ``size`` bytes. Raises ValueError if they cannot be."""
        head = stream.read(393)
        require(head[:4] == b"LASF" and len(head) >= 227, "it does not begin as LAS")
        major, minor = head[24:26]
        require(major == 1 and minor in HEADER_BYTES, f"LAS {major}.{minor} is not known")
        header_bytes, first_point, vlrs, kind, record_bytes, points = struct.unpack_from(
            "<HIIBHI", head, 94
        )
        require(
            HEADER_BYTES[minor] <= header_bytes <= first_point <= size,
            f"a header of {header_bytes} bytes and points from byte {first_point} on do not go "
            f"into {size} bytes of LAS 1.{minor}",
        )
        kind, compressed = kind & 63, kind > 63
        require(
            kind < len(RECORD_BYTES) and record_bytes >= RECORD_BYTES[kind],
            f"points of format {kind} do not go into {record_bytes} bytes",
        )
        scales_and_offsets = np.frombuffer(head, "<f8", 6, 131)
        require(
            bool(np.isfinite(scales_and_offsets).all() and (scales_and_offsets[:3] > 0).all()),
            f"scales and offsets of its coordinates are {scales_and_offsets.tolist()}",
        )
        behind = (0, 0)
        if minor >= 4:
            *behind, long_points = struct.unpack_from("<QIQ", head, 235)
            require(
                points in (0, long_points) or kind > 5,
                f"its two counts of points are {points} and {long_points}",
            )
            points = long_points
        places = header_bytes, first_point, vlrs, compressed, kind, record_bytes, points
        return cls(size, minor, *places, *behind)


def records(
    stream: BinaryIO, start: int, end: int, count: int, extended: bool
) -> list[tuple[bytes, int, int, int]]:
    """User, number, start and length of the (extended) variable length records, all before end."""
    head_bytes, what = (EVLR_BYTES, "extended ") if extended else (VLR_BYTES, "")
    what += "variable length records"
    require(
        start + count * head_bytes <= end, f"{count} {what} do not fit between {start} and {end}"
    )
    found = []
    for _ in range(count):
        stream.seek(start)
        head = stream.read(head_bytes)
        require(len(head) == head_bytes and start + head_bytes <= end, f"its {what} are cut short")
        number, length = struct.unpack_from("<HQ" if extended else "<HH", head, 18)
        found.append((head[2:18].split(b"\0")[0], number, start + head_bytes, length))
        start += head_bytes + length
        require(start <= end, f"its {what} reach to byte {start}, past {end}")
    return found


def _checked_chunks(stream: BinaryIO, layout: Layout, packing: Packing, file: Path) -> Any:
    """Points and bytes of the chunks [n, 2] by the chunk table, which is held against the file."""
    first = layout.first_point + 8
    stream.seek(layout.first_point)
    place = stream.read(8)
    missing = "0 can be read, as its chunk table is missing"
    if len(place) < 8:
        raise wrong_count(file, layout.points, missing)
    (table,) = struct.unpack("<q", place)
    if table == -1:  # written in one go: the place of the table stands at the end
        stream.seek(layout.size - 8)
        (table,) = struct.unpack("<q", stream.read(8))
    if not first <= table <= layout.size - 8:
        raise wrong_count(file, layout.points, missing)
    stream.seek(table)
    version, count = struct.unpack("<II", stream.read(8))
    room = table - first
    require(
        version == 0 and count * layout.record_bytes <= room,
        f"its chunk table of version {version} has {count} chunks in {room} bytes",
    )
    per_chunk, points = packing.chunk_points, layout.points
    if per_chunk != VARIABLE and count != -(-points // per_chunk):
        raise wrong_count(file, points, f"its chunks hold {count * per_chunk}")
    stream.seek(layout.first_point)
    read = lazrs.read_chunk_table(stream, lazrs.LazVlr(packing.record)) or []
    sizes = np.array([size for _, size in read], np.float64)
    require(
        len(read) == count and bool((sizes >= layout.record_bytes).all()) and sizes.sum() == room,
        f"the chunks of its chunk table do not fill the {room} bytes before it",
    )
    chunks = np.array(read, np.int64).reshape(-1, 2)
    if per_chunk == VARIABLE and (total := int(chunks[:, 0].sum())) != points:
        raise wrong_count(file, points, f"its chunks hold {total}")
    return chunks


def _check_layers(stream: BinaryIO, layout: Layout, packing: Packing, file: Path) -> None:
    """Hold the head of each layered chunk against the chunk table."""
    head, at = layout.record_bytes + 4 + 4 * packing.layers, layout.first_point + 8
    wanted = layout.chunks[:, 0].copy()
    if packing.chunk_points != VARIABLE:
        wanted[-1] = layout.points - (len(wanted) - 1) * packing.chunk_points
    for k, size in enumerate(layout.chunks[:, 1].tolist()):
        stream.seek(at + layout.record_bytes)
        numbers = np.frombuffer(stream.read(head - layout.record_bytes), "<u4").astype(np.int64)
        require(
            numbers.size == 1 + packing.layers and head + int(numbers[1:].sum()) == size,
            f"the layers of chunk {k + 1} of {len(wanted)} do not fill it",
        )
        if numbers[0] != wanted[k]:
            total = layout.points + int(numbers[0] - wanted[k])
            raise wrong_count(file, layout.points, f"its chunks hold {total}")
        at += size


def check_layout(file: Path, layers: bool = True) -> Layout:
    """The places and counts of a file's header, after all of them were found to fit into it.

    ``layers``: look at the head of each chunk, too, and so all over the file.

    Raises InputError: no LAS, truncated, damaged, or never completed.
    """
    size = size_of(file)
    try:
        with open_stream(file, STREAM_BYTES if layers else GLANCE_BYTES) as stream:
            layout = Layout.of(stream, size)
            room = size - layout.first_point
            vlrs = records(
                stream, layout.header_bytes, layout.first_point, layout.vlrs, extended=False
            )
            if layout.points == 0:
                raise InputError(
                    "the header announces 0 points"
                    + (f", {room} bytes follow it: it was never completed" if room > 100 else ""),
                    file=file,
                    remedy="remove the file, or write it again",
                )
            if layout.compressed:
                found = [vlr for vlr in vlrs if vlr[:2] == LASZIP]
                require(len(found) == 1, f"it has {len(found)} LASzip records instead of one")
                stream.seek(found[0][2])
                packing = Packing.of(stream.read(found[0][3]), layout.record_bytes)
                layout.packing = packing
                layout.chunks = _checked_chunks(stream, layout, packing, file)
                if layers and packing.kind == LAYERED:
                    _check_layers(stream, layout, packing, file)
            elif room // layout.record_bytes < layout.points:
                held = f"the file holds {room // layout.record_bytes}"
                raise wrong_count(file, layout.points, held)
            if layout.evlrs:
                require(
                    layout.first_point <= layout.first_evlr <= size,
                    f"its extended variable length records begin at byte {layout.first_evlr}",
                )
                records(stream, layout.first_evlr, size, layout.evlrs, extended=True)
    except InputError:
        raise
    except (ValueError, lazrs.LazrsError, struct.error, OSError) as error:
        raise InputError(
            f"no readable LAS or LAZ file, truncated or damaged ({error})",
            file=file,
            remedy="fetch or write the file again",
        ) from error
    return layout


def read_header(file: str | Path, layers: bool = True) -> laspy.LasHeader:
    """Header of a LAS or LAZ file whose counts agree with what the file holds.

    ``layers``: see :func:`check_layout`.

    Raises InputError: missing, no LAS, empty, truncated (both counts are named).
    """
    file = Path(file)
    if not file.is_file():
        raise InputError("no such LiDAR file", file=file, remedy="correct the path in scenes.tsv")
    check_layout(file, layers)
    unreadable = "no readable LAS or LAZ file"
    with (
        decoding(lambda e: InputError(f"{unreadable} ({e})", file=file, remedy="replace the file")),
        open_stream(file, STREAM_BYTES if layers else GLANCE_BYTES) as stream,
    ):
        header = laspy.LasHeader.read_from(stream, read_evlrs=True)
    by_return = sum(map(int, header.number_of_points_by_return))
    if by_return > header.point_count:
        raise wrong_count(file, header.point_count, f"its counts by return add up to {by_return}")
    return header


def surplus_of(header: laspy.LasHeader, file: Path) -> str | None:
    """Remark on points after the last that the header counts (a stale header), or None."""
    if header.are_points_compressed or header.version.minor == 3:  # 1.3: waveforms may follow
        return None
    end = header.start_of_first_evlr if header.number_of_evlrs else size_of(file)
    held = (end - header.offset_to_point_data) // header.point_format.size
    if held <= header.point_count:
        return None
    return f"the header announces {header.point_count} points, which are read; {held} would fit"


@contextmanager
def _reader(file: Path, block_bytes: int, **how: Any) -> Iterator[laspy.LasReader]:
    """laspy's reader, by the backend that does not take all cores there are."""
    with (
        open_stream(file, block_bytes) as stream,
        laspy.open(
            stream, closefd=False, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False, **how
        ) as reader,
    ):
        yield reader


def read_chunks(
    file: Path, header: laspy.LasHeader, size: int
) -> Iterator[laspy.ScaleAwarePointRecord]:
    """All points of a file in its order, at most ``size`` at a time, with the fields needed here.

    COPC is read like any LAZ, through its chunk table: whole, whatever its hierarchy pages.
    """
    done, count = 0, header.point_count
    with _reader(file, STREAM_BYTES, decompression_selection=FIELDS) as reader:
        while done < count:
            wanted = min(size, count - done)
            held = f"decoding failed after {done}"
            with decoding(lambda e, held=held: wrong_count(file, count, held, e)):
                points = reader.read_points(wanted)
            done += len(points)
            if len(points) < wanted:
                raise wrong_count(file, count, f"{done} were read")
            yield points


def is_outside_sampled(file: Path, header: laspy.LasHeader) -> bool:
    """Whether one of some points all over the file lies outside of the header's bounds.

    They are the first ones of chunks, so that little is decoded.
    """
    slack = 2 * np.asarray(header.scales)
    low, high = np.asarray(header.mins) - slack, np.asarray(header.maxs) + slack
    places = np.linspace(0, header.point_count, SAMPLES, endpoint=False).astype(np.int64)
    with (
        decoding(lambda e: wrong_count(file, header.point_count, "decoding failed", e)),
        _reader(file, GLANCE_BYTES) as reader,
    ):
        for place in np.unique(places // LAZ_CHUNK * LAZ_CHUNK).tolist():
            reader.seek(place)
            point = reader.read_points(1)
            xyz = np.stack([np.asarray(point[axis]) for axis in "xyz"], axis=1)
            if ((xyz < low) | (xyz > high)).any():
                return True
    return False
