"""Control points of other programs in the form of the project.

Pixels: (0, 0) is the centre of the upper-left pixel here and in Ames Stereo Pipeline; QGIS counts
from the corner of that pixel, rows downward as negative numbers. Places and heights mean what the
file's system says, by the reader of systems that serves LiDAR.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..align.control_points import COLUMNS, read_gcps
from ..core.errors import InputError
from ..core.numerics.geometry import metres_per_degree, turn
from ..core.products.files import as_text
from ..core.tables import Lines, Table, epoch_year
from ..lidar.declared_crs import LidarCRS, degrees_of, parse_crs, unbound
from ..lidar.frames import WGS84_ENSEMBLE, WGS84_NAME, Epoch, Epochs, datum_code
from ..lidar.geoid import candidates_at, named
from ..lidar.height_raster import Floats, HeightRaster
from ..lidar.to_wgs84 import ToWGS84, check_area, transformation

EPOCHS = Epochs(Epoch(2020.0, "the import"))  # of what is computed, not of what is written
SAME_PLACE_M = 0.01  # points of two .points files within this are one
NAMES = {  # column: what others call it
    "id": ("id", "name", "point", "gcp", "label"),
    "lon": ("lon", "longitude", "long", "x", "easting", "east", "mapx"),
    "lat": ("lat", "latitude", "y", "northing", "north", "mapy"),
    "height": ("height", "h", "z", "alt", "altitude", "elevation", "ellipsoidal_height"),
    **{
        f"{view}_{axis}": tuple(f"{v}_{a}" for v in (view, view[0]) for a in names)
        for view in ("left", "right")
        for axis, names in (
            ("col", ("col", "column", "x", "sample")),
            ("row", ("row", "y", "line")),
        )
    },
}

NO_GEOID = Path("none")  # heights count from the ellipsoid
NO_SYSTEM = "EPSG:4326"  # of degrees
SYSTEM = ("crs", "wkt", "epsg", "frame")  # remarks that declare it, the first before others

# QGIS.
QGIS = "save the points by QGIS: mapX,mapY,sourceX,sourceY,enable"

TABLES = (".csv", ".txt", ".tsv")


@dataclass(frozen=True)
class Point:
    """A control point; NaN where a view does not show it, or nothing is known of its height.

    ``x``, ``y``, ``height`` in the system of its file, or longitude, latitude and ellipsoidal m.
    """

    id: str
    x: float
    y: float
    height: float
    left: tuple[float, float] = (math.nan, math.nan)
    right: tuple[float, float] = (math.nan, math.nan)


def import_gcps(
    files: Sequence[Path],
    to: Path,
    *,
    heights: Path | None = None,
    crs: str = "",
    geoid: Path | None = None,
    left: str = "",
    right: str = "",
    epoch: str = "",
) -> list[str]:
    """Write ``to`` from the files of another program; returns what was done, line by line.

    Points of a system whose frame is known to centimetres keep it, and ``to`` says it in its first
    lines, as ``epoch`` of the coordinates where it is given (:mod:`..align.control_points`).
    Heights of rasters and geoids are brought to that frame. ``geoid``: a grid, or NO_GEOID.

    Raises InputError that names file and line; nothing is written then.
    """
    files, to = [Path(file) for file in files], Path(to)
    if to.exists():
        raise InputError("is there already", file=to, remedy="name another file, or remove it")
    kinds = {file.suffix.lower() for file in files}
    if kinds == {".points"}:
        points, said, lines = from_qgis(files, crs, epoch)
    elif kinds == {".gcp"} and len(files) == 1:
        points, said, lines = from_asp(files[0], crs, left, right)
    elif len(files) == 1:
        points, said, lines = from_csv(files[0], crs)
    else:
        raise InputError(
            f"{len(files)} files of {', '.join(sorted(kinds))}",
            file=files[0],
            remedy="give two .points (left, right), one .gcp, or one .csv",
        )
    crs, epoch, raster = said["crs"], epoch or said["epoch"], heights
    geoid = geoid or said.get("geoid")
    if heights is not None and heights.suffix.lower() in TABLES:
        placed = to_itrf(points, crs, None, files[0], epoch, places_only=True)
        points, of_table = with_heights(points, _in_own_frame(*placed[:2]), heights)
        geoid, raster = geoid or of_table, None
    points, transform, notes = to_itrf(points, crs, geoid, files[0], epoch)
    if raster is not None and (without := [p for p in points if math.isnan(p.height)]):
        grid = None if geoid == NO_GEOID else geoid
        surface = HeightRaster.open(raster, grid, epochs=EPOCHS, whole=False)
        found = dict(zip((p.id for p in without), surface.heights_at(*_places(without)[:2])))
        points = [replace(p, height=float(found.get(p.id, p.height))) for p in points]
        notes += [f"{raster.name}: {note}" for note in surface.to_wgs84.notes]
    points = _in_own_frame(points, transform)
    if unknown := [point.id for point in points if math.isnan(point.height)]:
        raise InputError(
            f"no height for {len(unknown)} of {len(points)} points ({', '.join(unknown[:6])})",
            file=files[0],
            remedy="give --heights: a CSV with id and height (or lon, lat, height), or a raster",
        )
    _write(points, to, _name_of_frame(transform), epoch)
    try:
        read = read_gcps(to)
    except InputError:
        to.unlink()
        raise
    both = int(np.logical_and(*read.seen).sum())
    return [*lines, *notes, f"{to}: {len(read.ids)} points, {both} of them in both views"]


def to_itrf(
    points: Sequence[Point],
    crs: str,
    geoid: Path | None,
    file: Path,
    epoch: str = "",
    *,
    places_only: bool = False,
) -> tuple[list[Point], ToWGS84 | None, list[str]]:
    """Points in longitude, latitude and ellipsoidal m, how they got there, and remarks.

    In ITRF2020 at EPOCHS where their frame is known to centimetres, else in WGS 84.

    ``crs``: EPSG code, compound code or WKT; none: they are degrees. ``epoch`` of the coordinates.
    ``places_only``: heights are left as they are. Raises InputError as for LiDAR
    (:func:`.to_wgs84.transformation`), and for heights of a national plane system of which nobody
    says what they count from.
    """
    if not points:
        return [], None, []
    x, y, height = _places(points)
    if not crs and ((np.abs(x) > 360).any() or (np.abs(y) > 90).any()):
        raise InputError(
            f"ground coordinates such as {x[0]:g}, {y[0]:g} are no degrees, and the file "
            "names no system",
            file=file,
            remedy="give --crs, as in --crs EPSG:32650",
        )
    system = parse_crs(crs or NO_SYSTEM, "the coordinate system (--crs)", file)
    known = np.isfinite(height)
    if places_only or not known.any():  # what heights count from is of no account
        system = replace(system, vertical_datum=None, ellipsoidal=True)
        geoid = None
    elif geoid == NO_GEOID or not (crs or geoid):  # as control points of a project have them
        system = system if system.has_vertical else replace(system, ellipsoidal=True)
        geoid = None
    elif not (geoid or system.has_vertical) and _is_national_plane(system):
        raise _undecided(points, system, file)
    ends = np.array([[x.min(), y.min()], [x.max(), y.max()]])
    try:
        epochs = EPOCHS._replace(own=epoch_year(epoch))
    except ValueError as error:
        raise InputError(f"its epoch {epoch!r} {error}", file=file, remedy="as 2016.4") from None
    transform = transformation(system, file, ends, geoid=geoid, epochs=epochs)
    lon, lat, lifted = transform(x, y, np.where(known, height, 0.0))
    bad = ~(np.isfinite(lon) & np.isfinite(lat))
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(
            f"point {points[k].id} at {x[k]:g}, {y[k]:g} has no place on Earth in '{system.name}'",
            file=file,
            remedy="correct its coordinates, or give another --crs",
        )
    spans = ((float(v.min()), float(v.max())) for v in (lon, lat))
    notes = [
        *(f"{file.name}: {note}" for note in transform.notes),
        check_area(system, *spans, file),
    ]
    if geoid is not None and not system.ellipsoidal:
        notes.append(f"heights brought to the ellipsoid by {geoid.name}")
    height = height if places_only else np.where(known, lifted, np.nan)
    return _placed(points, lon, lat, height), transform, [note for note in notes if note]


def _is_national_plane(system: LidarCRS) -> bool:
    """Whether it is projected, and of another datum than WGS 84: of a survey, with its heights."""
    horizontal = unbound(system.horizontal)
    return horizontal.is_projected and datum_code(horizontal.geodetic_crs) != WGS84_ENSEMBLE


def _undecided(points: Sequence[Point], system: LidarCRS, file: Path) -> InputError:
    """A refusal with the geoids that there are of the place."""
    x, y, _ = _places(points)
    place = degrees_of(system.horizontal, x.mean(), y.mean())
    of_place = candidates_at(*map(float, place)) if place else []
    return InputError(
        f"heights of '{system.name}': nothing says what they count from, and heights of national "
        "plane systems are orthometric as a rule",
        file=file,
        remedy="give --geoid GRID if they are"
        + (f" (of the place PROJ knows {named(of_place)})" if of_place else "")
        + ", or --geoid none if they count from the ellipsoid",
    )


def _places(points: Sequence[Point]) -> Floats:
    """x, y, height [3, n] of points."""
    return np.array([(p.x, p.y, p.height) for p in points]).reshape(-1, 3).T


def _placed(points: Sequence[Point], x: Floats, y: Floats, height: Floats) -> list[Point]:
    """The points at other places."""
    places = np.stack([x, y, height], axis=1).tolist()
    return [replace(p, x=x, y=y, height=height) for p, (x, y, height) in zip(points, places)]


def _in_own_frame(points: Sequence[Point], transform: ToWGS84 | None) -> list[Point]:
    """Points where they were before a change of frame; so what is written depends on no epoch."""
    if transform is None or transform.change is None:
        return list(points)
    lon, lat, height = _places(points)
    x, y, known = transform.change.inverse(lon, lat, np.nan_to_num(height))
    return _placed(points, x, y, np.where(np.isnan(height), np.nan, known))


def _name_of_frame(transform: ToWGS84 | None) -> str:
    """The geographic system of the written points by its EPSG code, or WKT; empty: WGS 84."""
    change = None if transform is None else transform.change
    if change is None or change.frame == WGS84_NAME:
        return ""
    system = transform.system.horizontal.geodetic_crs.to_2d()
    code = system.to_epsg(min_confidence=20)
    return f"EPSG:{code}" if code else system.to_wkt()


def _write(points: Sequence[Point], to: Path, frame: str, epoch: str) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    with to.open("w", newline="", encoding="utf-8") as stream:
        for name, value in (("frame", frame), ("epoch", epoch)):
            if value:
                stream.write(f"# {name}: {value}\n")
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for p in points:
            pixels = ["" if math.isnan(v) else f"{v:.4f}" for v in (*p.left, *p.right)]
            writer.writerow(
                [as_text(p.id), f"{p.x:.10f}", f"{p.y:.10f}", f"{p.height:.4f}", *pixels]
            )


def _declared(read: Lines, crs: str = "") -> dict[str, str]:
    """``crs`` and ``epoch`` that remarks of a file declare; ``crs`` that is given goes before."""
    systems = [crs, *(read.declared.get(key, "") for key in SYSTEM)]
    return {"crs": next(filter(None, systems), ""), "epoch": read.declared.get("epoch", "")}


def _called(header: Sequence[str], columns: Sequence[str]) -> dict[str, str]:
    """What a header calls columns of ours; none of those that it lacks."""
    found = {c: next((n for n in NAMES[c] if n in header), "") for c in columns}
    return {column: name for column, name in found.items() if name}


# ------------------------------------------------------------------------------------------- QGIS


def from_qgis(
    files: Sequence[Path], crs: str = "", epoch: str = ""
) -> tuple[list[Point], dict[str, str], list[str]]:
    """Points of the georeferencer, one file a view; without a column id joined by their place.

    Points that are switched off there are left out. Also their system, and what was done.
    """
    if len(files) != 2:
        raise InputError(
            f"{len(files)} .points files",
            file=files[0],
            remedy="give two, that of the left image first",
        )
    tables = [Table.read(file, QGIS) for file in files]
    views = [_qgis_view(table) for table in tables]
    every = [point for view in views for point in view]
    declared = [_declared(table, crs) for table in tables]
    placed = [
        point
        for file, view, said in zip(files, views, declared)
        for point in to_itrf(
            view, said["crs"], None, file, epoch or said["epoch"], places_only=True
        )[0]
    ]
    if declared[0]["crs"] != declared[1]["crs"]:
        raise InputError(
            "names another coordinate system than the other file",
            file=files[1],
            remedy="save both in one system, or give --crs",
        )
    named = all(point.id for point in every)
    joined: dict[object, Point] = {}
    at: dict[object, tuple[float, float]] = {}
    for k, (point, ground) in enumerate(zip(every, placed)):
        view = "left" if k < len(views[0]) else "right"
        key = point.id if named else _same_place(at, ground.x, ground.y)
        at.setdefault(key, (ground.x, ground.y))
        entry = joined.setdefault(key, replace(point, left=Point.left, right=Point.right))
        if not math.isnan(getattr(entry, view)[0]):
            raise InputError(
                f"point {point.id or (ground.x, ground.y)} stands twice in it",
                file=files[view == "right"],
                remedy="remove one of the two",
            )
        joined[key] = replace(entry, **{view: point.left})
    points = [
        point if named else replace(point, id=f"G{k:02d}")
        for k, point in enumerate(joined.values(), 1)
    ]
    how = "their ids" if named else "their map coordinates"
    counts = f"{len(views[0])} points of {files[0].name}, {len(views[1])} of {files[1].name}"
    return points, declared[0], [f"{counts}, joined by {how}"]


def _same_place(at: dict, lon: float, lat: float) -> object:
    """The key of a point that lies there already, or a new one."""
    for key, (there_lon, there_lat) in at.items():
        east, north = metres_per_degree(lat) * (turn(lon - there_lon), lat - there_lat)
        if math.hypot(east, north) <= SAME_PLACE_M:
            return key
    return len(at)


def _qgis_view(table: Table) -> list[Point]:
    """Each point that is switched on, its pixel (col, row) in ``left``."""
    axes = ("sourcex", "sourcey") if "sourcex" in table.columns else ("pixelx", "pixely")
    needed = ("mapx", "mapy", *axes)
    table.require(needed, None, QGIS)
    called = _called(table.columns, ("id", "height"))
    points = []
    for line, cells in table.rows:
        if cells.get("enable", "1") == "0":
            continue
        x, y, col, row = (table.number_of(cells if cells[c] else {c: "-"}, c, line) for c in needed)
        height = table.number_of(cells, called["height"], line) if "height" in called else math.nan
        if row > 0:
            raise InputError(
                f"line {line}: sourceY is {row:g}, above the image's first row",
                file=table.file,
                remedy="georeference the image without a world file or a coordinate system of its "
                "own: QGIS then counts rows as 0, -1, -2 …",
            )
        name = cells[called["id"]] if "id" in called else ""
        points.append(Point(name, x, y, height, (col - 0.5, -row - 0.5)))
    return points


# ---------------------------------------------------------------------------- Ames Stereo Pipeline


def from_asp(
    file: Path, crs: str = "", left: str = "", right: str = ""
) -> tuple[list[Point], dict[str, str], list[str]]:
    """A .gcp file: id lat lon height, three sigmas, then image col row sigma sigma of each image.

    ``left``, ``right`` name the images, whole or by a part that only one has; else there have to be
    two, in the order in which they first appear.
    """
    expected = "write id lat lon height, three sigmas, and image col row sigma sigma of each image"
    read, rows, images = Lines.read(file, expected), [], {}
    for number, line in enumerate(read.lines, 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) < 12 or (len(words) - 7) % 5:
            raise InputError(f"line {number} has {len(words)} fields", file=file, remedy=expected)
        ground = [read.number(words[k], "coordinate", number) for k in (1, 2, 3)]
        seen = {}
        for k in range(7, len(words), 5):
            images.setdefault(words[k], len(images))
            seen[words[k]] = tuple(read.number(words[k + j], "pixel", number) for j in (1, 2))
        rows.append((words[0], ground, seen))
    views = _views_of(file, list(images), left, right)
    points = []
    for name, (lat, lon, height), seen in rows:
        pixels = {view: seen[image] for view, image in views.items() if image in seen}
        if pixels:
            points.append(Point(name, lon, lat, height, **pixels))
    said = ", ".join(f"{view}: {image}" for view, image in views.items())
    done = [f"{len(points)} of {len(rows)} points; {said}"]
    return points, _declared(read, crs), done


def _views_of(file: Path, images: list[str], left: str, right: str) -> dict[str, str]:
    found = {}
    for view, wanted in (("left", left), ("right", right)):
        if not wanted:
            continue
        fitting = [image for image in images if Path(wanted).name in image]
        if len(fitting) != 1:
            raise InputError(
                f"{len(fitting)} images are called {wanted!r}; there are {', '.join(images)}",
                file=file,
                remedy=f"name the {view} image by --{view} as it stands in the file",
            )
        found[view] = fitting[0]
    rest = [image for image in images if image not in found.values()]
    for view in ("left", "right"):
        if view not in found and len(images) == 2 and rest:
            found[view] = rest.pop(0)
    if len(found) < 2 or len(set(found.values())) < 2:
        raise InputError(
            f"points of {len(images)} images: {', '.join(images)}",
            file=file,
            remedy="say which are the pair: --left NAME --right NAME",
        )
    return {view: found[view] for view in ("left", "right")}


# -------------------------------------------------------------------------------------------- CSV


def from_csv(file: Path, crs: str = "") -> tuple[list[Point], dict[str, Any], list[str]]:
    """A table with a header, of any of the names and separators that are common; its system."""
    names = ({"lon": "x", "lat": "y"}.get(name, name) if crs else name for name in COLUMNS)
    expected = f"call the columns {','.join(names)}"
    table = Table.read(file, expected, ragged=True)
    called = _called(table.columns, COLUMNS)
    missing = [column for column in COLUMNS if column not in called and column != "height"]
    if missing:
        raise InputError(
            f"no column for {', '.join(missing)} among {', '.join(table.columns)}",
            file=file,
            remedy=expected,
        )
    points = []
    for line, cells in table.rows:
        value = {c: table.number_of(cells, n, line) for c, n in called.items() if c != "id"}
        pixels = ((value[f"{v}_col"], value[f"{v}_row"]) for v in ("left", "right"))
        ground = value["lon"], value["lat"], value.get("height", math.nan)
        points.append(Point(cells[called["id"]], *ground, *pixels))
    said = _declared(table, crs) | {"geoid": _geoid_of(called)}
    return points, said, [f"{len(points)} points of {file.name}"]


def _geoid_of(called: Mapping[str, str]) -> Path | None:
    """NO_GEOID, if the column of heights says that they count from the ellipsoid."""
    return NO_GEOID if called.get("height") == "ellipsoidal_height" else None


def with_heights(
    points: Sequence[Point], ground: Sequence[Point], source: Path
) -> tuple[list[Point], Path | None]:
    """Points with heights of a table, by id, or by longitude and latitude (those of ``ground``).

    Heights are in the points' own system. Points that have one keep it. Also NO_GEOID, if the table
    says that all heights count from the ellipsoid.
    """
    expected = "write id,height or lon,lat,height"
    table = Table.read(source, expected, ragged=True)
    called = _called(table.columns, ("id", "lon", "lat", "height"))
    if "height" not in called or not ("id" in called or {"lon", "lat"} <= set(called)):
        raise InputError(
            f"columns {', '.join(table.columns)} are no heights of points",
            file=source,
            remedy=expected,
        )
    by_id, at, height_at = {}, {}, {}
    for line, cells in table.rows:
        height = table.number_of(cells, called["height"], line)
        if "id" in called:
            by_id[cells[called["id"]]] = height
        if {"lon", "lat"} <= set(called):
            at[line] = tuple(table.number_of(cells, called[a], line) for a in ("lon", "lat"))
            height_at[line] = height
    found = []
    for point, place in zip(points, ground):
        height = point.height
        if math.isnan(height):
            height = by_id.get(point.id, math.nan)
        if math.isnan(height) and at:
            height = height_at.get(_same_place(at, place.x, place.y), math.nan)
        found.append(replace(point, height=height))
    own = any(not math.isnan(point.height) for point in points)
    return found, None if own else _geoid_of(called)
