"""Figures of labels and alignments against what is true, tables of them, and pictures.

Truth is exact (of a block: shares, errors, edges, surfaces; of an alignment: exact ground points)
or that of check points, which were measured in both images and took no part in anything. Their
disparity is x_left − x_right of the two image positions, mapped by the epipolar model. The label is
taken at the sub-pixel position in the rectified left image: bilinearly from those of the four
neighbours that are labelled (weights renormalised), if the nearest is; from the nearest alone if
the labels differ by more than ``STEP_PX``, as at an edge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from synthetic_pairs import Block

from stereotruth.align.control_points import ControlPoints, read_gcps
from stereotruth.core.numerics.statistics import LIMITS, ErrorSum, median_and_nmad
from stereotruth.core.products.files import atomic_file
from stereotruth.core.products.grids import blocks, require_complete
from stereotruth.core.status import Status, is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.labels_against_truth import CLASSES, WATER
from stereotruth.pages.pictures import DIFFERENCES, DISPARITIES, NO_VALUE
from stereotruth.tiles.tile_checks import WarpedTile

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

OFF_PX = 1.0  # a label further away is off
STEP_PX = 1.0  # of disparity between neighbouring pixels: more is an edge
DISTANCES_PX = (1, 2, 3, 5, 10, np.inf)  # from the edge
NEAR_PX = 3.0
RAW_ROWS = 1024  # of a raw image that are read at a time
SURFACES = {"ground": "ground", "roof": "roof and wall", "wall": "roof and wall", "tree": "tree"}
KINDS = {
    "measured": Status.LABELLED,
    "between": Status.LABELLED_BETWEEN,
    "crown": Status.LABELLED_CROWN,
}


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table that Markdown takes as it is."""
    print(f"\n{title}\n")
    width = [max(len(cell) for cell in column) for column in zip(columns, *rows)]
    for row in (columns, ["-" * w for w in width], *rows):
        print("| " + " | ".join(f"{cell:<{w}}" for cell, w in zip(row, width)) + " |")


def print_records(title: str, records: Sequence[Mapping[str, str]]) -> None:
    """The same of records whose keys are the columns; nothing of none."""
    if records:
        print_table(title, list(records[0]), [list(record.values()) for record in records])


def edge_distance(disparity: NDArray) -> NDArray[np.float64]:
    """Distance (px) of pixels' centres from the nearest step between two of a disparity [h, w]."""
    steps = np.zeros(disparity.shape, bool)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            step = np.abs(np.diff(disparity, axis=axis)) > STEP_PX
            here, there = [slice(None)] * 2, [slice(None)] * 2
            here[axis], there[axis] = slice(None, -1), slice(1, None)
            steps[tuple(here)] |= step
            steps[tuple(there)] |= step
    if not steps.any():
        return np.full(disparity.shape, np.inf)
    return distance_transform_edt(~steps) + 0.5


def composition(block: Block) -> tuple[float, float, float]:
    """Megapixels that both views see, % of crowns among them, and % near an edge."""
    visible = block.truth.groups()["visible"] & (block.truth.kind != WATER)
    crowns = visible & (block.surface == CLASSES.index("tree"))
    near = visible & (edge_distance(block.truth.disparity) <= NEAR_PX)
    count = visible.sum()
    return count / 1e6, percent(crowns.sum(), count), percent(near.sum(), count)


@dataclass(frozen=True)
class Figures:
    """Figures of the labels of a block.

    ``counts``: pixels visible, of these labelled, hidden, of these labelled, and off.
    ``hidden_in_both``: % of the hidden pixels with a label, without those that only a building
    hides which the LiDAR never saw. ``rings``: these by (surface, distance from the nearest edge).
    ``errors``: by kind of label, share of the visible pixels (%), errors (px), sigma's coverage
    (%).
    """

    counts: NDArray[np.int64]
    hidden_in_both: float
    rings: dict[tuple[str, str], NDArray[np.int64]]
    errors: dict[str, dict[str, float]]

    @classmethod
    def of(cls, block: Block, found: dict[str, NDArray]) -> Figures:
        """Of the layers that were found for a block."""
        of = _Compared(block, found)
        return cls(of.counts(), of.hidden_in_both(), of.by_distance(), of.errors())


