"""Strips and tiles of a TIFF held against the file: their places, and the checksums of deflate.

GDAL does not always look: some damaged blocks of deflate come out as other pixels without an
error. Sources: TIFF 6.0 (Adobe), sections 2 and 15; BigTIFF (libtiff); zlib (RFC 1950).
"""

from __future__ import annotations

import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..products.remote_files import open_file, size_of

OFFSETS, COUNTS = (273, 324), (279, 325)  # of strips, of tiles
WIDTH, HEIGHT, BITS, COMPRESSION, SAMPLES, STRIP_ROWS = 256, 257, 258, 259, 277, 278
PLANAR, TILE_WIDTH, TILE_HEIGHT = 284, 322, 323
DEFAULTS = {BITS: 1, COMPRESSION: 1, SAMPLES: 1, PLANAR: 1, STRIP_ROWS: (1 << 32) - 1}
WANTED = {*OFFSETS, *COUNTS, *DEFAULTS, WIDTH, HEIGHT, TILE_WIDTH, TILE_HEIGHT}
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


def _inflates(block: bytes) -> bool:
    """Whether a block of deflate is whole; its checksum is compared."""
    inflating = zlib.decompressobj()
    try:
        inflating.decompress(block)
    except zlib.error:
        return False
    return inflating.eof


def damaged_block(path: Path, workers: int = 1) -> str:
    """What is wrong with the first strip or tile that is damaged; empty if none is, or no TIFF."""
    size = size_of(path)
    with open_file(path) as stream:
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
        past = np.flatnonzero((offsets < 0) | (counts < 0) | (offsets + counts > size))
        if past.size:
            return f"block {past[0] + 1} of {offsets.size} reaches past the end of the file"
        halves = np.flatnonzero((offsets == 0) != (counts == 0))  # empty ones have neither
        if halves.size:
            return f"block {halves[0] + 1} of {offsets.size} has a place or a size, but not both"
        compression = int(tags.get(COMPRESSION, [PLAIN])[0])
        if compression == PLAIN and (wanted := _plain_bytes(tags, offsets.size)) is not None:
            most = 2 * wanted.max()  # some programs pad, or write the last strip in full
            wrong = np.flatnonzero((counts > 0) & ((counts < wanted) | (counts > most)))
            if wrong.size:
                k = wrong[0]
                return f"block {k + 1} has {counts[k]} bytes, its pixels take {wanted[k]}"
        if compression not in DEFLATE:
            return ""

        with ThreadPoolExecutor(workers) as pool:
            for first in range(0, offsets.size, 64):  # few at a time: memory
                data = []
                for k in range(first, min(first + 64, offsets.size)):
                    stream.seek(int(offsets[k]))
                    data.append(stream.read(int(counts[k])))
                for k, whole in enumerate(pool.map(_inflates, data)):
                    if data[k] and not whole:  # blocks without bytes are empty ones
                        return f"block {first + k + 1} of {offsets.size} is damaged"
    return ""
