"""Accuracy of what the workflow made: one command, one table. See README.md beside this file.

Scenes with ``truth.zarr`` beside their left image (the synthetic ones) are compared with it, scenes
with ``checkpoints.csv`` there with these points; in all, the right image is warped to the left.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from stereotruth import sheets
from stereotruth.alignment import align
from stereotruth.epipolar import EpipolarModel
from stereotruth.errors import InputError
from stereotruth.evaluation import checkpoints, truth, warping
from stereotruth.grid_store import require_complete

PROJECT = Path(__file__).resolve().parents[1]
SCHEMAS = PROJECT / "workflow" / "schemas"
LIMITS = {  # what is asked for: key of a row, at most
    "noisy": {"mean_abs": 0.25, "over_1px": 0.005, "parallax": 0.20},
    "exact": {"mean_abs": 0.06, "parallax": 0.03},
}


def overridden(base: dict[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with the keys of another file in place of its own."""
    for key, value in extra.items():
        if isinstance(value, Mapping) and isinstance(base.get(key), dict):
            overridden(base[key], value)
        else:
            base[key] = value
    return base


def share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.2f} %"


def pixels(value: float | None, sign: bool = False) -> str:
    return "–" if value is None else f"{value:{'+' if sign else ''}.3f}"


def print_table(title: str, rows: Sequence[Mapping[str, str]]) -> None:
    """A table of text cells, columns as wide as needed."""
    if not rows:
        return
    columns = list(rows[0])
    width = {c: max(len(c), *(len(row[c]) for row in rows)) for c in columns}
    print(f"\n{title}")
    print("  ".join(f"{c:<{width[c]}}" for c in columns))
    for row in rows:
        print("  ".join(f"{row[c]:<{width[c]}}" for c in columns))


def truth_row(name: str, comparison: truth.Comparison) -> dict[str, Any]:
    row = truth.table_row(name, comparison)
    return {
        "scope": name,
        "labels": row["labels"],
        "mean_abs": row["mean_absolute_px"],
        "median": row["median_px"],
        "rms": row["rms_px"],
        "over_1px": row["share_over_1_px"],
        "over_3px": row["share_over_3_px"],
        "mean_abs_either": comparison.either.figures()["mean_absolute"],
        "over_1px_either": comparison.either.figures()["share_over_1_px"],
        "mean_abs_changed": comparison.with_changed.figures()["mean_absolute"],
        "over_1px_changed": comparison.with_changed.figures()["share_over_1_px"],
        "visible": row["share_of_visible_labelled"],
        "hidden": row["share_of_hidden_labelled"],
        "changed": row["share_of_changed_labelled"],
        "parallax": row["y_parallax_rms_px"],
        "parallax_max": row["y_parallax_max_px"],
    }


def shown_truth(row: Mapping[str, Any], limits: Mapping[str, float]) -> dict[str, str]:
    missed = [key for key, limit in limits.items() if row[key] is None or row[key] > limit]
    return {
        "scene": row["scope"],
        "labels": str(row["labels"]),
        "mean abs px": pixels(row["mean_abs"]),
        "median": pixels(row["median"], sign=True),
        "rms": pixels(row["rms"]),
        "> 1 px": share(row["over_1px"]),
        "> 3 px": share(row["over_3px"]),
        "either surface: mean abs": pixels(row["mean_abs_either"]),
        " > 1 px": share(row["over_1px_either"]),
        "with changed: mean abs": pixels(row["mean_abs_changed"]),
        "> 1 px ": share(row["over_1px_changed"]),
        "visible labelled": share(row["visible"]),
        "hidden labelled": share(row["hidden"]),
        "changed labelled": share(row["changed"]),
        "y-parallax rms px": pixels(row["parallax"]),
        "max": pixels(row["parallax_max"]),
        "limits": "kept" if not missed else f"missed: {', '.join(missed)}",
    }


def geometry_row(scene: str, gcps: str, model: EpipolarModel, store: Path) -> dict[str, str]:
    disparity, parallax = (e.figures() for e in truth.geometry_errors(model, store))
    return {
        "scene": scene,
        "GCPs": gcps,
        "disparity bias px": pixels(disparity["bias"], sign=True),
        "mean abs": pixels(disparity["mean_absolute"]),
        "max": pixels(disparity["max"]),
        "y-parallax rms px": pixels(parallax["rms"]),
        "max ": pixels(parallax["max"]),
    }