class _Compared:
    """The labels of a block, and what is true there."""

    def __init__(self, block: Block, found: dict[str, NDArray]) -> None:
        truth = block.truth
        groups, land = truth.groups(), truth.kind != WATER
        self.kind, self.surface = truth.kind, block.surface
        self.visible, self.hidden = groups["visible"] & land, groups["hidden"] & land
        self.bared = groups["hidden_bared"]
        self.status = found["status"]
        self.known = is_labelled(self.status)
        self.error = np.where(self.known, found["disparity"] - truth.disparity, 0.0)
        self.sigma = found["uncertainty"].astype(np.float64)
        self.off = self.known & self.visible & (np.abs(self.error) > OFF_PX)
        self.distance = edge_distance(truth.disparity)

    def counts(self, part: Bools | bool = True) -> NDArray[np.int64]:
        """Pixels as in Figures, of a part."""
        seen, hidden = self.visible & part, self.hidden & part
        masks = (seen, seen & self.known, hidden, hidden & self.known, self.off & part)
        return np.array([int(mask.sum()) for mask in masks])

    def hidden_in_both(self) -> float:
        hidden = self.hidden & ~self.bared
        return percent((hidden & self.known).sum(), hidden.sum())

    def by_distance(self) -> dict[tuple[str, str], NDArray[np.int64]]:
        surfaces = {name: np.zeros_like(self.visible) for name in ("all", *SURFACES.values())}
        for surface, name in SURFACES.items():
            surfaces[name] |= self.surface == CLASSES.index(surface)
        surfaces["all"][:] = True
        result, low = {}, 0.0
        for high in DISTANCES_PX:
            name = f"> {low:g}" if np.isinf(high) else f"{low:g}–{high:g}"
            ring = (self.distance > low) & (self.distance <= high)
            result |= {(of, name): self.counts(ring & mask) for of, mask in surfaces.items()}
            low = high
        near = self.distance <= NEAR_PX
        name = f"0–{NEAR_PX:g} together"
        return result | {(of, name): self.counts(near & mask) for of, mask in surfaces.items()}

    def errors(self) -> dict[str, dict[str, float]]:
        result = {}
        for name, status in KINDS.items():
            part = self.visible & (self.status == status)
            if not part.any():
                continue
            size, sigma = np.abs(self.error[part]), self.sigma[part]
            result[name] = {
                "share": percent(part.sum(), self.visible.sum()),
                "mean absolute": float(size.mean()),
                "median": float(np.median(self.error[part])),
                "< 1 sigma": 100.0 * float((size < sigma).mean()),
                "< 2 sigma": 100.0 * float((size < 2 * sigma).mean()),
            }
        return result


def percent(part: int, of: int) -> float:
    """A share in %; NaN of nothing."""
    return 100.0 * float(part) / float(of) if of else np.nan


def shares(counts: NDArray[np.int64]) -> tuple[float, float, float]:
    """Visible labelled, hidden labelled, off (of the labelled visible), %."""
    visible, labelled, hidden, wrong, off = counts
    return percent(labelled, visible), percent(wrong, hidden), percent(off, labelled)


def shown(values: Sequence[float]) -> str:
    """``96.4 / .34 / .008``: two digits of small shares."""
    return " / ".join("–" if np.isnan(v) else _digits(v) for v in values)


def _digits(value: float) -> str:
    if value >= 10:
        return f"{value:.1f}"
    text = f"{value:.2f}" if value >= 0.1 else f"{value:.3f}"
    return text.lstrip("0") if value < 1 and float(text) else ("0" if not float(text) else text)


def spread(rows: Sequence[Sequence[float]]) -> tuple[str, str]:
    """Median of each share over scenes, and its least and greatest."""
    columns = list(zip(*rows))
    least, most = ([_digits(f(column)) for column in columns] for f in (min, max))
    return shown([median(column) for column in columns]), " / ".join(
        f"{low}–{high}" for low, high in zip(least, most)
    )


