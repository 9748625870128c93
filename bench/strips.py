"""Strips of a LiDAR that disagree: how well offsets are found, and what labels state of them.

Cities are drawn, flown in four strips that are off by centimetres in height and decimetres in plan,
labelled as they are (``named``) and with the points moved (``adjusted``), and compared with their
exact truth. See README.md beside this file.

python bench/strips.py --folder results/strips_bench --cities 2 3
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr
from scipy.ndimage import binary_dilation
from synthetic_pairs import SEED, VIEWS, label_by

from stereotruth.alignment.align import align
from stereotruth.alignment.refine import refine
from stereotruth.config.labels import LabelSettings
from stereotruth.evaluation.epipolar_truth import write_grid_truth
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.strip_comparison import compare_strips
from stereotruth.lidar.strip_moves import move_strips
from stereotruth.simulate.cities import (
    CitySpec,
    FlightStrip,
    Jitter,
    ViewSpec,
    lidar_files,
    training_city,
)
from stereotruth.simulate.control_points import simulate_points
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.render import simulate_image

OFFSETS_M = (0.31, 0.0, 0.07), (-0.2, 0.25, -0.06), (0.1, -0.33, 0.09), (-0.25, -0.15, -0.08)
DENSITIES = 10.6, 2.6, 5.0, 4.0  # points/m²
EDGE_PX = 4  # from edges of truth: ground beyond is judged
GROUND = 1


def drawn(number: int, side_px: int, jitter_px: float) -> CitySpec:
    """A city of one scene, flown in strips, whose images may jitter."""
    city = training_city(number, SEED, side_px)
    scene = replace(city.scenes[0], name="Strips", lidar_grid=(1, 2))
    strips = tuple(FlightStrip(o, d**-0.5) for o, d in zip(OFFSETS_M, DENSITIES))
    view = ViewSpec(jitter=Jitter(jitter_px)) if jitter_px else ViewSpec()
    return replace(city, name="Strips", scenes=(scene,), strips=strips, left=view, right=view)


def make(city: CitySpec, folder: Path) -> tuple[list[Path], list[Path]]:
    """Images and point stores of a city, and its control points, in a folder."""
    scene = city.scenes[0]
    images = [folder / f"{view}.tif" for view in VIEWS]
    for view, image in zip(VIEWS, images):
        simulate_image(city, scene, view, image, seed=SEED)
    tables = (folder / f"{name}.csv" for name in ("gcps", "gcps_exact", "checkpoints"))
    simulate_points(city, scene, *tables, seed=SEED)
    stores = []
    for file in lidar_files(city, scene):
        simulate_lidar_tile(city, scene, file, folder / file, seed=SEED)
        stores.append(folder / "named" / f"{Path(file).stem}.points")
        ingest(folder / file, stores[-1])
    return images, stores


def judge(folder: Path) -> dict[str, float]:
    """Errors (px) of the labels of ground beyond EDGE_PX of edges, and shares within 1 and 2 σ."""
    made, truth = zarr.open(folder / "disparity.zarr"), zarr.open(folder / "truth.zarr")
    error = made["disparity"][:] - truth["disparity"][:]
    sigma = made["uncertainty"][:]
    use = (truth["visible"][:] == 1) & (truth["changed"][:] == 0) & np.isfinite(error)
    use &= truth["surface"][:] == GROUND
    use &= ~binary_dilation(truth["edge"][:] > 0, iterations=EDGE_PX)
    error, sigma = error[use], sigma[use]
    return {
        "labels": error.size,
        "mean": float(error.mean()),
        "rms": float(np.sqrt((error**2).mean())),
        "sigma": float(np.median(sigma)),
        **{f"within_{k}_sigma": float((np.abs(error) < k * sigma).mean()) for k in (1, 2)},
    }


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=Path("results/strips_bench"))
    parser.add_argument("--cities", type=int, nargs="+", default=[2, 3], help="drawn by number")
    parser.add_argument("--side", type=int, default=800, help="px of the left image")
    parser.add_argument("--jitter", type=float, default=0.0, help="px rms of both attitudes")
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    for number in given.cities:
        city = drawn(number, given.side, given.jitter)
        folder = given.folder / f"{number}-{given.side}-{given.jitter:g}"
        folder.mkdir(parents=True, exist_ok=True)
        images, stores = make(city, folder)
        found = compare_strips([PointStore(store) for store in stores])
        of = {int(strip.name) - 1: np.array(strip.offset_m) for strip in found.strips}
        reference = int(found.strips[0].name) - 1
        for k, offset in sorted(of.items()):
            miss = offset - np.subtract(OFFSETS_M[k], OFFSETS_M[reference])
            plan, up = 100 * np.hypot(*miss[:2]), 100 * miss[2]
            print(f"city {number}, strip {k + 1}: {plan:.1f} cm in plan, {up:+.1f} cm in height")
        moved = [folder / "adjusted" / store.name for store in stores]
        for store, out in zip(stores, moved):
            move_strips(store, found, out)
        for name, points in (("named", stores), ("adjusted", moved)):
            out = folder / f"labels_{name}"
            out.mkdir(exist_ok=True)
            alone = align(*images, folder / "gcps.csv", provenance={})
            alignment, _ = refine(alone, *images, points, provenance={})
            label_by(alignment, images, points, out, LabelSettings(), workers=given.threads)
            truth = out / "epipolar.json", out / "truth.zarr"
            write_grid_truth(city, city.scenes[0], *truth, workers=given.threads)
            print(f"city {number}, {name}:", {k: round(v, 4) for k, v in judge(out).items()})


if __name__ == "__main__":
    main()
