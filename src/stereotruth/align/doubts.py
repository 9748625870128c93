"""Doubts and remarks in words: the LiDAR's heights, images of a site, why labels are less sure.

A fault of the vertical datum moves the LiDAR along the vertical, which the images see as a shift of
both, each along its own line of sight. Three witnesses tell it: the heights of the control points;
the tie points, against what the alignment's uncertainty allows; and without control points the
RPCs, whose errors have no reason to look like a fault of heights (docs/planted_errors.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtrc, chdtri, ndtri, stdtrit

from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.geometry import metres_per_degree
from ..core.numerics.statistics import robust_sigma
from ..lidar.lattice import PER_M
from ..lidar.point_store import PointStore, query_points
from ..sensor.rpc import SensorModel
from .adjustment import Estimate
from .align import CAREFUL_SIGMA
from .alignment import Alignment, GcpResidual
from .line_fit import LineFit
from .shared_errors import SharedErrors, plan_slopes

LIDAR_SIGMA_M = 0.15  # m, vertical: what airborne surveys promise against their control
LIDAR_PLAN_M = 0.3  # m, of east and of north: what they promise in plan
FAR_OFF = 4.0  # deviations that no point of the LiDAR around a control point may lie off it
CHANCE = 1e-4  # probability that heights without a fault are doubted by the tie points
CHANCE_OF_RPCS = 0.01  # the same, of scenes that nothing but their RPCs can tell about
AROUND = 12  # points around a control point that are looked at, or all
WIDEST_M = 5.0  # within this, or none
FEWEST_GCPS = 3
MODEL_MARGIN_M, MODEL_MARGIN = 10.0, 0.1  # m, and share of the LiDAR's span: what rises above it
MIN_USED = 0.5  # share of the tie points or places, less of which tell of a fault
TOLD = 2.0  # times that σ grows, from which on it is said
HEAVY = 0.1  # weight of a pair that is left out, or nearly so
CHANCE_OF_SITE = 0.05  # that a site without a fault has an image that stands out
FEWEST_VALUES = 4  # values of a test: if two of three are alike, the third is always an outlier
MOST_OUT = 0.25  # share of the images that may stand out
NORMAL = 2.0 / 3.0  # power of a length that is normal if both coordinates are (Wilson, Hilferty)
LEAST_SPREAD_PX = 0.3  # px to that power, of corrections: less makes none of them stand out
LEAST_SPREAD_SHARE = 0.1  # of the shares that match, likewise
Figures = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class HeightOffset:
    """The LiDAR's height minus that of the images, m.

    ``sigma_m``: standard uncertainty, the LiDAR's own and that of the alignment before the
    refinement counted; ``told_from_m``: a fault of less is not told from these.
    """

    offset_m: float
    sigma_m: float
    told_from_m: float

    @property
    def doubtful(self) -> bool:
        """Whether it is more than the uncertainties explain."""
        return abs(self.offset_m) > self.told_from_m


def control_points_of(alignment: Alignment) -> list[GcpResidual]:
    """The control points that either view uses, by their ids."""
    used = {g.id: g for fit in alignment.fits for g in fit.gcps if g.used}
    return [used[name] for name in sorted(used)]


def heights_of_model(
    stores: Sequence[PointStore], sensors: Sequence[SensorModel]
) -> tuple[float, float] | None:
    """Over which heights (ellipsoidal m) an epipolar model serves: the LiDAR's, and a margin.

    None where all of the LiDAR is outside the RPCs' heights; a stray point that is has no say.
    """
    low = min(int(store.cell_heights.min()) for store in stores) / PER_M
    high = max(int(store.cell_heights.max()) for store in stores) / PER_M
    margin = MODEL_MARGIN_M + MODEL_MARGIN * (high - low)
    for sensor in sensors:
        lowest, highest = sensor.rpc.ground_box[4:]
        spare = (highest - lowest) / 4
        low, high = max(low, lowest - spare), min(high, highest + spare)
    return (round(low - margin, 3), round(high + margin, 3)) if low <= high else None


def _heights_around(stores: Sequence[PointStore], gcp: GcpResidual, reach_m: float) -> Floats:
    """Heights m of the points within ``reach_m`` of a control point, or of the AROUND nearest.

    None where there are fewer within WIDEST_M.
    """
    metres = metres_per_degree(gcp.lat)
    widest = max(WIDEST_M, reach_m)
    east, north = widest / metres
    points = query_points(stores, gcp.lon - east, gcp.lat - north, gcp.lon + east, gcp.lat + north)
    distance = np.hypot((points.lon - gcp.lon) * metres[0], (points.lat - gcp.lat) * metres[1])
    distance, height = distance[distance <= widest], points.height[distance <= widest]
    if distance.size < AROUND:
        return np.empty(0)
    return height[distance <= max(reach_m, np.partition(distance, AROUND - 1)[AROUND - 1])]


def off_at_gcps(
    gcps: Sequence[GcpResidual], stores: Sequence[PointStore], pixel: float
) -> tuple[list[Floats], float]:
    """Heights m of the LiDAR's points around each control point less its own; and how far off they
    may lie by chance. ``pixel``: size on the ground, m; a measurement is good to a part of it."""
    tolerance = FAR_OFF * float(np.hypot(LIDAR_SIGMA_M, CAREFUL_SIGMA[0] * pixel))
    around = [_heights_around(stores, gcp, pixel) - gcp.height for gcp in gcps]
    return [differences for differences in around if differences.size], tolerance


def agreeing(around: Sequence[Floats], shift: float, tolerance: float) -> int:
    """How many control points (see :func:`off_at_gcps`) have a point that is off by the shift.

    A control point on a roof's corner has ground beside it: any of the points around may be the
    one that it stands for.
    """
    return sum(bool((np.abs(d - shift) <= tolerance).any()) for d in around)


def doubt_at_gcps(gcps: Sequence[GcpResidual], stores: Sequence[PointStore], pixel: float) -> str:
    """A sentence if most control points lie on no point of the LiDAR, else nothing."""
    around, tolerance = off_at_gcps(gcps, stores, pixel)
    here = agreeing(around, 0.0, tolerance)
    if len(around) < FEWEST_GCPS or 2 * here >= len(around):
        return ""
    candidates = np.unique(np.round(np.concatenate(around) / tolerance)) * tolerance
    counts = np.array([agreeing(around, shift, tolerance) for shift in candidates])
    best = int(np.argmax(counts))
    near = [d[np.abs(d - candidates[best]) <= tolerance] for d in around]
    shift = float(np.median([np.median(d) for d in near if d.size]))
    from ..lidar.geoid import fits  # PROJ, which few refinements need

    declared = not any(store.has_assumed_heights for store in stores)
    place = [float(np.median([getattr(gcp, name) for gcp in gcps])) for name in ("lon", "lat")]
    cause = (
        f"{counts[best]} would if it were {abs(shift):.1f} m "
        f"{'lower' if shift > 0 else 'higher'}; check the LiDAR's vertical datum and unit (geoid, "
        "feet), and that the points' heights are ellipsoidal"
        if 2 * counts[best] > len(around)
        else "at no other height would most of them; check the LiDAR's coordinate system and "
        "height unit"
    )
    text = (
        f"only {here} of {len(around)} ground control points have a LiDAR point within "
        f"{tolerance:.1f} m of their height: {cause}"
    )
    if declared or 2 * counts[best] <= len(around):
        return text
    explained = fits(shift, *place)
    return f"{text}; {explained}" if explained else text


def doubt_by_rpcs(stores: Sequence[PointStore], sensors: Sequence[SensorModel]) -> str:
    """A sentence if most of the LiDAR is outside an RPC's heights by more than a quarter."""
    heights = np.concatenate([s.cell_heights.mean(axis=1) for s in stores]) / PER_M
    counts = np.concatenate([s.cell_counts for s in stores])
    for sensor in sensors:
        low, high = sensor.rpc.ground_box[4:]
        margin = (high - low) / 4
        outside = (heights < low - margin) | (heights > high + margin)
        if 2 * counts[outside].sum() > counts.sum():
            return (
                f"most of the LiDAR, at {np.median(heights):.0f} m, is outside the {low:.0f} to "
                f"{high:.0f} m of the RPC: are its heights ellipsoidal metres?"
            )
    return ""


