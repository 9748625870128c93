"""What a run takes and how many pixels get a label: the figures that `stereotruth check` goes by.

Measured on fresh synthetic pairs, in seconds of one core, and written to the package
(``src/stereotruth/command/estimates.json``), which holds no other copy. See README.md beside this.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from labelled_block import Block
from synthetic_pairs import SEED, Pair, fresh_pair, label_by, rectify_by

from stereotruth.alignment.align import align
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.refine import refine
from stereotruth.command.check_tiles import pixel_m2
from stereotruth.dataset.export import City, export_city
from stereotruth.dataset.scene_stores import SceneFiles, open_stores
from stereotruth.dataset.settings import Settings as Tiles
from stereotruth.dataset.windows import scan_scene
from stereotruth.disparity.settings import Settings
from stereotruth.disparity.status import is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluation.labels_against_truth import WATER
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.products.grids import open_grid
from stereotruth.simulate.cities import lidar_files
from stereotruth.simulate.control_points import simulate_points

PROJECT = Path(__file__).resolve().parents[1]
TABLE = PROJECT / "src/stereotruth/command/estimates.json"
DENSITIES = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 6.0)  # points/m²
MIDDLE_PX = 1024
RECIPES = ("paper", "surface")
START = "import snakemake.cli, stereotruth.disparity.project, stereotruth.products.atomic_outputs"


def seconds(work: Callable[[], Any]) -> float:
    """Seconds of one core that work takes once all is compiled."""
    work()
    start = time.process_time()
    work()
    return time.process_time() - start


def size(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def labelled(
    pair: Pair, rectified: Path, asked: Sequence[float]
) -> tuple[dict[str, list[float]], tuple[float, float]]:
    """Share of the visible pixels with a label by density and recipe, and what labels take.

    That is seconds for each pixel and for each point. In the middle of the grid, all of which both
    images show and LiDAR covers; water, which has no labels, does not count.
    """
    model = EpipolarModel.load(rectified / "epipolar.json")
    starts = ((side - MIDDLE_PX) // 2 for side in model.shape)
    block = Block(pair, rectified, *(slice(start, start + MIDDLE_PX) for start in starts))
    area = pixel_m2(model)
    densities = [min(d, block.density) for d in asked]
    found: dict[str, list[float]] = {"points_per_px": [round(d * area, 3) for d in densities]}
    visible, took = block.truth.groups()["visible"] & (block.truth.kind != WATER), []
    for recipe in RECIPES:
        shares = []
        for density in densities:
            job = block.job(density, recipe)
            block.compile(job)
            start = time.process_time()
            status = block.labels(job)["status"]
            if recipe == "surface":
                took.append((time.process_time() - start, density * area * status.size))
            shares.append(round(float(is_labelled(status)[visible].mean()), 3))
        found[recipe] = shares
        print(recipe, *zip(densities, shares), flush=True)
    cost, points = np.transpose(took)
    per_point, fixed = np.polyfit(points, cost, 1)
    return found, (fixed / block.surface.size, max(per_point, 0.0))


def measured(pair: Pair, folder: Path, densities: Sequence[float]) -> dict[str, Any]:
    """All figures, of one pair."""
    folder.mkdir(parents=True, exist_ok=True)
    images = [pair.data / f"{view}.tif" for view in ("left", "right")]
    tables = [folder / f"{name}.csv" for name in ("gcps", "gcps_exact", "checkpoints")]
    simulate_points(pair.city, pair.spec, *tables, seed=SEED)
    start = align(*images, tables[0])
    refined: list[Alignment] = []
    of_scene = seconds(lambda: refined.append(refine(start, *images, pair.points)[0]))
    alignment = refined[-1]
    file = pair.data / "lidar" / lidar_files(pair.city, pair.spec)[0]
    of_ingest = seconds(lambda: ingest(file, folder / "again.points"))
    count = PointStore(folder / "again.points").count
    of_rectify = seconds(lambda: rectify_by(alignment, images, folder))
    shares, (of_pixel, of_point) = labelled(pair, folder, densities)
    grid = label_by(alignment, images, pair.points, folder, Settings())
    pixels = open_grid(grid)["status"].size
    scene = SceneFiles(pair.name, grid, folder / "left.zarr", folder / "right.zarr")
    city = City(pair.city.name, "FR", 6, 1, 3)
    tiles, settings = folder / "tiles", Tiles(size=256, min_labelled=0.3, seed=1)
    work = folder / "none"

    def export() -> None:
        export_city(city, [scene], tiles, settings, work=work / str(time.monotonic_ns()))

    of_scan = seconds(lambda: scan_scene(open_stores(scene), 32, 1))
    of_export = seconds(export)
    done = subprocess.run([sys.executable, "-X", "importtime", "-c", START], capture_output=True)
    of_start = 1e-6 * float(done.stderr.decode().split("|")[-2])
    stores = (folder / f"{name}.zarr" for name in ("left", "right", "disparity"))
    return {
        "seconds": {
            "ingest_point": of_ingest / count,
            "rectify_px": of_rectify / pixels,
            "project_px": of_pixel,
            "project_point": of_point,
            "scan_px": of_scan / pixels,
            "tile_px": max(of_export - of_scan, 0.0) / pixels,
            "scene": of_scene,
            "job": of_start,
        },
        "bytes": {
            "point": size(folder / "again.points") / count,
            "px": (sum(map(size, stores)) + size(tiles)) / pixels,
        },
        "labelled": shares,
    }


def rounded(values: Any) -> Any:
    """Rates with three digits."""
    if isinstance(values, dict):
        return {name: rounded(value) for name, value in values.items()}
    return [rounded(v) for v in values] if isinstance(values, list) else float(f"{values:.3g}")


def main() -> None:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=PROJECT / "bench/out/estimates")
    parser.add_argument(
        "--cities",
        type=int,
        nargs="+",
        default=[1, 2, 3],
        help="numbers of the fresh cities; times are of the first, labels of all",
    )
    parser.add_argument("--densities", type=float, nargs="+", default=DENSITIES)
    parser.add_argument("--out", type=Path, default=TABLE)
    arguments = parser.parse_args()
    of_cities = []
    for city in arguments.cities:
        pair = fresh_pair(city, arguments.folder)
        of_cities.append(measured(pair, arguments.folder / f"made_{city}", arguments.densities))
    labels = [of["labelled"] for of in of_cities]
    mean = {name: np.mean([of[name] for of in labels], axis=0).tolist() for name in labels[0]}
    table = rounded(of_cities[0] | {"labelled": mean})
    arguments.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    print(arguments.out.read_text())


if __name__ == "__main__":
    main()
