"""Accuracy of what the workflow made: one command, one table. See README.md beside this file.

Synthetic scenes are compared with their exact truth, scenes with ``checkpoints.csv`` beside their
left image with these points; in all, the right image is warped to the left.
"""

from __future__ import annotations

import argparse
import json
import logging
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drawn_scenes import DENSITIES, NAMED, add_place, compare_drawn, compare_twin, place_given
from figures import draw_panels, evaluate_checkpoints, geometry_errors, print_records
from synthetic_pairs import label_by, labels_of

from stereocities.cities import CITIES
from stereotruth.align.align import align
from stereotruth.align.alignment import Alignment
from stereotruth.core import sheets
from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.section import merged
from stereotruth.core.errors import InputError
from stereotruth.core.numerics.statistics import LIMITS, ErrorSum
from stereotruth.core.products.files import read_table
from stereotruth.core.products.grids import require_complete
from stereotruth.core.status import carries_label
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate import labels_against_truth
from stereotruth.evaluate.epipolar_truth import write_grid_truth
from stereotruth.evaluate.labels_against_images import warp_scene
from stereotruth.project.project import read_mapping
from stereotruth.tiles.manifest import labelled_tiles
from stereotruth.tiles.tile_checks import warp_tile

PROJECT = Path(__file__).resolve().parents[1]
GOALS = (  # measure of exported tiles: key of a row, lowest, highest, factor to its unit
    ("visible labelled %", "visible", 98.5, None, 100),
    ("hidden labelled %", "hidden", None, 1.0, 100),
    ("mean abs px", "mean_abs", None, 0.08, 1),
    ("y-parallax rms px", "parallax", None, 0.04, 1),
    ("> 1 px %", "over_1px", None, 0.05, 100),
    ("|error| < uncertainty %", "below_1", 63.0, 73.0, 100),
    ("< 2 uncertainties %", "below_2", 92.0, 98.0, 100),
    ("in LiDAR only labelled %", "in_lidar_only", None, 5.0, 100),
    ("SIFT mean abs px, building", "sift_building", None, 0.32, 1),
)


def share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.2f} %"


def pixels(value: float | None, sign: bool = False) -> str:
    return "–" if value is None else f"{value:{'+' if sign else ''}.3f}"


def truth_row(name: str, comparison: labels_against_truth.Comparison) -> dict[str, Any]:
    row = labels_against_truth.table_row(name, comparison)
    return {
        "scope": name,
        "labels": row["labels"],
        "mean_abs": row["mean_absolute_px"],
        "median": row["median_px"],
        "rms": row["rms_px"],
        "nmad": row["nmad_px"],
        **{f"over_{limit:g}px": row[f"share_over_{limit:g}_px"] for limit in LIMITS},
        "visible": row["share_of_visible_labelled"],
        "hidden": row["share_of_hidden_labelled"],
        "in_lidar_only": row["share_of_in_lidar_only_labelled"],
        "in_images_only": row["share_of_in_images_only_labelled"],
        "parallax": row["y_parallax_rms_px"],
        "parallax_max": row["y_parallax_max_px"],
        "below_1": row["share_below_1_uncertainty"],
        "below_2": row["share_below_2_uncertainties"],
    }


def shown_truth(row: Mapping[str, Any]) -> dict[str, str]:
    return {
        "scope": row["scope"],
        "labels": str(row["labels"]),
        "mean abs px": pixels(row["mean_abs"]),
        "median": pixels(row["median"], sign=True),
        "rms": pixels(row["rms"]),
        "NMAD": pixels(row["nmad"]),
        **{f"> {limit:g} px": share(row[f"over_{limit:g}px"]) for limit in LIMITS},
        "visible labelled": share(row["visible"]),
        "hidden": share(row["hidden"]),
        "in LiDAR only": share(row["in_lidar_only"]),
        "in images only": share(row["in_images_only"]),
        "y-parallax rms px": pixels(row["parallax"]),
        "max": pixels(row["parallax_max"]),
        "< 1 uncertainty": share(row["below_1"]),
        "< 2": share(row["below_2"]),
    }