def lines_of_sight(alignment: Alignment) -> Floats:
    """[2, 2] px: how far a metre of height moves a point in the middle of the left image.

    In the left and the right image, (col, row).
    """
    lon, lat, height = alignment.middle
    moved = []
    for sensor in (alignment.left, alignment.right):
        ends = [np.array(sensor.project(lon, lat, height + z)) for z in (-5.0, 5.0)]
        moved.append((ends[1] - ends[0]) / 10.0)
    return np.array(moved)


def scatter_by_heights(alignment: Alignment, along: Floats, across: Floats) -> tuple[float, float]:
    """Scatter of disparity residuals (px) of tie points, and what of it is explained at most.

    ``along``, ``across`` [n] px: residuals along and across the rows. Both have the scatter of the
    matches; that along the rows has the LiDAR's heights besides. At a wrong place of the ground
    the heights of tie points have nothing to do with what the images show there.
    """
    px_per_m = float(np.linalg.norm(np.subtract(*lines_of_sight(alignment))))
    own, found = (robust_sigma(values, 0.0) for values in (across, along))
    explained = float(np.hypot(own, LIDAR_SIGMA_M * px_per_m))
    return found, explained * float(np.sqrt(chdtri(along.size - 1, CHANCE) / (along.size - 1)))


def _constants(shifts: Floats) -> Floats:
    """Parameters [12] of shifts [2, 2] of both images."""
    parameters = np.zeros(12)
    parameters[[2, 5, 8, 11]] = shifts.ravel()
    return parameters


