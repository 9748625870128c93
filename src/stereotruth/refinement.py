"""Automatic refinement of an alignment: what is left between LiDAR and the two images is removed.

GCPs of 0.25 px leave 0.1 to 0.25 px of y-parallax and of difference between the disparities of
LiDAR and images. Hundreds of tie points (see ``tie_points``) see this relative error directly. What
both images have in common they see on slopes only, as LiDAR strips are co-registered by their
heights: to 0.05 to 0.3 px on the synthetic cities, even in the plains. So the twelve parameters of
both affines are estimated together, the GCP fits and their covariance being the prior: tie points
settle the relative part, and the rest as far as they see it.

Blunders (moved or built since, vegetation, water, repetition) get no weight (Tukey's biweight).
Thousands of matches do not pretend thousandths of a pixel: neighbours share errors, by an amount
that is estimated from the scatter between sites, and all share SYSTEMATIC px at least. If the tie
points do not contradict the alignment, it is left exactly as it is.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.stats import chi2

from .alignment import RPC_TILT, Alignment, ViewFit
from .epipolar import EpipolarModel, fit_epipolar
from .errors import InputError
from .evaluation.statistics import median_and_nmad
from .points import PointStore
from .rectification import CACHE_MB, Source
from .rpc import SensorModel
from .tie_points import (
    Geometry,
    TiePoints,
    choose_sites,
    common_shift,
    find_places,
    match,
)

log = logging.getLogger("stereotruth")

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

MATCHING = 0.01  # px, what even the best match may be off
SYSTEMATIC = 0.01  # px that all tie points may have in common, along and across the rows
FINE = 6  # px: radius of the first search around every place
FINEST = 2  # px: of the last
COARSEST = 48  # px: of a search for the shift that all places have in common
CLEAR = 8.0  # standard deviations that its peak must rise
ROUNDS = 5
SETTLED = 0.01  # px, change of a round after which no other follows
MOVED = 3.0  # px in the left image after which places are looked for anew
MIN_PLACES, MIN_SITES = 30, 8
LOOSE = 0.5  # px: tie points that scatter more, or half of them blunders, tell nothing
MIN_USED = 0.5
DOUBTFUL = 1e-6  # probability of so large a change, by the GCPs' own scatter, that is worth a word
FREE = 1e-4  # share of the prior's weight that keeps a fit without it determined
TUKEY = 4.685  # deviations at which an observation has lost all weight
SIGNIFICANT = 0.001  # probability of the change by chance, if the alignment were right


@dataclass(frozen=True, eq=False)
class Observations:
    """n tie points against an alignment, in px of the epipolar grid; [n, 2] is along, across rows.

    ``at``: place in the left grid.
    ``before``: disparity of LiDAR minus that of the images, and y-parallax (y of the right position
    found minus that of the left), with the alignment as it came; ``after`` with the refined one.
    ``used`` bool[n]: not a blunder.
    """

    ties: TiePoints
    at: Floats
    before: Floats
    after: Floats
    used: Bools


@dataclass(frozen=True, eq=False)
class _Estimate:
    """Parameters [12] in the order of ``Alignment.covariance``, and what they rest on.

    ``ratio``, ``site_ratio`` [2]: standard deviation of a match along and across the rows, and the
    part that a site shares, in units of the match's own. ``statistic``: chi-square of the
    observations against no change, ``pull``: that of the change against the prior.
    """

    parameters: Floats
    covariance: Floats
    weights: Floats
    ratio: Floats
    site_ratio: Floats
    statistic: float
    freedom: int
    pull: float
    pull_freedom: int


# ------------------------------------------------------------------------------------ estimation


def _prior(alignment: Alignment) -> Floats:
    """Covariance [12, 12] of both fits; what a simpler model keeps fixed may be off as RPCs are."""
    prior = alignment.covariance.copy()
    if alignment.model == "affine":
        return prior
    free = np.zeros((6, 6))
    free[[0, 1, 3, 4], [0, 1, 3, 4]] = 1.0
    if alignment.model == "similarity":
        for turn in ([1, 0, 0, 0, 1, 0], [0, -1, 0, 1, 0, 0]):
            free -= np.outer(turn, turn) / 2.0
    for k, fit in enumerate(alignment.fits):
        own = slice(6 * k, 6 * k + 6)
        prior[own, own] += free * (RPC_TILT * fit.scale) ** 2
    return prior


def _root(covariance: Floats) -> Floats:
    """[12, r] with covariance = root · rootᵀ, without the directions that are fixed."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-12 * values.max()
    return vectors[:, keep] * np.sqrt(values[keep])


