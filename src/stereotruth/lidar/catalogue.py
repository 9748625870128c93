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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any
from urllib.parse import urljoin, urlsplit

import numpy as np
import pyproj
import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError
from shapely import Geometry
from shapely.geometry import shape

from ..core.errors import InputError
from ..core.numerics.geometry import continuous
from ..core.products.remote_files import SCHEMES, is_remote, read_bytes
from ..core.sheets import LIDAR_SEPARATOR, LIDAR_SUFFIXES, RASTER_SUFFIXES
from .catalogue_list import EPT
from .declared_crs import interpret
from .lattice import CELL_DEG, Footprint

MOST_BYTES = 200_000_000  # of a catalogue
MOST_TILES = 1_000_000
TILE_SUFFIXES = (*LIDAR_SUFFIXES, *RASTER_SUFFIXES, EPT)
ELSEWHERE = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:|//|\\\\")  # a scheme, or another host
NO_DATA_ROLES = {"overview", "thumbnail", "metadata", "visual"}
KINDS = "give a VPC, STAC items, GeoJSON or GeoPackage; see that the file is whole"
CUT = "cut it to the region"
FARTHEST = 1e9  # coordinate, in metres or feet
SIDE_PARTS = 8  # of an outline in a projection, whose sides are not straight in degrees
JOINT_DEG = 1e-5  # by which outlines of neighbours may miss each other: a metre
DOUBLED_SHARE = 0.5  # of the smaller one of two tiles that cover the same ground

Row = tuple[Mapping[str, Any], Geometry | None]  # of a tile index: columns, outline in degrees


@dataclass(frozen=True)
class Tile:
    """A tile as a catalogue has it.

    ``href``: location as it stands there; ``outline`` in degrees, longitudes without a jump at the
    line of 180°; ``crs``: what the catalogue says of its coordinates (WKT), or empty; ``start``,
    ``end``: dates of its acquisition (ISO), or empty; ``points``: how many it has, or None.
    """

    href: str
    outline: Geometry
    crs: str = ""
    start: str = ""
    end: str = ""
    points: int | None = None


@dataclass(frozen=True)
class Catalogue:
    """A catalogue and its tiles; ``bytes`` and ``sha256`` are those of its file."""

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
    elif not (file := Path(location)).is_file():
        raise InputError("no such catalogue", file=file, remedy="correct its path")
    elif file.stat().st_size > MOST_BYTES:
        problem = f"a catalogue larger than {MOST_BYTES / 1e6:g} MB"
        raise InputError(problem, file=file, remedy=CUT)
    else:
        content = file.read_bytes()
    if content[:15] == b"SQLite format 3":
        tiles = _indexed(_rows_of_geopackage(content, location), column, dates, location)
    else:
        tiles = _of_json(content, location, column, dates)
    if not tiles:
        raise InputError("a catalogue without a tile", file=location, remedy="check its content")
    if len(tiles) > MOST_TILES:
        raise InputError(f"more than {MOST_TILES} tiles", file=location, remedy=CUT)
    return Catalogue(len(content), hashlib.sha256(content).hexdigest(), tuple(tiles))


def _of_json(
    content: bytes, location: str, column: str, dates: tuple[str, str] | None
) -> list[Tile]:
    try:
        read = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        problem = f"no catalogue that can be read ({type(error).__name__})"
        raise InputError(problem, file=location, remedy=KINDS) from None
    kind = read.get("type") if isinstance(read, Mapping) else None
    if kind in ("Catalog", "Collection"):
        raise InputError(
            f"a STAC {kind}, which only links to its items",
            file=location,
            remedy="save its items in one file (an ItemCollection), and name that",
        )
    features = read.get("features") if kind == "FeatureCollection" else [read]
    if kind not in ("FeatureCollection", "Feature") or not isinstance(features, list):
        raise InputError("neither STAC items nor GeoJSON", file=location, remedy=KINDS)
    links, matched = read.get("links"), read.get("numberMatched")
    linked = map(_mapping, links if isinstance(links, list) else ())
    more = any(link.get("rel") == "next" for link in linked)
    if more or (isinstance(matched, int) and matched > len(features)):
        raise InputError(
            f"a page of {len(features)} items of a search that has found more",
            file=location,
            remedy="save all of its pages in one file",
        )
    for number, feature in enumerate(features, 1):
        if _mapping(feature).get("type") != "Feature":
            raise _damaged(location, number, "is no feature")
    if any("assets" in feature for feature in features):
        is_dated = not location.lower().endswith(".vpc")  # which has days of writing there
        return [_item(item, n, location, is_dated) for n, item in enumerate(features, 1)]
    crs = None
    if isinstance(read.get("crs"), Mapping):  # of GeoJSON 2008, as GDAL writes it
        try:
            crs = CRS.from_user_input(read["crs"]["properties"]["name"])
        except (KeyError, TypeError, CRSError, ValueError):
            raise _no_system(location) from None
    rows = (
        (_mapping(one.get("properties")), _outline(one.get("geometry"), crs)) for one in features
    )
    return _indexed(rows, column, dates, location)


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _damaged(location: str, number: int, problem: str) -> InputError:
    return InputError(
        f"damaged: tile {number} {problem}", file=location, remedy="correct it, or fetch it again"
    )


