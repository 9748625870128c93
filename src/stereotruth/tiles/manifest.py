"""The manifest of a folder of tiles or of a dataset: a line per pair, and its one reader.

What a line states becomes names of files. It may come from somebody else, so that every line is
held to plain names, and to paths below the manifest's folder (:mod:`..products.names`).
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..core.errors import InputError
from ..core.products.files import path_below, plain_name, read_table, shown
from .split_names import NONE, SPLITS

NAMES = ("tile", "city", "scene", "split")  # columns that name something
PATHS = ("left", "right", "disp")  # columns of files, with all that have a checksum
WHOLE = ("row0", "col0", "size", "right_offset_px")
SUM = "_sha256"  # ends the name of a checksum's column, which begins with that of the file


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


def manifest_rows(file: Path) -> Iterator[dict[str, str]]:
    """Lines of a manifest, checked. Raises FileNotFoundError if there is none.

    Raises InputError if a line is no text, or states a name, path or number that is none.
    """
    try:
        for number, row in enumerate(read_table(file), 2):
            _check(row, f"line {number}", file)
            yield row
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"no table of text ({error})", file=file, remedy="get or make the folder again"
        ) from None


def _check(row: Mapping[str, str], where: str, file: Path) -> None:
    """Raise InputError if a line cannot be used."""
    if None in row or None in row.values():
        raise InputError(
            f"{where} has not as many cells as columns",
            file=file,
            remedy="get or make the folder again",
        )
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
        raise InputError(
            f"{where}: {wrong[0]} is {shown(row[wrong[0]])}",
            file=file,
            remedy="get or make the folder again",
        )


def read_manifest(folder: str | Path) -> list[dict[str, str]]:
    """Rows of a folder's manifest. Raises InputError if there is none, or a line is wrong."""
    path = Path(folder) / "manifest.csv"
    if not path.is_file():
        raise InputError(
            "no manifest", file=path, remedy="make the folder with snakemake, tiles/<City>"
        )
    return list(manifest_rows(path))


def labelled_tiles(folder: Path, scene: str) -> list[Tile]:
    """A scene's labelled tiles. Raises InputError if there is no manifest."""
    tiles = map(Tile.of, read_manifest(folder))
    return [tile for tile in tiles if tile.scene == scene and tile.labelled]
