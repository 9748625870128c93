"""The user's sheets: read, checked, and turned into plain values.

Everything that can be known to be wrong before any work is refused here, in one line that names
the sheet, the row and the remedy.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from datetime import date, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, StringConstraints, model_validator
from pydantic.dataclasses import dataclass

from .config.section import (
    CHECKED,
    PATTERN,
    REPEATED,
    FilePath,
    Number,
    Text,
    Whole,
    check,
    name_of,
)
from .errors import InputError, did_you_mean
from .products.files import LONGEST_NAME
from .tables import Mistakes, Table, acquisition_time, epoch_year, require_unique

MOST_SCENES = 2000  # Snakemake takes 20 ms of a plan for each: 40 s
LIDAR_SUFFIXES = (".las", ".laz")
RASTER_SUFFIXES = (".tif", ".tiff")  # of surface models
LIDAR_SEPARATOR = ";"

FILES = ("left_image", "right_image", "gcps", "geoid", "left_mask", "right_mask")  # of a scene


def _count(cell: str | int) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", str(cell)):
        raise ValueError("is no whole number, 0 or more")
    return int(cell)


def _epoch(text: str) -> str:
    epoch_year(text)
    return text


def _time(text: str) -> str:
    if text:
        acquisition_time(text)
    return text


def _degrees(cell: str | float | None) -> float | None:
    return None if cell in ("", None) else float(cell)


Count = Annotated[Whole, BeforeValidator(_count)]
Azimuth = Annotated[Number, Field(ge=0, le=360)]
Elevation = Annotated[Number, Field(gt=0, le=90)]
EpochCell = Annotated[Text, AfterValidator(_epoch)]
Given = Annotated[FilePath, StringConstraints(min_length=1)]


@dataclass(frozen=True, config=CHECKED)
class City:
    """One row of the cities sheet; the counts are those of the paper's table 3."""

    city: name_of("A-Za-z0-9_-")
    """name of letters, digits, `-` and `_`; its tiles go to `tiles/<city>/`"""

    prefix: name_of("A-Za-z0-9")
    """what its tile names begin with (SG, KM, YD, QC, WH, HY …), of letters and digits"""

    training: Count
    """weight of the split: 6, 1 and 3 for the three give 60, 10 and 30 % of the labelled tiles; the
    paper's cities have their counts of its table 3"""

    validation: Count
    """likewise"""

    testing: Count
    """likewise"""

    epoch: EpochCell = ""
    """optional column: epoch of the city's places in ITRF2020, as `2020.8` or `2020-10-25`; empty:
    the day of the images of its first scene that tell one, or else 2020.0. Control points without a
    frame of their own are of this epoch. See docs/explanation/frames.md"""


@dataclass(frozen=True, config=CHECKED)
class Scene:
    """One row of the scenes sheet: a stereo pair, its LiDAR and its ground control points."""

    scene: name_of("A-Za-z0-9-")
    """unique id of letters, digits and `-`"""

    city: Given
    """a row of the cities sheet"""

    left_image: Given
    """an image of the [images sheet](#imagestsv), or a file: backward view (reference), GeoTIFF, or
    another format that holds its pixels (JPEG 2000, NITF, PNG, HFA, ENVI …), with RPC metadata in
    the TIFF, `_RPC.TXT`, `.RPB` or GF-7's `.rpb` beside it. In this and the columns below that name
    files, URLs may stand, too (`s3://`, `https://`; see docs/how-to/object_storage.md)"""

    right_image: Given
    """forward view (target), likewise"""

    lidar: Given
    """a folder, a glob or a file of points (`.las`, `.laz`, `.copc.laz`, `ept.json`) or of surface
    models (GeoTIFF, COG), a list of tiles that `stereotruth lidar` has written from a catalogue
    (`.tsv`), or several of these with `;` between them; of a folder that has both kinds, the points
    are read; of web servers, files. See docs/how-to/national_lidar.md"""

    lidar_crs: Text
    """EPSG code or WKT (compound allowed) for files that carry none; else empty"""

    geoid: FilePath
    """geoid grid (GTX or GeoTIFF), m, where the LiDAR's heights are orthometric; else empty:
    heights are ellipsoidal"""

    gcps: FilePath
    """CSV of ground control points, see below; empty without any, if `alignment.refine` is true:
    the refinement then starts from the RPCs alone (10 px standard deviation is assumed, 3e-4 of
    scale and rotation; up to 48 px between the images are found), and slopes alone tell where both
    images lie on the LiDAR: the attribute `alignment_sigma_px` of the scene's disparity store says
    how well"""

    lidar_epoch: EpochCell = ""
    """optional column: epoch of the LiDAR's coordinates, as `2016.4` or `2016-05-27`, which systems
    of a dynamic frame (ITRF2014, WGS 84 (G1762)) need where the files do not state it; in WGS 84
    without a realisation empty means the epoch of the images. Coordinates in a frame that moves
    with its plate (NAD83(2011), ETRS89, GDA2020) or has an epoch of its own (NZGD2000) need none"""

    left_mask: FilePath = ""
    """optional column: a raster on the left image's grid, not zero where the image is not to be
    used (cloud, water, anything): no labels, no tie points, no correlation there; the pixels have
    the status `masked` (11), as have those that the image's own mask or alpha band hides. The tile
    shows them all the same, but for the image's own mask"""

    right_mask: FilePath = ""
    """likewise, of the right image"""

    diachronic: Literal["", "true", "false"] = ""
    """optional: whether both images were taken under different suns or in different seasons, see
    `project.diachronic`; empty: true if the images were taken more than 30 days apart, or under two
    suns by which the shadows of a building of 10 m end more than half a pixel apart; where neither
    the images sheet nor the deliveries know it, as `project.diachronic` says"""


