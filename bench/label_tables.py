"""Figures of labels against exact truth, and tables of them: shares, errors, edges, surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from labelled_block import Block
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from stereotruth.evaluation.labels_against_truth import CLASSES, WATER
from stereotruth.status import Status, is_labelled

OFF_PX = 1.0  # a label further away is off
STEP_PX = 1.0  # of disparity between neighbouring pixels: more is an edge
DISTANCES_PX = (1, 2, 3, 5, 10, np.inf)  # from the edge
NEAR_PX = 3.0
SURFACES = {"ground": "ground", "roof": "roof and wall", "wall": "roof and wall", "tree": "tree"}
KINDS = {
    "measured": Status.LABELLED,
    "between": Status.LABELLED_BETWEEN,
    "crown": Status.LABELLED_CROWN,
}
Bools = NDArray[np.bool_]


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
    hides which the LiDAR never saw. ``rings``:
    these by (surface, distance from the nearest edge). ``errors``: by kind of label, share of the
    visible pixels (%), errors (px), sigma's coverage (%). ``surfaces``: by kind of surface, share
    of the visible pixels and of these by status, %.
    """

    counts: NDArray[np.int64]
    hidden_in_both: float
    rings: dict[tuple[str, str], NDArray[np.int64]]
    errors: dict[str, dict[str, float]]
    surfaces: dict[str, dict[str, float]]

    @classmethod
    def of(cls, block: Block, found: dict[str, NDArray]) -> Figures:
        """Of the layers that were found for a block."""
        of = _Compared(block, found)
        return cls(of.counts(), of.hidden_in_both(), of.by_distance(), of.errors(), of.by_surface())


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

    def by_surface(self) -> dict[str, dict[str, float]]:
        result = {}
        for number, name in enumerate(CLASSES):
            part = self.visible & (self.kind == number)
            if not part.any():
                continue
            statuses = self.status[part]
            labelled = self.known & self.hidden & (self.kind == number)
            result[name] = {
                "all": percent(part.sum(), self.visible.sum()),
                "hidden labelled (of all hidden)": percent(labelled.sum(), self.hidden.sum()),
                "off (of all labelled)": percent(
                    (self.off & part).sum(), (self.known & self.visible).sum()
                ),
            } | {s.name.lower(): 100.0 * float((statuses == s).mean()) for s in Status}
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


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table that Markdown takes as it is."""
    print(f"\n{title}\n")
    width = [max(len(cell) for cell in column) for column in zip(columns, *rows)]
    for row in (columns, ["-" * w for w in width], *rows):
        print("| " + " | ".join(f"{cell:<{w}}" for cell, w in zip(row, width)) + " |")
