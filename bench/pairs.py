"""What the predicted quality of a pair rests on: SGM on all pairs of simulated sites.

Each pair of a drawn site is rectified by exact sensor models, matched by SGM as the benchmark runs
it, and held against the exact truth: the share of the pixels that both images show whose disparity
SGM misses by more than 1 px, or has not at all. The site's roughness is that of a LiDAR of 4
points/m². ``--fit`` prints the coefficients of sensor/site_pairs.py from sites of even numbers;
without it, the rank correlation of what is predicted with what is found over sites of odd numbers,
which no fit has seen: within each site, since pairs are chosen within a site, and over all of them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr
from synthetic_pairs import fly

from stereobench.methods.sgm import SemiGlobalMatcher
from stereocities.rpcs import draw_bias
from stereocities.sites import SiteSpec, drawn_site, pair_truth, simulate_site_image
from stereotruth.core.products.grids import open_grid
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.rectify import rectify
from stereotruth.lidar.point_statistics import roughness_m
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.images import open_pair
from stereotruth.sensor.rpc import SensorModel
from stereotruth.sensor.rpc_files import read_rpc
from stereotruth.sensor.site_pairs import (
    USUAL_ROUGHNESS_M,
    SiteImage,
    SitePair,
    pairs_of_site,
    quality_of,
)

SEED = 2026
SPACING_M = 0.5  # of the LiDAR's points
FOLDER = Path("results/pairs")

TERMS = ("base over height", "way of the shadows", "roughness over the usual one")


def exact_image(site: SiteSpec, name: str, folder: Path) -> SiteImage:
    """An image of a site, made in the folder, with its RPCs corrected by their own bias."""
    image = site.image(name)
    file = folder / f"{name}.tif"
    simulate_site_image(site, image, file, seed=SEED)
    bias = np.vstack([draw_bias(image.cols, image.rows, image.pose_seed, "left"), [0, 0, 1]])
    sensor = SensorModel(read_rpc(file), np.linalg.inv(bias)[:2])
    return SiteImage(name, sensor, (image.cols, image.rows), image.acquired, image.sun_deg)


def match(site: SiteSpec, images: dict[str, SiteImage], pair: SitePair, folder: Path) -> dict:
    """Shares of pixels that SGM has wrong: by 1 px, by 1 m and by 2 m, or has not."""
    left, right = images[pair.left], images[pair.right]
    height = left.sensor.rpc.height_off
    model = fit_epipolar(left.sensor, right.sensor, left.size, right.size, height)
    stores = [folder / f"{view}.zarr" for view in ("left", "right")]
    with open_pair(*(folder / f"{name}.tif" for name in (pair.left, pair.right))) as opened:
        rectify(*opened, model, None, *stores)
    pictures = [np.asarray(open_grid(store)["image"]) for store in stores]
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(float)
    at = model.epipolar_to_left(x, y)
    truth = pair_truth(site, site.image(pair.left), site.image(pair.right), *at)
    exact = x - model.right_to_epipolar(truth["right_col"], truth["right_row"])[0]
    counted = (truth["visible_right"] > 0) & (pictures[0] > 0) & (truth["surface"] != 5)
    low, high = np.nanpercentile(exact[counted], (0, 100))
    bounds = int(np.floor(low)) - 8, int(np.ceil(high)) + 8
    found = SemiGlobalMatcher()(*pictures, bounds)
    miss = np.abs(found - exact)[counted]
    miss[np.isnan(miss)] = np.inf
    per_m = model.report["disparity_px_per_m"]["mean"]
    shares = {f"over_{m}_m": float((miss > m * per_m).mean()) for m in (1, 2, 3)}
    return shares | {"over_1_px": float((miss > 1).mean()), "pixels": int(counted.sum())}


def rows_of(number: int, images: int, side_px: int) -> list[dict]:
    """All pairs of a drawn site: what is known before, and what SGM does."""
    kept = FOLDER / f"{SEED}-{number}-{images}-{side_px}-{SPACING_M}.json"
    if kept.is_file():
        return json.loads(kept.read_text())
    site = drawn_site(number, SEED, images=images, side_px=side_px)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        stores = open_stores(fly(site.city, site.area, folder, SEED, SPACING_M))
        rough = {"roughness": roughness_m(stores)}
        opened = {image.name: exact_image(site, image.name, folder) for image in site.images}
        for pair in pairs_of_site(list(opened.values())):
            if pair.convergence < 1.5:
                continue
            measured = match(site, opened, pair, folder)
            states = {site.image(name).state for name in (pair.left, pair.right)}
            rows.append(
                {"site": number, **asdict(pair), **measured, **rough, "seasons": len(states)}
            )
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(rows))
    return rows


def fit(rows: list[dict]) -> np.ndarray:
    """Log odds of a wrong match [4]: at nothing, then per term.

    Each site has its own level, which its roughness is fitted to.
    """
    sites = np.array([row["site"] for row in rows])
    numbers, first = np.unique(sites, return_index=True)
    levels = (sites[:, None] == numbers).astype(float)
    terms = np.array([(2 * np.tan(np.radians(r["convergence"]) / 2), r["shadow"]) for r in rows])
    wrong = np.clip([row["over_1_px"] for row in rows], 0.01, 0.99)
    found = np.linalg.lstsq(np.hstack([terms, levels]), np.log(wrong / (1 - wrong)), rcond=None)[0]
    of_pair, of_site = found[: terms.shape[1]], found[terms.shape[1] :]
    rough = np.log([rows[k]["roughness"] / USUAL_ROUGHNESS_M for k in first])
    by_roughness, at_nothing = np.polyfit(rough, of_site, 1)
    return np.array([at_nothing, *of_pair, by_roughness])


def predicted(row: dict) -> float:
    """Share of right matches, as ``stereotruth pairs`` predicts it."""
    pair = SitePair(**{f.name: row[f.name] for f in fields(SitePair)})
    return quality_of(pair, row["roughness"]).matched


def rank(rows: list[dict]) -> float:
    """Rank correlation of what is predicted with what is found."""
    found = [1 - row["over_1_px"] for row in rows]
    return float(spearmanr([predicted(row) for row in rows], found)[0])


def interval(values: Callable[[list[int]], float], count: int) -> str:
    """A figure of sites, and 95 % of it with sites drawn anew (bootstrap; pairs share images)."""
    rng = np.random.default_rng(SEED)
    drawn = [values(list(rng.integers(0, count, count))) for _ in range(1000)]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return f"{values(list(range(count))):.2f} ({low:.2f} to {high:.2f})"


def compare(every: list[list[dict]]) -> None:
    """Print the rank correlation of the prediction with the truth, of each site and of all."""
    print("| site | pairs | matched within 1 px | rank correlation |\n|---|---|---|---|")
    each = [rank(rows) for rows in every]
    for rows, of_site in zip(every, each):
        low, high = np.quantile([1 - row["over_1_px"] for row in rows], (0, 1))
        print(
            f"| {rows[0]['site']} | {len(rows)} | {100 * low:.0f} to {100 * high:.0f} % | "
            f"{of_site:.2f} |"
        )
    within = interval(lambda chosen: float(np.mean([each[k] for k in chosen])), len(every))
    across = interval(lambda chosen: rank([row for k in chosen for row in every[k]]), len(every))
    print(f"\nWithin a site, mean of {len(every)} sites, and 95 % of such means: {within}")
    print(f"Over the pairs of all sites together: {across}")


def main() -> None:
    """Make the sites, match their pairs, and fit or compare."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--sites", type=int, default=5)
    arguments.add_argument("--images", type=int, default=7)
    arguments.add_argument("--side", type=int, default=440, help="px of each image")
    arguments.add_argument("--fit", action="store_true")
    given = arguments.parse_args()
    numbers = [2 * k + (not given.fit) for k in range(given.sites)]
    every = [rows_of(number, given.images, given.side) for number in numbers]
    if not given.fit:
        compare(every)
        return
    for name, value in zip(("at nothing", *TERMS), fit([row for rows in every for row in rows])):
        print(f"{name}: {value:.2f}")


if __name__ == "__main__":
    main()