def goal_rows(cities: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """The measures asked for, by city; those that miss their limit are marked."""
    rows = []
    for measure, key, lowest, highest, factor in GOALS:
        limits = ((">=", lowest), ("<=", highest))
        bounds = [f"{sign} {limit:g}" for sign, limit in limits if limit is not None]
        row, missed = {"measure": measure, "limit": " and ".join(bounds)}, []
        for city in cities:
            value = None if city[key] is None else factor * city[key]
            kept = (
                value is not None
                and (lowest is None or value >= lowest)
                and (highest is None or value <= highest)
            )
            if not kept:
                missed.append(city["scope"])
            row[city["scope"]] = "–" if value is None else f"{value:.3f}{'' if kept else ' !'}"
        rows.append(row | {"missed (!)": ", ".join(missed) or "by none"})
    return rows


def status_rows(comparisons: Mapping[str, labels_against_truth.ByClass]) -> list[dict[str, str]]:
    """Where visible pixels without a label went, and which hidden ones have one: % of each."""
    rows = []
    for name, parts in comparisons.items():
        figures = parts.figures()
        pixels_of, labelled = figures["pixels"], figures["labelled"]

        def states(group: str, figures: Mapping[str, Any] = figures) -> str:
            found = figures["status"][group]
            total = max(sum(found.values()), 1)
            return ", ".join(
                f"{state} {100 * n / total:.2f}"
                for state, n in sorted(found.items(), key=lambda item: -item[1])
                if not carries_label(state)
            )

        def surfaces(group: str, has_label: bool, figures: Mapping[str, Any] = figures) -> str:
            total = max(figures["pixels"][group], 1)
            found = {
                kind: part["labelled"][group] - (0 if has_label else part["pixels"][group])
                for kind, part in figures["surfaces"].items()
                if kind != "water"
            }
            return ", ".join(f"{kind} {100 * abs(n) / total:.2f}" for kind, n in found.items() if n)

        lost = 100 * pixels_of["visible_lost"] / max(pixels_of["visible"], 1)
        bared = 100 * labelled["hidden_bared"] / max(pixels_of["hidden"], 1)
        rows += [
            {"city": name, "pixels": what, "%": values}
            for what, values in (
                ("visible, unlabelled by status", states("visible")),
                ("visible, unlabelled by surface", surfaces("visible", False)),
                (f"{lost:.2f} % behind a building in the LiDAR only", states("visible_lost")),
                ("hidden, labelled by surface", surfaces("hidden", True)),
                ("behind a building in the images only, labelled", f"{bared:.2f}"),
                ("in LiDAR only, masked by status", states("in_lidar_only")),
                ("in images only, masked by status", states("in_images_only")),
            )
        ]
    return rows


def calibration_rows(
    comparisons: Mapping[str, labels_against_truth.ByClass],
) -> list[dict[str, str]]:
    """Calibration of the uncertainty by class and by decile of the uncertainty."""
    rows = []
    for city, parts in comparisons.items():
        figures = parts.figures()
        scopes = {"all": figures["calibration"]}
        scopes |= {kind: part["calibration"] for kind, part in figures["surfaces"].items()}
        scopes |= {f"decile {k}": d for k, d in enumerate(figures["calibration"]["deciles"], 1)}
        rows += [
            {
                "city": city,
                "scope": scope,
                "labels": str(values["count"]),
                "mean uncertainty px": pixels(values["mean_uncertainty"]),
                "rms error": pixels(values["rms_error"]),
                "< 1 uncertainty": share(values["share_below_1"]),
                "< 2": share(values["share_below_2"]),
            }
            for scope, values in scopes.items()
            if values["count"]
        ]
    return rows


def table4(city: str) -> list[dict[str, str]]:
    """Rows of the city's table 4, as ``snakemake evaluate`` wrote them; none if it did not."""
    file = Path(f"results/evaluate/{city}/table4.csv")
    if not file.is_file():
        return []
    return list(read_table(file))


def geometry_row(scene: str, alignment: str, model: EpipolarModel, store: Path) -> dict[str, str]:
    return error_row(scene, alignment, *geometry_errors(model, store))


def error_row(scene: str, alignment: str, *sums: ErrorSum) -> dict[str, str]:
    """Errors of an alignment: of disparity, and the y-parallax."""
    disparity, parallax = (e.figures() for e in sums)
    return {
        "scene": scene,
        "alignment": alignment,
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
        self.points = sorted(Path(f"results/ingest/{place}").glob("*.points"))
        self.aligned = Path(f"results/align/{place}/alignment.json")
        self.refined = Path(f"results/refine/{place}/alignment.json")
        self.exact = Path(f"results/accuracy/{place}")

    @property
    def has_truth(self) -> bool:
        place = Path("data/synthetic") / self.scene.city / self.scene.scene
        return self.scene.city in CITIES and self.input == place

    def before(self, model: EpipolarModel) -> EpipolarModel:
        """The epipolar model by the ground control points alone; ``model``: the one in use."""
        aligned = Alignment.read(self.aligned)
        sizes = model.left_size, model.right_size
        return fit_epipolar(aligned.left, aligned.right, *sizes, aligned.reference_height)

    def truth(self, folder: Path, disparity: Path, workers: int) -> Path:
        """The truth on the grid of a disparity store: the workflow's, or made in ``folder``."""
        store = Path(f"results/truth/{self.scene.city}/{self.scene.scene}.zarr")
        epipolar = require_complete(disparity).attrs["epipolar"]
        for made in (store, folder / "truth.zarr"):
            if made.is_dir() and require_complete(made).attrs["epipolar"] == epipolar:
                return made
        city = CITIES[self.scene.city]
        EpipolarModel.from_dict(epipolar).save(folder / "truth.json")
        scene = city.scene(self.scene.scene)
        write_grid_truth(city, scene, folder / "truth.json", folder / "truth.zarr", workers=workers)
        return folder / "truth.zarr"


def with_exact_gcps(made: Made, folder: Path, config: Configuration, workers: int) -> Path:
    """Align with noise-free GCPs, rectify and project again; the disparity store."""
    scene = made.scene
    shutil.rmtree(folder, ignore_errors=True)
    aligned = align(
        scene.left_image,
        scene.right_image,
        made.input / "gcps_exact.csv",
        model=config.alignment.model,
        scene=scene.scene,
    )
    folder.mkdir(parents=True)
    images = scene.left_image, scene.right_image
    return label_by(aligned, images, made.points, folder, labels_of(config), workers=workers)


def panels(made: Made, folder: Path, count: int) -> list[dict[str, str]]:
    """Correlation of each exported tile; pictures of the first ``count``."""
    if not (made.tiles / "manifest.csv").is_file():
        return []
    found = []
    for k, of in enumerate(labelled_tiles(made.tiles, made.scene.scene)):
        tile = warp_tile(made.tiles, of.row)
        found.append({"tile": tile.name, "correlation": f"{tile.correlation:.4f}"})
        if k < count:
            draw_panels(tile, folder / f"{tile.name}.png")
    return found


def read_config(files: Sequence[Path]) -> Configuration:
    """The defaults with the keys of files in place of theirs."""
    values: dict[str, Any] = {}
    for file in files:
        values = merged(values, read_mapping(file))
    return Configuration.of(values)


def scenes_made(config: Configuration, only: Sequence[str] | None) -> list[Made]:
    """The scenes of the sheet, of these cities or of all, that the workflow has made."""
    cities = sheets.read_cities(config.cities)
    scenes = sheets.read_scenes(config.scenes, cities)
    present = []
    for made in (Made(s) for s in scenes.values() if not only or s.city in only):
        if made.disparity.is_dir():
            present.append(made)
        else:
            print(f"{made.scene.scene}: not made yet ({made.disparity} is missing)")
    return present


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    config = read_config(arguments.configfile)
    report: dict[str, Any] = {"truth": [], "exact": [], "geometry": [], "points": [], "warping": []}
    by_city: dict[str, labels_against_truth.SceneComparison] = {}
    cities = []
    for made in scenes_made(config, arguments.city):
        name = made.scene.scene
        cities.append(made.scene.city)
        if made.has_truth:
            raw = made.input / "truth.zarr"
            tiles = made.tiles if (made.tiles / "manifest.csv").is_file() else None
            true = made.truth(made.exact, made.disparity, arguments.workers)
            result = labels_against_truth.compare_scene(
                made.disparity, true, tiles, scene=name, workers=arguments.workers
            )
            for scope, parts in (("scene", result.whole), ("tiles", result.all_tiles)):
                if parts.parts:
                    report["truth"].append(truth_row(f"{name} {scope}", parts.total))
                if arguments.surfaces:
                    report["truth"] += [truth_row(f"  {k}", parts.parts[k]) for k in parts.classes]
            if arguments.tiles:
                report["truth"] += [truth_row(f"  {t}", c) for t, c in result.tiles.items()]
            by_city.setdefault(
                made.scene.city, labels_against_truth.SceneComparison(made.scene.city)
            ).merge(result)
            model = EpipolarModel.from_dict(require_complete(made.disparity).attrs["epipolar"])
            if not raw.is_dir():
                print(f"{name}: for the alignment alone, make {raw} (snakemake --cores 2 {raw})")
            elif made.refined.is_file() and config.alignment.refine:
                report["geometry"].append(geometry_row(name, "GCPs", made.before(model), raw))
            if raw.is_dir():
                report["geometry"].append(geometry_row(name, "as used", model, raw))
        if made.has_truth and arguments.exact:
            folder = made.exact / "noise-free"
            exact = with_exact_gcps(made, folder, config, arguments.workers)
            true = made.truth(folder, exact, arguments.workers)
            result = labels_against_truth.compare_scene(
                exact, true, None, scene=name, workers=arguments.workers
            )
            report["exact"].append(truth_row(f"{name} scene", result.whole.total))
            model = EpipolarModel.from_dict(require_complete(exact).attrs["epipolar"])
            if raw.is_dir():
                report["geometry"].append(geometry_row(name, "noise-free GCPs", model, raw))
        if (made.input / "checkpoints.csv").is_file():
            figures = evaluate_checkpoints(
                made.disparity, made.input / "checkpoints.csv", scene=name
            )
            report["points"].append({"scene": name, **figures})
        sums = warp_scene(made.left, made.right, made.disparity).sums
        warped = {"pixels": sums.count, "correlation": round(sums.coefficient, 6)}
        tiles_warped = panels(made, arguments.panels or Path(), 2 if arguments.panels else 0)
        report["warping"].append({"scene": name, **warped, "tiles": tiles_warped})
    settings = labels_of(config)
    place = place_given(arguments)
    more = [(compare_drawn, name) for name in arguments.drawn]
    more += [] if place is None else [(compare_twin, place)]
    for compare, of in more:
        for density in DENSITIES:
            drawn = compare(of, density, settings, arguments.workers)
            by_city[drawn.name] = drawn.labels
            report["truth"].append(truth_row(f"{drawn.name} scene", drawn.labels.whole.total))
            report["geometry"] += [
                error_row(drawn.name, word, *sums) for word, sums in drawn.alignments.items()
            ]
    parts = {c: r.all_tiles if r.tiles else r.whole for c, r in by_city.items()}
    report["cities"] = [truth_row(city, part.total) for city, part in parts.items()]
    report["table4"] = [row for city in dict.fromkeys(cities) for row in table4(city)]
    absolute = {
        row["city"]: row["mean_of_mean_absolute_disparity_errors_px"] for row in report["table4"]
    }
    for row in report["cities"]:
        value = absolute.get(f"{row['scope']} (building)")
        row["sift_building"] = float(value) if value else None
    report["goals"] = goal_rows(report["cities"])
    report["status"] = status_rows(parts)
    report["calibration"] = calibration_rows(parts)
    return report


def show(report: Mapping[str, Any]) -> None:
    print_records("Labels against the exact truth", [shown_truth(row) for row in report["truth"]])
    print_records("The same, tiles by city", [shown_truth(row) for row in report["cities"]])
    print_records("With noise-free GCPs", [shown_truth(row) for row in report["exact"]])
    print_records("Where labels are missing or wrong, tiles by city", report["status"])
    print_records("Calibration of the uncertainty, tiles by city", report["calibration"])
    print_records("Alignment and epipolar model alone, on exact ground points", report["geometry"])
    print_records(
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
    print_records("Left and warped right image, labelled pixels", warped)
    print_records("SIFT matches (table 4; by snakemake evaluate)", report["table4"])
    print_records("What is asked for, tiles by city", report["goals"])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--city", nargs="*", help="these cities only")
    parser.add_argument(
        "--drawn", nargs="+", choices=list(NAMED), default=[], help="and these, which no sheet has"
    )
    parser.add_argument(
        "--configfile", nargs="*", type=Path, default=[], help="as given to snakemake"
    )
    add_place(parser)
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