def _scale(residuals: Floats, used: Bools) -> float:
    """Robust standard deviation about zero."""
    return max(1.4826 * float(np.median(np.abs(residuals[used]))), 1e-4)


def _site_sigma(residuals: Floats, weights: Floats, sites: NDArray[np.int64], s: float) -> float:
    """Standard deviation that the places of a site share, from the scatter of the sites' means."""
    total = np.bincount(sites, weights)
    full = total > 1.0
    mean = np.bincount(sites, weights * residuals)[full] / total[full]
    own = s**2 * np.bincount(sites, weights**2)[full] / total[full] ** 2
    return float(np.sqrt(max(_scale(mean, np.ones(mean.size, bool)) ** 2 - np.median(own), 0.0)))


def estimate(
    design: Floats, observed: Floats, own: Floats, sites: NDArray[np.int64], prior: Floats
) -> _Estimate:
    """Parameters [12] from observations [n, 2] = design [n, 2, 12] · parameters and the prior.

    ``own`` [n]: the matches' own standard deviations in px, taken as ratios only (poor matches are
    poorer than that, and biased where the surface is not what the points say). ``prior`` [12, 12]
    is the covariance about zero. Observations of one site, int[n], share errors.
    """
    root = _root(prior)
    sites = np.unique(sites, return_inverse=True)[1]
    counts = np.bincount(sites)[sites]
    expected = np.hypot(own, MATCHING)[:, None]
    inner = design @ root
    rank = root.shape[1]
    used = np.ones(len(observed), bool)
    residuals = observed - np.median(observed, axis=0)
    z = np.zeros(rank)
    sigma, site_sigma = np.ones(2), np.zeros(2)
    weights = np.ones(len(observed))
    for step in range(40):
        relative = residuals / expected
        sigma = np.array([_scale(relative[:, k], used) for k in (0, 1)])
        length = np.hypot(*(relative / sigma).T)
        if step < 8:  # first a convex one: Huber's, which any start leads to its minimum
            weights = np.minimum(1.0, 2.0 / np.maximum(length, 1e-12))
        else:
            weights = np.maximum(1.0 - (length / TUKEY) ** 2, 0.0) ** 2
            used = weights > 0.0
            sigma = np.array([_scale(relative[:, k], used) for k in (0, 1)])
            site_sigma = np.array(
                [_site_sigma(relative[:, k], weights, sites, sigma[k]) for k in (0, 1)]
            )
        variance = expected**2 * (sigma**2 + counts[:, None] * site_sigma**2)
        information = weights[:, None] / variance
        weighted = inner * information[:, :, None]
        normal = np.einsum("nap,naq->pq", weighted, inner)
        right = np.einsum("nap,na->p", weighted, observed)
        shared = weighted.sum(axis=0).T  # [r, 2], with what all observations have in common
        total = information.sum(axis=0) + SYSTEMATIC**-2.0
        normal -= (shared / total) @ shared.T
        right -= (shared / total) @ np.sum(information * observed, axis=0)
        last = z
        # Weights and scatter are those about what the tie points say by themselves: an alignment
        # that is far off and sure of itself shall not make them look bad.
        z = np.linalg.solve(FREE * np.eye(rank) + normal, right)
        residuals = observed - inner @ z
        if step > 12 and np.abs(inner @ (z - last)).max() < 1e-5:
            break
    z = np.linalg.solve(np.eye(rank) + normal, right)
    values, vectors = np.linalg.eigh(normal)
    seen = values > 1e-9 * values.max()
    statistic = float(np.sum((vectors[:, seen].T @ right) ** 2 / values[seen]))
    covariance = root @ np.linalg.inv(np.eye(rank) + normal) @ root.T
    return _Estimate(
        np.round(root @ z, 8),  # so that the count of threads leaves no trace
        np.round(covariance, 14),
        weights,
        sigma,
        site_sigma,
        statistic,
        int(seen.sum()),
        float(z @ z),
        rank,
    )


# ----------------------------------------------------------------------------------- observations


