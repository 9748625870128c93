"""The files that a city's page is made of, and what they hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..dataset.manifest import read_manifest
from ..errors import InputError
from ..products.files import read_table
from ..pages.page import way

Place = str | Path


@dataclass(frozen=True)
class CityFiles:
    """Files of a city; a section of the page is left out whose file is None or missing.

    ``tiles``: the exported tiles; ``coverage``: the coverage map (PNG); ``looks``: georeferenced
    pictures of the left images by scene; ``alignments``, ``refinements``: alignment.json by scene,
    after the fit to the GCPs and after refinement; ``refinement_figures``: refinement.png by scene;
    ``truth``, ``truth_table``: truth.json and truth.csv; ``table4``, ``sift``: table4.csv and
    sift.csv with their ``sift_figure`` (PNG).
    """

    tiles: Place
    coverage: Place | None = None
    looks: Mapping[str, Place] = field(default_factory=dict)
    alignments: Mapping[str, Place] = field(default_factory=dict)
    refinements: Mapping[str, Place] = field(default_factory=dict)
    refinement_figures: Mapping[str, Place] = field(default_factory=dict)
    truth: Place | None = None
    truth_table: Place | None = None
    table4: Place | None = None
    sift: Place | None = None
    sift_figure: Place | None = None

    @property
    def folder(self) -> Path:
        """Of the tiles."""
        return Path(self.tiles)

    @property
    def looks_there_are(self) -> list[Path]:
        """Pictures of the left images, those that exist."""
        return [Path(file) for file in self.looks.values() if Path(file).is_file()]

    def links(self, page: Place) -> list[tuple[str, str, str]]:
        """Name, way from the page and meaning of what a reader may open, as far as it exists."""
        every = (
            (self.folder, "tiles", "left, right, disp, status, orientation"),
            (self.folder / "manifest.csv", "manifest.csv", "one row per tile"),
            (self.folder / "footprints.geojson", "footprints.geojson", "with a style for QGIS"),
            (self.folder / "export.json", "export.json", "figures, limits, parameters"),
            (self.truth_table, "truth.csv", "labels against the exact truth"),
            (self.table4, "table4.csv", "SIFT matches, as table 4 of the paper"),
            (self.sift, "sift.csv", "the same by scene and tile"),
        )
        return [
            (name, str(way(page, file)), text)
            for file, name, text in every
            if file is not None and Path(file).exists()
        ]


@dataclass(frozen=True)
class CityRecords:
    """What a city's files hold: the manifest's rows, alignments before and after, truth, export."""

    rows: list[dict[str, str]]
    alignments: dict[str, dict[str, Any]]
    refinements: dict[str, dict[str, Any]]
    truth_rows: list[dict[str, str]]
    truth: dict[str, Any]
    export: dict[str, Any]

    @classmethod
    def of(cls, files: CityFiles) -> CityRecords:
        """Read them. Raises InputError without a manifest, and if a file is damaged."""
        return cls(
            read_manifest(files.folder),
            _records(files.alignments),
            _records(files.refinements),
            rows_of(files.truth_table),
            _record(files.truth),
            _record(files.folder / "export.json"),
        )

    @property
    def labelled(self) -> list[dict[str, str]]:
        """Rows of the labelled tiles."""
        return [row for row in self.rows if row["complete"] == "yes"]

    @property
    def quality(self) -> dict[str, Any]:
        """Gates of the export."""
        return self.export.get("quality", {})


def rows_of(path: Place | None) -> list[dict[str, str]]:
    """Rows of a CSV file; none if there is no such file."""
    if path is None or not Path(path).is_file():
        return []
    return list(read_table(path))


def _records(files: Mapping[str, Place]) -> dict[str, dict[str, Any]]:
    """Records by scene, those that are there."""
    found = {scene: _record(file) for scene, file in files.items()}
    return {scene: record for scene, record in found.items() if record}


def _record(path: Place | None) -> dict[str, Any]:
    """A JSON file's object; empty if there is no such file. Raises InputError if it is damaged."""
    if path is None or not Path(path).is_file():
        return {}
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError:
        raise InputError(
            "damaged: it is no JSON", file=path, remedy="delete it and run the workflow again"
        ) from None