@dataclass(frozen=True, config=CHECKED)
class Image:
    """One row of the images sheet: an image of a site, which any scene of its city may name."""

    image: name_of("A-Za-z0-9_-")
    """unique name of letters, digits, `-` and `_`"""

    city: Given
    """a row of the cities sheet: the site"""

    file: Given
    """the image with its RPC metadata, as in `left_image` of the scenes sheet; each file stands in
    one row"""

    acquired: Annotated[Text, AfterValidator(_time)] = ""
    """optional: date (`2020-10-25`), or time with its zone (`2020-10-25T03:12:45Z`, `…+08:00`);
    empty: as the delivery says it (IMD, DIMAP, GF-7 XML, STAC, tags of the file)"""

    sun_azimuth: Annotated[Azimuth | None, BeforeValidator(_degrees)] = None
    """optional: direction to the sun, degrees from north over east; empty: as the delivery says it,
    or else computed from `acquired` and the image's place"""

    sun_elevation: Annotated[Elevation | None, BeforeValidator(_degrees)] = None
    """optional: likewise, degrees above the horizon"""

    mask: FilePath = ""
    """optional: as `left_mask` of the scenes sheet; holds in every scene that names the image and
    no mask of its own"""

    @model_validator(mode="after")
    def _sun_is_whole(self) -> Image:
        if (self.sun_azimuth is None) != (self.sun_elevation is None):
            raise InputError(
                f"image {self.image!r} has one angle of the sun, and not the other",
                remedy="write both in degrees, or leave both empty",
            )
        return self


def _rows(path: Path, sheet: type) -> list[tuple[int, dict[str, str]]]:
    """Line and cells of each row of a sheet whose columns are the fields of a dataclass.

    Cells of columns that are left out are empty. Raises InputError that names line or column.
    """
    columns = [f.name for f in fields(sheet)]
    needed = [f.name for f in fields(sheet) if f.default is MISSING]
    optional = " and ".join(c for c in columns if c not in needed)
    more = f"; {optional} may be left out" if optional else ""
    expected = f"the columns are {', '.join(columns)}{more}"
    table = Table.read(path, expected, "\t", ragged=True)
    table.require(needed, columns, expected)
    return [(number, dict.fromkeys(columns, "") | cells) for number, cells in table.rows]


def read_cities(path: str | Path) -> dict[str, City]:
    """The cities sheet by name of the city. Raises InputError as described in the module."""
    path = Path(path)
    cities, wrong = {}, Mistakes()
    rows = _rows(path, City)
    for number, cells in rows:
        with wrong.collect():
            cities[cells["city"]] = check(cells, City, f"{path}, line {number}")
    for column in ("city", "prefix"):
        with wrong.collect():
            require_unique([cells[column] for _, cells in rows], column, path)
    wrong.refuse()
    return cities