def _no_system(location: str) -> InputError:
    return InputError(
        "its coordinate system cannot be used",
        file=location,
        remedy="write it in WGS 84 longitude and latitude",
    )


def _rows_of_geopackage(content: bytes, location: str) -> Iterable[Row]:
    """Columns and outline of each row of its one layer. Raises InputError for other files."""
    import geopandas  # half a second, which other catalogues do not need
    import pyogrio

    table = None
    try:
        with NamedTemporaryFile(suffix=".gpkg") as file:
            file.write(content)
            file.flush()
            layers = [str(name) for name, kind in pyogrio.list_layers(file.name) if kind]
            if len(layers) == 1:
                table = geopandas.read_file(file.name, layer=layers[0], rows=MOST_TILES + 1)
    except (RuntimeError, ValueError, shapely.errors.ShapelyError) as error:
        raise InputError(
            f"no GeoPackage that can be read ({type(error).__name__})",
            file=location,
            remedy="check or fetch it again; see that its layer has polygons",
        ) from None
    if table is None:
        raise InputError(
            f"a GeoPackage of {len(layers)} layers ({', '.join(layers) or 'none'}); a tile index "
            "has one",
            file=location,
            remedy="write the layer of the tiles alone",
        )
    if table.crs is None:
        raise _no_system(location)
    outlines = [_in_degrees(outline, table.crs) for outline in table.geometry]
    return zip(table.drop(columns=table.geometry.name).to_dict("records"), outlines)


def _item(item: Mapping[str, Any], number: int, location: str, is_dated: bool) -> Tile:
    """A tile of a STAC item; its own coordinates come before degrees, as VPC has it."""
    properties = _mapping(item.get("properties"))
    crs = outline = None
    for key in ("proj:wkt2", "proj:projjson", "proj:code", "proj:epsg"):
        if crs is None and (value := properties.get(key)):
            try:
                crs = CRS.from_user_input(value)
            except (CRSError, TypeError, ValueError):
                continue
    if crs is not None:
        outline = _outline(properties.get("proj:geometry"), crs)
        outline = outline or _boxed(properties.get("proj:bbox"), crs)
    outline = outline or _outline(item.get("geometry"), None) or _boxed(item.get("bbox"), None)
    if outline is None:
        raise _damaged(location, number, "has no outline that can be read")
    first, last = properties.get("start_datetime"), properties.get("end_datetime")
    if is_dated and not (first and last):
        first = last = properties.get("datetime")
    points = properties.get("pc:count")
    return Tile(
        _asset(item.get("assets"), number, location),
        outline,
        "" if crs is None else crs.to_wkt(),
        _day(first),
        _day(last),
        points if type(points) is int and 0 <= points < 10**15 else None,
    )


def _asset(assets: Any, number: int, location: str) -> str:
    """The location of an item's points: the one asset with data."""
    held = []
    for asset in map(_mapping, _mapping(assets).values()):
        href, roles = asset.get("href"), asset.get("roles")
        is_other = isinstance(roles, list) and NO_DATA_ROLES & set(map(str, roles))
        if isinstance(href, str) and not is_other:
            held.append(href)
    for kind in (LIDAR_SUFFIXES, (EPT,), RASTER_SUFFIXES):
        if fitting := [href for href in held if _path(href).endswith(kind)]:
            if len(set(fitting)) > 1:
                raise _damaged(location, number, f"has {len(fitting)} files of points")
            return fitting[0]
    raise _damaged(
        location,
        number,
        "is packed in a ZIP archive, of which no part can be read: fetch and unpack it"
        if any(_path(href).endswith(".zip") for href in held)
        else "has no file of LAS, LAZ, COPC, EPT or GeoTIFF",
    )


