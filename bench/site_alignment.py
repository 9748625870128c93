"""Joint adjustment of a site's images against pairs refined one by one. See README.md beside this.

Sites are drawn by seed. Their images are paired as ``stereotruth pairs`` chooses, each pair is
aligned and refined by itself, and all are adjusted together. What either makes of exact ground
points in each image is compared. Files are kept in the folder: a run that was stopped is carried
on.

python bench/site_alignment.py --images 12 --side 900
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from stereotruth.alignment.gcp_checks import open_view
from stereotruth.epipolar.pair_quality import quality_of
from stereotruth.epipolar.rpc import SensorModel
from stereotruth.epipolar.site_pairs import SiteImage, SitePair, pairs_of_site
from stereotruth.lidar.ingest import ingest
from stereotruth.products.files import atomic_folder, write_table
from stereotruth.simulate.cities import lidar_files
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.site_images import image_truth, simulate_site_image, simulate_site_points
from stereotruth.simulate.sites import SiteSpec

SEED = 2030
SPACING_M = 0.5  # of the LiDAR's points


def make_site(site: SiteSpec, folder: Path) -> None:
    """Images, point stores and control points of a site, below its folder."""
    for image in site.images:
        made = folder / f"{image.name}.tif"
        if not made.is_file():
            simulate_site_image(site, image, made, seed=SEED)
    if not (folder / "points").is_dir():
        with atomic_folder(folder / "points") as scratch:
            for file in lidar_files(site.city, site.area):
                simulate_lidar_tile(
                    site.city, site.area, file, scratch / file, spacing_m=SPACING_M, seed=SEED
                )
                ingest(scratch / file, scratch / f"{Path(file).stem}.points")
                (scratch / file).unlink()
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


def some_points(folder: Path, count: int) -> Path:
    """The control points with the ``count`` that most images show, far from each other."""
    with (folder / "gcps.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    ids = sorted({row["id"] for row in rows})
    if count >= len(ids):
        return folder / "gcps.csv"
    seen = {name: sum(row["id"] == name for row in rows) for name in ids}
    often = [name for name in ids if seen[name] >= 0.8 * max(seen.values())]
    place = {row["id"]: (float(row["lon"]), float(row["lat"])) for row in rows}
    at = np.array([place[name] for name in often])
    at *= np.cos(np.radians(at[:, 1].mean())), 1.0
    chosen = [int(np.argmin(at.sum(axis=1)))]
    while len(chosen) < min(count, len(often)):
        away = np.min([np.hypot(*(at - at[k]).T) for k in chosen], axis=0)
        chosen.append(int(np.argmax(away)))
    kept = {often[k] for k in chosen}
    write_table(folder / f"gcps_{count}.csv", [row for row in rows if row["id"] in kept])
    return folder / f"gcps_{count}.csv"


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