def lift_by_rpcs(alignment: Alignment) -> tuple[float, float]:
    """How many m the control points lie too low for the RPCs alone, with its standard uncertainty,
    by the means of their residuals. Each view has control points."""
    residuals = [[g.before for g in fit.gcps if g.used] for fit in alignment.fits]
    moved = np.concatenate([np.mean(of_view, axis=0) for of_view in residuals])
    return _as_height(lines_of_sight(alignment).ravel(), moved, np.zeros((4, 4)))


def _as_height(look: Floats, moved: Floats, covariance: Floats) -> tuple[float, float]:
    """The height m by which both images would move as they did, and its standard uncertainty.

    Of the four shifts ``moved`` px (two each, with a ``covariance`` px²), one combination looks
    like a height: ``look``, px by m. The other three say how far these RPCs are off.
    """
    length = float(np.linalg.norm(look))
    along = look / length
    others = np.eye(4) - np.outer(along, along)
    square = float(np.sum((others @ moved) ** 2) + np.trace(others @ covariance @ others))
    return float(along @ moved) / length, float(np.sqrt(square / 3)) / length


def height_by_images(alignment: Alignment, found: Estimate) -> HeightOffset:
    """The fault of height that tie points and prior would agree with, by generalised least squares.

    ``alignment`` as it came, whose covariance is the prior.
    """
    offset, sigma = found.amount_along(_constants(-lines_of_sight(alignment)))
    sigma = float(np.hypot(sigma, LIDAR_SIGMA_M))
    return HeightOffset(offset, sigma, -float(ndtri(CHANCE / 2)) * sigma)