def read_images(
    path: str | Path, cities: Mapping[str, City], cities_sheet: str | Path = "the cities sheet"
) -> dict[str, Image]:
    """The images sheet by name of the image. Raises InputError as described in the module."""
    path = Path(path)
    rows = _rows(path, Image)
    images: dict[str, Image] = {}
    first: dict[str, tuple[int, str]] = {}
    wrong = Mistakes()
    for number, cells in rows:
        with wrong.collect():
            image = check(cells, Image, f"{path}, line {number}")
            where = f"line {number}: image {image.image!r}"
            _known_city(image.city, where, cities, path, cities_sheet)
            before, other = first.setdefault(file_key(image.file), (number, image.image))
            if before != number:
                raise InputError(
                    f"{where}: its file is that of image {other!r} in line {before}",
                    file=path,
                    remedy="keep one of the two rows; scenes may name the image as often as they "
                    "like",
                )
            images[image.image] = image
    with wrong.collect():
        require_unique([cells["image"] for _, cells in rows], "image", path)
    wrong.refuse()
    return images


def file_key(file: str) -> str:
    """What two cells that name one file have in common."""
    return file if "://" in file else os.path.realpath(file)


def _known_city(
    city: str, where: str, cities: Iterable[str], path: Path, cities_sheet: str | Path
) -> None:
    """Raise InputError if the city of a row is none of the cities sheet."""
    if city in cities:
        return
    raise InputError(
        f"{where} is of city {city!r}, which is not in {cities_sheet}",
        file=path,
        remedy=did_you_mean(city, cities, "add a row to the cities sheet"),
    )


def with_images(
    cells: dict[str, str], images: Mapping[str, Image], where: str, path: Path
) -> dict[str, str]:
    """A row of the scenes sheet with the files and masks of the images that it names.

    A cell that names the file of an image means that image. Raises InputError for an image of
    another city, and for a name that is neither an image nor a file.
    """
    by_file = {file_key(image.file): image for image in images.values()}
    found = dict(cells)
    for view in ("left", "right"):
        cell = cells[f"{view}_image"]
        image = images.get(cell) or by_file.get(file_key(cell))
        if image is None:
            if images and cell and not re.search(r"[./\\]", cell) and not Path(cell).is_file():
                raise InputError(
                    f"{where}: {view}_image {cell!r} is no image of the images sheet, and no file",
                    file=path,
                    remedy=did_you_mean(cell, images, "add its row to that sheet"),
                )
            continue
        if image.city != cells["city"]:
            raise InputError(
                f"{where}: {view}_image {image.image!r} is an image of {image.city}, the scene is "
                f"of {cells['city']}",
                file=path,
                remedy="name two images of the scene's own city",
            )
        found[f"{view}_image"] = image.file
        found[f"{view}_mask"] = cells[f"{view}_mask"] or image.mask
    return found


def day_of(acquired: str) -> date | None:
    """Of a cell ``acquired``; None where it is empty."""
    time = acquisition_time(acquired) if acquired else None
    return time.date() if isinstance(time, datetime) else time


def read_scenes(
    path: str | Path,
    cities: Mapping[str, City],
    images: Mapping[str, Image] | None = None,
    cities_sheet: str | Path = "the cities sheet",
) -> dict[str, Scene]:
    """The scenes sheet by id of the scene. Raises InputError as described in the module.

    Images that rows name are replaced by their files and masks.
    """
    path = Path(path)
    scenes, wrong = {}, Mistakes()
    rows = _rows(path, Scene)
    if len(rows) > MOST_SCENES:
        raise InputError(
            f"{len(rows)} scenes; a project has at most {MOST_SCENES}",
            file=path,
            remedy="share them among several projects (their datasets can be put together), or "
            "among several sheets that key scenes names in turn",
        )
    for number, cells in rows:
        with wrong.collect():
            check(cells, Scene, f"{path}, line {number}")
            where = f"line {number}: scene {cells['scene']!r}"
            _known_city(cells["city"], where, cities, path, cities_sheet)
            completed = with_images(cells, images or {}, where, path)
            scene = check(completed, Scene, f"{path}, line {number}")
            if file_key(scene.left_image) == file_key(scene.right_image):
                raise InputError(
                    f"{where} names one image twice",
                    file=path,
                    remedy="left_image is the backward view, right_image the forward view",
                )
            scenes[scene.scene] = scene
    with wrong.collect():
        require_unique([cells["scene"] for _, cells in rows], "scene", path)
    wrong.refuse()
    return scenes


