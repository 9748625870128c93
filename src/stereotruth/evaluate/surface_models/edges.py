"""Where a surface model has the edges of roofs, in metres.

A vertical error at a wall says little: it grows with the building's height, and a mean over all
cells drowns it. Here the error is horizontal. From the reference points around an edge follow its
straight line, the height of the roof beside it and that of the ground at its foot. The model's
heights along the line's normal are brought to shares of that step; at each level between the two a
sharp edge stands at 0, and the model's somewhere else. The position error of an edge is the mean of
that distance over the levels from a tenth to nine tenths of the step, which is an area between two
profiles:

    error   = ∫ |q(s) − q₀(s)| ds        outward = ∫ (q(s) − q₀(s)) ds

with s in m outward along the normal, q the model's share of the step and q₀ the sharp edge's.
A roof drawn 1 m too wide has 1 and +1; an edge that is blurred to both sides with a standard
deviation of 1 m has 0.56 and 0. Vertical noise below a tenth of the step has no say.

The resolution is what is left of the error when the sharp edge is moved, profile by profile, to
where the model has it: as the width at half maximum of the Gaussian spread that leaves as much, so
that an edge in a wrong place is as well resolved as one in the right place.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from ...core.numerics.statistics import ErrorSum, Scale
from ...lidar.height_raster import Floats
from .reference import BUILDING, NONE, OTHER, TREE, WATER, Lattice

# All-NaN rows are edges that are dropped: NumPy need not warn of them.
_quiet = partial(warnings.catch_warnings, action="ignore", category=RuntimeWarning)

LEAST_STEP_M = 3.0  # of a roof's edge over the ground beside it
REACH_M = 4.0  # of profiles to each side, and of the points that tell the line
NEAR_M = 2.0  # of roof points that tell the eaves' height
APART_M = 3.0  # between edges that are looked at
LEAST_POINTS = 12  # on each side
STRAIGHT = 0.04  # share of points on the wrong side of the line at most
GAP_M = 0.2  # between roof and ground points across the line; more is shadow of the wall
LOW, HIGH = 0.1, 0.9  # levels of the step
ALONG_M = (-2.0, -1.0, 0.0, 1.0, 2.0)  # profiles of an edge, from its middle
STEP_M = 0.25  # along a profile
LEAST_RISE = 0.5  # share of the step from the ends' outer halves: the model has the edge
GAPS = 0.6  # share of a profile that may lack, as behind walls; between its ends it is bridged
KNOWN = 0.8  # share of a profile that has heights at least
TOGETHER = 2000  # edges
S = np.arange(-REACH_M + STEP_M / 2, REACH_M, STEP_M)  # m
SHARP = (S < 0).astype(np.float64)
POSITIONS = Scale((1.0,), 0.01, 801)  # m, to ±4
# Width at half maximum, 2.3548 σ, over the area between a Gaussian's edge and a sharp one at its
# place, both between LOW and HIGH: 2 / 0.8 ∫ (Φ(−s) − 0.1) ds from 0 to 1.2816 σ = 0.5586 σ.
WIDTH_OF_AREA = 2.3548 / 0.5586
WIDTHS = Scale((1.0,), 0.02, 1001)  # m, to 10


@dataclass(frozen=True)
class Edges:
    """Straight edges [n]: a point on each (m), its outward normal, roof and ground height (m)."""

    x: Floats
    y: Floats
    nx: Floats
    ny: Floats
    top: Floats
    foot: Floats


def _candidates(lattice: Lattice, classified: bool) -> tuple[NDArray, NDArray]:
    """Squares [n] (row, column) with a roof's point beside something lower, some metres apart."""
    z, kind = lattice.z, lattice.kind
    roof = kind == BUILDING if classified else (kind == OTHER) | (kind == BUILDING)
    beside = (kind != NONE) & (kind != TREE) & ((kind != BUILDING) if classified else True)
    low = minimum_filter(np.where(beside, z, np.inf), 3, mode="constant", cval=np.inf)
    found = roof & lattice.own & (z - low > LEAST_STEP_M) & np.isfinite(low)
    i, j = np.nonzero(found)
    size = max(round(APART_M / lattice.step_m), 1)
    key = (i // size) * 100_003 + j // size
    _, first = np.unique(key, return_index=True)
    return i[first], j[first]


def find_edges(lattice: Lattice, classified: bool) -> Edges:
    """The straight edges of roofs in a lattice, by its own points."""
    i, j = _candidates(lattice, classified)
    parts = [
        _lines(lattice, i[k : k + TOGETHER], j[k : k + TOGETHER], classified)
        for k in range(0, i.size, TOGETHER)
    ]
    names = ("x", "y", "nx", "ny", "top", "foot")
    return Edges(*(np.concatenate([getattr(p, n) for p in parts] or [[]]) for n in names))


def _median(values: Floats, chosen: NDArray[np.bool_]) -> Floats:
    return np.nanmedian(np.where(chosen, values, np.nan), axis=1)


def _lines(lattice: Lattice, i: NDArray, j: NDArray, classified: bool) -> Edges:
    """The edges around given squares, where all points around fit a straight one."""
    reach = int(np.ceil(REACH_M / lattice.step_m))
    around = np.arange(-reach, reach + 1)
    rows = np.clip(i[:, None, None] + around[:, None], 0, lattice.z.shape[0] - 1)
    cols = np.clip(j[:, None, None] + around, 0, lattice.z.shape[1] - 1)
    size = (i.size, around.size**2)
    x, y, z, kind = (
        np.broadcast_to(v[rows, cols], (i.size, around.size, around.size)).reshape(size)
        for v in (lattice.x, lattice.y, lattice.z, lattice.kind)
    )
    cx, cy, cz = (v[i, j][:, None] for v in (lattice.x, lattice.y, lattice.z))
    with np.errstate(invalid="ignore", divide="ignore"), _quiet():
        dx, dy = x - cx, y - cy
        inside = np.isfinite(z) & (dx * dx + dy * dy <= REACH_M**2)
        # first by the corner point and the lowest beside it, then by the levels that follow
        beside = inside & (dx * dx + dy * dy <= NEAR_M**2)
        lowest = np.nanmin(np.where(beside, z, np.nan), axis=1, keepdims=True)
        high = inside & (z > (cz + lowest) / 2)
        top = _median(z, high & beside)[:, None]
        foot = _median(z, inside & ~high)[:, None]
        high = inside & (z > (top + foot) / 2)
        low = inside & ~high
        mean = [
            [np.nanmean(np.where(side, v, np.nan), axis=1) for v in (dx, dy)]
            for side in (high, low)
        ]
        nx, ny = mean[1][0] - mean[0][0], mean[1][1] - mean[0][1]
        length = np.hypot(nx, ny)
        nx, ny = nx / length, ny / length
        s = np.where(inside, nx[:, None] * dx + ny[:, None] * dy, np.inf)
        order = np.argsort(s, axis=1)
        sorted_s = np.take_along_axis(s, order, 1)
        is_high = np.take_along_axis(high, order, 1)
        is_low = np.take_along_axis(low, order, 1)
        wrong = np.cumsum(is_low, axis=1) + high.sum(axis=1)[:, None] - np.cumsum(is_high, axis=1)
        best = np.argmin(wrong, axis=1)[:, None]
        last = np.take_along_axis(sorted_s, best, 1)[:, 0]
        following = np.take_along_axis(sorted_s, np.minimum(best + 1, size[1] - 1), 1)[:, 0]
        at = last + np.minimum(following - last, GAP_M) / 2
        # the eaves: roof points beside the line
        near = high & (s > at[:, None] - NEAR_M) & (s <= at[:, None])
        top = _median(z, near)
        foot = foot[:, 0]
        step = top - foot
        count = inside.sum(axis=1)
        off = np.take_along_axis(wrong, best, 1)[:, 0]
        uneven = (near & (np.abs(z - top[:, None]) > 0.25 * step[:, None])).sum(axis=1)
        rough = (low & (np.abs(z - foot[:, None]) > 0.1 * step[:, None] + 0.3)).sum(axis=1)
        leafy = (inside & ((kind == TREE) | (kind == WATER))).sum(axis=1)
        good = (
            (step >= LEAST_STEP_M)
            & (high.sum(axis=1) >= LEAST_POINTS)
            & (low.sum(axis=1) >= LEAST_POINTS)
            & (off <= STRAIGHT * count)
            & (uneven <= 0.1 * near.sum(axis=1))
            & (rough <= 0.05 * low.sum(axis=1))
            & (leafy <= 0.02 * count)
            & (np.abs(at) < APART_M)
        )
        if classified:
            good &= (high & (kind == BUILDING)).sum(axis=1) >= 0.95 * high.sum(axis=1)
    x, y = cx[:, 0] + at * nx, cy[:, 0] + at * ny
    return Edges(*(v[good] for v in (x, y, nx, ny, top, foot)))


@dataclass(frozen=True)
class Profiles:
    """What a model has at edges [n]: position error and its outward part (m, NaN if unknown).

    ``resolution``: width of the spread at half maximum, m. ``measured``: with heights around;
    ``found``: of them, with a step in the model. ``share`` [n, along, s]: of the step, NaN unknown.
    """

    error: Floats
    outward: Floats
    resolution: Floats
    measured: NDArray[np.bool_]
    found: NDArray[np.bool_]
    share: Floats


def _bridged(z: Floats) -> Floats:
    """Heights [..., s] with gaps filled linearly, where at most GAPS of a profile lacks."""
    known = np.isfinite(z)
    index = np.where(known, np.arange(S.size), -1)
    before = np.maximum.accumulate(index, axis=-1)
    index = np.where(known, np.arange(S.size), S.size)
    after = np.minimum.accumulate(index[..., ::-1], axis=-1)[..., ::-1]
    inside = (before >= 0) & (after < S.size) & (known.mean(axis=-1, keepdims=True) >= 1 - GAPS)
    first, last = np.where(inside, before, 0), np.where(inside, after, 0)
    low, high = (np.take_along_axis(z, k, -1) for k in (first, last))
    part = (np.arange(S.size) - first) / np.maximum(last - first, 1)
    return np.where(inside, low + part * (high - low), z)


def measure(
    edges: Edges, height_at: Callable[[Floats, Floats], Floats], *, bridge: bool = True
) -> Profiles:
    """The edges in a model; ``height_at`` (x, y in m) gives its heights, registered.

    ``bridge``: gaps are bridged; they lie on one side of walls, and would pull a registration.
    """
    n = [v[:, None, None] for v in (edges.nx, edges.ny)]
    along, s = np.array(ALONG_M)[:, None], S[None]
    x = edges.x[:, None, None] + n[0] * s - n[1] * along
    y = edges.y[:, None, None] + n[1] * s + n[0] * along
    step = (edges.top - edges.foot)[:, None, None]
    z = height_at(x, y)
    share = ((_bridged(z) if bridge else z) - edges.foot[:, None, None]) / step
    q = np.clip((share - LOW) / (HIGH - LOW), 0.0, 1.0)
    known = np.isfinite(q)
    whole = known.mean(axis=2) >= KNOWN  # [n, along]
    q[~whole] = np.nan
    measured = whole.any(axis=1)
    with _quiet():
        inner, outer = (
            np.nanmean(q[..., side], axis=(1, 2)) for side in (S < -REACH_M / 2, S > REACH_M / 2)
        )
        found = measured & (inner - outer > LEAST_RISE)
        off = q - SHARP
        error = np.nanmean(np.where(whole, np.nansum(np.abs(off), axis=2), np.nan), axis=1)
        moved = np.where(whole, np.nansum(off, axis=2), np.nan)  # steps, of each profile
        outward = np.nanmean(moved, axis=1)
        sharp = np.clip(moved[..., None] - S / STEP_M + 0.5, 0.0, 1.0)  # at the model's place
        between = np.nansum(q + sharp - 2 * q * sharp, axis=2)  # |q - q₀|, of a step within a bin
        spread = np.nanmean(np.where(whole, between, np.nan), axis=1)
    spread *= WIDTH_OF_AREA
    values = (np.where(found, STEP_M * v, np.nan) for v in (error, outward, spread))
    return Profiles(*values, measured, found, q)


@dataclass
class EdgeErrors:
    """Position errors of edges, added up window by window, and their mean profile."""

    edges: int = 0
    measured: int = 0  # with heights around
    errors: ErrorSum = field(default_factory=lambda: ErrorSum(POSITIONS))  # where a step is found
    widths: ErrorSum = field(default_factory=lambda: ErrorSum(WIDTHS))  # likewise
    outward: float = 0.0
    profile: Floats = field(default_factory=lambda: np.zeros(S.size))
    profiles: NDArray[np.int64] = field(default_factory=lambda: np.zeros(S.size, np.int64))

    def add(self, seen: Profiles) -> None:
        """Add edges as they were measured."""
        self.edges += seen.found.size
        self.measured += int(seen.measured.sum())
        self.errors.add(seen.error[seen.found])
        self.widths.add(seen.resolution[seen.found])
        self.outward += float(seen.outward[seen.found].sum())
        share = seen.share[seen.found]
        self.profile += np.nansum(share, axis=(0, 1))
        self.profiles += np.isfinite(share).sum(axis=(0, 1))

    def figures(self) -> dict[str, float | int | None]:
        """JSON-ready; m. ``measured_share``: of the reference's edges, those with heights around;
        ``missing_share``: of these, those where the model has no step. All else is of the rest;
        ``resolution_m``: that of half of them, at best.
        """
        n = self.errors.count
        shares = {
            "measured_share": self.measured / self.edges if self.edges else None,
            "missing_share": 1 - n / self.measured if self.measured else None,
        }
        names = ("position_error_m", "median_m", "p90_m", "outward_m", "resolution_m")
        lacking = dict.fromkeys(names)
        if not n:
            return {"edges": self.edges, **shares, **lacking}
        values = {
            **shares,
            "position_error_m": self.errors.mean_absolute,
            "median_m": self.errors.quantile_of_size(0.5),
            "p90_m": self.errors.quantile_of_size(0.9),
            "outward_m": self.outward / n,
            "resolution_m": self.widths.quantile_of_size(0.5),
        }
        return {"edges": self.edges} | {name: round(v, 4) for name, v in values.items()}

    def mean_profile(self) -> list[float | None]:
        """Share of the step at each place of S, between the levels LOW and HIGH."""
        return [round(float(v / n), 4) if n else None for v, n in zip(self.profile, self.profiles)]


def near_steps(lattice: Lattice, reach_m: float) -> NDArray[np.bool_]:
    """Squares within ``reach_m`` of a step that is no slope: neighbours 60 degrees apart."""
    solid = (lattice.kind != NONE) & (lattice.kind != TREE)
    low = minimum_filter(np.where(solid, lattice.z, np.inf), 3, mode="nearest")
    high = maximum_filter(np.where(solid, lattice.z, -np.inf), 3, mode="nearest")
    steepest = max(2.0, 2 * lattice.step_m * np.tan(np.radians(60.0)))
    with np.errstate(invalid="ignore"):
        step = (high - low > steepest) & np.isfinite(high) & np.isfinite(low)
    size = 2 * int(np.ceil(reach_m / lattice.step_m)) + 1
    return maximum_filter(step, size, mode="nearest")
