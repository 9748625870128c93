"""The manifest of a folder of tiles or of a dataset: a line per pair, and its one reader.

What a line states becomes names of files. It may come from somebody else, so that every line is
held to plain names, and to paths below the manifest's folder (:mod:`..core.products.files`).

Beside its labels, a tile has the layers that a user asks for, on the grid of the left image:

============  =======  =========================================================================
layer         type     what it holds
============  =======  =========================================================================
height        float32  height above the WGS 84 ellipsoid of what the label shows, m
class         uint8    LAS class (ASPRS) of the highest point that the label rests on; 0: none
agl           float32  its height above the ground, m
uncertainty   float32  standard uncertainty of the disparity, px
lidar_date    uint16   when the LiDAR measured what the label shows, days since 1970-01-01; 0: not
                       known
============  =======  =========================================================================

Where a pixel has no label they hold nodata: NODATA, or 0 of whole numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.products.files import path_below, plain_name, read_table, shown
from ..core.products.provenance import file_sha256
from ..core.status import Status

SPLITS = ("train", "val", "test")
NONE = "none"  # of pairs without labels, and of those that share ground with two splits
TRUTH, NO_TRUTH = "with ground truth", "without ground truth"  # folders of the published layout
FOOTPRINTS, STYLE = "footprints.geojson", "footprints.qml"  # beside the manifest
STATUS_COLOURS_FILE = "status_colours.txt"
NODATA = -9999.0  # of layers of real numbers
NAMES = ("tile", "city", "scene", "split")  # columns that name something
PATHS = ("left", "right", "disp")  # columns of files, with all that have a checksum
WHOLE = ("row0", "col0", "size", "right_offset_px")
SUM = "_sha256"  # ends the name of a checksum's column, which begins with that of the file
MAKE_AGAIN = "get or make the folder again"
CHANGED = "is not what its manifest has the checksum of"
CHANGED_REMEDY = "get or make the dataset again; or delete the manifest, if the edit was yours"
DISPARITY_FIGURES = ("disparity_min_px", "disparity_mean_px", "disparity_max_px")


class LayerKind(NamedTuple):
    """``dtype`` of the file, its nodata, and what it says of itself."""

    dtype: str
    nodata: float
    description: str


KINDS = {
    "height": LayerKind("float32", NODATA, "height above the WGS 84 ellipsoid in m"),
    "class": LayerKind("uint8", 0, "LAS class (ASPRS)"),
    "agl": LayerKind("float32", NODATA, "height above the ground in m"),
    "uncertainty": LayerKind("float32", NODATA, "standard uncertainty of the disparity in px"),
    "lidar_date": LayerKind("uint16", 0, "days since 1970-01-01 of the LiDAR"),
}


def column(name: str) -> str:
    """The manifest's column of a layer's file; ``class`` alone is that of the tile."""
    return f"layer_{name}"


def tile_flags(flags: Mapping[int, str]) -> dict[int, str]:
    """Names of the status values of tiles, from those of their store."""
    more = Status.LABELLED_CROWN.label in flags.values()
    added = {int(Status.TOO_UNCERTAIN): Status.TOO_UNCERTAIN.label} if more else {}
    return dict(flags) | added


@dataclass(frozen=True)
class Tile:
    """A pair of a city, as its line of the manifest tells.

    ``row0``, ``col0``: its upper-left pixel in the scene's grid; ``size``, ``right_offset_px`` in
    px; ``labelled``: whether its labels are complete; ``row``: the whole line, as text.
    """

    name: str
    city: str
    scene: str
    row0: int
    col0: int
    size: int
    right_offset_px: int
    labelled: bool
    split: str
    row: Mapping[str, str] = field(repr=False, compare=False)

    @classmethod
    def of(cls, row: Mapping[str, str]) -> Tile:
        """From a line of the manifest."""
        return cls(
            name=row["tile"],
            city=row["city"],
            scene=row["scene"],
            row0=int(row["row0"]),
            col0=int(row["col0"]),
            size=int(row["size"]),
            right_offset_px=int(row["right_offset_px"]),
            labelled=row["complete"] == "yes",
            split=row["split"],
            row=row,
        )

    @property
    def window(self) -> tuple[slice, slice]:
        """[rows, cols] of the left image in the scene's grid."""
        rows = slice(self.row0, self.row0 + self.size)
        return rows, slice(self.col0, self.col0 + self.size)