def require_files(scene: Scene, sheet: str | Path, columns: Iterable[str]) -> None:
    """Raise InputError if a file that the scene's row names does not exist."""
    for column in columns:
        value = getattr(scene, column)
        if value and (_too_long(value) or not Path(value).is_file()):
            raise InputError(
                f"scene {scene.scene!r}: {column} {value!r} does not exist",
                file=sheet,
                remedy="correct the path (relative to the working directory, or absolute)",
            )


def _too_long(path: str) -> bool:
    """Whether no file system has files of such a name."""
    return len(os.fsencode(path)) > 4000 or any(
        len(os.fsencode(part)) > 255 for part in Path(path).parts
    )


def lidar_files(cell: str) -> list[Path]:
    """The files of points of folders, globs and paths with ``;`` between them, sorted.

    Of a folder, these are its LAS and LAZ files, or, if it has none, its GeoTIFFs. Raises
    InputError for a part of the cell that names no file.
    """
    parts = [part.strip() for part in cell.split(LIDAR_SEPARATOR)]
    found = {file for part in parts if part for file in _files_of(part)}
    if not found:
        raise InputError("no LiDAR file is named", remedy="name a folder, a glob or files")
    return sorted(found)


def _files_of(pattern: str) -> list[Path]:
    """The files of one folder, glob or path. Raises InputError if there is none."""
    path = Path(pattern)
    if _too_long(pattern):
        found = []
    elif path.is_dir():
        kinds = [f for f in path.iterdir() if f.suffix.lower() in LIDAR_SUFFIXES + RASTER_SUFFIXES]
        found = [f for f in kinds if f.suffix.lower() in LIDAR_SUFFIXES] or kinds
    elif path.is_file():
        found = [path]
    else:
        anchor = Path(path.anchor)
        found = [f for f in anchor.glob(str(path.relative_to(anchor))) if not f.is_dir()]
    if not found:
        raise InputError(
            f"no LiDAR file at {pattern!r}",
            remedy="lidar is a folder that holds .las or .laz files or GeoTIFFs of heights, a glob "
            "that matches some, or several of these with ';' between them",
        )
    if gone := [file for file in found if not file.is_file()]:
        raise InputError(
            "is a folder, or a link to what is not there",
            file=gone[0],
            remedy="put the file there, or take it out of the folder",
        )
    if patterns := [file for file in found if PATTERN.search(str(file))]:
        raise InputError(
            "has a name in { }, which stands for something else in the workflow",
            file=patterns[0],
            remedy="rename it",
        )
    return found


def find_lidar(scene: Scene, sheet: str | Path) -> list[Path]:
    """The files of a scene's ``lidar`` cell, sorted. Raises InputError if there is none."""
    try:
        return lidar_files(scene.lidar)
    except InputError as error:
        place = f"{error.file}: " if error.file else ""
        problem = f"scene {scene.scene!r}: {place}{error.problem}"
        raise InputError(problem, file=sheet, remedy=error.remedy) from None


def store_names(files: Iterable[Path]) -> dict[str, Path]:
    """A unique name for each LiDAR file: its stem, with a hash of its path if two share it.

    Stems that are too long for a name, or repeat themselves, are cut short and get the hash too.
    """

    def stem(file: Path) -> str:
        name = re.sub(r"(\.copc)?\.(las|laz|tiff?)$", "", file.name, flags=re.IGNORECASE)
        return re.sub(r"[^A-Za-z0-9._-]", "_", name)

    files = list(files)
    shared = {name for name, n in Counter(map(stem, files)).items() if n > 1}

    def unique(file: Path) -> str:
        name = stem(file)
        if name not in shared and len(name) <= LONGEST_NAME and not REPEATED.search(name):
            return name
        mark = hashlib.sha256(str(file).encode("utf-8", "surrogateescape")).hexdigest()[:8]
        return f"{name[: LONGEST_NAME - 9]}-{mark}"

    return {unique(file): file for file in files}
