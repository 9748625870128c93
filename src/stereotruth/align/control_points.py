"""Reading of control and check points: ground coordinates with their measured image positions.

A CSV of the columns ``id,lon,lat,height,left_col,left_row,right_col,right_row``: WGS 84 degrees,
ellipsoidal height in m, and (col, row) in px of each original image, both empty where a view does
not see the point. Or the long form, one line per point and image of a site: ``id,lon,lat,height,
image,col,row``, ``image`` being a name of the images sheet. Lines that begin with ``#`` are
remarks; ``# frame:`` and ``# epoch:`` say what the ground coordinates are where they are not WGS 84
at the date of the images (docs/explanation/frames.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from ..core.errors import InputError
from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.geometry import continuous
from ..core.products.files import of_text
from ..core.tables import Table, decimal_number, epoch_year
from ..lidar.frames import DEFAULT_EPOCH, Epoch, frame_change, taken_as_it_is

COLUMNS = ("id", "lon", "lat", "height", "left_col", "left_row", "right_col", "right_row")
LONG = ("id", "lon", "lat", "height", "image", "col", "row")  # one line per point and image
MOST_POINTS = 20_000  # lines; nobody measures as many
LONGEST_ID = 100  # characters, which figures and tables have room for
HEIGHT_RANGE = (-1000.0, 9500.0)  # ellipsoidal m: the Dead Sea and Everest, with a margin


class TooFewPoints(InputError):
    """Control points that cannot carry the correction of an image by themselves."""


class NoPoints(TooFewPoints):
    """Control points of a site, none of which the images of a pair show."""


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """n points in ascending order of their ids, whatever the order in the file.

    ``lon``, ``lat`` degrees and ``height`` ellipsoidal m, float64[n]; ``left``, ``right``
    float64[n, 2] measured (col, row) px, NaN where the view does not see the point; ``line``:
    line of the file; ``frame``: record of the frame and epoch of the ground coordinates, and of
    those that the file has; ``remarks`` for the user about them.
    """

    file: Path
    ids: tuple[str, ...]
    line: tuple[int, ...]
    lon: Floats
    lat: Floats
    height: Floats
    left: Floats
    right: Floats
    frame: dict[str, Any] | None = None
    remarks: tuple[str, ...] = ()

    @property
    def seen(self) -> tuple[Bools, Bools]:
        """bool[n] each: measured in the left, in the right image."""
        return np.isfinite(self.left[:, 0]), np.isfinite(self.right[:, 0])


def read_gcps(
    file: str | Path,
    scene: str = "",
    images: tuple[str, str] | None = None,
    epoch: Epoch = DEFAULT_EPOCH,
) -> ControlPoints:
    """Read and check the ground control points (or check points) of a scene.

    Columns may have any order. Of the long form, the points that the scene's ``images`` (names of
    the left and the right one) show.
    Ground coordinates of another frame than WGS 84, or of another ``epoch``, are brought there.

    Raises InputError, naming the file and the line, for anything else that is not as it should be.
    """
    file = Path(file)
    try:
        return _read(file, images, epoch)
    except InputError as error:
        of = f" (scene {scene})" if scene else ""
        raise type(error)(error.problem + of, file=file, remedy=error.remedy) from None


def _read(file: Path, images: tuple[str, str] | None, epoch: Epoch) -> ControlPoints:
    """The points; what is refused does not name the file yet."""
    table = _table(file)
    rows = _as_pair(table.rows, images) if "image" in table.columns else table.rows
    points: dict[str, tuple[int, list[float]]] = {}
    for line, cells in rows:
        name = of_text(cells["id"])
        if name in points:
            raise InputError(
                f"lines {points[name][0]} and {line} both have the id {name!r}",
                remedy="give every point an id of its own",
            )
        if not name or len(name) > LONGEST_ID or not name.isprintable():
            raise InputError(
                f"line {line}: the id {name[:20]!a} of {len(name)} characters is no name",
                remedy=f"give ids of at most {LONGEST_ID} characters that can be printed",
            )
        values = [_number(cells[column]) for column in COLUMNS[1:]]
        if defect := _defect_of(cells, values):
            problem, remedy = defect
            raise InputError(f"line {line}, point {name}: {problem}", remedy=remedy)
        points[name] = line, values
    if not points:
        raise InputError(
            "there are no points in the file", remedy="add one line per point under the header"
        )
    _refuse_copies(points)
    ids = sorted(points)
    values = np.array([points[name][1] for name in ids])
    found = ControlPoints(
        file=file,
        ids=tuple(ids),
        line=tuple(points[name][0] for name in ids),
        lon=continuous(values[:, 0]).copy(),
        lat=values[:, 1].copy(),
        height=values[:, 2].copy(),
        left=values[:, 3:5].copy(),
        right=values[:, 5:7].copy(),
    )
    return _in_itrf(found, table.declared, epoch)


def _in_itrf(points: ControlPoints, declared: dict[str, str], epoch: Epoch) -> ControlPoints:
    """The points at an epoch in ITRF2020, where their file declares a frame or an epoch."""
    remedy = "write it as in '# frame: EPSG:6318' or '# epoch: 2016.4', or leave it out"
    try:
        system = CRS.from_user_input(declared.get("frame") or "EPSG:4979")
        own = epoch_year(declared.get("epoch", ""))
    except CRSError as error:
        raise InputError(
            f"its frame {declared['frame']!r} cannot be used ({error})", remedy=remedy
        ) from None
    except ValueError as error:
        raise InputError(f"its epoch {declared['epoch']!r} {error}", remedy=remedy) from None
    if not system.is_geographic:
        raise InputError(
            f"its frame '{system.name}' is no geographic system",
            remedy="name that of its longitudes and latitudes, as EPSG:6318 of NAD83(2011)",
        )
    place = float(np.median(points.lon)), float(np.median(points.lat))
    change = frame_change(system, place, epoch, own)
    if change is None:
        record = taken_as_it_is(system, epoch)
        if record["source"]["epoch"] is None:
            raise InputError(
                f"how its frame '{system.name}' gets to ITRF2020 is not known to centimetres",
                remedy="transform the points to ITRF2020 by the country's own service",
            )
        return replace(points, frame=record)
    lon, lat, height = change(points.lon, points.lat, points.height)
    return replace(
        points,
        lon=lon,
        lat=lat,
        height=height,
        frame=change.describe(),
        remarks=change.notes,
    )


def images_measured(file: str | Path) -> dict[str, int]:
    """Names of images in a file of the long form, each with its first line; none in another form.

    Raises InputError as :func:`read_gcps` for what is no table of control points.
    """
    table = _table(Path(file))
    found: dict[str, int] = {}
    for line, cells in table.rows if "image" in table.columns else ():
        found.setdefault(of_text(cells["image"]), line)
    return found


def _as_pair(
    rows: list[tuple[int, dict[str, str]]], images: tuple[str, str] | None
) -> list[tuple[int, dict[str, str]]]:
    """Lines of the long form as those of a pair: one for each point that either image shows."""
    if images is None or not all(images):
        raise InputError(
            "control points by image (column image), and the scene's images have no names",
            remedy="list both images in the images sheet (key images), or write a pair's form: "
            f"{','.join(COLUMNS)}",
        )
    views = dict(zip(images, ("left", "right")))
    found: dict[str, tuple[int, dict[str, str]]] = {}
    ground: dict[str, tuple[int, list[str]]] = {}
    for line, cells in rows:
        name, place = cells["id"], [cells[column] for column in ("lon", "lat", "height")]
        before, there = ground.setdefault(name, (line, place))
        if there != place:
            raise InputError(
                f"lines {before} and {line}: point {name} has two places on the ground",
                remedy="give all lines of a point the same lon, lat and height",
            )
        view = views.get(of_text(cells["image"]))
        if view is None:
            continue
        empty = dict.fromkeys(COLUMNS[4:], "")
        of_pair = found.setdefault(name, (line, {**dict(zip(COLUMNS, (name, *place))), **empty}))
        if of_pair[1][f"{view}_col"]:
            raise InputError(
                f"lines {of_pair[0]} and {line}: point {name} is measured twice in image "
                f"{cells['image']}",
                remedy="keep one of the two lines",
            )
        for axis in ("col", "row"):
            if not cells[axis]:
                raise InputError(
                    f"line {line}, point {name}: {axis} is empty",
                    remedy="give the point's position in the image, or remove the line",
                )
            of_pair[1][f"{view}_{axis}"] = cells[axis]
    if not found:
        raise NoPoints(
            f"no point is measured in {images[0]} or {images[1]}",
            remedy="measure some, or leave column gcps empty",
        )
    return list(found.values())


def _refuse_copies(points: dict[str, tuple[int, list[float]]]) -> None:
    """A point under two ids would count twice: the same ground and the same place in a view."""
    seen: dict[tuple, str] = {}
    for name, (line, values) in points.items():
        for view in (3, 5):
            if np.isnan(values[view]):
                continue
            first = seen.setdefault((view, *values[:3], *values[view : view + 2]), name)
            if first != name:
                raise InputError(
                    f"lines {points[first][0]} and {line} are one point under two ids, {first} "
                    f"and {name}",
                    remedy="keep one of the two lines",
                )


def _table(file: Path) -> Table:
    """The table of a file, of either form. Raises InputError."""
    expected = f"the header is {','.join(COLUMNS)}, or {','.join(LONG)}"
    table = Table.read(file, expected, ",")
    columns = LONG if "image" in table.columns else COLUMNS
    table.require(columns, columns, expected)
    if len(table.rows) > MOST_POINTS:
        raise InputError(
            f"more than {MOST_POINTS} points",
            file=file,
            remedy="give those that are measured in the images; points of LiDAR belong to column "
            "lidar",
        )
    return table


def _number(text: str) -> float:
    """The number in a cell; NaN where there is none."""
    try:
        return decimal_number(text)
    except ValueError:
        return np.nan


def _defect_of(cells: dict[str, str], values: list[float]) -> tuple[str, str] | None:
    """What is wrong with the seven numbers of a point, and the remedy."""
    for column, value in zip(COLUMNS[1:], values):
        if not np.isfinite(value) and (cells[column] or column in COLUMNS[1:4]):
            what = f"{cells[column][:40]!r} is no number" if cells[column] else "is empty"
            return f"{column} {what}", "write a decimal number"
    lon, lat, height, *image = values
    if abs(lat) > 90 or not -180 <= lon <= 360:
        if abs(lon) <= 90 and abs(lat) <= 360:
            return f"lon {lon:g} and lat {lat:g} seem to be swapped", "exchange the two columns"
        remedy = "give WGS 84 longitude and latitude in degrees, not projected coordinates"
        return f"lon {lon:g}, lat {lat:g} are no degrees", remedy
    if not HEIGHT_RANGE[0] <= height <= HEIGHT_RANGE[1]:
        return (
            f"a height of {height:g} m is not of this Earth",
            "give ellipsoidal heights in metres",
        )
    for view, pair in (("left", image[:2]), ("right", image[2:])):
        if np.isnan(pair).sum() == 1:
            remedy = "give both, or leave both empty where the image does not show the point"
            return f"only one of {view}_col, {view}_row is given", remedy
    if np.isnan(image).all():
        remedy = "give its position in at least one image, or remove it"
        return "it is measured in neither image", remedy
    return None