def _path(href: str) -> str:
    """A location without query and fragment, in small letters."""
    return re.split(r"[?#]", href, maxsplit=1)[0].lower()


def _day(value: Any) -> str:
    """The UTC date of a time, or empty."""
    try:
        time = datetime.fromisoformat(str(value).strip())
        return (time if time.tzinfo is None else time.astimezone(UTC)).date().isoformat()
    except (ValueError, OverflowError):  # none, or of the year 0
        return ""


def _indexed(
    rows: Iterable[Row], column: str, dates: tuple[str, str] | None, location: str
) -> list[Tile]:
    """Tiles of an index: the locations stand in a column, the one whose texts all name files."""
    held = list(rows)
    names = list(map(str, held[0][0])) if held else []
    if held and not column:
        fitting = [name for name in names if all(_is_tile(row.get(name)) for row, _ in held)]
        if len(fitting) != 1:
            several = f"{len(fitting)} columns" if fitting else "no column"
            raise InputError(
                f"{several} whose every value names a LAS, LAZ, COPC, EPT or GeoTIFF file",
                file=location,
                remedy=f"name it by --column; there are {', '.join(fitting or names) or 'none'}",
            )
        column = fitting[0]
    missing = {name for name in (column, *(dates or ())) if all(name not in row for row, _ in held)}
    if held and missing:
        raise InputError(
            f"has no column {min(missing)!r}",
            file=location,
            remedy=f"its columns are {', '.join(names) or 'none'}",
        )
    tiles = []
    for number, (row, outline) in enumerate(held, 1):
        href = row.get(column)
        if outline is None:
            raise _damaged(location, number, "has no outline that can be read (a polygon)")
        if not isinstance(href, str) or not href.strip():
            raise _damaged(location, number, f"names no file in column {column!r}")
        days = [_day(row.get(name)) for name in dates] if dates else ["", ""]
        tiles.append(Tile(href.strip(), outline, "", *days))
    return tiles


def _is_tile(value: Any) -> bool:
    return isinstance(value, str) and _path(value).endswith(TILE_SUFFIXES)


# ---------------------------------------------------------------------------------------- outlines


def _outline(geometry: Any, crs: CRS | None) -> Geometry | None:
    """A GeoJSON geometry in degrees; see :func:`_in_degrees`."""
    try:
        return _in_degrees(shape(geometry), crs)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError,
            shapely.errors.ShapelyError):  # fmt: skip
        return None


def _boxed(box: Any, crs: CRS | None) -> Geometry | None:
    """A box of two or three dimensions in degrees; two of one across the antimeridian."""
    try:
        values = np.array(box, np.float64).reshape(2, -1)[:, :2]
        (west, south), (east, north) = values
    except (TypeError, ValueError, OverflowError):
        return None
    if not np.isfinite(values).all():
        return None
    sides = [(west, east)] if crs is not None or west <= east else [(west, 180.0), (-180.0, east)]
    parts = [shapely.box(first, south, last, north) for first, last in sides]
    return _in_degrees(shapely.multipolygons(parts), crs)


def _in_degrees(outline: Geometry | None, crs: CRS | None) -> Geometry | None:
    """Polygons in longitude and latitude; None if they lie nowhere on Earth, or are none.

    ``crs``: of their coordinates, east first; None: they are degrees. Longitudes of a polygon do
    not jump at the line of 180°, as those of footprints, unless it goes around the Earth.
    """
    if outline is None or outline.geom_type not in ("Polygon", "MultiPolygon") or outline.is_empty:
        return None
    if not (np.abs(shapely.get_coordinates(outline)) < FARTHEST).all():  # nor NaN
        return None
    outline = shapely.force_2d(outline)
    if crs is not None:
        west, south, east, north = outline.bounds
        outline = shapely.segmentize(outline, max(east - west, north - south) / SIDE_PARTS)
        try:
            system = interpret(crs).horizontal
            pyproj.network.set_network_enabled(False)
            change = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True)
        except (ProjError, ValueError):
            return None
        outline = shapely.transform(outline, lambda xy: np.stack(change.transform(*xy.T), axis=1))
    if not (np.abs(shapely.get_coordinates(outline)) <= [180.0, 90.0]).all():
        return None
    parts = [
        part
        if {-180.0, 180.0} <= set(shapely.get_coordinates(part)[:, 0].tolist())
        else shapely.transform(part, lambda xy: np.stack([continuous(xy[:, 0]), xy[:, 1]], axis=1))
        for part in shapely.get_parts(outline)
    ]
    valid = shapely.make_valid(
        shapely.multipolygons(parts), method="structure", keep_collapsed=False
    )
    return None if valid.is_empty else valid


