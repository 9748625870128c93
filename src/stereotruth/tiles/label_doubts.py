"""What images say of labels: doubts about a scene by surface, and limits of tiles and scenes.

Of each surface the location of 'SIFT disparity less label' is found robustly (see
:func:`location`), with a standard error from the scatter between cells of ``CELL_PX``. A
disagreement that chance explains too seldom, by that error, what SIFT itself is off and what the
labels state, is a doubt. One that the labels' uncertainty does explain, but is significant without
it and larger than ``REMARK_PX``, is a remark (docs/explanation/uncertainty.md). Crowns are told,
and raise neither. Rows are judged in the same way by the y-parallax, which should be zero.

Limits hold figures that need no truth: residuals of the control points, SIFT matches and image
warping (section IV of the paper). A tile or scene beyond one is flagged, not dropped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from ..core.config.configuration import Limits
from ..core.numerics.arrays import Floats
from ..core.numerics.statistics import TO_SIGMA, biweight
from .label_surfaces import LabelSurface
from .sift_matches import TileMatches

CELL_PX = 256  # px of the scene's grid
MIN_CELLS = 5  # with fewer, by number or by weight, their scatter says nothing
SIFT_SIGMA_PX = 0.02  # what SIFT may be off on exact labels of drawn scenes
STATED = 0.2  # quantile of the labels' uncertainties
REMARK_PX = 0.1
REACH = 3.0  # scales from the location at which a match no longer counts
STEPS = 100  # of the iteration, at most
PARALLAX = "y-parallax"
ALIGNMENT, LIDAR, STRIPS = ABOUT = ("alignment", "LiDAR", "strips")  # what earlier stages tell of
FIGURES = {  # the figure that a limit is for; of signed figures, the size counts
    "max_gcp_rms_px": "gcp_rms_px",
    "max_y_parallax_px": "y_parallax_median_px",
    "max_sift_error_px": "sift_median_error_px",
    "max_sift_mean_absolute_error_px": "sift_mean_absolute_error_px",
    "min_sift_matches": "sift_matches",
    "min_warp_correlation": "warp_correlation",
    "min_agreement": "agreement",
}
OF_ERRORS = ("max_sift_error_px", "max_sift_mean_absolute_error_px")
JUDGED = (LabelSurface.OPEN_GROUND.words, LabelSurface.ROOFS.words, PARALLAX)


@dataclass(frozen=True)
class Bias:
    """What the images say of the labels of a surface, px: SIFT disparity less label.

    ``error``: its standard error, from ``cells`` effective cells of ``matches``; ``stated``: what
    the labels state of themselves there.
    """

    surface: str
    matches: int
    cells: float
    value: float
    error: float
    stated: float

    @property
    def sigma(self) -> float:
        """Standard uncertainty of what the images say, that of SIFT itself included."""
        return math.hypot(self.error, SIFT_SIGMA_PX)

    def chance(self, stated: float) -> float:
        """Probability of so large a bias where labels of that standard uncertainty are right.

        Two-sided, by Student's t with the effective degrees of freedom of Welch and Satterthwaite.
        """
        variance = self.sigma**2 + stated**2
        freedom = (self.cells - 1.0) * (variance / max(self.error**2, 1e-12)) ** 2
        return float(2.0 * stdtr(freedom, -abs(self.value) / math.sqrt(variance)))

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "matches": self.matches,
            "cells": round(self.cells, 1),
            "bias_px": round(self.value, 4),
            "standard_error_px": round(self.error, 4),
            "sift_sigma_px": SIFT_SIGMA_PX,
            "labels_sigma_px": round(self.stated, 4),
        }

    def sentence(self, explained: bool) -> str:
        """The disagreement in words; ``explained``: what the labels state covers it."""
        if self.surface == PARALLAX:
            what = f"rows of left and right differ by {self.value:+.2f} ± {self.sigma:.2f} px"
        else:
            value = f"{self.value:+.2f} ± {self.sigma:.2f} px"
            what = f"images say {value} of the labels of {self.surface}"
        word = "within" if explained else "more than"
        return f"{what}, {word} the {self.stated:.2f} px that the alignment states"


@dataclass(frozen=True)
class Doubt:
    """What is doubted of a scene: by its images, ``about`` a surface, or told by earlier stages,
    ``about`` one of ABOUT; ``explained``: labels state it in their uncertainty."""

    about: str
    sentence: str
    explained: bool = False

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"of": self.about, "text": self.sentence, "explained_by_alignment": self.explained}

    def __str__(self) -> str:
        return self.sentence


def location(values: Floats) -> tuple[float, Floats, float]:
    """Robust location of values with tails to one side; each one's influence; its sum's slope.

    Tukey's biweight, which gives no weight to what is ``REACH`` scales away, from the half-sample
    mode on, so that the dense part is followed and not the tail. The scale is that of a normal
    distribution whose densest half is as wide. The influences add up to zero.
    """
    at = half_sample_mode(values)
    width = float(np.ptp(shortest_half(np.sort(values))))
    reach = REACH * max(width * TO_SIGMA / 2.0, 1e-4)
    for _ in range(STEPS):
        weight = biweight((values - at) / reach)
        step = float((weight * (values - at)).sum() / weight.sum())
        at += step
        if abs(step) < 1e-6:
            break
    inside = np.maximum(1.0 - ((values - at) / reach) ** 2, 0.0)
    slope = float((inside * (5.0 * inside - 4.0)).sum())
    return at, inside**2 * (values - at), slope


def shortest_half(ordered: Floats) -> Floats:
    """Of ascending values, the half that lies in the shortest interval."""
    half = (ordered.size + 1) // 2
    first = int(np.argmin(ordered[half - 1 :] - ordered[: ordered.size - half + 1]))
    return ordered[first : first + half]


def half_sample_mode(values: Floats) -> float:
    """The mode by halving (Bickel and Frühwirth 2006): the densest half of the densest half …"""
    v = np.sort(values)
    while v.size > 2:
        v = shortest_half(v)
    return float(v.mean())


def bias_of(surface: str, values: Floats, cell: NDArray[np.int64], stated: Floats) -> Bias | None:
    """The bias of values (px) in numbered cells, or None where they are too few to tell."""
    if not values.size:
        return None
    _, which, counts = np.unique(cell, return_inverse=True, return_counts=True)
    cells = float(counts.sum() ** 2 / (counts.astype(float) ** 2).sum())
    if cells < MIN_CELLS:
        return None
    at, influence, slope = location(values)
    if slope <= 0.0:
        return None
    sums = np.bincount(which, influence)
    error = math.sqrt(float((sums**2).sum()) * cells / (cells - 1.0)) / slope
    sigma = float(np.quantile(stated, STATED)) if stated.size else 0.0
    return Bias(surface, values.size, cells, at, error, sigma)


@dataclass
class SceneMatches:
    """Matches of the labelled tiles of a scene, as far as doubts need them."""

    parts: list[Floats] = field(default_factory=list)

    def add(
        self, m: TileMatches, surface: NDArray[np.uint8], sigma: Floats, row0: int, col0: int
    ) -> None:
        """Add those of the tile whose upper-left pixel lies there in the scene's grid.

        ``surface``, ``sigma``: what each match's label lies on, and its uncertainty, px.
        """
        cell = np.floor((m.y + row0) / CELL_PX) * 2.0**20 + np.floor((m.x + col0) / CELL_PX)
        columns = (m.error, m.y_parallax, m.in_row, surface, sigma, cell)
        self.parts.append(np.stack([np.asarray(c, np.float64) for c in columns]))

    @cached_property
    def biases(self) -> list[Bias]:
        """What the images say by surface, and of the rows; those that can be told."""
        error, parallax, in_row, surface, stated, cell = np.hstack([np.empty((6, 0)), *self.parts])
        cell, found = cell.astype(np.int64), []
        for kind in LabelSurface:
            of = (surface == kind) & (in_row > 0)
            if kind != LabelSurface.NEAR_EDGES:
                found.append(bias_of(kind.words, error[of], cell[of], stated[of]))
        plain = (surface == LabelSurface.OPEN_GROUND) | (surface == LabelSurface.ROOFS)
        found.append(bias_of(PARALLAX, parallax[plain], cell[plain], stated[plain]))
        return [bias for bias in found if bias is not None]


def agreement(biases: Iterable[Bias]) -> float | None:
    """Probability that labels as sure as they say disagree so with the images, by chance.

    Of all that is judged together, each at most (Bonferroni); None where nothing can be told.
    """
    chances = [bias.chance(bias.stated) for bias in biases if bias.surface in JUDGED]
    return min(1.0, min(chances) * len(chances)) if chances else None


def doubts(biases: Iterable[Bias], probability: float | None) -> list[Doubt]:
    """Where images and labels disagree, by a probability of saying so by chance in a scene.

    None without a probability.
    """
    if probability is None:
        return []
    judged = [bias for bias in biases if bias.surface in JUDGED]
    found = []
    for bias in judged:
        unlikely = bias.chance(bias.stated) * len(judged) < probability
        alone = bias.chance(0.0) * len(judged) < probability and abs(bias.value) > REMARK_PX
        if unlikely or alone:
            explained = not unlikely
            found.append(Doubt(bias.surface, bias.sentence(explained), explained))
    return found


class Miss(NamedTuple):
    """A gate that was missed: its name in the configuration, the value found, the limit."""

    gate: str
    value: float
    limit: float

    def __str__(self) -> str:
        word = "below" if self.gate.startswith("min_") else "above"
        return f"{FIGURES[self.gate]} {self.value:.3g} is {word} {self.gate} {self.limit:g}"


def missed(figures: Mapping[str, float | int | None], limits: Limits) -> list[Miss]:
    """Gates that the figures miss, in the order of the limits.

    A figure that is absent, None or NaN misses nothing. With fewer matches than
    ``min_sift_matches``, that gate alone speaks for their errors: a few say nothing.
    """
    found = []
    count = figures.get("sift_matches")
    few = limits.min_sift_matches is not None and (count or 0) < limits.min_sift_matches
    for gate, name in FIGURES.items():
        limit, value = getattr(limits, gate), figures.get(name)
        if limit is None or value is None or math.isnan(value) or (few and gate in OF_ERRORS):
            continue
        low = gate.startswith("min_")
        if value < limit if low else abs(value) > limit:
            found.append(Miss(gate, value, limit))
    return found


def flag(misses: Sequence[Miss]) -> str:
    """Cell of the manifest: ``ok``, or the names of the missed gates with ``;`` between."""
    return ";".join(miss.gate for miss in misses) or "ok"
