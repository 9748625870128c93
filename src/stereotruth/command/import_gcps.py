"""Control points of other programs in the form of the project.

Pixels: (0, 0) is the centre of the upper-left pixel here and in Ames Stereo Pipeline; QGIS counts
from the corner of that pixel, rows downward as negative numbers. Places and heights mean what the
file's system says, by the reader of systems that serves LiDAR.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..alignment.control_points import COLUMNS, read_gcps
from ..epipolar.decimal_numbers import decimal_number
from ..errors import InputError
from ..lidar.declared_crs import LidarCRS, parse_crs
from ..lidar.frames import is_known
from ..lidar.height_raster import HeightRaster
from ..lidar.to_wgs84 import check_area, transformation
from ..numerics.degrees import metres_per_degree, turn
from ..products.files import as_text

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


NO_SYSTEM = "EPSG:4326"  # of degrees


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
    lines, as ``epoch`` of the coordinates where it is given (:mod:`..alignment.control_points`).

    Raises InputError that names file and line; nothing is written then.
    """
    files, to = [Path(file) for file in files], Path(to)
    if to.exists():
        raise InputError("is there already", file=to, remedy="name another file, or remove it")
    kinds = {file.suffix.lower() for file in files}
    if kinds == {".points"}:
        points, said, lines = from_qgis(files, crs)
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
    crs, epoch, raster = said.get("crs", ""), epoch or said.get("epoch", ""), heights
    if heights is not None and heights.suffix.lower() in TABLES:
        ground, _ = to_wgs84(points, crs, None, files[0], places_only=True)
        points, raster = with_heights(points, ground, heights), None
    points, notes = to_wgs84(points, crs, geoid, files[0])
    frame = _own_frame(parse_crs(crs)) if crs else ""
    if raster is not None and (without := [p for p in points if math.isnan(p.height)]):
        lon, lat = (np.array([getattr(p, axis) for p in without]) for axis in "xy")
        surface = HeightRaster.open(raster, geoid, whole=False)
        found = dict(zip((p.id for p in without), surface.heights_at(lon, lat)))
        points = [replace(p, height=float(found.get(p.id, p.height))) for p in points]
        notes += [f"{raster.name}: {note}" for note in surface.to_wgs84.notes]
    if unknown := [point.id for point in points if math.isnan(point.height)]:
        raise InputError(
            f"no height for {len(unknown)} of {len(points)} points ({', '.join(unknown[:6])})",
            file=files[0],
            remedy="give --heights: a CSV with id and height (or lon, lat, height), or a raster",
        )
    _write(points, to, frame, epoch)
    try:
        read = read_gcps(to)
    except InputError:
        to.unlink()
        raise
    both = int((read.in_left & read.in_right).sum())
    return [*lines, *notes, f"{to}: {len(read.ids)} points, {both} of them in both views"]


def to_wgs84(
    points: Sequence[Point], crs: str, geoid: Path | None, file: Path, *, places_only: bool = False
) -> tuple[list[Point], list[str]]:
    """Points in longitude, latitude and ellipsoidal m, and remarks.

    In their own frame where that is known to centimetres, else in WGS 84.

    ``crs``: EPSG code, compound code or WKT; none: they are degrees. ``places_only``: heights are
    left as they are. Raises InputError as for LiDAR: see :func:`.to_wgs84.transformation`.
    """
    if not points:
        return [], []
    x, y, height = (np.array([getattr(p, name) for p in points]) for name in ("x", "y", "height"))
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
    elif not crs and geoid is None:  # as control points of a project have them
        system = replace(system, ellipsoidal=True)
    ends = np.array([[x.min(), y.min()], [x.max(), y.max()]])
    keep_frame = bool(_own_frame(system))
    transform = transformation(system, file, ends, geoid=geoid, keep_frame=keep_frame)
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
    if transform.is_orthometric:
        notes.append(f"heights brought to the ellipsoid by {geoid.name}")
    height = height if places_only else np.where(known, lifted, np.nan)
    placed = zip(points, lon, lat, height)
    found = [replace(p, x=float(a), y=float(b), height=float(h)) for p, a, b, h in placed]
    return found, [note for note in notes if note]


