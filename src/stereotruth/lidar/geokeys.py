"""GeoTIFF keys of a LAS file as WKT: GDAL knows what they mean. And the epoch of a GeoTIFF."""

from __future__ import annotations

import struct
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile

SHORTS, DOUBLES = 34735, 34736  # tags of keys, and of their doubles
EPOCH_KEY = 5120  # CoordinateEpochGeoKey, a double
BIG_TIFF = 43  # the version of a TIFF
MOST_ENTRIES, MOST_VALUES = 4096, 65_536  # of a directory, of a tag


def _geokeys_tiff(shorts: np.ndarray, doubles: bytes, text: bytes) -> bytes:
    """A TIFF of one pixel that carries the GeoKeys of a LAS file, for GDAL to interpret."""
    blobs = {
        33550: (12, 3, struct.pack("<3d", 1, 1, 0)),
        33922: (12, 6, struct.pack("<6d", 0, 0, 0, 0, 0, 0)),
        34735: (3, shorts.size, shorts.astype("<u2").tobytes()),
        34736: (12, len(doubles) // 8, doubles[: len(doubles) // 8 * 8]),
        34737: (2, len(text), text),
    }
    blobs = {tag: blob for tag, blob in blobs.items() if blob[1]}
    plain = {256: 1, 257: 1, 258: 8, 259: 1, 262: 1, 277: 1, 278: 1, 279: 1}
    end = 8 + 2 + 12 * (len(plain) + 1 + len(blobs)) + 4
    entries = [(tag, 4, 1, value) for tag, value in plain.items()] + [(273, 4, 1, end)]
    data = bytes(8)
    for tag, (kind, count, blob) in blobs.items():
        entries.append((tag, kind, count, end + len(data)))
        data += blob + bytes(8 - len(blob) % 8)
    directory = b"".join(struct.pack("<HHII", *entry) for entry in sorted(entries))
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4) + data


def epoch_in(shorts: np.ndarray, doubles: bytes) -> float | None:
    """The epoch of the coordinates (decimal year) that keys state; None where they do not.

    ``shorts`` uint16[n], ``doubles``: the records 34735 and 34736.
    """
    for key, location, _, index in (
        shorts[4 : 4 + (shorts.size - 4) // 4 * 4].reshape(-1, 4).tolist()
    ):
        if key == EPOCH_KEY and location == DOUBLES and len(doubles) >= 8 * (index + 1):
            return float(np.frombuffer(doubles, "<f8", 1, 8 * index)[0])
    return None


def epoch_of_tiff(file: Path) -> float | None:
    """The epoch of the coordinates that a GeoTIFF states, which rasterio does not tell.

    None where it states none, or is no TIFF.
    """
    records: dict[int, bytes] = {}
    with suppress(struct.error, KeyError, OSError), file.open("rb") as stream:
        head = stream.read(16)
        order = {b"II": "<", b"MM": ">"}[head[:2]]
        big = struct.unpack_from(f"{order}H", head, 2)[0] == BIG_TIFF
        offset, count, entry = ("Q", "Q", "HHQQ") if big else ("I", "H", "HHII")
        stream.seek(struct.unpack_from(order + offset, head, 8 if big else 4)[0])
        (entries,) = struct.unpack(order + count, stream.read(struct.calcsize(order + count)))
        size = struct.calcsize(order + entry)
        table = stream.read(size * min(entries, MOST_ENTRIES))
        for tag, _, number, place in struct.iter_unpack(order + entry, table):
            if tag in (SHORTS, DOUBLES) and number <= MOST_VALUES:
                kind, item = ("u2", 2) if tag == SHORTS else ("f8", 8)
                inline = struct.pack(order + offset, place)
                stream.seek(place)
                data = inline if number * item <= len(inline) else stream.read(number * item)
                values = np.frombuffer(data[: len(data) // item * item], order + kind)
                records[tag] = values[:number].astype(f"<{kind}").tobytes()
    shorts = np.frombuffer(records.get(SHORTS, b""), "<u2")
    return epoch_in(shorts, records.get(DOUBLES, b"")) if shorts.size >= 4 else None


def wkt_of_geokeys(shorts: np.ndarray, doubles: bytes, text: bytes) -> str:
    """The system of GeoKeys, "" if they name none.

    ``shorts`` uint16[n], ``doubles``, ``text``: the records 34735, 34736 and 34737. Raises
    ValueError if GDAL cannot read them.
    """
    try:
        with (
            rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"),
            MemoryFile(_geokeys_tiff(shorts, doubles, text)) as memory,
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")  # "not georeferenced"
            with memory.open() as tiff:
                return tiff.crs.to_wkt() if tiff.crs else ""
    except RasterioError as error:
        raise ValueError(str(error)) from error
