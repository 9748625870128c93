"""Where things lie in a LAS or LAZ file, held against its size before a library believes it.

Decoders take memory and time by what a file announces: 68 GB by four bytes of a chunk table, hours
by a number of records. So whatever announces a number, a length or a place is looked at here
first. Sources: LAS 1.4 R16 (ASPRS), "Public Header Block", "Variable Length Records"; the LAZ
specification 1.4 R1 (ASPRS), "LASzip VLR", "Chunk Table", "Layered Chunks".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import lazrs
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
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


class _Wrong(ValueError):
    """What does not fit."""


def _require(right: bool, problem: str) -> None:
    if not right:
        raise _Wrong(problem)


def wrong_count(file: Path, announced: int, held: str, error: object = "") -> InputError:
    """Refusal of a file whose header announces another number of points than is there."""
    return InputError(
        f"truncated or damaged: the header announces {announced} points, {held}"
        + (f" ({error})" if error else ""),
        file=file,
        remedy="fetch or write the file again",
    )


@dataclass(frozen=True)
class Layout:
    """What a header says about the file: counts, and places in bytes from the start.

    ``packing`` and ``chunks`` are found by :func:`check_layout`.
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
    first_evlr: int
    evlrs: int
    packing: Packing | None = None  # of LAZ
    chunks: NDArray[np.int64] | None = None  # of LAZ: points and bytes [n, 2]

    @classmethod
    def of(cls, stream: BinaryIO, size: int) -> Layout:
        """Of the first bytes of a file of ``size`` bytes. Raises ValueError if they cannot be."""
        head = stream.read(393)
        _require(head[:4] == b"LASF" and len(head) >= 227, "it does not begin as LAS")
        major, minor = head[24:26]
        _require(major == 1 and minor in HEADER_BYTES, f"LAS {major}.{minor} is not known")
        header_bytes, first_point, vlrs, kind, record_bytes, points = struct.unpack_from(
            "<HIIBHI", head, 94
        )
        _require(
            HEADER_BYTES[minor] <= header_bytes <= first_point <= size,
            f"a header of {header_bytes} bytes and points from byte {first_point} on do not go "
            f"into {size} bytes of LAS 1.{minor}",
        )
        kind, compressed = kind & 63, kind > 63
        _require(
            kind < len(RECORD_BYTES) and record_bytes >= RECORD_BYTES[kind],
            f"points of format {kind} do not go into {record_bytes} bytes",
        )
        scales_and_offsets = np.frombuffer(head, "<f8", 6, 131)
        _require(
            bool(np.isfinite(scales_and_offsets).all() and (scales_and_offsets[:3] > 0).all()),
            f"scales and offsets of its coordinates are {scales_and_offsets.tolist()}",
        )
        first_evlr = evlrs = 0
        if minor >= 4:
            first_evlr, evlrs, long_points = struct.unpack_from("<QIQ", head, 235)
            _require(
                points in (0, long_points) or kind > 5,
                f"its two counts of points are {points} and {long_points}",
            )
            points = long_points
        return cls(
            size,
            minor,
            header_bytes,
            first_point,
            vlrs,
            compressed,
            kind,
            record_bytes,
            points,
            first_evlr,
            evlrs,
        )


def _records(
    stream: BinaryIO, start: int, end: int, count: int, extended: bool
) -> list[tuple[bytes, int, int, int]]:
    """User, number, start and length of the (extended) variable length records, all before end."""
    head_bytes, what = (EVLR_BYTES, "extended ") if extended else (VLR_BYTES, "")
    what += "variable length records"
    _require(
        start + count * head_bytes <= end, f"{count} {what} do not fit between {start} and {end}"
    )
    found = []
    for _ in range(count):
        stream.seek(start)
        head = stream.read(head_bytes)
        _require(len(head) == head_bytes and start + head_bytes <= end, f"its {what} are cut short")
        number, length = struct.unpack_from("<HQ" if extended else "<HH", head, 18)
        found.append((head[2:18].split(b"\0")[0], number, start + head_bytes, length))
        start += head_bytes + length
        _require(start <= end, f"its {what} reach to byte {start}, past {end}")
    return found