def chance_of_contradiction(alignment: Alignment, found: Estimate) -> float:
    """Probability that tie points differ so much from what is known of the alignment and of the
    LiDAR in plan; by all parameters, or, if that is less, by the shift in plan alone.

    ``alignment`` as it came. A LiDAR that is off in plan moves both images alike.
    """
    sensors = alignment.left, alignment.right
    slopes = np.stack([plan_slopes(sensor, *alignment.middle) for sensor in sensors])
    moved = [_constants(LIDAR_PLAN_M * slopes[:, :, k]) for k in (0, 1)]
    plan = np.linalg.pinv(found.root) @ np.stack(moved, axis=1)
    values, vectors = np.linalg.eigh(found.normal)
    seen = values > 1e-9 * values.max()
    alone = vectors[:, seen].T @ np.linalg.pinv(found.root) @ found.alone
    known = vectors[:, seen].T @ (np.eye(len(values)) + plan @ plan.T) @ vectors[:, seen]
    total = known + np.diag(1.0 / values[seen])
    by_all = float(alone @ np.linalg.solve(total, alone))
    # of the shift, in LIDAR_PLAN_M, by generalised least squares; its own variance, 1, is in total
    along = vectors[:, seen].T @ plan
    pull = along.T @ np.linalg.solve(total, alone)
    by_shift = float(pull @ np.linalg.solve(along.T @ np.linalg.solve(total, along), pull))
    return float(min(chdtrc(int(seen.sum()), by_all), chdtrc(2, by_shift)))


def height_by_rpcs(alignment: Alignment, refined: Alignment, found: Estimate) -> HeightOffset:
    """The same where nothing is known but that RPC errors have no preferred direction: Student's t,
    since three combinations of the shifts say how far these RPCs are off."""
    shifts, covariance = [], np.zeros((4, 12))
    for k, (before, after) in enumerate(zip(alignment.fits, refined.fits)):
        middle = (np.array(after.size) - 1) / 2
        rpc = np.linalg.solve(after.affine[:, :2], middle - after.affine[:, 2])
        shifts.append(middle - before.affine @ (*rpc, 1.0))
        covariance[2 * k : 2 * k + 2, 6 * k : 6 * k + 6] = after.design(*middle)
    covariance = covariance @ found.covariance @ covariance.T
    look = -lines_of_sight(alignment).ravel()
    offset_m, sigma_m = _as_height(look, np.concatenate(shifts), covariance)
    sigma_m = float(np.hypot(sigma_m, LIDAR_SIGMA_M))
    return HeightOffset(offset_m, sigma_m, -float(stdtrit(3, CHANCE_OF_RPCS / 2)) * sigma_m)


@dataclass(frozen=True)
class LabelSigma:
    """Standard deviation px of disparity on level ground, median of the tie points: by the scatter
    of the tie points alone, and as labels state it."""

    by_scatter: float
    stated: float

    @classmethod
    def of(
        cls,
        design: Floats,
        lines: Floats,
        rows: int,
        covariances: tuple[Floats, Floats],
        fit: LineFit,
        shared: SharedErrors,
    ) -> LabelSigma:
        """At tie points: ``design`` [n, 12] along the rows, ``lines`` [n] of the left image, which
        has ``rows``; ``covariances`` [12, 12] of the parameters by scatter alone and as stated."""
        alone, all_ = (np.einsum("np,pq,nq->n", design, c, design) for c in covariances)
        all_ = all_ + shared.label_px**2
        if (nodes := fit.used_covariance) is not None:
            at = np.clip(np.rint(lines / (rows - 1.0) * (len(nodes) - 1)), 0, len(nodes) - 1)
            shifts = design[:, [2, 5, 8, 11]]
            all_ = all_ + np.einsum("np,npq,nq->n", shifts, nodes[at.astype(int)], shifts)
        return cls(*(float(np.sqrt(np.median(values))) for values in (alone, all_)))


def remark_of(sigma: LabelSigma, fit: LineFit, shared: SharedErrors) -> str:
    """A sentence where lines are corrected, or σ grows by more than TOLD; else nothing."""
    grown = sigma.stated > TOLD * sigma.by_scatter
    causes = []
    if fit.stands_out:
        along, across = fit.rms_px
        causes.append(
            f"the attitude jitters (residuals of tie points depend on the image line, by "
            f"{along:.2f} px along and {across:.2f} px across the lines), which is corrected by "
            "line"
        )
    if shared.are_told and grown:
        amount = f"{shared.sigma_px[0]:.3f} px of disparity"
        causes.append(
            f"residuals change smoothly over the scene and not by line ({amount}), as RPCs leave "
            "that no affine corrects"
            if shared.smooth
            else f"tie points near each other share errors, not by line ({amount}), as strips of "
            "the LiDAR that disagree leave"
        )
    if not causes:
        return ""
    stated = (
        f"the alignment's part of labels' uncertainty is {sigma.stated:.3f} px instead of "
        f"{sigma.by_scatter:.3f} px"
    )
    return "; ".join([*causes, stated] if grown else causes)


