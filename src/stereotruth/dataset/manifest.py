"""The manifest of a folder of tiles: a line per pair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from ..products.files import read_table


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


def read_manifest(folder: str | Path) -> list[dict[str, str]]:
    """Rows of a folder's manifest. Raises InputError if there is none."""
    path = Path(folder) / "manifest.csv"
    if not path.is_file():
        raise InputError(
            "no manifest", file=path, remedy="make the folder with snakemake, tiles/<City>"
        )
    return list(read_table(path))


def labelled_tiles(folder: Path, scene: str) -> list[Tile]:
    """A scene's labelled tiles. Raises InputError if there is no manifest."""
    manifest = folder / "manifest.csv"
    try:
        tiles = [Tile.of(row) for row in read_table(manifest)]
    except FileNotFoundError:
        raise InputError(
            "no manifest of tiles", file=manifest, remedy="run the export stage"
        ) from None
    return [tile for tile in tiles if tile.scene == scene and tile.labelled]


def carries_label(status: str) -> bool:
    """Whether pixels of a status have a label: measured by points in them, or between points."""
    return status.startswith("labelled")
