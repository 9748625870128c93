"""Joint adjustment of a site's images against pairs refined one by one. See README.md beside this.

Sites are drawn by seed. Their images are paired as ``stereotruth pairs`` chooses, each pair is
aligned and refined by itself, and all are adjusted together. What either makes of exact places in
each image is compared. Then one image is spoilt, and what the others suffer is measured. Files are
kept in the folder: a run that was stopped is carried on.

python bench/site_alignment.py --sites 3
"""

from __future__ import annotations

import argparse
import csv
import logging
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from label_tables import print_table

from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import align, from_rpcs
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.gcp_checks import open_view
from stereotruth.alignment.refine import refine
from stereotruth.alignment.site_adjustment import adjust_site
from stereotruth.alignment.site_pair import ScenePair, pair_alignment
from stereotruth.alignment.tie_equations import write_equations
from stereotruth.epipolar.pair_quality import quality_of
from stereotruth.epipolar.rpc import SensorModel
from stereotruth.epipolar.site_pairs import SiteImage, SitePair, pairs_of_site
from stereotruth.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.products.files import atomic_folder, write_table
from stereotruth.products.provenance import source_digest
from stereotruth.products.ungeoreferenced import open_raster
from stereotruth.simulate.cities import lidar_files
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.rpcs import draw_bias
from stereotruth.simulate.site_images import (
    image_truth,
    pair_truth,
    simulate_site_image,
    simulate_site_points,
)
from stereotruth.simulate.sites import SiteSpec, drawn_site

SEED = 2030
SPACING_M = 0.5  # of the LiDAR's points


def make_points(site: SiteSpec, folder: Path, spacing_m: float, seed: int) -> list[Path]:
    """Point stores of a site's LiDAR, in a folder."""
    stores = []
    for file in lidar_files(site.city, site.area):
        simulate_lidar_tile(
            site.city, site.area, file, folder / file, spacing_m=spacing_m, seed=seed
        )
        stores.append(folder / f"{Path(file).stem}.points")
        ingest(folder / file, stores[-1])
        (folder / file).unlink()
    return stores


def make_site(site: SiteSpec, folder: Path, spacing_m: float = SPACING_M) -> None:
    """Images, point stores and control points of a site, below its folder."""
    for image in site.images:
        made = folder / f"{image.name}.tif"
        if not made.is_file():
            simulate_site_image(site, image, made, seed=SEED)
    if not (folder / "points").is_dir():
        with atomic_folder(folder / "points") as scratch:
            make_points(site, scratch, spacing_m, SEED)
    simulate_site_points(site, folder / "gcps.csv", folder / "exact.csv", seed=SEED)


def pairs_of(site: SiteSpec, folder: Path, most: int) -> list[SitePair]:
    """The best pairs, as ``stereotruth pairs --most`` chooses them, in the order of their names."""
    images = []
    for image in site.images:
        sensor, size = open_view("site's", folder / f"{image.name}.tif", "")
        images.append(SiteImage(image.name, sensor, size, image.acquired, image.sun_deg))
    found = [pair for pair in pairs_of_site(images) if 5.0 <= pair.convergence <= 45.0]
    best = sorted(found, key=lambda pair: -quality_of(pair).matched)[:most]
    return sorted(best, key=lambda pair: (pair.left, pair.right))


