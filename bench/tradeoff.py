"""Visible against hidden pixels labelled by both recipes, over thresholds of the correlation.

One command, a table and a figure; see README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import tempfile
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from accuracy import (
    Made,
    pixels,
    print_table,
    read_config,
    scenes_made,
    share,
    truth_row,
)
from matplotlib.figure import Figure
from synthetic_pairs import labels_of

from stereotruth.config.configuration import Configuration
from stereotruth.config.labels import LabelSettings
from stereotruth.disparity.project import SHARD, project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.errors import InputError
from stereotruth.evaluation.labels_against_truth import (
    ByClass,
    Labels,
    Truth,
    compare,
    open_truth,
    status_names,
)
from stereotruth.pages.pictures import SERIES
from stereotruth.products.files import atomic_file
from stereotruth.products.grids import blocks, open_grid
from stereotruth.products.provenance import source_digest

THRESHOLDS = (-1.0, 0.0, 0.25, 0.5, 0.8, 0.9)
COLOURS = {"paper": "#8a8a8a", "surface": SERIES[0]}  # of the recipes
Window = tuple[slice, slice]
Rows = list[dict[str, Any]]


def fullest(truth: Path, count: int) -> list[Window]:
    """The blocks of the grid with most pixels that both views see, inside the LiDAR's coverage."""
    store = open_truth(truth)
    windows = blocks(store["disparity"].shape, SHARD)
    filled = [int(((store["visible"][w] == 1) & (store["covered"][w] == 1)).sum()) for w in windows]
    order = np.argsort(filled, kind="stable")[::-1][: count or None]
    return [windows[k] for k in sorted(order)]


def measure(
    made: Made, windows: Sequence[Window], truth: Path, settings: Mapping[str, Any], workers: int
) -> ByClass:
    """Project these windows of a scene and compare their labels with the truth."""
    result = ByClass()
    with tempfile.TemporaryDirectory(dir=made.exact) as folder:
        out = Path(folder) / "disparity.zarr"
        with patch("stereotruth.disparity.project.blocks", lambda *_: list(windows)):
            alignment = made.refined if made.refined.is_file() else made.aligned
            inputs = SceneInputs.of(
                made.left, made.right, made.points, LabelSettings(**settings), alignment=alignment
            )
            inputs = inputs.with_surface(made.exact, workers)
            code = source_digest("disparity.project")
            project_scene(inputs, out, workers=workers, code=code)
        store = open_grid(out)
        true = open_truth(truth, store.attrs["epipolar"])
        for window in windows:
            labels = Labels.read(store, *window)
            result.merge(compare(labels, Truth.read(true, *window), status_names(store)))
    return result


def rows_of_city(
    scenes: Sequence[Made], config: Configuration, arguments: argparse.Namespace
) -> Rows:
    """A row for each recipe and threshold, all scenes of a city together."""
    found: dict[tuple[str, float], ByClass] = {}
    for made in scenes:
        made.exact.mkdir(parents=True, exist_ok=True)
        truth = made.truth(made.exact, made.disparity, arguments.workers)
        windows = fullest(truth, arguments.blocks)
        for recipe, threshold in product(COLOURS, THRESHOLDS):
            settings = labels_of(config).model_dump()
            settings |= {"recipe": recipe, "correlation_threshold": threshold}
            part = measure(made, windows, truth, settings, arguments.workers)
            found.setdefault((recipe, threshold), ByClass()).merge(part)
    return [
        {"city": scenes[0].scene.city, "recipe": recipe, "threshold": threshold}
        | truth_row(recipe, part.total)
        for (recipe, threshold), part in found.items()
    ]


def shown(row: Mapping[str, Any]) -> dict[str, str]:
    return {
        "city": row["city"],
        "recipe": row["recipe"],
        "threshold": f"{row['threshold']:g}",
        "visible labelled": share(row["visible"]),
        "hidden labelled": share(row["hidden"]),
        "in LiDAR only": share(row["in_lidar_only"]),
        "mean abs px": pixels(row["mean_abs"]),
        "> 1 px": share(row["over_1px"]),
    }


def draw(rows: Rows, path: Path) -> None:
    """A panel per city: visible against hidden pixels labelled."""
    cities = list(dict.fromkeys(row["city"] for row in rows))
    columns = min(3, len(cities))
    lines = -(-len(cities) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.6 * lines), layout="constrained")
    axes = np.ravel(figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False))
    for ax, city in zip(axes, cities):
        ax.fill_between([0.1, 1], 98.5, 100, color="0.8", alpha=0.6, lw=0, label="aim")
        for recipe, colour in COLOURS.items():
            here = [row for row in rows if row["city"] == city and row["recipe"] == recipe]
            x, y = (100 * np.array([row[key] for row in here]) for key in ("hidden", "visible"))
            ax.plot(x, y, "o-", color=colour, ms=4, lw=1.3, label=recipe)
            for row, at_x, at_y in zip(here, x, y):
                # the points of surface lie close together: its last one only
                if recipe == "paper" or row["threshold"] == THRESHOLDS[-1]:
                    ax.annotate(
                        f"{row['threshold']:g}", (at_x, at_y), (3, -8),
                        textcoords="offset points", fontsize=6, color=colour, annotation_clip=True,
                    )  # fmt: skip
        ax.set_title(city, fontsize=10)
        ax.set_xscale("log")
        ax.set_xlim(0.1, 100)
        ax.set_ylim(45, 100)
        ax.grid(alpha=0.3)
    for ax in axes[len(cities) :]:
        ax.set_axis_off()
    axes[0].legend(fontsize=7, loc="lower right")
    figure.supxlabel("hidden pixels labelled, % (at the points: threshold)", fontsize=9)
    figure.supylabel("visible pixels labelled, %", fontsize=9)
    with atomic_file(path) as scratch:
        figure.savefig(scratch, dpi=80)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--city", nargs="*", help="these cities only")
    parser.add_argument(
        "--configfile", nargs="*", type=Path, default=[], help="as given to snakemake"
    )
    parser.add_argument(
        "--blocks", type=int, default=0, help="only so many blocks of each scene, the fullest"
    )
    parser.add_argument("--figure", type=Path, help="file for the figure (PNG)")
    parser.add_argument("--json", type=Path, help="file for all figures; keeps other cities' there")
    parser.add_argument("--redraw", action="store_true", help="draw what --json holds, run nothing")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.ERROR, format="%(message)s")
    rows: Rows = []
    if arguments.json and arguments.json.is_file():
        known = json.loads(arguments.json.read_text(encoding="utf-8"))
        again = [] if arguments.redraw else arguments.city or {row["city"] for row in known}
        rows = [row for row in known if row["city"] not in again]
    try:
        config = read_config(arguments.configfile)
        made = [] if arguments.redraw else scenes_made(config, arguments.city)
        scenes = [scene for scene in made if scene.has_truth]
        for city in dict.fromkeys(scene.scene.city for scene in scenes):
            rows += rows_of_city([s for s in scenes if s.scene.city == city], config, arguments)
            if arguments.json:
                arguments.json.parent.mkdir(parents=True, exist_ok=True)
                arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print_table("Labelled pixels, by recipe and threshold of the correlation", [*map(shown, rows)])
    if arguments.figure and rows:
        draw(rows, arguments.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