def stand_out(values: Floats, least_spread: float) -> Bools:
    """Which of n values are too large for the others, by the generalised extreme deviate test.

    Rosner 1983: the largest value is held against mean and standard deviation (``least_spread`` at
    least), then the largest of the others, and so on; all up to the last one that Student's t makes
    too unlikely stand out, so that two of them do not hide each other.
    """
    order = np.argsort(values)[::-1]
    count = 0
    for k in range(max(1, int(MOST_OUT * len(values)))):
        rest = values[order[k:]]
        n = len(rest)
        if n < FEWEST_VALUES:
            break
        t = stdtrit(n - 2, 1.0 - CHANCE_OF_SITE / n)
        limit = (n - 1) * t / np.sqrt((n - 2 + t**2) * n)
        spread = max(float(rest.std(ddof=1)), least_spread)
        if rest[0] - rest.mean() > limit * spread:
            count = k + 1
    out = np.zeros(len(values), bool)
    out[order[:count]] = True
    return out


def _named(values: Mapping[str, float], sign: float, least_spread: float) -> set[str]:
    """The names whose values, times ``sign``, are too large for the others."""
    out = stand_out(sign * np.array(list(values.values())), least_spread)
    return {name for name, is_out in zip(values, out) if is_out}


def image_doubts(images: Figures, pairs: Figures) -> dict[str, list[str]]:
    """The doubts of each image by name; ``images``, ``pairs``: figures of the adjustment."""
    own = {
        name: [pair for pair in pairs.values() if name in (pair["left"], pair["right"])]
        for name in images
    }
    placed = [name for name, image in images.items() if not image["refused"]]
    lengths = {
        name: float(np.hypot(images[name]["correction"]["col"], images[name]["correction"]["row"]))
        for name in placed
    }
    far = _named({name: v**NORMAL for name, v in lengths.items()}, 1.0, LEAST_SPREAD_PX)
    # A pair matches no better than the poorer of its images: the best pair tells of both.
    shares = {
        name: max(pair["matched"] for pair in own[name])
        for name in placed
        if any(pair["tie_points"] for pair in own[name])
    }
    usual, usual_share = (
        float(np.median(list(values.values()))) if values else 0.0 for values in (lengths, shares)
    )
    poor = _named(shares, -1.0, LEAST_SPREAD_SHARE)
    poor |= {name for name, share in shares.items() if share < MIN_USED * usual_share}
    doubts: dict[str, list[str]] = {}
    for name, image in images.items():
        texts = doubts.setdefault(name, [])
        gcps, count = image["gcps"], len(own[name])
        if image["refused"]:
            texts.append(image["refused"])
            continue
        if name in far and not image["fixed"]:
            texts.append(
                f"its RPC is off by {lengths[name]:.1f} px, where {usual:.1f} px are usual here; "
                "corrected"
            )
        if name not in shares:
            reasons = "; ".join(sorted({pair["reason"] for pair in own[name]}))
            texts.append(f"no tie points in any of its pairs ({count}): {reasons}")
        elif name in poor:
            texts.append(
                f"of the places compared in its pairs {100 * shares[name]:.0f} % match at best, "
                f"where {100 * usual_share:.0f} % are usual here: clouds, or another ground?"
            )
        light = sum(pair.get("weight", 1.0) < HEAVY for pair in own[name])
        if light > count / 2:
            texts.append(
                f"the tie points of {light} of its {count} pairs contradict the other images"
            )
        if gcps["left_out"]:
            texts.append(
                f"control points left out, which fit no correction: {', '.join(gcps['left_out'])}"
            )
    return doubts
