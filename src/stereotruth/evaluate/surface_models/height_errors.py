"""Vertical errors by what the reference shows: sums and histograms, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter

from ...core.numerics.statistics import ErrorSum, Scale
from ...lidar.height_raster import Floats
from .edges import near_steps
from .reference import BUILDING, GROUND, OTHER, TREE, WATER, Lattice

METRES = Scale((1.0, 3.0), 0.005, 40_001)  # to ±100 m
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

    points: int = 0  # of the reference; the errors are those where the model has a height
    errors: ErrorSum = field(default_factory=lambda: ErrorSum(METRES))

    def add(self, errors: Floats) -> None:
        """Add errors [n], NaN where the model has no height."""
        self.points += errors.size
        self.errors.add(errors[np.isfinite(errors)])

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready; ``known_share``: completeness, of the reference's points."""
        e = self.errors
        shares = e.shares_beyond("m")
        if not e.count:
            lacking = ("mean_m", "mean_absolute_m", "rms_m", "median_m", "nmad_m", "le90_m")
            known = 0.0 if self.points else None
            return {"points": self.points, "known_share": known, **dict.fromkeys(lacking), **shares}
        values = {
            "known_share": e.count / self.points,
            "mean_m": e.bias,
            "mean_absolute_m": e.mean_absolute,
            "rms_m": e.rms,
            "median_m": e.median,
            "nmad_m": e.nmad,
            "le90_m": e.quantile_of_size(0.9),
            **shares,
        }
        return {"points": self.points} | {k: round(float(v), 4) for k, v in values.items()}


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
