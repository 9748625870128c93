"""Sites that are drawn by seed: how right their alignments are. See README.md beside this file.

``alignment``: the joint adjustment of a site's images against pairs that are refined one by one, by
what either makes of exact places in each image. ``closure``: whether triplets of images close as is
stated, with the corrections that the images have in common and with those of each pair by itself.
Images are paired as ``stereotruth pairs`` chooses. Files stay in the folder: a run that was stopped
is carried on.

python bench/sites.py alignment --sites 3
python bench/sites.py closure --sites 1 3
"""

from __future__ import annotations

import argparse
import csv
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from figures import print_table
from synthetic_pairs import VIEWS, far_apart, fly, rectify_by

from stereocities.sites import (
    SiteSpec,
    drawn_site,
    image_truth,
    pair_truth,
    simulate_site_image,
    simulate_site_points,
)
from stereotruth.align.adjustment import epipolar_model
from stereotruth.align.align import align, from_rpcs
from stereotruth.align.alignment import Alignment
from stereotruth.align.images import open_view
from stereotruth.align.records import ScenePair, pair_alignment, write_equations
from stereotruth.align.refine import refine
from stereotruth.align.site_adjustment import adjust_site
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_folder, write_table
from stereotruth.core.products.provenance import source_digest
from stereotruth.evaluate.closure import PairFiles, closure_of_labels, figures, triplets_of
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.pair_geometry import GroundOfImages
from stereotruth.sensor.rpc import SensorModel
from stereotruth.sensor.site_pairs import SiteImage, SitePair, pairs_of_site, quality_of
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell

SEED = 2030
SPACING_M = 0.5  # of the LiDAR's points

# Closure.
CASES = ("joint", "separate")


def site_folder(site: SiteSpec, number: int, options: argparse.Namespace) -> Path:
    """The folder of a site's images, point stores and control points, made once."""
    key = f"{SEED}-{number}-{options.images}-{options.side}-{options.spacing:g}"
    folder = options.folder / key
    folder.mkdir(parents=True, exist_ok=True)
    for image in site.images:
        made = folder / f"{image.name}.tif"
        if not made.is_file():
            simulate_site_image(site, image, made, seed=SEED)
    if not (folder / "points").is_dir():
        with atomic_folder(folder / "points") as scratch:
            fly(site.city, site.area, scratch, SEED, options.spacing)
    simulate_site_points(site, folder / "gcps.csv", folder / "exact.csv", seed=SEED)
    return folder


def pairs_of(site: SiteSpec, folder: Path, most: int) -> list[SitePair]:
    """The best pairs, as ``stereotruth pairs --most`` chooses them, in the order of their names."""
    images = []
    for image in site.images:
        sensor, size = open_view("site's", folder / f"{image.name}.tif", "")
        images.append(SiteImage(image.name, sensor, size, image.acquired, image.sun_deg))
    found = [pair for pair in pairs_of_site(images) if 5.0 <= pair.convergence <= 45.0]
    best = sorted(found, key=lambda pair: -quality_of(pair).matched)[:most]
    return sorted(best, key=lambda pair: (pair.left, pair.right))


