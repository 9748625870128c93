"""The user's sheets: read, checked, and turned into plain values.

Everything that can be known to be wrong before any work is refused here, in one line that names
the sheet, the row and the remedy.
"""

from __future__ import annotations

import csv
import difflib
import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from .errors import InputError
from .settings import (
    LONGEST_NAME,
    PATTERN,
    REPEATED,
    FilePath,
    Text,
    Whole,
    name_of,
    settings,
)
from .settings_text import check

MOST_SCENES = 2000  # Snakemake takes 20 ms of a plan for each: 40 s
MOST_BYTES = 20_000_000  # of a sheet
LIDAR_SUFFIXES = (".las", ".laz")


Count = Annotated[Whole, Field(ge=0)]
Given = Annotated[FilePath, StringConstraints(min_length=1)]


@settings
class City:
    """One row of the cities sheet; the counts are those of the paper's table 3."""

    city: name_of("A-Za-z0-9_-")
    """name of letters, digits, `-` and `_`; its tiles go to `tiles/<city>/`"""

    prefix: name_of("A-Za-z0-9")
    """what its tile names begin with (SG, KM, YD, QC, WH, HY …), of letters and digits"""

    training: Count
    """tiles of this split in the paper's table 3: the weights by which the labelled tiles are
    split"""

    validation: Count
    """likewise"""

    testing: Count
    """likewise"""


@settings
class Scene:
    """One row of the scenes sheet: a stereo pair, its LiDAR and its ground control points."""

    scene: name_of("A-Za-z0-9-")
    """unique id of letters, digits and `-`"""

    city: Given
    """a row of the cities sheet"""

    left_image: Given
    """backward view (reference): GeoTIFF, or another format that holds its pixels (JPEG 2000, NITF,
    PNG, HFA, ENVI …), with RPC metadata in the TIFF, `_RPC.TXT`, `.RPB` or GF-7's `.rpb` beside
    it. In this and the columns below that name files, URLs may stand, too (`s3://`, `https://`; see
    docs/how-to/object_storage.md)"""

    right_image: Given
    """forward view (target), likewise"""

    lidar: Given
    """a folder or a glob of `.las`, `.laz`, `.copc.laz` files; of web servers, one file"""

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

    left_mask: FilePath = ""
    """optional column: a raster on the left image's grid, not zero where the image is not to be
    used (cloud, water, anything): no labels, no tie points, no correlation there; the pixels have
    the status `masked` (11), as have those that the image's own mask or alpha band hides. The tile
    shows them all the same, but for the image's own mask"""

    right_mask: FilePath = ""
    """likewise, of the right image"""


def _read_table(path: Path, sheet: type) -> list[tuple[int, dict[str, str]]]:
    """(line number, cells) of each row of a tab-separated sheet; a cell is empty where none is."""
    columns = [f.name for f in fields(sheet)]
    needed = [f.name for f in fields(sheet) if f.default is MISSING]
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(
                f"{path.stat().st_size / 1e6:.0f} MB are no sheet",
                file=path,
                remedy=f"its columns are {', '.join(columns)}",
            )
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(
            "no such file", file=path, remedy="correct its path in the config, or write it"
        ) from None
    except (UnicodeDecodeError, IsADirectoryError) as error:
        raise InputError(str(error), file=path, remedy="save it as UTF-8 text") from None
    rows = csv.reader(text.splitlines(), delimiter="\t")
    try:
        numbered = [(n, [c.strip() for c in row]) for n, row in enumerate(rows, 1) if any(row)]
    except csv.Error as error:
        raise InputError(
            f"no sheet of text ({error})", file=path, remedy="save it as text with tabs"
        ) from None
    numbered = [(n, row) for n, row in numbered if not row[0].startswith("#")]
    if not numbered:
        raise InputError("empty sheet", file=path, remedy=f"its columns are {', '.join(columns)}")
    header = numbered[0][1]
    missing = [c for c in needed if c not in header]
    unknown = [c for c in header if c not in columns]
    if missing or unknown:
        tabs = "" if len(header) > 1 else " (are the columns separated by tabs?)"
        wrong = [f"column {c!r} is missing" for c in missing]
        wrong += [f"column {c!r} is unknown" for c in unknown]
        optional = [c for c in columns if c not in needed]
        more = f"; {' and '.join(optional)} may be left out" if optional else ""
        raise InputError(
            "; ".join(wrong) + tabs,
            file=path,
            remedy=f"the columns are {', '.join(columns)}{more}",
        )
    table = []
    for number, row in numbered[1:]:
        if len(row) > len(header):
            raise InputError(
                f"line {number} has {len(row)} cells for {len(header)} columns",
                file=path,
                remedy="remove the surplus tab",
            )
        row += [""] * (len(header) - len(row))
        table.append((number, dict.fromkeys(columns, "") | dict(zip(header, row))))
    return table


