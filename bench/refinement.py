"""Refinement among crowns: ever worse than its control points? See README.md beside this file.

Scenes are drawn by seed, aligned by control points and refined, and what both make of exact places
is compared. Rows are kept in the folder: a run that was stopped is carried on.

python bench/refinement.py accuracy
python bench/refinement.py any --scenes 60
python bench/refinement.py open --scenes 2 --labels
python bench/refinement.py jitter --scenes 4
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from drawn_scenes import HIGH, LOW, MIXED, Draw, LabelErrors, Scene
from figures import OFF_PX, percent, print_table
from numpy.typing import NDArray
from synthetic_pairs import Block, rectify_by

from stereocities.render import prepare
from stereocities.surfaces import GROUND, TREE, terrain_heights
from stereocities.truth import truth_at
from stereotruth.align.adjustment import epipolar_model
from stereotruth.align.alignment import Alignment
from stereotruth.align.label_uncertainty import label_covariance
from stereotruth.align.refine import refine
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_file, atomic_folder
from stereotruth.core.products.provenance import source_digest
from stereotruth.core.status import Status, is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.labels_against_truth import CLASSES, WATER

SEEDS = {
    "accuracy": 2700,
    "any": 52700,
    "open": 92700,
    "jitter": 132700,
}  # of the first scene; nothing is tuned on them
SIDE_PX = 1400
DENSITIES = (0.25, 0.5, 1.0, 2.0, 4.0, 12.0)
GCPS = (15, 15, 15, 4, 4, 0)
WORSE_PX = 0.01
STEP_PX_PER_PX = 1.0  # slope of the disparity: more is a step of the surface
SIGMA_EVERY = 5  # of the places whose σ is compared
LABELS_PX = 768  # side of the block in the middle of the grid that is labelled
SLOPES_DEG = {"0–5°": (0.0, 5.0), "5–15°": (5.0, 15.0), "> 15°": (15.0, 90.0)}
FAR_SIGMAS = 3.0
Row = dict[str, Any]
Floats = NDArray[np.float64]

COLUMNS = [
    "crowns, %", "points/m²", "conditions", "control points alone: bias", "mean abs",
    "refined: bias", "mean abs", "stated σ", "tie points", "doubts",
]  # fmt: skip


def accuracy_draws(count: int) -> Iterator[tuple[Draw, int]]:
    """Wooded suburbs and parks in turn, each at 4 and at 1 points/m², with 15 control points."""
    for number in range(count):
        rng = np.random.default_rng([SEEDS["accuracy"], number])
        draw = Draw(
            SEEDS["accuracy"] + number,
            zones=("suburb", "park")[number % 2],
            ground_m2=float(rng.choice([60.0, 100.0, 170.0, 250.0])),
            arrangement=str(rng.choice(["single", "rows", "forest"])),
            brightness=float(rng.uniform(0.3, 0.9)),
            ground_look=(float(rng.uniform(1.0, 1.8)), float(rng.uniform(0.3, 1.0))),
            buildings=0.8,
            relief_m=float(rng.uniform(6, 40)),
            side_px=SIDE_PX,
            **(LOW, HIGH, MIXED)[int(rng.integers(3))],
        )
        for density in (4.0, 1.0):
            yield replace(draw, density=density), 15


def any_draws(count: int) -> Iterator[tuple[Draw, int]]:
    """Scenes of every density, crowns over 0 to 40 % of the ground, under every condition."""
    for number in range(count):
        rng = np.random.default_rng([SEEDS["any"], number])
        crowns = float(rng.uniform(0, 0.4)) if rng.random() < 0.85 else 0.0
        area = float(np.pi * (4.5**3 - 1.5**3) / 9.0)  # mean of a crown
        yield (
            Draw(
                SEEDS["any"] + number,
                zones=str(rng.choice(["suburb", "park", "town"])),
                ground_m2=-area / float(np.log1p(-crowns)) if crowns > 0.01 else None,
                arrangement=str(rng.choice(["single", "rows", "forest"])),
                brightness=float(rng.uniform(0.3, 1.0)),
                ground_look=(float(rng.uniform(0.9, 1.8)), float(rng.uniform(0.2, 1.0))),
                density=float(rng.choice(DENSITIES)),
                noise=bool(rng.random() < 0.3),
                gain=bool(rng.random() < 0.3),
                later=bool(rng.random() < 0.25),
                bare=str(rng.choice(["", "", "", "left", "right"])),
                vehicles=float(rng.choice([0.0, 5.0, 20.0])),
                relief_m=float(np.exp(rng.uniform(np.log(5.0), np.log(220.0)))),
                roofs=str(rng.choice(["mixed", "flat"])),
                buildings=float(rng.uniform(0.4, 1.0)),
                side_px=SIDE_PX,
                **(LOW, HIGH, MIXED)[int(rng.integers(3))],
            ),
            GCPS[number % len(GCPS)],
        )


def open_draws(count: int) -> Iterator[tuple[Draw, int]]:
    """Towns without crowns: dense and sparse points, noisy images, steep ground."""
    for number in range(count):
        plain = Draw(SEEDS["open"] + number, zones="town", ground_m2=None, side_px=SIDE_PX)
        for draw in (
            replace(plain, density=12.0),
            replace(plain, density=1.0),
            replace(plain, density=2.0, noise=True, gain=True),
            replace(plain, density=4.0, relief_m=180.0),
        ):
            yield draw, 15


def jitter_draws(count: int) -> Iterator[tuple[Draw, int]]:
    """Towns and suburbs of 8 bits, white roofs and blur that differs; the same with an attitude
    that jitters."""
    for number in range(count):
        plain = Draw(
            SEEDS["jitter"] + number,
            zones=("town", "suburb")[number % 2],
            ground_m2=400.0,
            psf_px=(0.42, 0.6),
            saturates=0.45,
            side_px=1100,
        )
        for jitter_px in (0.0, 0.18):
            yield replace(plain, jitter_px=jitter_px), 15


DRAWS = {"accuracy": accuracy_draws, "any": any_draws, "open": open_draws, "jitter": jitter_draws}


def conditions(draw: Mapping[str, Any], gcps: int) -> str:
    """What a scene has besides crowns, in words."""
    found = [name for name in ("noise", "gain", "later") if draw[name]]
    if draw["bare"]:
        found.append(f"bare {draw['bare']}")
    if draw["vehicles"]:
        found.append(f"{draw['vehicles']:g} cars/ha")
    if draw["roofs"] == "flat":
        found.append("flat")
    if draw["saturates"]:
        found.append("8 bits")
    if draw["jitter_px"]:
        found.append(f"jitter {draw['jitter_px']:g} px")
    return ", ".join([draw["zones"], f"{draw['relief_m']:.0f} m", f"{gcps} GCPs", *found])


def stated_sigma(scene: Scene, alignment: Alignment, errors: LabelErrors) -> Floats:
    """Standard deviation [n] px that an alignment states for labels at the pixels of some errors.

    A label's wrong place counts by the slope of the disparity there. NaN at a step of the surface.
    """
    model = epipolar_model(alignment)

    def true_disparity(x: Floats, y: Floats) -> Floats:
        shown = truth_at(scene.city, scene.spec, *model.epipolar_to_left(x, y))
        return x - model.right_to_epipolar(shown["right_col"], shown["right_row"])[0]

    x, y = errors.at.T
    here = true_disparity(x, y)
    slope = np.stack([true_disparity(x + 1.0, y) - here, true_disparity(x, y + 1.0) - here])
    slope[:, np.abs(slope).max(axis=0) > STEP_PX_PER_PX] = np.nan
    effect = np.stack([np.ones_like(x), *-slope], axis=-1)
    variance = np.einsum("ni,nij,nj->n", effect, label_covariance(alignment, model, x, y), effect)
    return np.sqrt(np.maximum(variance, 0.0))


def _of_errors(scene: Scene, alignment: Alignment, *, with_sigma: bool = False) -> Row:
    errors = scene.errors(alignment)
    found = {
        "bias": errors.bias,
        "mean_absolute": errors.mean_absolute,
        "parallax_rms": errors.parallax_rms,
    } | {f"mean_absolute_{name}": value for name, value in errors.by_surface().items()}
    if with_sigma:
        some = replace(errors, **{k: v[::SIGMA_EVERY] for k, v in vars(errors).items()})
        sigma = stated_sigma(scene, alignment, some)
        size, sigma = np.abs(some.disparity[sigma > 0.0]), sigma[sigma > 0.0]
        found |= {
            "sigma": float(np.mean(sigma)),
            "within_1": float(np.mean(size < sigma)),
            "within_2": float(np.mean(size < 2.0 * sigma)),
        }
    return found


def slope_of_ground(block: Block) -> Floats:
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


def coverage(error: NDArray, sigma: NDArray) -> Row:
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


def label_figures(scene: Scene, alignment: Alignment, folder: Path) -> Row:
    """Labels of the block in the middle, by an alignment of the scene, against exact truth."""
    made = folder / "rectified" / scene.draw.key()
    with atomic_folder(made) as scratch:
        rectify_by(alignment, scene.images, scratch)
    rows, cols = EpipolarModel.load(made / "epipolar.json").shape
    window = (
        slice((side - min(LABELS_PX, side)) // 2, (side + min(LABELS_PX, side)) // 2)
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

    def of(part: NDArray[np.bool_]) -> Row:
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


def _pooled(rows: Sequence[Row], group: str) -> dict[str, Row]:
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


def print_labels(rows: Sequence[Row]) -> None:
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


def asked_of_labels(rows: Sequence[Row]) -> list[list[str]]:
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


def trial(draw: Draw, gcps: int, with_labels: bool, folder: Path) -> Row:
    """One scene: made, aligned, refined and compared with its truth."""
    scene = Scene(draw, folder)
    row: Row = {"draw": asdict(draw), "gcps": gcps, "crowns": scene.crown_share}
    start = time.process_time()
    alone = scene.align(gcps)
    row["alone"] = _of_errors(scene, alone)
    try:
        refined, observations = refine(alone, *scene.images, scene.stores, provenance={})
    except InputError as error:
        return row | {"refused": str(error), "seconds": time.process_time() - start}
    row["applied"] = bool(refined.refinement["applied"])
    row["by_line"] = bool(refined.refinement.get("by_line", {}).get("used"))
    row["ties"] = 0 if observations is None else int(observations.used.sum())
    row["refined"] = _of_errors(scene, refined, with_sigma=True)
    row["doubts"] = list(refined.warnings)
    if with_labels:
        row["labels"] = label_figures(scene, refined, folder)
    return row | {"seconds": time.process_time() - start}


def rows_of(options: argparse.Namespace) -> Iterator[Row]:
    """All rows: those of an earlier run by the same code are read, the others made."""
    code = source_digest("stereotruth.align.align", "stereotruth.align.refine")[:8]
    if options.labels:
        code = source_digest("stereotruth.align.refine", "stereotruth.labels.project")[:8]
    draws = list(DRAWS[options.what](options.scenes))
    for number, (draw, gcps) in enumerate(draws):
        name = f"{draw.key()}-{gcps}-{code}.json"
        file = options.folder / ("labels" if options.labels else "rows") / name
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            row = trial(draw, gcps, options.labels, options.folder)
            with atomic_file(file) as scratch:
                scratch.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
        row = json.loads(file.read_text(encoding="utf-8"))
        print(f"{number + 1} of {len(draws)}: {' '.join(cells(row))}", flush=True)
        yield row


def cells(row: Row) -> list[str]:
    """A row of the table."""
    draw, alone = row["draw"], row["alone"]
    first = [
        f"{100 * row['crowns']:.0f}", f"{draw['density']:g}", conditions(draw, row["gcps"]),
        f"{alone['bias']:+.3f}", f"{alone['mean_absolute']:.3f}",
    ]  # fmt: skip
    if "refused" in row:
        return [*first, "refused", "–", "–", "–", row["refused"][:60]]
    refined = row["refined"]
    return [
        *first, f"{refined['bias']:+.3f}", f"{refined['mean_absolute']:.3f}",
        f"{refined['sigma']:.3f}", str(row["ties"]) + (", by line" if row["by_line"] else "")
        + ("" if row["applied"] else " (not applied)"),
        str(len(row["doubts"])),
    ]  # fmt: skip


def asked(what: str, rows: list[Row]) -> list[list[str]]:
    """Measures: name, asked, reached."""
    refined = [row for row in rows if "refined" in row]
    size = np.array([row["refined"]["mean_absolute"] for row in refined])
    found: list[list[str]] = []
    if what == "accuracy" and refined:
        found.append(["refined, mean abs px, mean of scenes", "≤ 0.03", f"{size.mean():.3f}"])
        found.append(["the same, worst scene", "≤ 0.05", f"{size.max():.3f}"])
    with_gcps = [row for row in refined if row["gcps"]]
    worse = [
        row for row in with_gcps
        if row["refined"]["mean_absolute"] > row["alone"]["mean_absolute"] + WORSE_PX
    ]  # fmt: skip
    found.append([
        f"refined worse than control points alone by more than {WORSE_PX:g} px", "0",
        f"{len(worse)} of {len(with_gcps)}",
    ])  # fmt: skip
    none = [row["refined"]["mean_absolute"] for row in refined if not row["gcps"]]
    if none:
        found.append(["without control points, mean abs px, worst", "–", f"{max(none):.3f}"])
    found.append(["refused", "–", f"{len(rows) - len(refined)} of {len(rows)}"])
    sigmas = [(row["refined"]["within_1"], row["refined"]["within_2"]) for row in refined]
    if sigmas:
        one, two = 100.0 * np.mean(sigmas, axis=0)
        found.append(["places within 1 and 2 σ, %", "63–75, 92–97", f"{one:.0f}, {two:.0f}"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "what",
        choices=list(DRAWS),
        help="suburbs and parks, any scenes, open towns, or an attitude that jitters",
    )
    parser.add_argument("--scenes", type=int, default=10, help="how many are drawn")
    parser.add_argument("--folder", type=Path, default=Path("results/refinement"))
    parser.add_argument("--labels", action="store_true", help="also labels of the middle")
    options = parser.parse_args()
    logging.basicConfig(level=logging.ERROR, format="%(message)s")
    rows = list(rows_of(options))
    print_table("Errors of alignments, px", COLUMNS, [cells(row) for row in rows])
    measures = asked(options.what, rows)
    if options.labels:
        print_labels(rows)
        measures += asked_of_labels(rows)
    print_table("Asked and reached", ["measure", "asked", "reached"], measures)


if __name__ == "__main__":
    main()
