"""Figures of the labels of a wooded scene: shares, errors and coverage of σ by status and slope."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from label_tables import OFF_PX, percent, print_table
from labelled_block import Block
from numpy.typing import NDArray
from synthetic_pairs import rectify_by
from wooded_scenes import Scene

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluation.labels_against_truth import CLASSES, WATER
from stereotruth.products.files import atomic_folder
from stereotruth.simulate.render import prepare
from stereotruth.simulate.surfaces import GROUND, TREE, terrain_heights
from stereotruth.simulate.truth import truth_at
from stereotruth.status import Status, is_labelled

SIZE_PX = 768  # of the block in the middle of the grid
SLOPES_DEG = {"0–5°": (0.0, 5.0), "5–15°": (5.0, 15.0), "> 15°": (15.0, 90.0)}
FAR_SIGMAS = 3.0
Figures = dict[str, Any]


def slope_of_ground(block: Block) -> NDArray[np.float64]:
    """Slope [h, w] of the ground that a block shows, degrees; NaN on other surfaces."""
    model = EpipolarModel.load(block.rectified / "epipolar.json")
    y, x = np.mgrid[block.rows, block.cols].astype(float)
    pair = block.pair
    shown = truth_at(pair.city, pair.spec, *model.epipolar_to_left(x, y))
    ground = shown["surface"] == GROUND
    ready = prepare(pair.city, pair.spec)
    at = np.column_stack([shown[name][ground] for name in ("lon", "lat", "height")])
    z = terrain_heights(ready.surfaces, ready.frame.from_geodetic(at)[:, :2])
    slope = np.full(ground.shape, np.nan)
    slope[ground] = np.degrees(np.arctan(np.hypot(z[:, 1], z[:, 2])))
    return slope


def coverage(error: NDArray, sigma: NDArray) -> Figures:
    """Errors (px) of labels and how many lie within their σ."""
    if not error.size:
        return {"labels": 0}
    size = np.abs(error)
    return {
        "labels": int(error.size),
        "mean_absolute": float(size.mean()),
        "median": float(np.median(error)),
        "within_1": percent((size < sigma).sum(), size.size),
        "within_2": percent((size < 2.0 * sigma).sum(), size.size),
        "off_3": percent((size > FAR_SIGMAS * sigma).sum(), size.size),
    }


def label_figures(scene: Scene, alignment: Alignment, folder: Path) -> Figures:
    """Labels of the block in the middle, by an alignment of the scene, against exact truth."""
    made = folder / "rectified" / scene.draw.key()
    with atomic_folder(made) as scratch:
        rectify_by(alignment, scene.images, scratch)
    rows, cols = EpipolarModel.load(made / "epipolar.json").shape
    window = (
        slice((side - min(SIZE_PX, side)) // 2, (side + min(SIZE_PX, side)) // 2)
        for side in (rows, cols)
    )
    block = Block(scene, made, *window)
    found = block.labels(block.job(None, "surface"))
    truth = block.truth
    groups, land = truth.groups(), truth.kind != WATER
    visible, hidden = groups["visible"] & land, groups["hidden"] & land
    status = found["status"]
    known = is_labelled(status)
    error = np.where(known, found["disparity"] - truth.disparity, 0.0)
    sigma = found["uncertainty"].astype(np.float64)
    labelled = visible & known
    crowns, open_ground = visible & (block.surface == TREE), visible & (
        truth.kind == CLASSES.index("ground")
    )  # fmt: skip
    slope = slope_of_ground(block)

    def of(part: NDArray[np.bool_]) -> Figures:
        return coverage(error[labelled & part], sigma[labelled & part])

    return {
        "visible": percent(labelled.sum(), visible.sum()),
        "hidden": percent((hidden & known).sum(), hidden.sum()),
        "crowns": percent((crowns & known).sum(), crowns.sum()),
        "ground": percent((open_ground & known).sum(), open_ground.sum()),
        "off": percent((labelled & (np.abs(error) > OFF_PX)).sum(), labelled.sum()),
        "all": of(np.ones_like(labelled)),
        "on crowns": of(crowns),
        "by status": {s.name.lower(): of(status == s) for s in Status if (status == s).any()},
        "by slope": {
            name: of((slope >= low) & (slope < high)) for name, (low, high) in SLOPES_DEG.items()
        },
    }


def _pooled(rows: Sequence[Mapping[str, Any]], group: str) -> dict[str, Figures]:
    """Coverage of each class over the scenes, by its labels."""
    classes = dict.fromkeys(name for row in rows for name in row["labels"][group])
    found = {}
    for name in classes:
        of = [row["labels"][group].get(name, {"labels": 0}) for row in rows]
        of = [figures for figures in of if figures["labels"]]
        count = sum(figures["labels"] for figures in of)
        if count:
            keys = "mean_absolute", "within_1", "within_2", "off_3"
            found[name] = {"labels": count} | {
                key: sum(figures[key] * figures["labels"] for figures in of) / count for key in keys
            }
    return found


def print_labels(rows: Sequence[Mapping[str, Any]]) -> None:
    """Tables: each scene; then statuses and slopes over all of them."""
    rows = [row for row in rows if "labels" in row]
    table = []
    for row in rows:
        f = row["labels"]
        every = f["all"]
        table.append([
            f"{row['draw']['seed']}", f"{row['draw']['density']:g}", f"{100 * row['crowns']:.0f}",
            f"{f['visible']:.1f}", f"{f['hidden']:.2f}", f"{f['crowns']:.0f}", f"{f['ground']:.1f}",
            f"{every.get('mean_absolute', np.nan):.4f}", f"{every.get('median', np.nan):+.4f}",
            f"{every.get('within_1', np.nan):.0f} / {every.get('within_2', np.nan):.0f}",
        ])  # fmt: skip
    columns = ["seed", "points/m²", "crowns, %", "visible labelled, %", "hidden, %"]
    columns += ["of crowns, %", "of ground, %", "mean abs, px", "median, px", "< 1 / 2 σ, %"]
    print_table("Labels in the middle of each scene", columns, table)
    for group in ("by status", "by slope"):
        table = [
            [name, str(f["labels"]), f"{f['mean_absolute']:.4f}", f"{f['within_1']:.1f}",
             f"{f['within_2']:.1f}", f"{f['off_3']:.2f}"]
            for name, f in _pooled(rows, group).items()
        ]  # fmt: skip
        columns = ["class", "labels", "mean abs, px", "< 1 σ, %", "< 2 σ, %", "> 3 σ, %"]
        print_table(f"All scenes, {group}", columns, table)


def asked_of_labels(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Measures of labels: name, asked, reached."""
    rows = [row for row in rows if "labels" in row]
    if not rows:
        return []
    hidden = [row["labels"]["hidden"] for row in rows]
    found = [["hidden pixels labelled, %, worst scene", "≤ 0.8", f"{np.nanmax(hidden):.2f}"]]
    for density, limit in ((4.0, 75), (1.0, 50)):
        of = [row["labels"]["crowns"] for row in rows if row["draw"]["density"] == density]
        if np.isfinite(of).any():
            name = f"visible crown pixels with a label at {density:g} points/m², %, mean"
            found.append([name, f"≥ {limit}", f"{np.nanmean(of):.0f}"])
    for group in ("by status", "by slope"):
        for name, f in _pooled(rows, group).items():
            reached = f"{f['within_1']:.0f}, {f['within_2']:.0f}"
            found.append([f"within 1 and 2 σ, %, {name}", "63–75, 92–97", reached])
    return found