class Made:
    """Where the workflow put the products of a scene, under the working directory."""

    def __init__(self, scene: sheets.Scene) -> None:
        place = f"{scene.city}/{scene.scene}"
        self.scene = scene
        self.input = Path(scene.left_image).parent
        self.disparity = Path(f"results/project/{place}.zarr")
        self.left = Path(f"results/rectify/{place}/left.zarr")
        self.right = Path(f"results/rectify/{place}/right.zarr")
        self.tiles = Path(f"tiles/{scene.city}")
        self.points = Path(f"results/ingest/{place}")
        self.exact = Path(f"results/accuracy/{place}")

    @property
    def has_truth(self) -> bool:
        return (self.input / "truth.zarr").is_dir()


def with_exact_gcps(made: Made, config: Mapping[str, Any], workers: int) -> Path:
    """Align with noise-free GCPs, rectify and project again; the disparity store."""
    from stereotruth.disparity import project_scene
    from stereotruth.rectification import rectify

    scene, folder = made.scene, made.exact
    shutil.rmtree(folder, ignore_errors=True)
    aligned = align(
        scene.left_image,
        scene.right_image,
        made.input / "gcps_exact.csv",
        model=config["alignment"]["model"],
        scene=scene.scene,
    )
    rectify(
        scene.left_image,
        scene.right_image,
        aligned.left,
        aligned.right,
        aligned.reference_height,
        folder / "epipolar.json",
        folder / "left.zarr",
        folder / "right.zarr",
        workers=workers,
    )
    project_scene(
        folder / "left.zarr",
        folder / "right.zarr",
        sorted(made.points.glob("*.zarr")),
        folder / "disparity.zarr",
        method=config["occlusion"]["method"],
        window=config["occlusion"]["window"],
        correlation_threshold=config["occlusion"]["correlation_threshold"],
        representative=config["project"]["representative"],
        min_points=config["project"]["min_points_per_px"],
        workers=workers,
    )
    return folder / "disparity.zarr"


def panels(made: Made, folder: Path, count: int) -> list[dict[str, str]]:
    """Correlation of each exported tile; pictures of the first ``count``."""
    manifest = made.tiles / "manifest.csv"
    if not manifest.is_file():
        return []
    with manifest.open(newline="", encoding="utf-8") as stream:
        rows = [r for r in csv.DictReader(stream) if r["scene"] == made.scene.scene]
    found = []
    for k, row in enumerate(r for r in rows if r["complete"] == "yes"):
        tile = warping.warp_tile(made.tiles, row)
        found.append({"tile": tile.name, "correlation": f"{tile.correlation:.4f}"})
        if k < count:
            warping.draw_panels(tile, folder / f"{tile.name}.png")
    return found


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    config = yaml.safe_load((PROJECT / "config" / "config.yaml").read_text(encoding="utf-8"))
    for file in arguments.configfile:
        overridden(config, yaml.safe_load(file.read_text(encoding="utf-8")) or {})
    cities = sheets.read_cities(config["cities"], SCHEMAS)
    scenes = sheets.read_scenes(config["scenes"], cities, SCHEMAS)
    wanted: Iterable[Made] = [
        Made(s) for s in scenes.values() if not arguments.city or s.city in arguments.city
    ]
    present = [made for made in wanted if made.disparity.is_dir()]
    for made in wanted:
        if made not in present:
            print(f"{made.scene.scene}: not made yet ({made.disparity} is missing)")
    report: dict[str, Any] = {"truth": [], "exact": [], "geometry": [], "points": [], "warping": []}
    by_city: dict[str, truth.Comparison] = {}
    for made in present:
        name = made.scene.scene
        model = EpipolarModel.from_dict(require_complete(made.disparity).attrs["epipolar"])
        if made.has_truth:
            store = made.input / "truth.zarr"
            tiles = made.tiles if (made.tiles / "manifest.csv").is_file() else None
            result = truth.compare_scene(
                made.disparity, store, tiles, scene=name, workers=arguments.workers
            )
            report["truth"].append(truth_row(f"{name} scene", result.whole))
            if result.tiles:
                report["truth"].append(truth_row(f"{name} tiles", result.all_tiles))
                report["truth"] += [
                    truth_row(f"  {tile}", c) for tile, c in result.tiles.items() if arguments.tiles
                ]
                city = by_city.setdefault(made.scene.city, truth.Comparison())
                city.merge(result.all_tiles)
            if arguments.surfaces:
                report["truth"] += [truth_row(f"  {k}", c) for k, c in result.surfaces.items()]
            report["geometry"].append(geometry_row(name, "measured", model, store))
        if made.has_truth and arguments.exact:
            exact = with_exact_gcps(made, config, arguments.workers)
            result = truth.compare_scene(exact, store, None, scene=name, workers=arguments.workers)
            report["exact"].append(truth_row(f"{name} scene", result.whole))
            model = EpipolarModel.from_dict(require_complete(exact).attrs["epipolar"])
            report["geometry"].append(geometry_row(name, "noise-free", model, store))
        if (made.input / "checkpoints.csv").is_file():
            figures = checkpoints.evaluate_checkpoints(
                made.disparity, made.input / "checkpoints.csv", scene=name
            )
            report["points"].append({"scene": name, **figures})
        warped = warping.evaluate_warping(made.left, made.right, made.disparity)
        tiles_warped = panels(made, arguments.panels or Path(), 2 if arguments.panels else 0)
        report["warping"].append({"scene": name, **warped, "tiles": tiles_warped})
    report["cities"] = [truth_row(f"{city} tiles", c) for city, c in by_city.items()]
    return report


