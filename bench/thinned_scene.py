"""Labels of a scene with check points from every n-th of its LiDAR points. See README.md.

The whole way from LAZ to labels, refinement included, sees the points that are left.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import laspy
import numpy as np
from checkpoints import evaluate_checkpoints
from label_tables import print_table, shown
from synthetic_pairs import VIEWS, rectify_pair

from stereotruth.config.labels import LabelSettings
from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest
from stereotruth.products.files import atomic_folder
from stereotruth.products.provenance import source_digest


def thinned(scene: Path, every: int, folder: Path) -> list[Path]:
    """Point stores of every n-th point, made once."""
    made = folder / f"every_{every}"
    if not made.is_dir():
        with atomic_folder(made) as scratch:
            for file in sorted((scene / "lidar").glob("*.la[sz]")):
                points = laspy.read(file)
                points.points = points.points[np.arange(0, len(points), every)]
                points.write(scratch / file.name)
                ingest(scratch / file.name, scratch / f"{file.stem}.points")
                (scratch / file.name).unlink()
    return sorted(made.glob("*.points"))


def rectified(scene: Path, stores: list[Path], folder: Path) -> Path:
    """The folder of the rectified pair, aligned by control points and these points."""
    made = folder / "rectified"
    if not made.is_dir():
        images = [scene / f"{view}.tif" for view in VIEWS]
        with atomic_folder(made) as scratch:
            rectify_pair(images, scene / "gcps.csv", stores, scratch)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="left.tif, right.tif, two CSV files, lidar/")
    parser.add_argument("--every", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--recipe", nargs="+", choices=("surface", "paper"), default=["surface"])
    parser.add_argument("--folder", type=Path, default=Path("results/thinned_scene"))
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    rows = []
    for every in options.every:
        stores = thinned(options.scene, every, options.folder)
        pair = rectified(options.scene, stores, options.folder / f"every_{every}_pair")
        for recipe in options.recipe:
            store = options.folder / f"every_{every}_{recipe}.zarr"
            images = (pair / f"{view}.zarr" for view in VIEWS)
            settings, alignment = LabelSettings(recipe=recipe), pair / "alignment.json"
            inputs = SceneInputs.of(*images, stores, settings, alignment=alignment)
            inputs = inputs.with_surface(pair)
            project_scene(inputs, store, code=source_digest("disparity.project"))
            f = evaluate_checkpoints(store, options.scene / "checkpoints.csv")
            share = 100.0 * f["labelled"] / f["points"]
            cells = [f"{f['median']:+.3f}", f"{f['nmad']:.3f}", f"{f['y_parallax_rms']:.3f}"]
            rows.append([str(every), recipe, shown([share]), *cells])
    columns = ["every", "recipe", "check points labelled, %", "median, px", "NMAD, px"]
    print_table("Labels less check points", [*columns, "y-parallax rms, px"], rows)


if __name__ == "__main__":
    main()
