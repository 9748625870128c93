"""Vertical errors by what the reference shows: sums and histograms, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from .edges import near_steps
from .height_raster import Floats
from .reference import BUILDING, GROUND, OTHER, TREE, WATER, Lattice

LIMITS_M = (1.0, 3.0)
BIN_M = 0.005
BINS = 40_001  # to ±100 m; what is beyond counts into the outer bins
STEP_REACH_M = 3.0  # around a step, or the shadow of one: heights there say where the edge is
CROWN_REACH_M = 1.5  # around a crown, below which slanting pulses reach the ground
SLOPES_DEG = (0.0, 5.0, 15.0, 30.0, 90.0)
SMOOTH_M = 2.0  # over which slopes are taken
SOLID = "all but trees and water"
OPEN = "off steps"  # and off crowns: the vertical error proper
STEPS = "beside steps and trees"


@dataclass
class HeightErrors:
    """Errors in m of a stratum: model less reference."""

    points: int = 0  # of the reference
    count: int = 0  # of them, where the model has a height
    total: float = 0.0
    absolute: float = 0.0
    square: float = 0.0
    beyond: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(LIMITS_M), np.int64))
    histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))

    def add(self, errors: Floats) -> None:
        """Add errors [n], NaN where the model has no height."""
        self.points += errors.size
        errors = errors[np.isfinite(errors)]
        size = np.abs(errors)
        self.count += errors.size
        self.total += float(errors.sum())
        self.absolute += float(size.sum())
        self.square += float((errors * errors).sum())
        self.beyond += [int((size > limit).sum()) for limit in LIMITS_M]
        index = np.clip(np.rint(errors / BIN_M) + BINS // 2, 0, BINS - 1).astype(np.int64)
        self.histogram += np.bincount(index, minlength=BINS)

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready; ``known_share``: completeness, of the reference's points."""
        names = [f"share_over_{limit:g}_m" for limit in LIMITS_M]
        medians = ("median_m", "nmad_m", "le90_m")
        if not self.count:
            lacking = ("mean_m", "mean_absolute_m", "rms_m", *medians, *names)
            share = 0.0 if self.points else None
            return {"points": self.points, "known_share": share, **dict.fromkeys(lacking)}
        n, middle = self.count, BINS // 2
        median = _quantile(self.histogram, 0.5)
        values = {
            "known_share": n / self.points,
            "mean_m": self.total / n,
            "mean_absolute_m": self.absolute / n,
            "rms_m": (self.square / n) ** 0.5,
            "median_m": (median - middle) * BIN_M,
            "nmad_m": 1.4826 * _quantile(_folded(self.histogram, median), 0.5) * BIN_M,
            "le90_m": _quantile(_folded(self.histogram, middle), 0.9) * BIN_M,
            **{name: int(k) / n for name, k in zip(names, self.beyond)},
        }
        return {"points": self.points} | {k: round(float(v), 4) for k, v in values.items()}


def _quantile(histogram: NDArray[np.int64], share: float) -> int:
    total = np.cumsum(histogram)
    return int(np.searchsorted(total, share * total[-1]))


def _folded(histogram: NDArray[np.int64], middle: int) -> NDArray[np.int64]:
    """Histogram of the distances to the bin ``middle``."""
    above, below = histogram[middle:], histogram[:middle][::-1]
    folded = np.zeros(max(above.size, below.size + 1), dtype=np.int64)
    folded[: above.size] = above
    folded[1 : 1 + below.size] += below
    return folded


def slopes(lattice: Lattice) -> Floats:
    """Slope in degrees of the ground around each square, NaN where there is none."""
    ground = (lattice.kind == GROUND) | (lattice.kind == OTHER)
    sigma = SMOOTH_M / lattice.step_m
    weight = gaussian_filter(ground.astype(np.float64), sigma)
    middle = np.nanmean(lattice.z[ground]) if ground.any() else 0.0
    z = gaussian_filter(np.where(ground, lattice.z - middle, 0.0), sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        south, east = np.gradient(z / weight, lattice.step_m)
        found = np.degrees(np.arctan(np.hypot(south, east)))
    return np.where(weight > 0.3, found, np.nan)


def strata(lattice: Lattice, classified: bool) -> dict[str, NDArray[np.bool_]]:
    """The squares of each stratum, by its name; only of the lattice's own window."""
    kind, own = lattice.kind, lattice.own & np.isfinite(lattice.z)
    solid = own & (kind != TREE) & (kind != WATER)
    reach = 2 * int(np.ceil(CROWN_REACH_M / lattice.step_m)) + 1
    crown = maximum_filter(kind == TREE, reach, mode="nearest")
    open_places = solid & ~near_steps(lattice, STEP_REACH_M) & ~crown & lattice.even
    found = {OPEN: open_places, STEPS: solid & ~open_places, SOLID: solid}
    if classified:
        found["ground, off steps"] = open_places & (kind == GROUND)
        found["buildings, off steps"] = open_places & (kind == BUILDING)
        found["other, off steps"] = open_places & (kind == OTHER)
        found["trees"] = own & (kind == TREE)
        found["water"] = own & (kind == WATER)
    slope = slopes(lattice)
    ground = open_places & (kind != BUILDING)
    for low, high in pairwise(SLOPES_DEG):
        with np.errstate(invalid="ignore"):
            chosen = ground & (slope >= low) & (slope < high)
        found[f"ground, slope {low:g}–{high:g}°"] = chosen
    return found
