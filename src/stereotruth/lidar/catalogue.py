"""Catalogues of LiDAR tiles: VPC, STAC items, tile indexes as GeoJSON or GeoPackage.

A catalogue says where each tile lies, on the ground and on the disk or a server. It may have been
written by anybody: a location in it leads to the catalogue's own origin (folder, host, bucket) and
to hosts that the user allows, and nowhere else (:func:`resolved`). Sources: STAC 1.0 ("Item"), its
point cloud and projection extensions, VPC (PDAL wrench), RFC 7946 (GeoJSON), OGC GeoPackage 1.3.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from ..errors import InputError
from ..products.remote_files import SCHEMES, is_remote, read_bytes
from ..sheets import LIDAR_SEPARATOR, LIDAR_SUFFIXES, RASTER_SUFFIXES
from .catalogue_list import EPT
from .catalogue_tiles import MOST_TILES, Floats, Row, Tile, in_degrees

MOST_BYTES = 200_000_000  # of a catalogue
TILE_SUFFIXES = (*LIDAR_SUFFIXES, *RASTER_SUFFIXES, EPT)
ELSEWHERE = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:|//|\\\\")  # a scheme, or another host
NO_DATA_ROLES = {"overview", "thumbnail", "metadata", "visual"}


@dataclass(frozen=True)
class Catalogue:
    """A catalogue and its tiles; ``bytes`` and ``sha256`` are those of its file."""

    location: str
    bytes: int
    sha256: str
    tiles: tuple[Tile, ...] = field(repr=False)


def read_catalogue(
    location: str,
    *,
    column: str = "",
    dates: tuple[str, str] | None = None,
    hosts: frozenset[str] = frozenset(),
) -> Catalogue:
    """A catalogue by path or URL.

    ``column`` of a tile index that has the locations (where several could), ``dates``: columns with
    the first and last day of acquisition. ``hosts`` that its server may redirect to.
    Raises InputError: missing, too large, damaged, no catalogue, or one whose tiles are not told.
    """
    if is_remote(location):
        content = read_bytes(location, MOST_BYTES, hosts=hosts)
    else:
        content = _local(Path(location))
    if content[:15] == b"SQLite format 3":
        from .catalogue_geopackage import rows_of

        tiles = _indexed(rows_of(content, location), column, dates, location)
    else:
        tiles = _of_json(content, location, column, dates)
    if not tiles:
        raise InputError("a catalogue without a tile", file=location, remedy="check its content")
    if len(tiles) > MOST_TILES:
        raise InputError(
            f"more than {MOST_TILES} tiles", file=location, remedy="cut it to the region"
        )
    return Catalogue(location, len(content), hashlib.sha256(content).hexdigest(), tuple(tiles))


def _local(file: Path) -> bytes:
    if not file.is_file():
        raise InputError("no such catalogue", file=file, remedy="correct its path")
    if file.stat().st_size > MOST_BYTES:
        raise InputError(
            f"a catalogue larger than {MOST_BYTES / 1e6:g} MB",
            file=file,
            remedy="cut it to the region",
        )
    return file.read_bytes()


def _of_json(
    content: bytes, location: str, column: str, dates: tuple[str, str] | None
) -> list[Tile]:
    try:
        read = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"no catalogue that can be read ({type(error).__name__})",
            file=location,
            remedy="give a VPC, STAC items, GeoJSON or GeoPackage; see that the file is whole",
        ) from None
    kind = read.get("type") if isinstance(read, Mapping) else None
    if kind in ("Catalog", "Collection"):
        raise InputError(
            f"a STAC {kind}, which only links to its items",
            file=location,
            remedy="save its items in one file (an ItemCollection), and name that",
        )
    features = read.get("features") if kind == "FeatureCollection" else [read]
    if kind not in ("FeatureCollection", "Feature") or not isinstance(features, list):
        raise InputError(
            "neither STAC items nor GeoJSON",
            file=location,
            remedy="give a VPC, STAC items, GeoJSON or GeoPackage",
        )
    _refuse_paged(read, len(features), location)
    for number, feature in enumerate(features, 1):
        if not isinstance(feature, Mapping) or feature.get("type") != "Feature":
            raise _damaged(location, number, "is no feature")
    if any("assets" in feature for feature in features):
        dated = not location.lower().endswith(".vpc")  # which has days of writing there
        return [_item(item, n, location, dated) for n, item in enumerate(features, 1)]
    return _indexed(_rows(read, features, location), column, dates, location)


def _refuse_paged(read: Mapping[str, Any], held: int, location: str) -> None:
    """Raise InputError if a search has found more items than the file has."""
    links = read.get("links")
    links = links if isinstance(links, list) else []
    more = any(isinstance(link, Mapping) and link.get("rel") == "next" for link in links)
    matched = read.get("numberMatched")
    if more or (isinstance(matched, int) and matched > held):
        raise InputError(
            f"a page of {held} items of a search that has found more",
            file=location,
            remedy="save all of its pages in one file",
        )


def _damaged(location: str, number: int, problem: str) -> InputError:
    return InputError(
        f"damaged: tile {number} {problem}", file=location, remedy="correct it, or fetch it again"
    )


def _item(item: Mapping[str, Any], number: int, location: str, dated: bool) -> Tile:
    """A tile of a STAC item."""
    given = item.get("properties")
    properties: Mapping[str, Any] = given if isinstance(given, Mapping) else {}
    crs = _projection(properties)
    rings = _own_outline(properties, crs) or _outline(item.get("geometry"), None)
    if not rings and isinstance(box := item.get("bbox"), list) and len(box) in (4, 6):
        rings = _boxed(box, None)
    if not rings:
        raise _damaged(location, number, "has no outline that can be read")
    first, last = properties.get("start_datetime"), properties.get("end_datetime")
    if dated and not (first and last):
        first = last = properties.get("datetime")
    points = properties.get("pc:count")
    return Tile(
        _asset(item.get("assets"), number, location),
        rings,
        "" if crs is None else crs.to_wkt(),
        _day(first),
        _day(last),
        points if type(points) is int and 0 <= points < 10**15 else None,
    )


def _projection(properties: Mapping[str, Any]) -> CRS | None:
    """The system that a STAC item declares (proj:wkt2, proj:projjson, proj:code, proj:epsg)."""
    for key in ("proj:wkt2", "proj:projjson", "proj:code", "proj:epsg"):
        if value := properties.get(key):
            try:
                return CRS.from_user_input(value)
            except (CRSError, TypeError, ValueError):
                continue
    return None


def _own_outline(properties: Mapping[str, Any], crs: CRS | None) -> tuple[Floats, ...]:
    """Outline by the tile's own coordinates, which VPC prefers to degrees; empty if there is none.

    Either proj:geometry or proj:bbox.
    """
    if crs is None:
        return ()
    if rings := _outline(properties.get("proj:geometry"), crs):
        return rings
    box = properties.get("proj:bbox")
    return _boxed(box, crs) if isinstance(box, list) and len(box) in (4, 6) else ()


def _asset(assets: Any, number: int, location: str) -> str:
    """The location of an item's points: the one asset with data."""
    every = assets.values() if isinstance(assets, Mapping) else ()
    held = [
        str(asset["href"])
        for asset in every
        if isinstance(asset, Mapping) and isinstance(asset.get("href"), str)
        if not _without_data(asset.get("roles"))
    ]
    for kind in (LIDAR_SUFFIXES, (EPT,), RASTER_SUFFIXES):
        if fitting := [href for href in held if _path(href).endswith(kind)]:
            if len(set(fitting)) > 1:
                raise _damaged(location, number, f"has {len(fitting)} files of points")
            return fitting[0]
    packed = [href for href in held if _path(href).endswith(".zip")]
    raise _damaged(
        location,
        number,
        "is packed in a ZIP archive, of which no part can be read: fetch and unpack it"
        if packed
        else "has no file of LAS, LAZ, COPC, EPT or GeoTIFF",
    )