def _own_frame(system: LidarCRS) -> str:
    """EPSG code of the geographic system that points keep; empty: WGS 84."""
    geodetic = system.horizontal.geodetic_crs
    if geodetic is None or not is_known(geodetic):
        return ""
    code = geodetic.to_2d().to_epsg(min_confidence=20)
    return f"EPSG:{code}" if code else ""


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


@dataclass
class _Text:
    """Lines [(number, text)] of a file that hold anything, and what its comments declare."""

    file: Path
    lines: list[tuple[int, str]] = field(default_factory=list)
    declared: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, file: Path) -> _Text:
        """Raises InputError if it is missing or no text."""
        try:
            text = file.read_text(encoding="utf-8-sig")
        except FileNotFoundError:
            raise InputError("no such file", file=file, remedy="correct the path") from None
        except (UnicodeDecodeError, OSError) as error:
            raise InputError(
                f"cannot be read as text ({error})", file=file, remedy="save it in UTF-8"
            ) from None
        found = cls(file)
        for number, line in enumerate(text.splitlines(), 1):
            if said := re.match(
                r"#\s*(CRS|WKT|EPSG|frame|epoch)\s*[:=]\s*(.+)", line, re.IGNORECASE
            ):
                key = "epoch" if said[1].lower() == "epoch" else "crs"
                found.declared.setdefault(key, said[2].strip())
            elif line.strip() and not line.startswith("#"):
                found.lines.append((number, line))
        return found

    def said(self, crs: str) -> dict[str, str]:
        """``crs`` and ``epoch`` of the coordinates; ``crs`` that is given goes before."""
        return self.declared | ({"crs": crs} if crs else {})

    def number(self, text: str, what: str, line: int) -> float:
        """A decimal number, NaN for an empty cell. Raises InputError that names the line."""
        if not text.strip():
            return math.nan
        try:
            return decimal_number(text.strip())
        except ValueError:
            raise InputError(
                f"line {line}: {what} {text[:40]!r} is no number",
                file=self.file,
                remedy="write a decimal number",
            ) from None

    def table(self) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
        """Names of columns, in small letters, and (line, cells by column); any usual separator."""
        if not self.lines:
            raise InputError(
                "there are no points in it", file=self.file, remedy="write a line a point"
            )
        separator = max(",;\t", key=self.lines[0][1].count)
        parsed = csv.reader([line for _, line in self.lines], delimiter=separator)
        header, *rows = [[cell.strip() for cell in cells] for cells in parsed]
        header = [name.lower() for name in header]
        if separator != ",":
            rows = [[cell.replace(",", ".") for cell in cells] for cells in rows]
        of = [dict(zip(header, [*cells, *[""] * len(header)])) for cells in rows]
        return header, [(number, cells) for (number, _), cells in zip(self.lines[1:], of)]


def _called(header: Sequence[str], columns: Sequence[str]) -> dict[str, str]:
    """What a header calls columns of ours; none of those that it lacks."""
    found = {c: next((n for n in NAMES[c] if n in header), "") for c in columns}
    return {column: name for column, name in found.items() if name}


# ------------------------------------------------------------------------------------------- QGIS


