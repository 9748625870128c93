"""Control points of other programs in the form of the project.

Pixels: (0, 0) is the centre of the upper-left pixel here and in Ames Stereo Pipeline; QGIS counts
from the corner of that pixel, rows downward as negative numbers.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyproj
from pyproj.exceptions import CRSError

from ..alignment.control_points import COLUMNS, read_gcps
from ..epipolar.decimal_numbers import decimal_number
from ..errors import InputError
from ..lidar.frames import is_known
from ..lidar.geoid import GeoidGrid
from ..numerics.bilinear import bilinear
from ..numerics.degrees import metres_per_degree
from ..products.files import as_text
from ..products.ungeoreferenced import open_raster

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


@dataclass(frozen=True)
class Point:
    """A control point; NaN where a view does not show it, or nothing is known of its height."""

    id: str
    lon: float
    lat: float
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
    frame = "" if kinds == {".gcp"} else _own_frame(crs)
    if kinds == {".points"}:
        points, lines = from_qgis(files, crs)
    elif kinds == {".gcp"} and len(files) == 1:
        points, lines = from_asp(files[0], left, right)
    elif len(files) == 1:
        points, lines = from_csv(files[0], crs)
    else:
        raise InputError(
            f"{len(files)} files of {', '.join(sorted(kinds))}",
            file=files[0],
            remedy="give two .points (left, right), one .gcp, or one .csv",
        )
    if heights is not None:
        points = with_heights(points, heights)
    if unknown := [point.id for point in points if math.isnan(point.height)]:
        raise InputError(
            f"no height for {len(unknown)} of {len(points)} points ({', '.join(unknown[:6])})",
            file=files[0],
            remedy="give --heights: a CSV with id and height (or lon, lat, height), or a raster",
        )
    if geoid is not None:
        lon, lat = (np.array([getattr(p, name) for p in points]) for name in ("lon", "lat"))
        lift = GeoidGrid(geoid)(lon, lat)
        points = [replace(p, height=p.height + float(n)) for p, n in zip(points, lift)]
        lines.append(f"heights brought to the ellipsoid by {geoid.name}")
    _write(points, to, frame, epoch)
    try:
        read = read_gcps(to)
    except InputError:
        to.unlink()
        raise
    both = int((read.in_left & read.in_right).sum())
    lines.append(f"{to}: {len(read.ids)} points, {both} of them in both views")
    return lines


def _own_frame(crs: str) -> str:
    """EPSG code of the geographic system of ``--crs`` that points keep; empty: WGS 84."""
    try:
        system = pyproj.CRS.from_user_input(f"EPSG:{crs}" if crs.isdigit() else crs)
    except CRSError:
        return ""  # to_degrees says what is wrong
    if not is_known(system):
        return ""
    code = system.geodetic_crs.to_2d().to_epsg(min_confidence=20)
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
                [as_text(p.id), f"{p.lon:.10f}", f"{p.lat:.10f}", f"{p.height:.4f}", *pixels]
            )


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError("no such file", file=file, remedy="correct the path") from None
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(
            f"cannot be read as text ({error})", file=file, remedy="save it in UTF-8"
        ) from None


def _number(text: str, what: str, line: int, file: Path) -> float:
    try:
        return decimal_number(text.strip())
    except ValueError:
        raise InputError(
            f"line {line}: {what} {text[:40]!r} is no number",
            file=file,
            remedy="write a decimal number",
        ) from None


def to_degrees(x: np.ndarray, y: np.ndarray, crs: str, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """lon, lat of coordinates of a system (EPSG code or WKT; empty: they are degrees).

    In its own frame where that is known to centimetres, else in WGS 84.
    """
    if not crs:
        if (np.abs(x) > 360).any() or (np.abs(y) > 90).any():
            raise InputError(
                f"ground coordinates such as {x[0]:g}, {y[0]:g} are no degrees, and the file "
                "names no system",
                file=file,
                remedy="give --crs, as in --crs EPSG:32650",
            )
        return x, y
    try:
        system = pyproj.CRS.from_user_input(f"EPSG:{crs}" if crs.isdigit() else crs)
        degrees = _own_frame(crs) or "EPSG:4326"
        transform = pyproj.Transformer.from_crs(system, degrees, always_xy=True)
    except CRSError as error:
        raise InputError(
            f"its coordinate system cannot be used ({error})",
            file=file,
            remedy="give --crs, as in --crs EPSG:32650",
        ) from None
    return transform.transform(x, y)


# ------------------------------------------------------------------------------------------- QGIS


def from_qgis(files: Sequence[Path], crs: str = "") -> tuple[list[Point], list[str]]:
    """Points of the georeferencer, one file a view; without a column id joined by their place.

    Points that are switched off there are left out.
    """
    if len(files) != 2:
        raise InputError(
            f"{len(files)} .points files",
            file=files[0],
            remedy="give two, that of the left image first",
        )
    views = [_qgis_view(file, crs) for file in files]
    named = all(name for view in views for name, *_ in view)
    joined: dict[object, dict[str, tuple]] = {}
    for view, rows in zip(("left", "right"), views):
        for name, lon, lat, height, pixel in rows:
            key = name if named else _same_place(joined, lon, lat)
            entry = joined.setdefault(key, {"ground": (name, lon, lat, height)})
            if view in entry:
                raise InputError(
                    f"point {name or (lon, lat)} stands twice in it",
                    file=files[view == "right"],
                    remedy="remove one of the two",
                )
            entry[view] = pixel
    points = []
    for k, entry in enumerate(joined.values(), 1):
        name, lon, lat, height = entry["ground"]
        pixels = {view: entry[view] for view in ("left", "right") if view in entry}
        points.append(Point(name if named else f"G{k:02d}", lon, lat, height, **pixels))
    how = "their ids" if named else "their map coordinates"
    counts = f"{len(views[0])} points of {files[0].name}, {len(views[1])} of {files[1].name}"
    return points, [f"{counts}, joined by {how}"]


def _same_place(joined: dict, lon: float, lat: float) -> object:
    """The key of a point that lies there already, or a new one."""
    for key, entry in joined.items():
        _, there_lon, there_lat, _ = entry["ground"]
        east, north = metres_per_degree(lat) * (lon - there_lon, lat - there_lat)
        if math.hypot(east, north) <= SAME_PLACE_M:
            return key
    return len(joined)


def _qgis_view(file: Path, crs: str) -> list[tuple[str, float, float, float, tuple[float, float]]]:
    """(id or nothing, lon, lat, height or NaN, (col, row)) of each point that is switched on."""
    lines = _text(file).splitlines()
    if lines and (found := re.match(r"#\s*CRS:\s*(.+)", lines[0])):
        crs = crs or found[1].strip()
    body = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not body:
        raise InputError("there are no points in it", file=file, remedy="save the points of QGIS")
    header = [cell.strip().lower() for cell in next(csv.reader([body[0][1]]))]
    axes = ("sourcex", "sourcey") if "sourcex" in header else ("pixelx", "pixely")
    for column in ("mapx", "mapy", *axes):
        if column not in header:
            raise InputError(
                f"column {column!r} is missing",
                file=file,
                remedy="save the points by QGIS: mapX,mapY,sourceX,sourceY,enable",
            )
    rows = []
    for number, line in body[1:]:
        cells = dict(zip(header, next(csv.reader([line]))))
        if cells.get("enable", "1").strip() == "0":
            continue
        values = [_number(cells.get(c) or "", c, number, file) for c in ("mapx", "mapy", *axes)]
        tall = next((cells[c] for c in NAMES["height"] if cells.get(c)), None)
        height = math.nan if tall is None else _number(tall, "height", number, file)
        name = next((cells[c].strip() for c in NAMES["id"] if cells.get(c)), "")
        if values[3] > 0:
            raise InputError(
                f"line {number}: sourceY is {values[3]:g}, above the image's first row",
                file=file,
                remedy="georeference the image without a world file or a coordinate system of its "
                "own: QGIS then counts rows as 0, -1, -2 …",
            )
        rows.append((name, *values, height))
    x, y = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    lon, lat = to_degrees(x, y, crs, file) if rows else (x, y)
    return [
        (name, float(here), float(there), height, (col - 0.5, -row - 0.5))
        for (name, _, _, col, row, height), here, there in zip(rows, lon, lat)
    ]


# ---------------------------------------------------------------------------- Ames Stereo Pipeline


def from_asp(file: Path, left: str = "", right: str = "") -> tuple[list[Point], list[str]]:
    """A .gcp file: id lat lon height, three sigmas, then image col row sigma sigma of each image.

    ``left``, ``right`` name the images, whole or by a part that only one has; else there have to be
    two, in the order in which they first appear.
    """
    rows, images = [], {}
    for number, line in enumerate(_text(file).splitlines(), 1):
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
        ground = [_number(words[k], "coordinate", number, file) for k in (1, 2, 3)]
        seen = {}
        for k in range(7, len(words), 5):
            images.setdefault(words[k], len(images))
            seen[words[k]] = tuple(_number(words[k + j], "pixel", number, file) for j in (1, 2))
        rows.append((words[0], ground, seen))
    views = _views_of(file, list(images), left, right)
    points = []
    for name, (lat, lon, height), seen in rows:
        pixels = {view: seen[image] for view, image in views.items() if image in seen}
        if pixels:
            points.append(Point(name, lon, lat, height, **pixels))
    said = ", ".join(f"{view}: {image}" for view, image in views.items())
    return points, [f"{len(points)} of {len(rows)} points; {said}"]


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


def from_csv(file: Path, crs: str = "") -> tuple[list[Point], list[str]]:
    """A table with a header, of any of the names and separators that are common."""
    lines = [line for line in _text(file).splitlines() if line.strip() and line[0] != "#"]
    if not lines:
        raise InputError("there are no points in it", file=file, remedy="write a line a point")
    separator = max(",;\t", key=lines[0].count)
    header = [cell.strip().lower() for cell in next(csv.reader([lines[0]], delimiter=separator))]
    at = {
        column: next((header.index(name) for name in names if name in header), None)
        for column, names in NAMES.items()
    }
    missing = [column for column in COLUMNS if at[column] is None and column != "height"]
    if missing:
        raise InputError(
            f"no column for {', '.join(missing)} among {', '.join(header)}",
            file=file,
            remedy=f"call them {','.join(COLUMNS)}",
        )
    points, ground = [], []
    for number, cells in enumerate(csv.reader(lines[1:], delimiter=separator), 2):
        if len(cells) < len(header):
            cells += [""] * (len(header) - len(cells))

        def value(column: str, cells: list[str] = cells, number: int = number) -> float:
            text = "" if at[column] is None else cells[at[column]].strip()
            text = text.replace(",", ".") if separator != "," else text
            return _number(text, column, number, file) if text else math.nan

        ground.append((value("lon"), value("lat")))
        left, right = ((value(f"{v}_col"), value(f"{v}_row")) for v in ("left", "right"))
        name = cells[at["id"]].strip()
        points.append(Point(name, *ground[-1], value("height"), left, right))
    lon, lat = to_degrees(*np.array(ground).T, crs, file)
    points = [replace(p, lon=float(x), lat=float(y)) for p, x, y in zip(points, lon, lat)]
    return points, [f"{len(points)} points of {file.name}"]


def with_heights(points: Sequence[Point], source: Path) -> list[Point]:
    """Points with heights of a CSV (by id, or by place), or of a raster (bilinear).

    Points that have one keep it.
    """
    if source.suffix.lower() not in (".csv", ".txt", ".tsv"):
        return _heights_of_raster(points, source)
    lines = [line for line in _text(source).splitlines() if line.strip()]
    separator = max(",;\t", key=lines[0].count) if lines else ","
    header = [cell.strip().lower() for cell in lines[0].split(separator)] if lines else []
    at = {
        column: next((header.index(name) for name in NAMES[column] if name in header), None)
        for column in ("id", "lon", "lat", "height")
    }
    if at["height"] is None or (at["id"] is None and at["lon"] is None):
        raise InputError(
            f"columns {', '.join(header)} are no heights of points",
            file=source,
            remedy="write id,height or lon,lat,height",
        )
    by_id, by_place = {}, {}
    for number, line in enumerate(lines[1:], 2):
        cells = [cell.strip() for cell in line.split(separator)]
        height = _number(cells[at["height"]], "height", number, source)
        if at["id"] is not None:
            by_id[cells[at["id"]]] = height
        if at["lon"] is not None and at["lat"] is not None:
            place = [_number(cells[at[axis]], axis, number, source) for axis in ("lon", "lat")]
            by_place[number] = {"ground": ("", *place, height)}
    found = []
    for point in points:
        height = point.height
        if math.isnan(height):
            height = by_id.get(point.id, math.nan)
        if math.isnan(height) and by_place:
            key = _same_place(by_place, point.lon, point.lat)
            height = by_place[key]["ground"][3] if key in by_place else math.nan
        found.append(replace(point, height=height))
    return found


def _heights_of_raster(points: Sequence[Point], source: Path) -> list[Point]:
    if not source.is_file():
        raise InputError("no such file", file=source, remedy="correct the path")
    with open_raster(source) as raster:
        if raster.crs is None:
            raise InputError(
                "a raster without a coordinate system", file=source, remedy="give it one"
            )
        transform = pyproj.Transformer.from_crs("EPSG:4326", raster.crs.to_wkt(), always_xy=True)
        x, y = transform.transform([p.lon for p in points], [p.lat for p in points])
        band = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
        to_pixel = ~raster.transform
        found = []
        for point, east, north in zip(points, x, y):
            col, row = to_pixel * (east, north)
            height = point.height
            if math.isnan(height):
                height = float(bilinear(band, col - 0.5, row - 0.5))
            found.append(replace(point, height=height))
    return found
