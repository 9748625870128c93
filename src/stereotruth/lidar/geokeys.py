"""What GDAL knows of coordinate systems and rasterio does not tell: GeoTIFF keys of a LAS file, and
the epoch of a raster's coordinates."""

from __future__ import annotations

import re
import struct
import warnings

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile


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


def wkt_of_geokeys(shorts: np.ndarray, doubles: bytes, text: bytes) -> tuple[str, float | None]:
    """The system of GeoKeys, "" if they name none, and the epoch of the coordinates if they do.

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
                return (tiff.crs.to_wkt(), epoch_of(tiff)) if tiff.crs else ("", None)
    except RasterioError as error:
        raise ValueError(str(error)) from error


def epoch_of(raster: rasterio.DatasetReader) -> float | None:
    """Epoch of an open raster's coordinates (decimal year), as GDAL writes it into a VRT of it."""
    with MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(raster, memory.name, driver="VRT")
        found = re.search(rb' coordinateEpoch="([0-9.]+)"', memory.read())
    return float(found[1]) if found else None
