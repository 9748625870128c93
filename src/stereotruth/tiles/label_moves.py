"""What an edit did: how far labels have moved, and the control point that fits worst.

A label joins a place of the left original image to one of the right. No edit of points, settings or
images' corrections moves these, while the epipolar grid follows the alignment: so labels of two
runs are compared at the same places of the left image, by where each has the right one.

Of each scene a thinned sample of its labels is kept in KEPT, outside the products, until the next
tiles are made. It is replaced last, so that a killed job is compared with the same labels again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.numerics.arrays import Floats
from ..core.products.files import atomic_file
from ..core.products.grids import blocks, require_complete
from ..epipolar.model import EpipolarModel

KEPT = Path(".snakemake", "stereotruth", "labels")
SAMPLES = 40_000  # labels of a scene at most, evenly thinned: 1.3 MB
BLOCK_PX = 1024  # a shard of the stores
SAME_SURFACE_PX = 1.0  # spread of the labels around one: with more, an edge is near
ON_GRID_PX = 1e-3  # what the inverse of the epipolar model leaves
STILL_PX = 0.0005  # less is said to be none


def sample_labels(store: str | Path) -> Floats:
    """[n, (left col, row, right col, row)] px of the original images, of labels of a disparity
    store whose eight neighbours have labels of the same surface. Raises InputError."""
    group = require_complete(store)
    disparity, model = group["disparity"], EpipolarModel.from_dict(group.attrs["epipolar"])
    step = max(1, math.ceil(math.sqrt(math.prod(disparity.shape) / SAMPLES)))
    found = [np.empty((0, 4))]
    for rows, cols in blocks(disparity.shape, BLOCK_PX):
        values = np.asarray(disparity[rows, cols])
        r, c = (np.arange(1, n - 1, step) for n in values.shape)
        around = np.stack([values[np.ix_(r + i, c + j)] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        smooth = np.ptp(around, axis=0) < SAME_SURFACE_PX  # false beside a pixel without a label
        d = around[4][smooth].astype(float)
        y, x = (np.add.outer(r, 0 * c)[smooth] + rows.start, np.add.outer(0 * r, c)[smooth])
        x = x + cols.start
        places = *model.epipolar_to_left(x, y), *model.epipolar_to_right(x - d, y)
        found.append(np.column_stack(places))
    return np.concatenate(found)


@dataclass(frozen=True)
class Moves:
    """How far ``count`` labels have moved, px of disparity: ``median_px``, ``most_px``; NaN if none
    is left. ``gone_share``: of the labels before, those that are no more."""

    count: int
    median_px: float
    most_px: float
    gone_share: float

    def __str__(self) -> str:
        share = f"{100 * self.gone_share:.1f} %"
        gone = "" if share == "0.0 %" else f"; {share} of them are gone"
        if not self.count:
            return "has none of its labels left"
        if self.most_px < STILL_PX:
            return f"labels have not moved{gone}"
        most = f"{self.most_px:.2g} px at most"
        return f"labels moved by {self.median_px:.3f} px in the median, {most}{gone}"


def moves(before: Floats, store: str | Path) -> Moves | None:
    """From a sample of :func:`sample_labels` to a store; None of an empty sample."""
    if not len(before):
        return None
    group = require_complete(store)
    disparity, model = group["disparity"], EpipolarModel.from_dict(group.attrs["epipolar"])
    x, y = model.left_to_epipolar(*before[:, :2].T)
    x_right, _ = model.right_to_epipolar(*before[:, 2:].T)
    moved = np.abs(_between(disparity, x, y) - (x - x_right))
    left = moved[np.isfinite(moved)]
    figures = (float(np.median(left)), float(left.max())) if left.size else (math.nan, math.nan)
    return Moves(left.size, *figures, 1.0 - left.size / len(moved))


def _between(disparity: Any, x: Floats, y: Floats) -> Floats:
    """Bilinear values at places (px) of a stored grid; NaN where a pixel that counts has none."""
    place = np.stack([x, y])
    place = np.where(np.abs(place - np.rint(place)) < ON_GRID_PX, np.rint(place), place)
    first = np.floor(place).astype(int)
    beside = np.array([[0, 1, 0, 1], [0, 0, 1, 1]])[..., None]  # (x, y) of four pixels
    at, part = first[:, None] + beside, (place - first)[:, None]
    weight = np.where(beside == 1, part, 1.0 - part).prod(axis=0)
    values = np.where(weight > 0.0, np.nan, 0.0)
    size = np.array(disparity.shape[::-1])[:, None, None]
    read = ((at >= 0) & (at < size)).all(axis=0) & (weight > 0.0)
    values[read] = disparity.vindex[at[1][read], at[0][read]]  # each chunk once
    return (weight * values).sum(axis=0)


def since_last_run(stores: Mapping[str, str | Path]) -> dict[str, Moves]:
    """By scene, of disparity stores: how far labels have moved since samples were kept, where some
    were. A sample that cannot be read counts as none."""
    found = {}
    for scene, store in stores.items():
        try:
            before = np.load(KEPT / f"{scene}.npy")
        except (OSError, ValueError):
            continue
        if (moved := moves(before, store)) is not None:
            found[scene] = moved
    return found


def keep_samples(stores: Mapping[str, str | Path]) -> None:
    """Keep samples of disparity stores, by scene, for the next run."""
    KEPT.mkdir(parents=True, exist_ok=True)
    for scene, store in stores.items():
        with atomic_file(KEPT / f"{scene}.npy") as scratch, scratch.open("wb") as stream:
            np.save(stream, sample_labels(store))


def worst_point(alignment: Mapping[str, Any]) -> tuple[float, str]:
    """The control point of a record ``alignment.json`` that the others predict worst: its residual
    without it in the fit, over the median of its image's points; its name and figures in words,
    empty where there are too few points to tell."""
    found = [(0.0, "")]
    for view in ("left", "right"):
        points = [p for p in alignment.get(view, {}).get("gcps", []) if p.get("used", True)]
        points = [p for p in points if None not in p.get("leave_one_out", [None])]
        lengths = [math.hypot(*point["leave_one_out"]) for point in points]
        for point, length in zip(points, lengths):
            if median := float(np.median(lengths)):
                text = f"worst control point {point['id']} ({view} image): "
                text += f"{math.hypot(*point['after']):.2f} px off the fit, {length:.2f} px off "
                text += f"that of the others, {length / median:.1f} times the median of such"
                found.append((length / median, text))
    return max(found)


def edit_lines(moved: Mapping[str, Moves], alignments: Iterable[Mapping[str, Any]]) -> list[str]:
    """For the end of a run: since the last one, and the worst control point of each scene."""
    points = [(record.get("scene", ""), worst_point(record)[1]) for record in alignments]
    return [
        *(f"Since the last run, {scene}: {found}" for scene, found in moved.items()),
        *(f"{scene}: {point}" for scene, point in points if point),
    ]
