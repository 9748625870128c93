"""Closure of the triplets of drawn sites, held against what is stated. See README.md beside this.

Sites are drawn by seed, all of their useful pairs are aligned, refined and labelled: once with the
corrections that the images have in common, and once with those of each pair by itself, whose
errors do not close. Files are kept in the folder: a run that was stopped is carried on.

python bench/closure.py --sites 1 3
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from label_tables import print_table
from site_alignment import SEED, SPACING_M, make_site, pairs_of, refined
from synthetic_pairs import VIEWS, rectify_by

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.site_adjustment import adjust_site
from stereotruth.alignment.site_pair import ScenePair, pair_alignment
from stereotruth.config.labels import LabelSettings
from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.epipolar.shown_ground import GroundOfImages
from stereotruth.evaluation.closure import PairFiles, closure_of_labels, figures, triplets_of
from stereotruth.lidar.point_store import open_stores
from stereotruth.products.files import atomic_folder
from stereotruth.products.provenance import source_digest
from stereotruth.simulate.sites import drawn_site
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell

CASES = ("joint", "separate")


def labelled(
    folder: Path, pair: ScenePair, alignment: Alignment, surface: Path, case: str
) -> PairFiles:
    """Files of a pair, rectified by an alignment and labelled on the surface of its site."""
    code = source_digest("disparity.project")
    made = folder / "labels" / f"{pair.scene}-{case}-{code[:8]}"
    if not made.is_dir():
        images = [folder / f"{name}.tif" for name in pair.names]
        stores = sorted((folder / "points").glob("*.points"))
        with atomic_folder(made) as scratch:
            rectify_by(alignment, images, scratch)
            rectified = (scratch / f"{view}.zarr" for view in VIEWS)
            inputs = SceneInputs.of(
                *rectified,
                stores,
                LabelSettings(),
                alignment=scratch / "alignment.json",
                surface=surface,
            )
            project_scene(inputs, scratch / "disparity.zarr", code=code)
    return PairFiles(
        pair.scene,
        *pair.names,
        made / "disparity.zarr",
        made / "alignment.json",
        pair.equations,
    )


def surface_of(folder: Path, images: Sequence[Path]) -> Path:
    """The surface of a site's points, as the workflow makes it for all of its images."""
    out = folder / f"site-{source_digest('surface.make_surface')[:8]}.surface"
    if not out.is_dir():
        ground = GroundOfImages.open(list(images))
        stores = open_stores(sorted((folder / "points").glob("*.points")))
        make_surface(stores, out, cell=ground_cell(ground.pixel_deg), ground=ground)
    return out


def pairs_by_case(number: int, options: argparse.Namespace) -> dict[str, list[PairFiles]]:
    """The labelled pairs of a site, by their alignment: of all images together, and separate."""
    site = drawn_site(number, SEED, images=options.images, side_px=options.side)
    folder = options.folder / f"{SEED}-{number}-{options.images}-{options.side}-{options.spacing:g}"
    folder.mkdir(parents=True, exist_ok=True)
    make_site(site, folder, options.spacing)
    chosen = [(pair.left, pair.right) for pair in pairs_of(site, folder, options.pairs)]
    pairs = [refined(folder, names, options.points) for names in chosen]
    surface = surface_of(folder, [folder / f"{image.name}.tif" for image in site.images])
    adjusted = adjust_site(site.city.name, pairs)
    found: dict[str, list[PairFiles]] = {case: [] for case in CASES}
    for pair in pairs:
        together = pair_alignment(adjusted, pair)
        if "refused" in together:
            continue
        alignments = Alignment.from_dict(together), Alignment.load(pair.alignment)
        for case, alignment in zip(CASES, alignments):
            found[case].append(labelled(folder, pair, alignment, surface, case))
    return found


def row_of(number: int | str, case: str, closures: np.ndarray, sigma: np.ndarray) -> list[str]:
    """A row of the table."""
    found: dict[str, Any] = figures(closures, sigma)
    return [
        str(number),
        case,
        str(found["count"]),
        f"{found['rms']:.4f}",
        f"{found['sigma_rms']:.4f}",
        f"{100 * found['within_1_sigma']:.1f}",
        f"{100 * found['within_2_sigma']:.1f}",
        f"{np.std(np.clip(closures / sigma, -5, 5)):.2f}",
    ]


def main() -> None:
    """Make the sites, label their pairs, and close their triplets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, nargs="+", default=[1, 3, 5], help="numbers of sites")
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--side", type=int, default=500, help="px of each image")
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--points", type=int, default=15, help="control points of a site")
    parser.add_argument("--spacing", type=float, default=SPACING_M, help="m, of LiDAR points")
    parser.add_argument("--folder", type=Path, default=Path("results/closure"))
    options = parser.parse_args()
    logging.basicConfig(level=logging.CRITICAL)
    rows, every = [], {case: [] for case in CASES}
    for number in options.sites:
        for case, pairs in pairs_by_case(number, options).items():
            parts = [closure_of_labels(triplet) for triplet in triplets_of(pairs)]
            if not parts:
                continue
            together = tuple(np.concatenate(values) for values in zip(*parts))
            every[case].append(together)
            rows.append(row_of(number, case, *together))
    for case, parts in every.items():
        if parts:
            rows.append(row_of("all", case, *(np.concatenate(values) for values in zip(*parts))))
    columns = ["site", "alignment", "pixels", "rms, px", "stated σ, px", "< 1 σ, %", "< 2 σ, %"]
    print_table("Closure of triplets", [*columns, "closure / σ, rms"], rows)


if __name__ == "__main__":
    main()