def _linearised(
    alignment: Alignment, model: EpipolarModel, ties: TiePoints | Geometry
) -> tuple[Floats, Floats]:
    """Change [n, 2, 12] of (along, across) with the parameters, and [n, 2, 2] with the shift."""
    slopes = model.right_image.slopes(ties.right[:, 0], ties.right[:, 1])
    left, right = (
        fit.design(at[:, 0], at[:, 1]) for fit, at in zip(alignment.fits, (ties.left, ties.right))
    )
    return np.concatenate([-slopes @ ties.carry @ left, slopes @ right], axis=-1), slopes


def _with(alignment: Alignment, parameters: Floats) -> Alignment:
    """The alignment with both affines moved by parameters [12]."""
    fits = []
    for fit, own in zip(alignment.fits, (parameters[:6], parameters[6:])):
        affine = fit.moved(own)
        gcps = []
        for gcp in fit.gcps:
            after = np.array(gcp.measured) - affine @ (*gcp.predicted, 1.0)
            gcps.append(replace(gcp, after=tuple(after.tolist())))
        fits.append(replace(fit, affine=affine, gcps=tuple(gcps)))
    return replace(
        alignment,
        left=SensorModel(alignment.left.rpc, fits[0].affine),
        right=SensorModel(alignment.right.rpc, fits[1].affine),
        left_fit=fits[0],
        right_fit=fits[1],
    )


def _epipolar(alignment: Alignment) -> EpipolarModel:
    return fit_epipolar(
        alignment.left,
        alignment.right,
        alignment.left_fit.size,
        alignment.right_fit.size,
        alignment.reference_height,
    )


# --------------------------------------------------------------------------------------- records


def _spread(values: Floats, ties: TiePoints, size: tuple[int, int]) -> dict[str, float]:
    """Figures of one component [n] in px; the trend is that of a plane over the left image."""
    median, nmad = median_and_nmad(values)
    middle, half = np.array(size) / 2, max(size) / 2
    design = np.column_stack([(ties.left - middle) / half, np.ones(len(values))])
    plane = np.linalg.lstsq(design, values, rcond=None)[0]
    figures = {
        "median": median,
        "nmad": nmad,
        "rms": float(np.sqrt(np.mean(values**2))),
        "trend_rms": float(np.sqrt(np.mean((design @ plane) ** 2))),
        "trend_over_half_the_image_col": float(plane[0]),
        "trend_over_half_the_image_row": float(plane[1]),
    }
    return {name: round(value, 4) for name, value in figures.items()}


def _changes(fit: ViewFit, affine: Floats) -> dict[str, float]:
    """How far an affine moves the positions of an image from where the fit has them, px."""
    cols, rows = fit.size
    col, row = np.meshgrid(np.linspace(0, cols - 1, 9), np.linspace(0, rows - 1, 9))
    here = np.stack([col.ravel(), row.ravel()])
    rpc = np.linalg.solve(fit.affine[:, :2], here - fit.affine[:, 2:])
    moved = affine[:, :2] @ rpc + affine[:, 2:] - here
    return {
        "mean_col": round(float(moved[0].mean()), 4),
        "mean_row": round(float(moved[1].mean()), 4),
        "largest": round(float(np.hypot(*moved).max()), 4),
    }


def _record(
    alignment: Alignment,
    refined: Alignment,
    observations: Observations,
    found: _Estimate,
    reason: str,
) -> dict[str, Any]:
    """JSON-ready figures of a refinement; ``reason`` why it was not applied, or empty."""
    used, ties = observations.used, observations.ties
    size = alignment.left_fit.size
    spreads = {
        word: {
            name: _spread(values[used, k], _subset(ties, used), size)
            for k, name in enumerate(("disparity", "y_parallax"))
        }
        for word, values in (("before", observations.before), ("after", observations.after))
    }
    return {
        "applied": not reason,
        "reason": reason,
        "tie_points": len(ties),
        "used": int(used.sum()),
        "sites": int(np.unique(ties.site[used]).size),
        "chi_square": round(found.statistic, 2),
        "degrees_of_freedom": found.freedom,
        "probability_by_chance": _chance(found),
        "deviation_over_that_of_the_match": found.ratio.round(3).tolist(),
        "shared_in_a_site": found.site_ratio.round(3).tolist(),
        "sigma_shared_by_all_px": SYSTEMATIC,
        **spreads,
        "change_of_left": _changes(alignment.left_fit, refined.left_fit.affine),
        "change_of_right": _changes(alignment.right_fit, refined.right_fit.affine),
        "meaning": "px of the epipolar grid at the tie points used: disparity of LiDAR minus that "
        "of the images, and y-parallax; changes in px of the original images over the whole image",
    }