def some_points(folder: Path, count: int, table: str = "gcps") -> Path:
    """Control points: the ``count`` that most images show, far from each other.

    ``table``: ``gcps`` as measured, ``exact`` without their noise.
    """
    with (folder / f"{table}.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    ids = sorted({row["id"] for row in rows})
    seen = {name: sum(row["id"] == name for row in rows) for name in ids}
    often = [name for name in ids if seen[name] >= 0.8 * max(seen.values())]
    place = {row["id"]: (float(row["lon"]), float(row["lat"])) for row in rows}
    at = np.array([place[name] for name in often])
    at *= np.cos(np.radians(at[:, 1].mean())), 1.0
    kept = set(ids) if count >= len(ids) else {often[k] for k in far_apart(at, count)}
    file = folder / f"{table}_{count}.csv"
    write_table(file, [row for row in rows if row["id"] in kept])
    return file


def exact_places(site: SiteSpec, name: str, step: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """(col, row) px [n, 2] of an image and (lon, lat, height) [n, 3] that they show, exactly."""
    image = site.image(name)
    grid = np.meshgrid(np.arange(6, image.cols, step), np.arange(6, image.rows, step))
    at = np.stack([axis.ravel().astype(float) for axis in grid], axis=1)
    truth = image_truth(site, image, *at.T)
    ground = np.stack([truth[layer] for layer in ("lon", "lat", "height")], axis=1)
    known = np.isfinite(ground).all(axis=1)
    return at[known], ground[known]


def error_px(sensor: SensorModel, places: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square error px of a coordinate, of exact places in an image."""
    at, ground = places
    return float(np.sqrt(np.mean((np.stack(sensor.project(*ground.T), axis=1) - at) ** 2)))


def label_error_px(
    site: SiteSpec, names: tuple[str, str], alignment: Alignment, places: np.ndarray
) -> float:
    """Mean absolute error px of the disparity of exact places [n, 2] that both images show."""
    model = epipolar_model(alignment)
    truth = pair_truth(site, *(site.image(name) for name in names), *places.T)
    seen = truth["visible_right"] > 0
    ground = [truth[layer][seen] for layer in ("lon", "lat", "height")]
    left = model.left_to_epipolar(*alignment.left.project(*ground))[0]
    right = model.right_to_epipolar(*alignment.right.project(*ground))[0]
    exact = model.left_to_epipolar(*places[seen].T)[0]
    exact = exact - model.right_to_epipolar(truth["right_col"][seen], truth["right_row"][seen])[0]
    return float(np.mean(np.abs(left - right - exact)))


def refined(folder: Path, names: tuple[str, str], count: int) -> ScenePair:
    """Files of a pair, aligned and refined by itself as the workflow does for a site."""
    gcps = some_points(folder, count)
    scene = f"{names[0]}_{names[1]}"
    made = folder / "pairs" / f"{scene}-{count}-{source_digest('stereotruth.align.refine')[:8]}"
    pair = ScenePair(scene, *names, made / "alignment.json", made / "equations.json", gcps)
    if not made.is_dir():
        files = [folder / f"{name}.tif" for name in names]
        try:
            start = align(*files, gcps, names=names, provenance={})
        except InputError:
            start = from_rpcs(*files, provenance={})
        stores = sorted((folder / "points").glob("*.points"))
        alignment, seen = refine(start, *files, stores, alone=False, provenance={})
        with atomic_folder(made) as scratch:
            alignment.save(scratch / "alignment.json")
            ties = seen.of_images if seen else None
            write_equations(scratch / "equations.json", ties, alignment.refinement["reason"])
    return pair


def sensors_of(site: dict[str, Any], pairs: list[ScenePair]) -> dict[str, Alignment]:
    """Alignments by scene of what was adjusted, of the pairs that are not refused."""
    found = {pair.scene: pair_alignment(site, pair) for pair in pairs}
    return {
        scene: Alignment.from_dict(record)
        for scene, record in found.items()
        if "refused" not in record
    }


def by_image(pairs: list[ScenePair], alignments: dict[str, Alignment], places: dict) -> dict:
    """Errors px of each image in all of its pairs."""
    found: dict[str, list[float]] = {}
    for pair in pairs:
        if alignment := alignments.get(pair.scene):
            for name, sensor in zip(pair.names, (alignment.left, alignment.right)):
                found.setdefault(name, []).append(error_px(sensor, places[name]))
    return found


def of_site(number: int, options: argparse.Namespace) -> list[list[str]]:
    """Rows of a site: one per count of control points."""
    site = drawn_site(number, SEED, images=options.images, side_px=options.side)
    folder = site_folder(site, number, options)
    chosen = [(pair.left, pair.right) for pair in pairs_of(site, folder, options.pairs)]
    places = {image.name: exact_places(site, image.name) for image in site.images}
    rows = []
    for count in (15, 4):
        pairs = [refined(folder, names, count) for names in chosen]
        alone = {pair.scene: Alignment.read(pair.alignment) for pair in pairs}
        adjusted = adjust_site(site.city.name, pairs)
        together = sensors_of(adjusted, pairs)
        noiseless = some_points(folder, count, table="exact")
        without_noise = adjust_site(site.city.name, [replace(p, gcps=noiseless) for p in pairs])
        by_exact = by_image(pairs, sensors_of(without_noise, pairs), places)
        single, joint = by_image(pairs, alone, places), by_image(pairs, together, places)
        errors = {name: values[0] for name, values in joint.items()}
        labels = [
            [
                label_error_px(site, pair.names, alignments[pair.scene], places[pair.left][0])
                for pair in pairs
            ]
            for alignments in (alone, together)
        ]
        error = float(np.mean(list(errors.values())))
        best, usual = (
            float(np.mean([of(values) for values in single.values()])) for of in (min, np.median)
        )
        sigma = np.mean([adjusted["images"][name]["sigma"] for name in errors])
        exact = np.mean([values[0] for values in by_exact.values()])
        doubted = sum(bool(image["doubts"]) for image in adjusted["images"].values())
        rows.append([
            str(number), str(count), f"{best:.3f}", f"{usual:.3f}", f"{error:.3f}",
            f"{error / best:.2f}", f"{sigma:.3f}", f"{exact:.3f}",
            *(f"{np.mean(of_labels):.4f}" for of_labels in labels), str(doubted),
        ])  # fmt: skip
        print(*rows[-1], flush=True)
    return rows


def compare_alignments(options: argparse.Namespace) -> None:
    """errors of the joint adjustment and of pairs"""
    columns = ["site", "control points", "best pair", "usual pair", "joint", "joint / best",
               "stated σ", "exact points", "labels: pairs", "labels: joint",
               "images doubted"]  # fmt: skip
    title = "Error at exact places per image, px of a coordinate; of labels, mean absolute px"
    print_table(title, columns, [row for k in options.sites for row in of_site(k, options)])


# ------------------------------------------------------------------------------- closure


def labelled(
    folder: Path, pair: ScenePair, alignment: Alignment, surface: Path, case: str
) -> PairFiles:
    """Files of a pair, rectified by an alignment and labelled on the surface of its site."""
    code = source_digest("stereotruth.labels.project")
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
    out = folder / f"site-{source_digest('stereotruth.surface.make_surface')[:8]}.surface"
    if not out.is_dir():
        ground = GroundOfImages.open(list(images))
        stores = open_stores(sorted((folder / "points").glob("*.points")))
        make_surface(stores, out, cell=ground_cell(ground.pixel_deg), ground=ground)
    return out


def pairs_by_case(number: int, options: argparse.Namespace) -> dict[str, list[PairFiles]]:
    """The labelled pairs of a site, by their alignment: of all images together, and separate."""
    site = drawn_site(number, SEED, images=options.images, side_px=options.side)
    folder = site_folder(site, number, options)
    chosen = [(pair.left, pair.right) for pair in pairs_of(site, folder, options.pairs)]
    pairs = [refined(folder, names, options.points) for names in chosen]
    surface = surface_of(folder, [folder / f"{image.name}.tif" for image in site.images])
    adjusted = adjust_site(site.city.name, pairs)
    found: dict[str, list[PairFiles]] = {case: [] for case in CASES}
    for pair in pairs:
        together = pair_alignment(adjusted, pair)
        if "refused" in together:
            continue
        alignments = Alignment.from_dict(together), Alignment.read(pair.alignment)
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


def close_triplets(options: argparse.Namespace) -> None:
    """how triplets close, and what is stated"""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = parser.add_subparsers(required=True)
    for name, run, sites, images, side, pairs in (
        ("alignment", compare_alignments, [1, 3, 5], 12, 900, 30),
        ("closure", close_triplets, [1, 3, 5], 4, 500, 6),
    ):
        part = parts.add_parser(name, help=run.__doc__)
        part.set_defaults(run=run)
        part.add_argument("--sites", type=int, nargs="+", default=sites, help="their numbers")
        part.add_argument("--images", type=int, default=images)
        part.add_argument("--side", type=int, default=side, help="px of each image")
        part.add_argument("--pairs", type=int, default=pairs)
        part.add_argument("--spacing", type=float, default=SPACING_M, help="m, of LiDAR points")
        part.add_argument("--points", type=int, default=15, help="control points of a closure")
        part.add_argument("--folder", type=Path, default=Path("results/sites"))
    options = parser.parse_args()
    logging.basicConfig(level=logging.CRITICAL)
    options.run(options)


if __name__ == "__main__":
    main()