@dataclass(frozen=True, eq=False)
class CheckPointErrors:
    """n check points that both images see.

    ``x``, ``y`` px in the left epipolar grid, ``measured`` and ``label`` disparity in px (NaN
    where there is no label), ``inner`` bool[n]: four labelled neighbours of one surface;
    ``y_parallax`` px, y_right − y_left of the measured positions.
    """

    ids: tuple[str, ...]
    x: Floats
    y: Floats
    measured: Floats
    label: Floats
    inner: NDArray[np.bool_]
    y_parallax: Floats

    def figures(self) -> dict[str, Any]:
        """JSON-ready: px, of label less measured disparity, and of the y-parallax.

        ``inner``: of the points on one surface. A check point on the corner of a roof has ground
        for most of its neighbours, and which of them it stands for is not known.
        """
        labelled = np.isfinite(self.label)
        errors = (self.label - self.measured)[labelled]
        result: dict[str, Any] = {
            "points": len(self.ids),
            "labelled": int(labelled.sum()),
            "y_parallax_rms": None,
            "y_parallax_median": None,
        }
        result |= _error_figures(errors)
        result["inner"] = _error_figures((self.label - self.measured)[labelled & self.inner])
        if self.ids:
            result["y_parallax_rms"] = float(np.sqrt(np.mean(self.y_parallax**2)))
            result["y_parallax_median"] = float(np.median(self.y_parallax))
        return {k: round(v, 6) if isinstance(v, float) else v for k, v in result.items()}


def _error_figures(errors: Floats) -> dict[str, Any]:
    if not errors.size:
        return {"count": 0, "median": None, "nmad": None, "mean_absolute": None}
    median, nmad = median_and_nmad(errors)
    size = np.abs(errors)
    values = {"median": median, "nmad": nmad, "mean_absolute": float(size.mean())}
    values |= {f"share_over_{limit:g}_px": float((size > limit).mean()) for limit in LIMITS}
    return {"count": errors.size, **{key: round(value, 6) for key, value in values.items()}}