def _without_data(roles: Any) -> bool:
    """Whether the roles of an asset say that it has no points."""
    return isinstance(roles, list) and bool(NO_DATA_ROLES & set(map(str, roles)))


def _path(href: str) -> str:
    """A location without query and fragment, in small letters."""
    return re.split(r"[?#]", href, maxsplit=1)[0].lower()


def _day(text: Any) -> str:
    """The UTC date of a time, or empty."""
    if not isinstance(text, str):
        return ""
    try:
        time = datetime.fromisoformat(text.strip())
        time = time if time.tzinfo is None else time.astimezone(UTC)
    except (ValueError, OverflowError):  # none, or of the year 0
        return ""
    return time.date().isoformat()


def _rows(
    read: Mapping[str, Any], features: list[Mapping[str, Any]], location: str
) -> Iterator[Row]:
    """Properties and outline of each feature of a GeoJSON file."""
    named = read.get("crs")
    crs = None
    if isinstance(named, Mapping):  # of GeoJSON 2008, as GDAL writes it
        try:
            crs = CRS.from_user_input(named["properties"]["name"])
        except (KeyError, TypeError, CRSError, ValueError):
            raise InputError(
                "its coordinate system cannot be used",
                file=location,
                remedy="write it in WGS 84 longitude and latitude",
            ) from None
    for number, feature in enumerate(features, 1):
        properties = feature.get("properties")
        if not (rings := _outline(feature.get("geometry"), crs)):
            raise _damaged(location, number, "has no outline that can be read (a polygon)")
        yield properties if isinstance(properties, Mapping) else {}, rings