def _subset(ties: TiePoints, which: Bools) -> TiePoints:
    return TiePoints(**{name: values[which] for name, values in vars(ties).items()})


def _chance(found: _Estimate) -> float:
    return float(f"{chi2.sf(found.statistic, found.freedom):.3g}")


# ----------------------------------------------------------------------------------------- stage


def _search(
    alignment: Alignment,
    sources: tuple[Source, Source],
    stores: Sequence[PointStore],
    prior: Floats,
) -> tuple[Observations, _Estimate, Alignment] | str:
    """Tie points, estimate and refined alignment; or why there is none."""
    sizes = sources[0].size, sources[1].size
    parameters = np.zeros(12)
    places, found_at = None, parameters
    radius = FINE
    current = alignment
    for number in range(ROUNDS):
        if places is None or _moved_left(alignment, parameters - found_at) > MOVED:
            sites = choose_sites(current.left, current.right, sizes, stores)
            places = find_places(current.left, current.right, sources[0], stores, sites)
            found_at = parameters
            if len(places) < MIN_PLACES:
                return f"only {len(places)} places of smooth, textured ground"
        model = _epipolar(current)
        geometry = Geometry.of(places, current.left, current.right)
        if number == 0:
            design, slopes = _linearised(current, model, geometry)
            spread = np.sqrt(np.einsum("nap,pq,naq->na", design, prior, design).max())
            if 4.0 * spread > FINE:
                shift, clearness = common_shift(
                    places, geometry, sources, min(int(4.0 * spread), COARSEST)
                )
                log.info("coarse search: %s px at %.1f deviations", shift, clearness)
                if clearness < CLEAR:
                    return "no shift at which the images agree with the LiDAR stands out"
                observed = np.einsum("nab,nbc,c->na", slopes, geometry.carry, shift)
                step = _pull(design, observed, prior)
                parameters = parameters + step
                current = _with(alignment, parameters)
                continue
        ties = match(places, geometry, sources, radius)
        if len(ties) < MIN_PLACES or np.unique(ties.site).size < MIN_SITES:
            return f"only {len(ties)} tie points in {np.unique(ties.site).size} parts of the scene"
        design, slopes = _linearised(current, model, ties)
        observed = np.einsum("nab,nb->na", slopes, ties.shift)
        found = estimate(design, observed + design @ parameters, ties.sigma, ties.site, prior)
        change = float(np.abs(design @ (found.parameters - parameters)).max())
        log.info("round %d: %d tie points, change %.3f px", number + 1, len(ties), change)
        last, parameters = parameters, found.parameters
        current = _with(alignment, parameters)
        if change < SETTLED and radius == FINEST:
            break
        radius = FINEST if change < FINEST / 2 or radius == FINEST else FINE
    observations = Observations(
        ties,
        np.stack(model.left_to_epipolar(*ties.left.T), axis=1),
        observed + design @ last,
        observed + design @ (last - parameters),
        found.weights > 0.0,
    )
    scatter = max(_scale(observations.after[:, k], found.weights > 0.0) for k in (0, 1))
    used = float(np.mean(found.weights > 0.0))
    if scatter > LOOSE or used < MIN_USED:
        return (
            f"the tie points contradict each other ({scatter:.2f} px, {100 * (1 - used):.0f} % "
            "blunders): LiDAR and images do not show the same ground, or not at the same height"
        )
    return observations, found, current


def _pull(design: Floats, observed: Floats, prior: Floats) -> Floats:
    """Parameters [12] for places [n] that all together tell one shift, to a pixel."""
    root = _root(prior)
    inner = (design @ root).reshape(-1, root.shape[1])
    normal = np.eye(root.shape[1]) + inner.T @ inner / len(design)
    return root @ np.linalg.solve(normal, inner.T @ observed.ravel() / len(design))