def tells_of_change(row: Mapping[str, str]) -> bool:
    """Whether dates or suns of a tile's row tell that the ground can have changed: points of
    another day than an image, or images of two lights. Else what is `changed` misfits."""
    days = (row.get(f"lidar_days_{view}") for view in ("left", "right"))
    return row.get("diachronic") == "yes" or any(cell and int(cell) for cell in days)


def manifest_rows(file: Path) -> Iterator[dict[str, str]]:
    """Lines of a manifest, checked. Raises FileNotFoundError if there is none.

    Raises InputError if a line is no text, or states a name, path or number that is none.
    """
    try:
        for number, row in enumerate(read_table(file), 2):
            _check(row, f"line {number}", file)
            yield row
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"no table of text ({error})", file=file, remedy=MAKE_AGAIN) from None


def _check(row: Mapping[str, str], where: str, file: Path) -> None:
    """Raise InputError if a line cannot be used."""
    if None in row or None in row.values():
        problem = f"{where} has not as many cells as columns"
        raise InputError(problem, file=file, remedy=MAKE_AGAIN)
    for column in NAMES:
        if column in row and (row[column] or column == "tile"):
            plain_name(row[column], f"{where}: {column}", file)
    for column in {*PATHS, *(key.removesuffix(SUM) for key in row if key.endswith(SUM))}:
        if row.get(column):
            path_below(row[column], f"{where}: {column}", file)
    wrong = [name for name in WHOLE if not re.fullmatch(r"-?[0-9]{0,9}", row.get(name, ""))]
    if row.get("split", NONE) not in (*SPLITS, NONE, ""):
        wrong.append("split")
    if wrong:
        problem = f"{where}: {wrong[0]} is {shown(row[wrong[0]])}"
        raise InputError(problem, file=file, remedy=MAKE_AGAIN)


def read_manifest(folder: str | Path) -> list[dict[str, str]]:
    """Rows of a folder's manifest. Raises InputError if there is none, or a line is wrong."""
    path = Path(folder) / "manifest.csv"
    if not path.is_file():
        raise InputError(
            "no manifest", file=path, remedy="make the folder with snakemake, tiles/<City>"
        )
    return list(manifest_rows(path))


def listed_files(folder: str | Path) -> list[tuple[str, str]]:
    """Files that a folder's manifest lists, as paths in the folder, with their checksums."""
    return [
        (row[key.removesuffix(SUM)], row[key])
        for row in read_manifest(folder)
        for key in row
        if key.endswith(SUM) and row[key.removesuffix(SUM)]
    ]


def refuse_changed(folder: str | Path) -> None:
    """Raise InputError that names a listed file which is another one than when it was listed.

    Files that are not there, as those of a sealed copy, are passed over.
    """
    for name, checksum in listed_files(folder):
        file = Path(folder, name)
        if file.is_file() and file_sha256(file) != checksum:
            raise InputError(CHANGED, file=file, remedy=CHANGED_REMEDY)


def disparity_cells(
    stored: NDArray[np.float32], disparity: NDArray[np.floating[Any]] | None = None
) -> dict[str, str]:
    """Cells that tell of labels [h, w] px, NaN without one, as their file has them.

    ``disparity``: likewise, before it was rounded to be stored.
    """
    exact = stored if disparity is None else disparity
    known = np.isfinite(exact)
    values, match = stored[known].astype(np.float64), np.arange(exact.shape[1]) - exact
    inside = (match >= -0.5) & (match <= exact.shape[1] - 0.5)
    figures = (values.min(), values.mean(), values.max()) if values.size else ()
    return {
        "labelled_share": f"{known.mean():.6f}",
        "matched_share": f"{inside.sum() / max(known.sum(), 1):.6f}",
        **dict.fromkeys(DISPARITY_FIGURES, ""),
        **{name: f"{value:.4f}" for name, value in zip(DISPARITY_FIGURES, figures)},
    }


def labelled_tiles(folder: Path, scene: str) -> list[Tile]:
    """A scene's labelled tiles. Raises InputError if there is no manifest."""
    tiles = map(Tile.of, read_manifest(folder))
    return [tile for tile in tiles if tile.scene == scene and tile.labelled]