@dataclass(frozen=True)
class Cover:
    """What a catalogue's tiles are to a footprint.

    ``taken``: indices of the tiles that touch it; ``area_m2`` of the footprint, ``hole_m2`` of it
    in no tile, ``hole_at``: lon and lat in the largest part of that, None without a hole.
    ``doubled``: pairs of taken tiles that have most of their ground in common.
    """

    taken: tuple[int, ...]
    area_m2: float
    hole_m2: float
    hole_at: tuple[float, float] | None
    doubled: tuple[tuple[int, int], ...]


def cover_of(tiles: Sequence[Tile], footprint: Footprint) -> Cover:
    """How the tiles cover the footprint; whether they touch it is told in whole cells around."""
    row, first, last = np.array(footprint.runs).T
    sides = np.stack([first, row, last + 1, row + 1]) * CELL_DEG
    cells = shapely.box(*sides)
    around = shapely.box(*(sides + np.array([[-1], [-1], [1], [1]]) * CELL_DEG))
    outlines = np.array([tile.outline for tile in tiles])
    taken = np.unique(shapely.STRtree(around).query(outlines, predicate="intersects")[0])
    ground = outlines[taken]
    covered = shapely.buffer(shapely.union_all(ground), JOINT_DEG, join_style="mitre")
    holes = shapely.difference(cells, covered)
    cell_m2 = footprint.cell_m2[row - footprint.row]
    hole_m2 = float(shapely.area(holes) / CELL_DEG**2 @ cell_m2)
    hole_at = None
    if hole_m2 > 0:
        parts = shapely.get_parts(shapely.union_all(holes))
        inside = shapely.point_on_surface(parts[np.argmax(shapely.area(parts))])
        hole_at = inside.x, inside.y
    own = shapely.intersection(ground, shapely.union_all(cells))
    one, other = shapely.STRtree(own).query(own, predicate="intersects")
    one, other = one[one < other], other[one < other]
    common = shapely.area(shapely.intersection(own[one], own[other]))
    least = np.minimum(shapely.area(own[one]), shapely.area(own[other]))
    same = (common > 0) & (common >= DOUBLED_SHARE * least)
    doubled = sorted(zip(taken[one[same]].tolist(), taken[other[same]].tolist()))
    return Cover(tuple(taken.tolist()), footprint.area_m2, hole_m2, hole_at, tuple(doubled))


# --------------------------------------------------------------------------------------- locations


def resolved(href: str, catalogue: str, hosts: frozenset[str]) -> str:
    """Where a tile lies: a path (relative to the working directory) or a URL.

    Raises InputError for a location that a catalogue may not lead to: another host than its own
    unless ``hosts`` has it, ``file:`` and other schemes, http where the catalogue came by https; of
    a catalogue on the disk, any host but those of ``hosts``.
    """

    def untrusted(where: str, remedy: str) -> InputError:
        return InputError(f"a tile of it leads to {where}", file=catalogue, remedy=remedy)

    if not href.isprintable() or LIDAR_SEPARATOR in href:
        remedy = f"name no file with {LIDAR_SEPARATOR!r}"
        raise untrusted("a name that no sheet can have", remedy)
    if not is_remote(catalogue) and not ELSEWHERE.match(href):
        return str(Path(catalogue).parent / href)
    try:
        target = _joined(href, catalogue)
        new, old = urlsplit(target), urlsplit(catalogue if is_remote(catalogue) else "")
        origin = new.scheme, new.hostname, new.port
    except ValueError:
        raise untrusted("what is no URL", "correct the catalogue") from None
    if new.scheme not in SCHEMES or not new.hostname:
        kind = f"{new.scheme}:" if new.scheme else "another host"
        raise untrusted(f"{kind}, which no catalogue may", "fetch the tiles by hand")
    if old.scheme and origin == (old.scheme, old.hostname, old.port):
        return target
    if new.hostname not in hosts:
        remedy = f"if you trust it: --allow-host {new.hostname}"
        raise untrusted(f"another host than its own, {new.hostname}", remedy)
    if old.scheme == "https" and new.scheme == "http":
        raise untrusted("http, and came by https itself", "fetch the tiles by hand")
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