@dataclass(frozen=True)
class Packing:
    """A LASzip record: kind of compression, points of a chunk, (type, bytes) of the items."""

    kind: int
    chunk_points: int
    items: tuple[tuple[int, int], ...]
    record: bytes

    @classmethod
    def of(cls, record: bytes, record_bytes: int) -> Packing:
        """Of the bytes of a LASzip record. Raises ValueError if they cannot be."""
        _require(len(record) >= 34, "its LASzip record is cut short")
        (kind,) = struct.unpack_from("<H", record)
        (chunk_points,) = struct.unpack_from("<I", record, 12)
        (count,) = struct.unpack_from("<H", record, 32)
        _require(len(record) >= 34 + 6 * count, "its LASzip record is cut short")
        items = tuple(struct.unpack_from("<HH", record, 34 + 6 * k) for k in range(count))
        _require(
            sum(size for _, size in items) == record_bytes,
            f"its LASzip record describes points of other than {record_bytes} bytes",
        )
        _require(kind in (CHUNKED, LAYERED), f"compression of kind {kind} is not known")
        _require(chunk_points > 0, "its chunks have no points")
        return cls(kind, chunk_points, items, record)

    @property
    def layers(self) -> int:
        """Number of layers of a chunk."""
        return sum(
            size if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, size in self.items
        )


def _check_chunks(
    stream: BinaryIO, layout: Layout, packing: Packing, file: Path, layers: bool
) -> NDArray[np.int64]:
    """Points and bytes of the chunks [n, 2], each of which fits into the file.

    The chunk table is held against the file; with ``layers`` each layered chunk against the table.
    """
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
    _require(
        version == 0 and count * layout.record_bytes <= room,
        f"its chunk table of version {version} has {count} chunks in {room} bytes",
    )
    per_chunk, points = packing.chunk_points, layout.points
    variable = per_chunk == VARIABLE
    if not variable and count != -(-points // per_chunk):
        raise wrong_count(file, points, f"its chunks hold {count * per_chunk}")
    stream.seek(layout.first_point)
    chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(packing.record)) or []
    bytes_of = np.array([size for _, size in chunks], np.float64)
    _require(
        len(chunks) == count
        and bool((bytes_of >= layout.record_bytes).all())
        and bytes_of.sum() == room,
        f"the chunks of its chunk table do not fill the {room} bytes before it",
    )
    if variable and (total := sum(number for number, _ in chunks)) != points:
        raise wrong_count(file, points, f"its chunks hold {total}")
    held = np.array(chunks, np.int64).reshape(-1, 2)
    if packing.kind != LAYERED or not layers:
        return held
    head, at = layout.record_bytes + 4 + 4 * packing.layers, first
    for k, (number, size) in enumerate(chunks):
        stream.seek(at + layout.record_bytes)
        numbers = np.frombuffer(stream.read(head - layout.record_bytes), "<u4").astype(np.int64)
        _require(
            numbers.size == 1 + packing.layers and head + int(numbers[1:].sum()) == size,
            f"the layers of chunk {k + 1} of {count} do not fill it",
        )
        last = not variable and k == count - 1
        wanted = points - k * per_chunk if last else number
        if numbers[0] != wanted:
            total = points + int(numbers[0]) - wanted
            raise wrong_count(file, points, f"its chunks hold {total}")
        at += size
    return held


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
            records = _records(
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
                found = [r for r in records if r[:2] == LASZIP]
                _require(len(found) == 1, f"it has {len(found)} LASzip records instead of one")
                stream.seek(found[0][2])
                packing = Packing.of(stream.read(found[0][3]), layout.record_bytes)
                chunks = _check_chunks(stream, layout, packing, file, layers)
                layout = replace(layout, packing=packing, chunks=chunks)
            elif room // layout.record_bytes < layout.points:
                held = f"the file holds {room // layout.record_bytes}"
                raise wrong_count(file, layout.points, held)
            if layout.evlrs:
                _require(
                    layout.first_point <= layout.first_evlr <= size,
                    f"its extended variable length records begin at byte {layout.first_evlr}",
                )
                _records(stream, layout.first_evlr, size, layout.evlrs, extended=True)
    except (_Wrong, lazrs.LazrsError, struct.error, OSError) as error:
        raise InputError(
            f"no readable LAS or LAZ file, truncated or damaged ({error})",
            file=file,
            remedy="fetch or write the file again",
        ) from error
    return layout