def _unique(values: Iterable[str], column: str, file: Path) -> None:
    twice = [value for value, n in Counter(values).items() if n > 1]
    if twice:
        raise InputError(
            f"{column} {twice[0]!r} stands in more than one row",
            file=file,
            remedy=f"give each row a {column} of its own",
        )


def read_cities(path: str | Path) -> dict[str, City]:
    """The cities sheet by name of the city. Raises InputError as described in the module."""
    path = Path(path)
    cities = {}
    rows = _read_table(path, City)
    for number, cells in rows:
        values: dict[str, Any] = dict(cells)
        for count in ("training", "validation", "testing"):
            if not re.fullmatch(r"[0-9]+", cells[count]):
                raise InputError(
                    f"line {number}: {count} is {cells[count]!r}",
                    file=path,
                    remedy=f"{count} is a number of tiles: a whole number, 0 or more",
                )
            values[count] = int(cells[count])
        cities[cells["city"]] = check(values, City, f"{path}, line {number}")
    _unique([cells["city"] for _, cells in rows], "city", path)
    _unique([cells["prefix"] for _, cells in rows], "prefix", path)
    return cities


def read_scenes(path: str | Path, cities: Mapping[str, City]) -> dict[str, Scene]:
    """The scenes sheet by id of the scene. Raises InputError as described in the module."""
    path = Path(path)
    scenes = {}
    rows = _read_table(path, Scene)
    if len(rows) > MOST_SCENES:
        raise InputError(
            f"{len(rows)} scenes; a project has at most {MOST_SCENES}",
            file=path,
            remedy="share them among several projects (their datasets can be put together), or "
            "among several sheets that key scenes names in turn",
        )
    for number, cells in rows:
        scene = check(cells, Scene, f"{path}, line {number}")
        if cells["city"] not in cities:
            close = difflib.get_close_matches(cells["city"], cities, n=1)
            raise InputError(
                f"line {number}: scene {cells['scene']!r} is of city {cells['city']!r}, which is "
                "not in the cities sheet",
                file=path,
                remedy=f"did you mean {close[0]!r}?" if close else "add a row to the cities sheet",
            )
        if cells["left_image"] == cells["right_image"]:
            raise InputError(
                f"line {number}: scene {cells['scene']!r} names one image twice",
                file=path,
                remedy="left_image is the backward view, right_image the forward view",
            )
        scenes[scene.scene] = scene
    _unique([cells["scene"] for _, cells in rows], "scene", path)
    return scenes


FILES = ("left_image", "right_image", "gcps", "geoid", "left_mask", "right_mask")  # of a scene


def require_files(scene: Scene, sheet: str | Path, columns: Iterable[str]) -> None:
    """Raise InputError if a file that the scene's row names does not exist."""
    for column in columns:
        value = getattr(scene, column)
        if value and not Path(value).is_file():
            raise InputError(
                f"scene {scene.scene!r}: {column} {value!r} does not exist",
                file=sheet,
                remedy="correct the path (relative to the working directory, or absolute)",
            )


def lidar_files(pattern: str) -> list[Path]:
    """The LAS/LAZ files of a folder or a glob, sorted. Raises InputError if there is none."""
    path = Path(pattern)
    if path.is_dir():
        found = [f for f in path.iterdir() if f.suffix.lower() in LIDAR_SUFFIXES]
    elif path.is_file():
        found = [path]
    else:
        anchor = Path(path.anchor)
        found = [f for f in anchor.glob(str(path.relative_to(anchor))) if f.is_file()]
    if not found:
        raise InputError(
            f"no LiDAR file at {pattern!r}",
            remedy="lidar is a folder that holds .las or .laz files, or a glob that matches some",
        )
    if patterns := [file for file in found if PATTERN.search(str(file))]:
        raise InputError(
            "has a name in { }, which stands for something else in the workflow",
            file=patterns[0],
            remedy="rename it",
        )
    return sorted(found)


def find_lidar(scene: Scene, sheet: str | Path) -> list[Path]:
    """The LAS/LAZ files of a scene's ``lidar`` cell, sorted. Raises InputError if there is none."""
    try:
        return lidar_files(scene.lidar)
    except InputError as error:
        problem = f"scene {scene.scene!r}: {error.problem}"
        raise InputError(problem, file=sheet, remedy=error.remedy) from None


def store_names(files: Iterable[Path]) -> dict[str, Path]:
    """A unique name for each LiDAR file: its stem, with a hash of its path if two share it.

    Stems that are too long for a name, or repeat themselves, are cut short and get the hash too.
    """

    def stem(file: Path) -> str:
        name = re.sub(r"(\.copc)?\.(las|laz)$", "", file.name, flags=re.IGNORECASE)
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