def _doubts(alignment: Alignment, record: Mapping[str, Any], found: _Estimate) -> list[str]:
    """What is odd about a refinement that is applied all the same."""
    if chi2.sf(found.pull, found.pull_freedom) > DOUBTFUL:
        return []
    ratio = abs(_epipolar(alignment).report["disparity_px_per_m"]["mean"])
    offset = record["before"]["disparity"]["median"]
    return [
        "LiDAR and images differ by more than the ground control points' own scatter explains: "
        f"{offset:+.2f} px of disparity ({offset / ratio:+.2f} m of height), "
        f"{record['before']['y_parallax']['median']:+.2f} px of y-parallax; check the LiDAR's "
        "vertical datum and the points' heights"
    ]


def _warn(doubts: Sequence[str], strict: bool, image: str | Path, of: str) -> None:
    for text in doubts:
        log.warning("warning: %s", text)
    if strict and doubts:
        raise InputError(
            f"{doubts[0]}{of}",
            file=image,
            remedy="check LiDAR and GCPs, or set strict or alignment.refine to false",
        )


def _moved_left(alignment: Alignment, parameters: Floats) -> float:
    fit = alignment.left_fit
    return _changes(fit, fit.moved(parameters[:6]))["largest"]


def refine(
    alignment: Alignment,
    left_image: str | Path,
    right_image: str | Path,
    point_stores: Sequence[str | Path],
    *,
    strict: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> tuple[Alignment, Observations | None]:
    """Refine an alignment by tie points between LiDAR and both images.

    Returns the alignment, with the record of what was done in ``refinement``, and the
    observations. It is the one that came, affines and all, if the tie points do not contradict
    it or are too few. Reads a fixed number of places, whatever the scene's size. ``strict`` makes
    warnings errors.

    Raises InputError if there are neither GCPs nor usable tie points.
    """
    of = f" (scene {alignment.scene})" if alignment.scene else ""
    with (
        rasterio.Env(GDAL_CACHEMAX=CACHE_MB),
        Source(left_image) as left,
        Source(right_image) as right,
    ):
        stores = [PointStore(path) for path in sorted(Path(p) for p in point_stores)]
        prior = _prior(alignment)
        result = _search(alignment, (left, right), stores, prior)
    record_of = dict(provenance or alignment.provenance)
    if isinstance(result, str):
        if not any(fit.gcps for fit in alignment.fits):
            raise InputError(
                f"no alignment without ground control points: {result}{of}",
                file=left_image,
                remedy="measure GCPs, and check that LiDAR and images show the same ground",
            )
        _warn([f"not refined: {result}"], strict, left_image, of)
        record = {"applied": False, "reason": result}
        return replace(alignment, refinement=record, provenance=record_of), None
    observations, found, refined = result
    insignificant = _chance(found) > SIGNIFICANT
    reason = "the tie points do not contradict the alignment" if insignificant else ""
    record = _record(alignment, refined, observations, found, reason)
    covariance = found.covariance
    if insignificant:  # what is not applied adds to the uncertainty
        covariance = covariance + np.outer(found.parameters, found.parameters)
        refined = alignment
        observations = replace(observations, after=observations.before)
        record["after"] = record["before"]
    doubts = [] if insignificant else _doubts(alignment, record, found)
    _warn(doubts, strict, left_image, of)
    height = alignment.reference_height
    if not any(fit.gcps for fit in alignment.fits):  # it was that of the RPCs, far off perhaps
        height = round(float(observations.ties.height[observations.used].mean()), 3)
    refined = replace(
        refined,
        reference_height=height,
        warnings=(*alignment.warnings, *doubts),
        left_fit=replace(refined.left_fit, covariance=covariance[:6, :6]),
        right_fit=replace(refined.right_fit, covariance=covariance[6:, 6:]),
        cross_covariance=covariance[:6, 6:],
        refinement=record,
        provenance=record_of,
    )
    for name in ("y_parallax", "disparity"):
        a, b = record["before"][name], record["after"][name]
        log.info(
            "%s at %d tie points: median %.3f -> %.3f px, rms %.3f -> %.3f px, trend %.3f -> %.3f",
            name,
            record["used"],
            *(pair[figure] for figure in ("median", "rms", "trend_rms") for pair in (a, b)),
        )
    log.info(
        "refinement %s",
        f"not applied: {reason}"
        if reason
        else f"applied: left moved by up to {record['change_of_left']['largest']:.3f} px, right by "
        f"{record['change_of_right']['largest']:.3f} px",
    )
    return refined, observations
