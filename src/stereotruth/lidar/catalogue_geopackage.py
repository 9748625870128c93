"""Rows and outlines of a GeoPackage's one layer of polygons.

Read by SQLite itself: read-only, without trust in what the file's schema would run. Source: OGC
GeoPackage 1.3, sections 1.1.2 (spatial reference systems), 2.1 (features), 2.1.3 (binary header).
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from tempfile import NamedTemporaryFile

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from ..errors import InputError
from .catalogue_tiles import MOST_TILES, Row, in_degrees

ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # by the indicator in the flags
POLYGON, MULTIPOLYGON = 3, 6  # of well-known binary
LONGEST_TEXT = 1_000_000


def rows_of(content: bytes, location: str) -> Iterator[Row]:
    """The columns and the outline of each row. Raises InputError for a file that has none."""
    with NamedTemporaryFile(suffix=".gpkg") as file:
        file.write(content)
        file.flush()
        try:
            base = sqlite3.connect(f"file:{file.name}?mode=ro&immutable=1", uri=True)
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, len(content) + LONGEST_TEXT)
            base.execute("PRAGMA trusted_schema = OFF")
            try:
                yield from _rows(base, location)
            finally:
                base.close()
        except (sqlite3.Error, struct.error, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"no GeoPackage that can be read ({type(error).__name__})",
                file=location,
                remedy="check or fetch it again; see that its layer has polygons",
            ) from None


def _rows(base: sqlite3.Connection, location: str) -> Iterator[Row]:
    layers = base.execute(
        "SELECT g.table_name, g.column_name, g.srs_id FROM gpkg_geometry_columns g "
        "JOIN sqlite_master m ON m.name = g.table_name AND m.type = 'table'"
    ).fetchall()
    if len(layers) != 1:
        names = ", ".join(str(name) for name, _, _ in layers) or "none"
        raise InputError(
            f"a GeoPackage of {len(layers)} layers ({names}); a tile index has one",
            file=location,
            remedy="write the layer of the tiles alone",
        )
    table, column, srs = layers[0]
    crs = _system(base, srs, location)
    named = base.execute(f"SELECT * FROM {_quoted(table)} LIMIT {MOST_TILES + 1}")
    names = [str(one[0]) for one in named.description]
    at = names.index(column)
    for values in named:
        rings = in_degrees(_rings(values[at]), crs)
        if not rings:
            raise InputError(
                "damaged: a row has no outline that can be read (a polygon)",
                file=location,
                remedy="correct it, or fetch it again",
            )
        yield {name: value for name, value in zip(names, values) if name != column}, rings


def _quoted(name: str) -> str:
    return '"' + str(name).replace('"', '""') + '"'


def _system(base: sqlite3.Connection, srs: int, location: str) -> CRS:
    row = base.execute(
        "SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys "
        "WHERE srs_id = ?",
        (srs,),
    ).fetchone()
    for text in () if row is None else (f"{row[0]}:{row[1]}", row[2]):
        try:
            return CRS.from_user_input(text)
        except (CRSError, TypeError):
            continue
    raise InputError(
        "its coordinate system cannot be used",
        file=location,
        remedy="write it in WGS 84 longitude and latitude",
    )


def _rings(blob: bytes) -> list[np.ndarray]:
    """Rings [2, n] of a GeoPackage geometry. Raises ValueError or struct.error for another one."""
    if not isinstance(blob, bytes) or blob[:2] != b"GP":
        raise ValueError("no geometry")
    envelope = blob[3] >> 1 & 7
    return _Reader(blob, 8 + ENVELOPE_BYTES[min(envelope, 4)]).polygons()


class _Reader:
    """Well-known binary (ISO 19125), from a place on."""

    def __init__(self, blob: bytes, at: int) -> None:
        self._blob, self._at, self._order = blob, at, "<"

    def _take(self, form: str) -> int:
        (value,) = struct.unpack_from(self._order + form, self._blob, self._at)
        self._at += struct.calcsize(form)
        return value

    def polygons(self) -> list[np.ndarray]:
        """Rings of a polygon or of several."""
        kind, axes = self._head()
        if kind == POLYGON:
            return [self._ring(axes) for _ in range(self._take("I"))]
        if kind != MULTIPOLYGON:
            raise ValueError("no polygon")
        rings = []
        for _ in range(self._take("I")):
            kind, axes = self._head()
            if kind != POLYGON:
                raise ValueError("no polygon")
            rings += [self._ring(axes) for _ in range(self._take("I"))]
        return rings

    def _head(self) -> tuple[int, int]:
        """Kind of a geometry, and numbers of a corner."""
        self._order = "<" if self._take("B") else ">"
        code = self._take("I")
        return code % 1000, 2 + (0, 1, 1, 2)[min(code // 1000, 3)]

    def _ring(self, axes: int) -> np.ndarray:
        count = self._take("I")
        values = np.frombuffer(self._blob, f"{self._order}f8", count * axes, self._at)
        self._at += values.nbytes
        return values.reshape(count, axes)[:, :2].T.astype(np.float64)