def _indexed(
    rows: Iterator[Row], column: str, dates: tuple[str, str] | None, location: str
) -> list[Tile]:
    """Tiles of an index: the locations stand in a column."""
    held = list(rows)
    column = column or _location_column([row for row, _ in held], location)
    missing = {name for name in (column, *(dates or ())) if all(name not in row for row, _ in held)}
    if held and missing:
        raise InputError(
            f"has no column {min(missing)!r}",
            file=location,
            remedy=f"its columns are {', '.join(map(str, held[0][0])) or 'none'}",
        )
    tiles = []
    for number, (row, rings) in enumerate(held, 1):
        href = row.get(column)
        if not isinstance(href, str) or not href.strip():
            raise _damaged(location, number, f"names no file in column {column!r}")
        days = [_day(row.get(name)) for name in dates] if dates else ["", ""]
        tiles.append(Tile(href.strip(), rings, "", *days))
    return tiles


def _location_column(rows: list[Mapping[str, Any]], location: str) -> str:
    """The one column whose texts all name files of points or of surface models."""
    names = list(rows[0]) if rows else []

    def fits(name: str) -> bool:
        values = [row.get(name) for row in rows]
        return all(
            isinstance(value, str) and _path(value).endswith(TILE_SUFFIXES) for value in values
        )

    fitting = [name for name in names if fits(name)]
    if rows and len(fitting) != 1:
        several = f"{len(fitting)} columns" if fitting else "no column"
        there = ", ".join(map(str, fitting or names)) or "none"
        raise InputError(
            f"{several} whose every value names a LAS, LAZ, COPC, EPT or GeoTIFF file",
            file=location,
            remedy=f"name it by --column; there are {there}",
        )
    return fitting[0] if fitting else ""


def _outline(geometry: Any, crs: CRS | None) -> tuple[Floats, ...]:
    """Rings of a GeoJSON polygon or several, in degrees; empty if it is none."""
    kind = geometry.get("type") if isinstance(geometry, Mapping) else None
    if kind not in ("Polygon", "MultiPolygon"):
        return ()
    parts = geometry.get("coordinates")
    polygons = [parts] if kind == "Polygon" else parts
    try:
        rings = [np.array([xy[:2] for xy in ring], np.float64).T for p in polygons for ring in p]
    except (TypeError, ValueError, IndexError, OverflowError):
        return ()
    return in_degrees(rings, crs)


def _boxed(box: list[Any], crs: CRS | None) -> tuple[Floats, ...]:
    """The ring of a box, of two or three dimensions; two of one across the antimeridian."""
    try:
        values = np.array(box, np.float64)
    except (TypeError, ValueError, OverflowError):
        return ()
    (west, south), (east, north) = values[:2], values[len(box) // 2 :][:2]
    sides = [(west, east)] if crs is not None or west <= east else [(west, 180.0), (-180.0, east)]
    rings = [np.array([[w, e, e, w], [south, south, north, north]]) for w, e in sides]
    return in_degrees(rings, crs)


def resolved(href: str, catalogue: str, hosts: frozenset[str]) -> str:
    """Where a tile lies: a path (relative to the working directory) or a URL.

    Raises InputError for a location that a catalogue may not lead to: another host than its own
    unless ``hosts`` has it, ``file:`` and other schemes, http where the catalogue came by https; of
    a catalogue on the disk, any host but those of ``hosts``.
    """
    if not href.isprintable() or LIDAR_SEPARATOR in href:
        raise _untrusted(
            catalogue, "a name that no sheet can have", f"name no file with {LIDAR_SEPARATOR!r}"
        )
    if not is_remote(catalogue) and not ELSEWHERE.match(href):
        return str(Path(catalogue).parent / href)
    try:
        target = _joined(href, catalogue)
        new, old = urlsplit(target), urlsplit(catalogue if is_remote(catalogue) else "")
        origin = new.scheme, new.hostname, new.port
    except ValueError:
        raise _untrusted(catalogue, "what is no URL", "correct the catalogue") from None
    if new.scheme not in SCHEMES or not new.hostname:
        kind = f"{new.scheme}:" if new.scheme else "another host"
        raise _untrusted(catalogue, f"{kind}, which no catalogue may", "fetch the tiles by hand")
    if old.scheme and origin == (old.scheme, old.hostname, old.port):
        return target
    if new.hostname not in hosts:
        raise _untrusted(
            catalogue,
            f"another host than its own, {new.hostname}",
            f"if you trust it: --allow-host {new.hostname}",
        )
    if old.scheme == "https" and new.scheme == "http":
        raise _untrusted(catalogue, "http, and came by https itself", "fetch the tiles by hand")
    return target


def _joined(href: str, catalogue: str) -> str:
    """A location as a URL. Raises ValueError for what is none."""
    if not is_remote(catalogue):
        return href
    if urlsplit(catalogue).scheme != "s3":
        return urljoin(catalogue, href)
    if ELSEWHERE.match(href):
        return href
    # urljoin does not know s3:
    return urljoin(catalogue.replace("s3://", "http://", 1), href).replace("http://", "s3://", 1)


def _untrusted(catalogue: str, where: str, remedy: str) -> InputError:
    return InputError(f"a tile of it leads to {where}", file=catalogue, remedy=remedy)