def show(report: Mapping[str, Any]) -> None:
    print_table(
        "Labels against the exact truth (limits: mean abs <= 0.25 px, > 1 px <= 0.5 %, "
        "y-parallax <= 0.20 px rms)",
        [shown_truth(row, LIMITS["noisy"]) for row in report["truth"]],
    )
    print_table(
        "The same, tiles by city",
        [shown_truth(row, LIMITS["noisy"]) for row in report["cities"]],
    )
    print_table(
        "With noise-free GCPs (limits: mean abs <= 0.06 px, y-parallax <= 0.03 px rms)",
        [shown_truth(row, LIMITS["exact"]) for row in report["exact"]],
    )
    print_table("Alignment and epipolar model alone, on exact ground points", report["geometry"])
    print_table(
        "Check points (label less measured disparity, px)",
        [
            {
                "scene": row["scene"],
                "points": str(row["points"]),
                "labelled": str(row["labelled"]),
                "median": pixels(row["median"], sign=True),
                "NMAD": pixels(row["nmad"]),
                "mean abs": pixels(row["mean_absolute"]),
                "on one surface: points": str(row["inner"]["count"]),
                "mean abs ": pixels(row["inner"]["mean_absolute"]),
                "y-parallax rms": pixels(row["y_parallax_rms"]),
                "y-parallax median": pixels(row["y_parallax_median"], sign=True),
            }
            for row in report["points"]
        ],
    )
    warped = []
    for row in report["warping"]:
        tiles = [float(t["correlation"]) for t in row["tiles"]]
        warped.append(
            {
                "scene": row["scene"],
                "pixels": str(row["pixels"]),
                "correlation": f"{row['correlation']:.4f}",
                "tiles": str(len(tiles)),
                "lowest of a tile": f"{min(tiles):.4f}" if tiles else "–",
            }
        )
    print_table("Left and warped right image, labelled pixels", warped)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--city", nargs="*", help="these cities only")
    parser.add_argument(
        "--configfile", nargs="*", type=Path, default=[], help="as given to snakemake"
    )
    parser.add_argument("--exact", action="store_true", help="again with noise-free GCPs (slow)")
    parser.add_argument("--tiles", action="store_true", help="a row for each tile")
    parser.add_argument("--surfaces", action="store_true", help="a row for each class of surface")
    parser.add_argument("--panels", type=Path, help="folder for pictures of warped tiles")
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        report = run(arguments)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    show(report)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
