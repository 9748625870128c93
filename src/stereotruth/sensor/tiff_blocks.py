"""Strips and tiles of a TIFF held against the file: their places, and the checksums of deflate.

GDAL does not always look: some damaged blocks of deflate come out as other pixels without an
error. Sources: TIFF 6.0 (Adobe), sections 2 and 15; BigTIFF (libtiff); zlib (RFC 1950).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..core.products.file_parts import open_stream
from ..core.products.remote_files import size_of

OFFSETS, COUNTS = (273, 324), (279, 325)  # of strips, of tiles
WIDTH, HEIGHT, BITS, COMPRESSION, SAMPLES, STRIP_ROWS = 256, 257, 258, 259, 277, 278
PLANAR, TILE_WIDTH, TILE_HEIGHT = 284, 322, 323
DEFAULTS = {BITS: 1, COMPRESSION: 1, SAMPLES: 1, PLANAR: 1, STRIP_ROWS: (1 << 32) - 1}
WANTED = {*OFFSETS, *COUNTS, *DEFAULTS, WIDTH, HEIGHT, TILE_WIDTH, TILE_HEIGHT}
BATCH, BATCH_BYTES = 64, 64 << 20  # blocks that are in memory at once
PART_BYTES = 1 << 20  # that are inflated at once
MOST_BYTES = 1 << 30  # of a block of which the tags do not say its size
PLAIN, DEFLATE = 1, (8, 32946)
TYPES = {1: "u1", 3: "u2", 4: "u4", 16: "u8", 13: "u4", 18: "u8"}


def _directory(stream: BinaryIO, size: int) -> dict[int, np.ndarray]:
    """Whole-number tags of the first image; raises ValueError or struct.error if cut short."""
    head = stream.read(16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None:
        raise ValueError("it does not begin as TIFF")
    big = struct.unpack(order + "H", head[2:4])[0] == 43
    (start,) = struct.unpack(order + ("Q" if big else "I"), head[8:16] if big else head[4:8])
    entry, number = (20, "Q") if big else (12, "H")
    stream.seek(min(start, size))
    (count,) = struct.unpack(order + number, stream.read(struct.calcsize(number)))
    entries = stream.read(min(count, 65535) * entry)
    found = {}
    for at in range(0, len(entries) - entry + 1, entry):
        tag, kind = struct.unpack_from(order + "HH", entries, at)
        (values,) = struct.unpack_from(order + ("Q" if big else "I"), entries, at + 4)
        if kind not in TYPES or tag not in WANTED:
            continue
        dtype = np.dtype(order + TYPES[kind])
        inline = at + (12 if big else 8)
        length = values * dtype.itemsize
        if length <= entry - (inline - at):
            data = entries[inline : inline + length]
        else:
            (place,) = struct.unpack_from(order + ("Q" if big else "I"), entries, inline)
            if place + length > size:
                raise ValueError("its list of blocks reaches past the end of the file")
            stream.seek(place)
            data = stream.read(length)
        found[tag] = np.frombuffer(data, dtype).astype(np.int64)
    return found


def _plain_bytes(tags: dict[int, np.ndarray], blocks: int) -> np.ndarray | None:
    """Bytes of each block without compression, [blocks]; None if the tags do not say."""
    one = {tag: int(values[0]) for tag, values in tags.items() if values.size}
    one = DEFAULTS | one
    if WIDTH not in one or HEIGHT not in one:
        return None
    bits = one[BITS] * (one[SAMPLES] if one[PLANAR] == 1 else 1)
    if TILE_WIDTH in one and TILE_HEIGHT in one:
        return np.full(blocks, one[TILE_HEIGHT] * -(-one[TILE_WIDTH] * bits // 8))
    rows = min(one[STRIP_ROWS], one[HEIGHT])
    strips = -(-one[HEIGHT] // max(rows, 1))
    at = np.arange(blocks) % max(strips, 1)
    return np.minimum(rows, one[HEIGHT] - at * rows) * -(-one[WIDTH] * bits // 8)


def _inflates(block: bytes, most: int) -> bool:
    """Whether a block of deflate is whole; its checksum is compared.

    ``most``: bytes that come out of it at most; one that holds more is as good as damaged.
    """
    inflating, rest, held = zlib.decompressobj(), block, 0
    try:
        while not inflating.eof:
            before, out = len(rest), len(inflating.decompress(rest, PART_BYTES))
            rest, held = inflating.unconsumed_tail, held + out
            if held > most or (not out and len(rest) == before):
                return False
    except zlib.error:
        return False
    return inflating.eof


def _shared(offsets: np.ndarray, counts: np.ndarray) -> str:
    """Which two blocks have bytes in common; empty if none have."""
    used = np.flatnonzero(counts > 0)
    used = used[np.argsort(offsets[used], kind="stable")]
    ends = offsets[used] + counts[used]
    over = np.flatnonzero(ends[:-1] > offsets[used[1:]])
    if not over.size:
        return ""
    first, second = sorted((int(used[over[0]]) + 1, int(used[over[0] + 1]) + 1))
    return f"blocks {first} and {second} of {offsets.size} share bytes"


def _batches(counts: np.ndarray) -> Iterator[range]:
    """Blocks that are read at once: few, and of few bytes."""
    first, held = 0, 0
    for k, count in enumerate(counts):
        if k > first and (k - first == BATCH or held + count > BATCH_BYTES):
            yield range(first, k)
            first, held = k, 0
        held += int(count)
    yield range(first, len(counts))


def damaged_block(path: Path, workers: int = 1, *, whole: bool = True) -> str:
    """What is wrong with the first strip or tile that is damaged; empty if none is, or no TIFF.

    ``whole``: checksums too, for which all of the file is read.
    """
    size = size_of(path)
    with open_stream(path, keep=False) as stream:
        if stream.read(4) not in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            return ""
        stream.seek(0)
        try:
            tags = _directory(stream, size)
        except (ValueError, struct.error) as error:
            return f"its directory cannot be read ({error})"
        offsets = next((tags[tag] for tag in OFFSETS if tag in tags), np.empty(0, np.int64))
        counts = next((tags[tag] for tag in COUNTS if tag in tags), np.empty(0, np.int64))
        if offsets.size != counts.size:  # files of one strip may leave its size out
            return ""
        wanted = _plain_bytes(tags, offsets.size)
        compression = int(tags.get(COMPRESSION, [PLAIN])[0])
        if problem := _misplaced(offsets, counts, size, wanted if compression == PLAIN else None):
            return problem
        if compression not in DEFLATE or not whole:
            return ""
        most = MOST_BYTES if wanted is None else 2 * int(wanted.max(initial=0)) + PART_BYTES
        with ThreadPoolExecutor(workers) as pool:
            for batch in _batches(counts):
                data = []
                for k in batch:
                    stream.seek(int(offsets[k]))
                    data.append(stream.read(int(counts[k])))
                whole = pool.map(_inflates, data, repeat(most))
                for k, block, good in zip(batch, data, whole):
                    if block and not good:  # blocks without bytes are empty ones
                        return f"block {k + 1} of {offsets.size} is damaged"
    return ""


def _misplaced(
    offsets: np.ndarray, counts: np.ndarray, size: int, wanted: np.ndarray | None
) -> str:
    """What is wrong with the places of blocks in a file of ``size`` bytes; empty if nothing is.

    ``wanted``: bytes of each block, if they are not compressed.
    """
    past = np.flatnonzero((offsets < 0) | (counts < 0) | (counts > size - offsets))
    if past.size:
        return f"block {past[0] + 1} of {offsets.size} reaches past the end of the file"
    halves = np.flatnonzero((offsets == 0) != (counts == 0))  # empty ones have neither
    if halves.size:
        return f"block {halves[0] + 1} of {offsets.size} has a place or a size, but not both"
    if wanted is not None and wanted.size:
        most = 2 * wanted.max()  # some programs pad, or write the last strip in full
        wrong = np.flatnonzero((counts > 0) & ((counts < wanted) | (counts > most)))
        if wrong.size:
            k = wrong[0]
            return f"block {k + 1} has {counts[k]} bytes, its pixels take {wanted[k]}"
    return _shared(offsets, counts)
