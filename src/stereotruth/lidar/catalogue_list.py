"""Lists of tiles: which files a catalogue has for a site, as a sheet that one can read.

A list is written once, by the command that looks into the catalogue and asks the servers; plans and
jobs read the list alone. A tile that is another one by then (size, ETag) ends the job that reads
it. The lines before the columns (``# key: value``) hold where the tiles come from and how much of
the footprint no tile covers.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path

from ..core.errors import InputError
from ..core.products.files import atomic_file
from ..core.products.remote_files import is_remote, place_of, stand_in_of
from ..core.tables import Table
from .lattice import Footprint

SUFFIX = ".tsv"
EPT = "ept.json"  # a file of points by its name, no catalogue
CATALOGUES = (".vpc", ".json", ".geojson", ".gpkg")
TITLE = "# tiles of a catalogue, written by stereotruth: see docs/how-to/national_lidar.md"
REMEDY = "write it again: stereotruth lidar CATALOGUE --to FILE"


@dataclass(frozen=True)
class ListedTile:
    """A tile of a list.

    ``file``: path or URL; ``bytes`` and ``content`` (ETag or time of the last change) of one on a
    server; ``points`` by the catalogue or -1; ``start``, ``end``: dates of acquisition (ISO), or
    empty.
    """

    file: str
    bytes: int
    content: str
    points: int
    start: str
    end: str


@dataclass(frozen=True)
class TileList:
    """A list of tiles, and what is known of all of them.

    ``catalogue``: path or URL, without secrets; ``sha256`` and ``bytes`` of it; ``hosts`` that its
    tiles' servers may redirect to; ``ground`` that was asked for, as runs of cells
    (:class:`.lattice.Footprint`), ``footprint_m2`` its area, ``hole_m2`` of it in no tile;
    ``crs``: that of all tiles by the catalogue, or empty.
    """

    catalogue: str
    sha256: str
    bytes: int
    hosts: tuple[str, ...]
    ground: tuple[tuple[int, int, int], ...]
    footprint_m2: float
    hole_m2: float
    crs: str
    tiles: tuple[ListedTile, ...]

    @property
    def tile_bytes(self) -> int:
        """Of all tiles, where they are known."""
        return sum(tile.bytes for tile in self.tiles)

    @property
    def hole_text(self) -> str:
        """What of the footprint is covered by no tile, or empty."""
        if not self.hole_m2:
            return ""
        share = self.hole_m2 / self.footprint_m2
        return (
            f"no tile of {self.catalogue} covers {self.hole_m2 / 1e6:.4g} km² "
            f"({100 * share:.2g} %) of the {self.footprint_m2 / 1e6:.4g} km² that the images see "
            "at most, with the margin"
        )


HEAD = tuple(field.name for field in fields(TileList) if field.name != "tiles")
COLUMNS = tuple(field.name for field in fields(ListedTile))


def is_catalogue(location: str) -> bool:
    """Whether a part of a cell names a catalogue, by its ending; of a URL, that of its path."""
    lowered = location.lower()
    if is_remote(location):
        lowered = re.split(r"[?#]", lowered, maxsplit=1)[0]
    return lowered.endswith(CATALOGUES) and lowered.rpartition("/")[2] != EPT


def is_list(cell: str) -> bool:
    """Whether a part of a cell names a list of tiles, by its ending."""
    return cell.lower().endswith(SUFFIX) and not is_remote(cell)


def write_list(listed: TileList, to: str | Path) -> None:
    """Write a list; whole or not at all."""
    stream = io.StringIO()
    stream.write(f"{TITLE}\n")
    texts = {key: str(getattr(listed, key)) for key in HEAD}
    texts |= {"hosts": " ".join(listed.hosts), "ground": json.dumps(listed.ground)}
    for key, text in (texts | {"count": str(len(listed.tiles))}).items():
        stream.write(f"# {key}: {' '.join(text.split())}\n")
    writer = csv.writer(stream, delimiter="\t", lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(asdict(tile).values() for tile in listed.tiles)
    Path(to).parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(Path(to)) as scratch:
        scratch.write_text(stream.getvalue(), encoding="utf-8")


def read_list(file: str | Path) -> TileList:
    """A list of tiles. Raises InputError: missing, damaged, no list of tiles."""
    table = Table.read(file, REMEDY, "\t")
    table.require(COLUMNS, COLUMNS, REMEDY)
    head = table.declared
    try:
        tiles = tuple(
            ListedTile(**cells | {key: int(cells[key]) for key in ("bytes", "points")})
            for _, cells in table.rows
        )
        if len(tiles) != int(head["count"]):
            raise ValueError(f"{len(tiles)} of its {head['count']} tiles stand in it")
        if not tiles or not all(tile.file and tile.bytes >= 0 for tile in tiles):
            raise ValueError("it names no tile, or one without a file")
        for day in (day for tile in tiles for day in (tile.start, tile.end) if day):
            date.fromisoformat(day)
        values = {key: head[key] for key in HEAD} | {
            "bytes": int(head["bytes"]),
            "hosts": tuple(head["hosts"].split()),
            "ground": tuple((int(a), int(b), int(c)) for a, b, c in json.loads(head["ground"])),
            "footprint_m2": float(head["footprint_m2"]),
            "hole_m2": float(head["hole_m2"]),
        }
        return TileList(**values, tiles=tiles)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        problem = f"no list of tiles that can be read ({error})"
        raise InputError(problem, file=file, remedy=REMEDY) from None


def files_of_list(file: str | Path) -> list[str]:
    """Paths of the tiles of a list: local files, and stand-ins of those on servers.

    Nobody is asked; what is not there is found by who reads it. Raises InputError.
    """
    listed = read_list(file)
    hosts = frozenset(listed.hosts)
    return [
        os.fspath(stand_in_of(tile.file, tile.bytes, tile.content, hosts))
        if is_remote(tile.file)
        else tile.file
        for tile in listed.tiles
    ]


def days_of_list(file: str | Path) -> dict[str, list[str]]:
    """First and last day of the tiles of a list that says them, by path; see files_of_list."""
    return {
        os.fspath(place_of(tile.file) if is_remote(tile.file) else Path(tile.file)): [
            tile.start,
            tile.end or tile.start,
        ]
        for tile in read_list(file).tiles
        if tile.start
    }


def remarks_on(file: str | Path) -> list[str]:
    """What users are to know of a list: ground without a tile, a catalogue that has changed."""
    listed = read_list(file)
    remarks = [f"{file}: {listed.hole_text}"] if listed.hole_m2 else []
    catalogue = Path(listed.catalogue)
    if not is_remote(listed.catalogue) and catalogue.is_file():
        same = catalogue.stat().st_size == listed.bytes
        if not same or hashlib.sha256(catalogue.read_bytes()).hexdigest() != listed.sha256:
            remarks.append(f"{catalogue} has changed since {file} was written: write it again")
    return remarks


def unlisted_m2(files: Sequence[str], footprint: Footprint) -> float:
    """Ground of a footprint that lists of tiles were not asked for."""
    asked = [run for file in files for run in read_list(file).ground]
    own = Footprint.of_runs(asked)
    every = Footprint.of_runs([*asked, *footprint.runs])
    return max(0.0, every.area_m2 - own.area_m2)
