"""What an edit did: how far labels have moved, and the control point that fits worst.

A label joins a place of the left original image to one of the right. No edit of points, settings or
images' corrections moves these, while the epipolar grid follows the alignment: so labels of two
runs are compared at the same places of the left image, by where each has the right one. Heights
there are compared as well: without control points the images follow the LiDAR, so that a fault of
all its heights hardly moves a disparity.

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
SAMPLES = 40_000  # labels of a scene at most, evenly thinned: 1.6 MB
BLOCK_PX = 1024  # a shard of the stores
SAME_SURFACE_PX = 1.0  # spread of the labels around one: with more, an edge is near
ON_GRID_PX = 1e-3  # what the inverse of the epipolar model leaves
STILL = 0.0005  # px or m: less is said to be none
COLUMNS = 5  # of a sample


def sample_labels(store: str | Path) -> Floats:
    """[n, (left col, row, right col, row, height)] px of the original images and m, of labels of a
    disparity store whose eight neighbours have labels of the same surface. Raises InputError."""
    group = require_complete(store)
    disparity, heights = group["disparity"], group["height"]
    model = EpipolarModel.from_dict(group.attrs["epipolar"])
    step = max(1, math.ceil(math.sqrt(math.prod(disparity.shape) / SAMPLES)))
    found = [np.empty((0, COLUMNS))]
    for rows, cols in blocks(disparity.shape, BLOCK_PX):
        values = np.asarray(disparity[rows, cols])
        r, c = (np.arange(1, n - 1, step) for n in values.shape)
        around = np.stack([values[np.ix_(r + i, c + j)] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        smooth = np.ptp(around, axis=0) < SAME_SURFACE_PX  # false beside a pixel without a label
        d = around[4][smooth].astype(float)
        y, x = (np.add.outer(r, 0 * c)[smooth] + rows.start, np.add.outer(0 * r, c)[smooth])
        x = x + cols.start
        height = np.asarray(heights[rows, cols])[np.ix_(r, c)][smooth].astype(float)
        places = *model.epipolar_to_left(x, y), *model.epipolar_to_right(x - d, y)
        found.append(np.column_stack([*places, height]))
    return np.concatenate(found)


@dataclass(frozen=True)
class Moves:
    """How far ``count`` labels have moved, px of disparity: ``median_px``, ``most_px``; NaN if none
    is left. ``gone_share``: of the labels before, those that are no more. ``height_median_m``,
    ``height_most_m``: how far heights have moved at labels that are left."""

    count: int
    median_px: float
    most_px: float
    gone_share: float
    height_median_m: float
    height_most_m: float

    def __str__(self) -> str:
        if not self.count:
            return "has none of its labels left"
        return f"labels {self.disparities}; heights {self.heights}"

    @property
    def disparities(self) -> str:
        """How far labels have moved, in words, and how many are gone."""
        share = f"{100 * self.gone_share:.1f} %"
        gone = "" if share == "0.0 %" else f"; {share} of them are gone"
        return _in_words(self.median_px, self.most_px, "px") + gone

    @property
    def heights(self) -> str:
        """How far heights have moved, in words."""
        return _in_words(self.height_median_m, self.height_most_m, "m")


def _in_words(median: float, most: float, unit: str) -> str:
    if math.isnan(most):
        return "are gone"
    if most < STILL:
        return "have not moved"
    return f"moved by {median:.3f} {unit} in the median, {most:.2g} {unit} at most"


def moves(before: Floats, store: str | Path) -> Moves | None:
    """From a sample of :func:`sample_labels` to a store; None of an empty sample."""
    if not len(before):
        return None
    group = require_complete(store)
    disparity, model = group["disparity"], EpipolarModel.from_dict(group.attrs["epipolar"])
    x, y = model.left_to_epipolar(*before[:, :2].T)
    x_right, _ = model.right_to_epipolar(*before[:, 2:4].T)
    moved = np.abs(_between(disparity, x, y) - (x - x_right))
    left = np.isfinite(moved)
    lifted = np.abs(_between(group["height"], x, y) - before[:, 4])[left]
    figures = [
        (float(np.median(v)), float(v.max())) if v.size else (math.nan, math.nan)
        for v in (moved[left], lifted[np.isfinite(lifted)])
    ]
    return Moves(int(left.sum()), *figures[0], 1.0 - left.mean(), *figures[1])


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
    were. A sample that cannot be read, or is of another form, counts as none."""
    found = {}
    for scene, store in stores.items():
        try:
            before = np.load(KEPT / f"{scene}.npy")
        except (OSError, ValueError):
            continue
        if before.shape[1:] == (COLUMNS,) and (moved := moves(before, store)) is not None:
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