def some_points(folder: Path, count: int, without: str = "", table: str = "gcps") -> Path:
    """Control points: the ``count`` that most images show, far from each other.

    None of them is measured in the image ``without``. ``table``: ``gcps`` as measured, ``exact``
    without their noise.
    """
    with (folder / f"{table}.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    ids = sorted({row["id"] for row in rows})
    seen = {name: sum(row["id"] == name for row in rows) for name in ids}
    often = [name for name in ids if seen[name] >= 0.8 * max(seen.values())]
    place = {row["id"]: (float(row["lon"]), float(row["lat"])) for row in rows}
    at = np.array([place[name] for name in often])
    at *= np.cos(np.radians(at[:, 1].mean())), 1.0
    chosen = [int(np.argmin(at.sum(axis=1)))]
    while len(chosen) < min(count, len(often)):
        away = np.min([np.hypot(*(at - at[k]).T) for k in chosen], axis=0)
        chosen.append(int(np.argmax(away)))
    kept = set(ids) if count >= len(ids) else {often[k] for k in chosen}
    file = folder / f"{table}_{count}{without}.csv"
    write_table(file, [row for row in rows if row["id"] in kept and row["image"] != without])
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


# ------------------------------------------------------------------------------- spoilt images


def _rewritten(
    source: Path, target: Path, change: Callable[[np.ndarray], np.ndarray], shift: float = 0.0
) -> None:
    with open_raster(source) as opened:
        profile, pixels, rpcs = opened.profile, opened.read(1), opened.rpcs
    rpcs.samp_off += 0.8 * shift
    rpcs.line_off += 0.6 * shift
    with open_raster(target, "w", **profile, rpcs=rpcs) as written:
        written.write(change(pixels).astype(pixels.dtype), 1)


def off_by_15_px(site: SiteSpec, name: str, folder: Path, target: Path) -> None:
    """The RPC is off by 15 px more than it is already, away from the others."""
    image = site.image(name)
    bias = draw_bias(image.cols, image.rows, image.pose_seed, "left")
    sign = 1.0 if (bias - np.eye(2, 3))[:, 2] @ (0.8, 0.6) > 0.0 else -1.0
    _rewritten(folder / f"{name}.tif", target, lambda pixels: pixels, sign * 15.0)


def of_another_site(site: SiteSpec, name: str, folder: Path, target: Path) -> None:
    """The pixels are those of another city."""
    image = site.image(name)
    other = drawn_site(1000, SEED, images=1, side_px=max(image.cols, image.rows) + 60)
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch, "other.tif")
        first = replace(other.images[0], cols=image.cols, rows=image.rows)
        other = replace(other, images=(first,))
        simulate_site_image(other, first, file, seed=SEED)
        with open_raster(file) as opened:
            pixels = opened.read(1)
    _rewritten(folder / f"{name}.tif", target, lambda _: pixels)


def clouded(site: SiteSpec, name: str, folder: Path, target: Path) -> None:
    """Clouds over two thirds of the image."""

    def clouds(pixels: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(SEED)
        cover = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), 60.0)
        detail = cv2.GaussianBlur(rng.normal(size=pixels.shape), (0, 0), 6.0)
        cover, detail = cover / cover.std(), detail / detail.std()
        thick = np.clip((cover + 0.2 * detail + 0.43) * 3.0, 0.0, 1.0)
        bright = np.percentile(pixels, 99) * (1.0 + 0.06 * detail)
        return (1.0 - thick) * pixels + thick * bright

    _rewritten(folder / f"{name}.tif", target, clouds)


FAULTS = {"RPC off by 15 px": off_by_15_px, "of another site": of_another_site, "clouds": clouded}

# ------------------------------------------------------------------------------- adjustments


def refined(
    folder: Path, names: tuple[str, str], count: int, spoilt: str = "", fault: str = ""
) -> ScenePair:
    """Files of a pair, aligned and refined by itself as the workflow does for a site."""
    unmeasured = spoilt if fault == "of another site" else ""
    gcps = some_points(folder, count, unmeasured)
    key = f"{spoilt}{fault}".replace(" ", "_") if spoilt in names else ""
    scene = f"{names[0]}_{names[1]}"
    made = folder / "pairs" / f"{scene}-{count}{key}-{source_digest('alignment.refine')[:8]}"
    pair = ScenePair(scene, *names, made / "alignment.json", made / "equations.json", gcps)
    if not made.is_dir():
        files = [
            folder / (f"{key}.tif" if key and name == spoilt else f"{name}.tif") for name in names
        ]
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