def from_qgis(
    files: Sequence[Path], crs: str = ""
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
    texts = [_Text.read(file) for file in files]
    views = [_qgis_view(text) for text in texts]
    every = [point for view in views for point in view]
    systems = [crs or text.declared.get("crs", "") for text in texts]
    placed = [
        point
        for text, view, system in zip(texts, views, systems)
        for point in to_wgs84(view, system, None, text.file, places_only=True)[0]
    ]
    if len(set(systems)) > 1:
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
    return points, texts[0].declared | {"crs": systems[0]}, [f"{counts}, joined by {how}"]


def _same_place(at: dict, lon: float, lat: float) -> object:
    """The key of a point that lies there already, or a new one."""
    for key, (there_lon, there_lat) in at.items():
        east, north = metres_per_degree(lat) * (turn(lon - there_lon), lat - there_lat)
        if math.hypot(east, north) <= SAME_PLACE_M:
            return key
    return len(at)


def _qgis_view(text: _Text) -> list[Point]:
    """Each point that is switched on, its pixel (col, row) in ``left``."""
    header, rows = text.table()
    axes = ("sourcex", "sourcey") if "sourcex" in header else ("pixelx", "pixely")
    for column in ("mapx", "mapy", *axes):
        if column not in header:
            raise InputError(
                f"column {column!r} is missing",
                file=text.file,
                remedy="save the points by QGIS: mapX,mapY,sourceX,sourceY,enable",
            )
    called = _called(header, ("id", "height"))
    points = []
    for line, cells in rows:
        if cells.get("enable", "1") == "0":
            continue
        x, y, col, row = (text.number(cells[c] or "-", c, line) for c in ("mapx", "mapy", *axes))
        height = text.number(cells[called["height"]], "height", line) if "height" in called else 0
        height = height if "height" in called else math.nan
        if row > 0:
            raise InputError(
                f"line {line}: sourceY is {row:g}, above the image's first row",
                file=text.file,
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
    text, rows, images = _Text.read(file), [], {}
    for number, line in text.lines:
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        if len(words) < 12 or (len(words) - 7) % 5:
            raise InputError(
                f"line {number} has {len(words)} fields",
                file=file,
                remedy="write id lat lon height, three sigmas, and image col row sigma sigma of "
                "each image",
            )
        ground = [text.number(words[k], "coordinate", number) for k in (1, 2, 3)]
        seen = {}
        for k in range(7, len(words), 5):
            images.setdefault(words[k], len(images))
            seen[words[k]] = tuple(text.number(words[k + j], "pixel", number) for j in (1, 2))
        rows.append((words[0], ground, seen))
    views = _views_of(file, list(images), left, right)
    points = []
    for name, (lat, lon, height), seen in rows:
        pixels = {view: seen[image] for view, image in views.items() if image in seen}
        if pixels:
            points.append(Point(name, lon, lat, height, **pixels))
    said = ", ".join(f"{view}: {image}" for view, image in views.items())
    done = [f"{len(points)} of {len(rows)} points; {said}"]
    return points, text.said(crs), done


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


def from_csv(file: Path, crs: str = "") -> tuple[list[Point], dict[str, str], list[str]]:
    """A table with a header, of any of the names and separators that are common; its system."""
    text = _Text.read(file)
    header, rows = text.table()
    called = _called(header, COLUMNS)
    missing = [column for column in COLUMNS if column not in called and column != "height"]
    if missing:
        raise InputError(
            f"no column for {', '.join(missing)} among {', '.join(header)}",
            file=file,
            remedy=f"call them {','.join(COLUMNS)}",
        )
    points = []
    for line, cells in rows:
        value = {c: text.number(cells[n], c, line) for c, n in called.items() if c != "id"}
        pixels = ((value[f"{v}_col"], value[f"{v}_row"]) for v in ("left", "right"))
        ground = value["lon"], value["lat"], value.get("height", math.nan)
        points.append(Point(cells[called["id"]], *ground, *pixels))
    return points, text.said(crs), [f"{len(points)} points of {file.name}"]


TABLES = (".csv", ".txt", ".tsv")


def with_heights(points: Sequence[Point], ground: Sequence[Point], source: Path) -> list[Point]:
    """Points with heights of a table, by id, or by longitude and latitude (those of ``ground``).

    Heights are in the points' own system. Points that have one keep it.
    """
    text = _Text.read(source)
    header, rows = text.table()
    called = _called(header, ("id", "lon", "lat", "height"))
    if "height" not in called or not ("id" in called or {"lon", "lat"} <= set(called)):
        raise InputError(
            f"columns {', '.join(header)} are no heights of points",
            file=source,
            remedy="write id,height or lon,lat,height",
        )
    by_id, at, height_at = {}, {}, {}
    for line, cells in rows:
        height = text.number(cells[called["height"]], "height", line)
        if "id" in called:
            by_id[cells[called["id"]]] = height
        if {"lon", "lat"} <= set(called):
            at[line] = tuple(
                text.number(cells[called[axis]], axis, line) for axis in ("lon", "lat")
            )
            height_at[line] = height
    found = []
    for point, place in zip(points, ground):
        height = point.height
        if math.isnan(height):
            height = by_id.get(point.id, math.nan)
        if math.isnan(height) and at:
            height = height_at.get(_same_place(at, place.x, place.y), math.nan)
        found.append(replace(point, height=height))
    return found
