"""The manifest of a city's tiles."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import InputError


def write_manifest(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows of one kind as CSV; the columns are those of the first row."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_manifest(folder: str | Path) -> list[dict[str, str]]:
    """Rows of a folder's manifest. Raises InputError if there is none."""
    path = Path(folder) / "manifest.csv"
    if not path.is_file():
        raise InputError(
            "no manifest", file=path, remedy="make the folder with snakemake, tiles/<City>"
        )
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def labelled_tiles(tiles: Path, scene: str) -> list[dict[str, str]]:
    """Manifest rows of a scene's labelled tiles."""
    manifest = tiles / "manifest.csv"
    try:
        with manifest.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    except FileNotFoundError:
        raise InputError(
            "no manifest of tiles", file=manifest, remedy="run the export stage"
        ) from None
    return [row for row in rows if row["scene"] == scene and row["complete"] == "yes"]


def window_of(row: Mapping[str, str]) -> tuple[slice, slice]:
    """Window [rows, cols] of a tile in its scene's grid; ``row`` is its line of the manifest."""
    r, c, size = int(row["row0"]), int(row["col0"]), int(row["size"])
    return slice(r, r + size), slice(c, c + size)
