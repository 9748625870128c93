"""Good files of a finished run, and its sheets, to be damaged; and how each is read.

A mutant takes the place of its file in a copy of the project, and is read without a plan.
"""

from __future__ import annotations

import csv
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from stereotruth.align.alignment import Alignment
from stereotruth.core.config.configuration import Configuration
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import link, read_perhaps_edited
from stereotruth.core.products.grids import open_grid
from stereotruth.core.products.rasters import read_image
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.lidar.point_store import PointStore
from stereotruth.project.project import lidar_of, read_scenes
from stereotruth.tiles.stereo_dataset import StereoDataset

from .damaged_cases import Case

SHEETS = ("tiny_scenes.tsv", "tiny_cities.tsv")
GRIDS = ("results/rectify/*/*/left.zarr", "results/project/*/*.zarr")
# By kind: how its files are read, and which they are; the project is that of tests/workflow.
KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "sheets": ("sheets", SHEETS),
    "tiles": ("tiles", tuple(f"tiles/*/{kind}/*" for kind in ("left", "right", "disp"))),
    "manifest": ("tiles", ("tiles/*/manifest.csv", "tiles/*/export.json")),
    "alignments": ("alignment", ("results/align/*/*/alignment.json",)),
    "epipolar models": ("model", ("results/rectify/*/*/epipolar.json",)),
    "zarr.json": ("grid", tuple(f"{place}/zarr.json" for place in GRIDS)),
    "point stores": (
        "points",
        tuple(f"results/ingest/*/*/*_0_0.points/{n}" for n in ("store.json", "*.npy")),
    ),
}
TEXT = {".tsv", ".csv", ".json"}
TILES_TRIED = 2  # of each kind of file


def product_cases(project: Path) -> Iterator[Case]:
    """The files of a finished project in which tiles/Tiny was made."""
    for kind, (reader, patterns) in KINDS.items():
        for pattern in patterns:
            for file in sorted(project.glob(pattern))[:TILES_TRIED]:
                place = str(file.relative_to(project))
                options = {"project": str(project), "place": place}
                text = file.suffix in TEXT
                yield Case(f"{kind}: {place}", kind, reader, file, text=text, options=options)


@contextmanager
def _in_place(case: Case, file: Path, folder: Path) -> Iterator[Path]:
    """The mutant's place in a copy of the project, which is the working directory."""
    root, here = folder / "project", Path.cwd()
    good, place = Path(case.options["project"]), Path(case.options["place"])
    if not root.exists():
        for top in ("results", "tiles", "in", "tiny.yaml", *SHEETS):
            for other in sorted((good / top).rglob("*")) if (good / top).is_dir() else [good / top]:
                if other.is_file():
                    link(other, root / other.relative_to(good))
    (root / place).unlink()
    (root / place).write_bytes(file.read_bytes())
    os.chdir(root)
    try:
        yield place
    finally:
        os.chdir(here)
        (root / place).unlink()
        link(good / place, root / place)


def _digest(*arrays: Any) -> str:
    found = hashlib.sha256()
    for array in map(np.ascontiguousarray, arrays):
        found.update(f"{array.shape} {array.dtype} ".encode() + array.tobytes())
    return found.hexdigest()


def _sheets(place: Path) -> Any:
    config = yaml.safe_load(Path("tiny.yaml").read_text())
    settings = Configuration.of(config)
    cities, scenes = read_scenes(settings)
    files = {name: lidar_of(scene, settings) for name, scene in scenes.items()}
    known = ({name: asdict(of) for name, of in sheet.items()} for sheet in (cities, scenes))
    return [*known, {name: list(map(str, of.values())) for name, of in files.items()}]


def _tiles(place: Path) -> Any:
    dataset, found = StereoDataset("tiny", Path(*place.parts[:2]), "stereotruth", (-64, 64)), []
    for pair in dataset.pairs():
        pair.refuse_changed()
        files = pair.left, pair.right, pair.disparity
        if place in files or place.parent == dataset.root:
            images = [read_image(pair.left), read_image(pair.right)]
            labels = [] if pair.disparity is None else [dataset.labels(pair)]
            found.append([pair.name, pair.city, pair.split, _digest(*images, *labels)])
    return found


def _alignment(place: Path) -> Any:
    """An alignment that is not as it was written is used, and told in the log."""
    alignment = Alignment.read(place)
    if not read_perhaps_edited(place)[1]:
        raise InputError("edited since it was made", file=place, remedy="run again")
    return repr(alignment.to_dict())


def _model(place: Path) -> Any:
    return repr(EpipolarModel.load(place).to_dict())


def _grid(place: Path) -> Any:
    grid = open_grid(place.parent)
    layers = {name: [_digest(layer.values), layer.attrs] for name, layer in grid.items()}
    return repr([layers, grid.sizes, grid.attrs])


def _points(place: Path) -> Any:
    store = PointStore(place.parent)
    found = store.query(*store.bounds[:4])
    strips = [store.strips_of(cell) for cell in range(store.cell_row.size)]
    values = found.lon_q, found.lat_q, found.h_q, found.classification, *strips
    return [repr(store.attrs), _digest(*values)]


READERS = {
    "sheets": _sheets,
    "tiles": _tiles,
    "alignment": _alignment,
    "model": _model,
    "grid": _grid,
    "points": _points,
}


def read_product(case: Case, file: Path, folder: Path) -> tuple[Any, list[str]]:
    """What a mutant in its place gives; no remarks."""
    with _in_place(case, file, folder) as place:
        return READERS[case.reader](place), []


def cannot_be_told(case: Case, data: bytes) -> bool:
    """Whether a sheet is one that its user may have meant; it ends with a whole line.

    All other files keep a checksum, or one is kept of them.
    """
    if case.reader != "sheets":
        return False
    lines = data.decode("utf-8-sig").splitlines(keepends=True)
    rows = [row for row in csv.reader(lines, delimiter="\t") if any(row)]
    return len(rows[-1]) == len(rows[0]) or lines[-1].endswith("\n")