def sample_labels(disparity: Any, x: Floats, y: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Labels float64[n] px at sub-pixel positions of a grid [y, x]; NaN where there is none.

    The second is bool[n]: all four neighbours are labelled, as one surface. ``disparity`` may be
    a Zarr array; it is read in blocks.
    """
    height, width = disparity.shape
    label, inner = np.full(x.shape, np.nan), np.zeros(x.shape, dtype=bool)
    # Every point belongs to the block of its upper-left neighbour.
    i = np.clip(np.floor(x), 0, width - 2)
    j = np.clip(np.floor(y), 0, height - 2)
    inside = (np.abs(x - (width - 1) / 2) <= width / 2) & (
        np.abs(y - (height - 1) / 2) <= height / 2
    )
    for rows, cols in blocks((height, width), 1024):
        at = np.flatnonzero(
            inside & (j >= rows.start) & (j < rows.stop) & (i >= cols.start) & (i < cols.stop)
        )
        if not at.size:
            continue
        part = np.asarray(disparity[rows.start : rows.stop + 1, cols.start : cols.stop + 1], float)
        jj, ii = (j[at] - rows.start).astype(int), (i[at] - cols.start).astype(int)
        four = np.stack(
            [part[jj, ii], part[jj, ii + 1], part[jj + 1, ii], part[jj + 1, ii + 1]], axis=1
        )
        fy, fx = np.clip(y[at] - j[at], 0, 1), np.clip(x[at] - i[at], 0, 1)  # half a pixel outside
        weights = np.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx], axis=1)
        nearest = np.argmax(weights, axis=1)
        there = four[np.arange(at.size), nearest]
        known = np.isfinite(four)
        weights = np.where(known, weights, 0.0)
        low, high = (f(np.where(known, four, there[:, None]), axis=1) for f in (np.min, np.max))
        with np.errstate(invalid="ignore"):
            mean = (weights * np.where(known, four, 0.0)).sum(axis=1) / weights.sum(axis=1)
            one_surface = high - low <= STEP_PX
        label[at] = np.where(np.isfinite(there), np.where(one_surface, mean, there), np.nan)
        inner[at] = known.all(axis=1) & one_surface
    return label, inner


def check_point_errors(
    model: EpipolarModel, disparity: Any, points: ControlPoints
) -> CheckPointErrors:
    """Labels of a disparity grid [y, x] against the check points that both images see."""
    both = np.flatnonzero(np.logical_and(*points.seen))
    x, y = model.left_to_epipolar(*points.left[both].T)
    x_right, y_right = model.right_to_epipolar(*points.right[both].T)
    label, inner = sample_labels(disparity, x, y)
    return CheckPointErrors(
        ids=tuple(points.ids[i] for i in both),
        x=x,
        y=y,
        measured=x - x_right,
        label=label,
        inner=inner,
        y_parallax=y_right - y,
    )


def evaluate_checkpoints(
    disparity: str | Path, checkpoints_csv: str | Path, *, scene: str = ""
) -> Mapping[str, Any]:
    """Figures of a scene's disparity.zarr at the check points of a CSV file (that of GCPs).

    Raises InputError for an unfinished store or a faulty file.
    """
    store = require_complete(disparity)
    model = EpipolarModel.from_dict(store.attrs["epipolar"])
    points = read_gcps(checkpoints_csv, scene)
    return check_point_errors(model, store["disparity"], points).figures()


def geometry_errors(
    model: EpipolarModel, raw_truth: str | Path, *, step: int = 7
) -> tuple[ErrorSum, ErrorSum]:
    """Errors of (disparity, y-parallax), px.

    The exact ground points of every ``step``-th raw pixel that both views see go through the
    pipeline's sensor models. The first is the error of a label on an exact point, compared with
    the truth of the same pixel; the second the y-parallax of the true correspondences.
    ``raw_truth``: the truth on the raw left image's grid.
    """
    group = require_complete(raw_truth)
    disparity, parallax = ErrorSum(), ErrorSum()
    height, width = group["right_col"].shape
    for top in range(0, height, RAW_ROWS):
        window = np.s_[top : min(top + RAW_ROWS, height)]
        thin = np.s_[-top % step :: step, ::step]
        seen = np.asarray(group["visible_right"][window])[thin] == 1
        row, col = np.mgrid[window, 0:width]
        row, col = row[thin][seen].astype(float), col[thin][seen].astype(float)
        lon, lat, h, right_col, right_row = (
            np.asarray(group[name][window], dtype=np.float64)[thin][seen]
            for name in ("lon", "lat", "height", "right_col", "right_row")
        )
        x_left, y_left = model.left_to_epipolar(col, row)
        x_right, y_right = model.right_to_epipolar(right_col, right_row)
        found = model.ground_to_epipolar(lon, lat, h)
        disparity.add(found[0] - found[2] - (x_left - x_right))
        parallax.add(y_right - y_left)
    return disparity, parallax


def draw_panels(tile: WarpedTile, path: str | Path) -> None:
    """PNG of the left image, the warped right one, their difference and the disparity.

    The difference is taken after a linear match of brightness.
    """
    figure = Figure(figsize=(15, 14.4), layout="constrained")
    axes = figure.subplots(2, 2)
    low, high = np.percentile(tile.left, (1, 99))
    difference = tile.left - tile.sums.match(tile.warped)
    spread = float(np.nanpercentile(np.abs(difference), 99)) if np.isfinite(difference).any() else 1
    gray = {"cmap": "gray", "vmin": low, "vmax": high}
    panels = (
        (tile.left, "left", gray),
        (tile.warped, f"warped right, correlation {tile.correlation:.3f}", gray),
        (
            difference,
            "left − warped right, brought to its brightness",
            {"cmap": DIFFERENCES, "vmin": -spread, "vmax": spread},
        ),
        (tile.disparity, "disparity (px)", {"cmap": DISPARITIES}),
    )
    for ax, (image, title, style) in zip(axes.ravel(), panels):
        ax.set_facecolor("black" if style is gray else np.array(NO_VALUE) / 255)
        shown = ax.imshow(image, interpolation="nearest", **style)
        ax.set_title(f"{tile.name}: {title}", parse_math=False)
        if style is not gray:
            figure.colorbar(shown, ax=ax, shrink=0.7)
    with atomic_file(path) as scratch:
        figure.savefig(scratch, dpi=75)