def of_site(number: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of a site: one per count of control points, and one per fault."""
    site = drawn_site(number, SEED, images=options.images, side_px=options.side)
    folder = options.folder / f"{SEED}-{number}-{options.images}-{options.side}"
    folder.mkdir(parents=True, exist_ok=True)
    make_site(site, folder)
    chosen = [(pair.left, pair.right) for pair in pairs_of(site, folder, options.pairs)]
    places = {image.name: exact_places(site, image.name) for image in site.images}
    rows, clean = [], {}
    for count in (15, 4):
        pairs = [refined(folder, names, count) for names in chosen]
        alone = {pair.scene: Alignment.load(pair.alignment) for pair in pairs}
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
        rows.append({
            "site": number, "case": f"{count} control points", "images": len(joint),
            "pairs": len(pairs), "joint": float(np.mean(list(errors.values()))),
            "best": float(np.mean([min(values) for values in single.values()])),
            "median": float(np.mean([np.median(values) for values in single.values()])),
            "exact": float(np.mean([values[0] for values in by_exact.values()])),
            "sigma": float(np.mean([adjusted["images"][name]["sigma"] for name in errors])),
            "labels_alone": float(np.mean(labels[0])), "labels_joint": float(np.mean(labels[1])),
            "doubts": sum(bool(image["doubts"]) for image in adjusted["images"].values()),
        })  # fmt: skip
        clean[count] = errors
    degree = {name: sum(name in names for names in chosen) for name in places}
    spoilt = sorted(degree, key=lambda name: (-degree[name], name))[1]
    for fault, make in FAULTS.items():
        made = folder / f"{spoilt}{fault}.tif".replace(" ", "_")
        if not made.is_file():
            make(site, spoilt, folder, made)
        pairs = [refined(folder, names, 15, spoilt, fault) for names in chosen]
        adjusted = adjust_site(site.city.name, pairs)
        joint = by_image(pairs, sensors_of(adjusted, pairs), places)
        suffered = [values[0] - clean[15][name] for name, values in joint.items() if name != spoilt]
        images = adjusted["images"]
        rows.append({
            "site": number, "case": fault, "named": "; ".join(images[spoilt]["doubts"]) or "no",
            "others_named": sum(bool(images[n]["doubts"]) for n in images if n != spoilt),
            "worse": max(suffered),
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, default=3, help="how many are drawn")
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--side", type=int, default=900, help="px of each image")
    parser.add_argument("--pairs", type=int, default=30)
    parser.add_argument("--folder", type=Path, default=Path("results/site_alignment"))
    options = parser.parse_args()
    logging.basicConfig(level=logging.CRITICAL)
    rows = []
    for k in range(options.sites):
        for row in of_site(2 * k + 1, options):
            print(row, flush=True)
            rows.append(row)
    joint = [row for row in rows if "joint" in row]
    columns = ["site", "case", "best pair", "usual pair", "joint", "joint / best", "stated σ",
               "exact points", "labels: pairs", "labels: joint", "images doubted"]  # fmt: skip
    title = "Error at exact places per image, px of a coordinate; of labels, mean absolute px"
    print_table(title, columns, [
        [str(r["site"]), r["case"], f"{r['best']:.3f}", f"{r['median']:.3f}", f"{r['joint']:.3f}",
         f"{r['joint'] / r['best']:.2f}", f"{r['sigma']:.3f}", f"{r['exact']:.3f}",
         f"{r['labels_alone']:.4f}", f"{r['labels_joint']:.4f}", str(r["doubts"])]
        for r in joint
    ])  # fmt: skip
    columns = ["site", "spoilt image", "named", "others named", "others worse by at most, px"]
    print_table("One image spoilt", columns, [
        [str(r["site"]), r["case"], r["named"], str(r["others_named"]), f"{r['worse']:+.4f}"]
        for r in rows if "named" in r
    ])  # fmt: skip


if __name__ == "__main__":
    main()
