"""Automatic refinement of an alignment: what is left between LiDAR and the two images is removed.

Tie points (:mod:`.tie_points`) see how both images are off against each other and, on slopes,
against the LiDAR. The twelve parameters of both affines are estimated from them together, with the
fits to the control points as the prior (:mod:`.adjustment`), corrections by line (:mod:`.line_fit`)
and the place in plan by edges of roofs (:mod:`.shared_errors`). The alignment is left exactly as it
is if nothing contradicts it, or if one half of the sites does not improve the other. How, and how
well: docs/explanation/refinement.md.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.config.configuration import Rectify
from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import DEGREE_M
from ..core.numerics.statistics import robust_sigma
from ..core.products.files import write_table
from ..lidar.point_store import PointStore, open_stores
from ..sensor.images import Source, open_pair
from ..sensor.pair_geometry import pixel_deg
from .adjustment import (
    LEAST_SIGMA,
    Estimate,
    Observations,
    agreement_of_halves,
    epipolar_model,
    linearised_at,
    pair_equations,
    pull_of,
)
from .align import PLACES_BY_RPCS
from .alignment import Alignment, ViewFit, prior_of, with_corrections
from .doubts import (
    MIN_USED,
    HeightOffset,
    LabelSigma,
    chance_of_contradiction,
    control_points_of,
    doubt_at_gcps,
    doubt_by_rpcs,
    height_by_images,
    height_by_rpcs,
    heights_of_model,
    remark_of,
    scatter_by_heights,
)
from .images import choose_sites
from .line_fit import UNKNOWNS as LINE_UNKNOWNS
from .line_fit import LineFit, estimate_with_lines, line_design
from .records import Equations, spreads_of
from .shared_errors import SharedErrors, place_pair, with_shared_errors
from .tie_points import Geometry, common_shift, find_places, match

log = logging.getLogger("stereotruth")


FINE = 6  # px: radius of the first search around every place
FINEST = 2  # px: of the last
COARSEST = 48  # px: of a search for the shift that all places have in common
CLEAR = 8.0  # standard deviations that its peak must rise
ROUNDS = 5
SETTLED = 0.01  # px, change of a round after which no other follows
MOVED = 3.0  # px in the left image after which places are looked for anew
MIN_PLACES, MIN_SITES = 30, 8
LOOSE = 0.5  # px: tie points that scatter more, or half of them blunders, tell nothing
DOUBTFUL = 1e-6  # probability of so large a change, by the GCPs' own scatter, that is worth a word
SIGNIFICANT = 0.001  # probability of the change by chance, if the alignment were right
HEIGHTS_BY_RPCS = (
    "without ground control points a fault of the LiDAR's heights of less than {:.0f} m cannot be "
    "told from errors of the RPCs"
)


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
    alignment: Alignment, result: _Found, reason: str, offset: HeightOffset, in_plan: dict[str, Any]
) -> dict[str, Any]:
    """JSON-ready figures of a refinement; ``reason`` why it was not applied, or empty."""
    observations, found, refined = result.observations, result.estimate, result.alignment
    used, ties = observations.used, observations.ties
    states = observations.before[used], observations.after[used]
    return {
        "applied": not reason,
        "reason": reason,
        "tie_points": len(ties),
        "used": int(used.sum()),
        "sites": int(np.unique(ties.site[used]).size),
        "chi_square": round(found.statistic, 2),
        "degrees_of_freedom": found.freedom,
        "probability_by_chance": found.chance,
        "deviation_over_that_of_the_match": found.ratio.round(3).tolist(),
        "shared_in_a_site": found.site_ratio.round(3).tolist(),
        "sigma_shared_by_all_px": found.shared.round(4).tolist(),
        **spreads_of(*states, ties.left[used], alignment.left_fit.size),
        "change_of_left": _changes(alignment.left_fit, refined.left_fit.affine),
        "change_of_right": _changes(alignment.right_fit, refined.right_fit.affine),
        "meaning": "px of the epipolar grid at the tie points used: disparity of LiDAR minus that "
        "of the images, and y-parallax; changes in px of the original images over the whole image; "
        "lidar_height: m, of LiDAR minus images, and from what on a fault is told; place_in_plan: "
        "m (east, north), by slopes and by edges of roofs",
        "by_line": result.lines.figures(),
        "shared_by_near_sites": result.shared.figures(),
        "remark": "" if reason else remark_of(result.sigma, result.lines, result.shared),
        "sigma_of_labels_px": {k: round(v, 4) for k, v in vars(result.sigma).items()},
        "place_in_plan": in_plan,
        "lidar_height": {name: round(value, 3) for name, value in vars(offset).items()},
        "misfit_of_one_half_by_the_other": {
            word: round(misfit, 3) for word, misfit in zip(("before", "after"), result.halves)
        },
    }


@dataclass(frozen=True, eq=False)
class _Found:
    """What tie points tell: the estimate, errors that it shares, lines, the refined alignment,
    :func:`.adjustment.agreement_of_halves`, and what all of it means for labels."""

    observations: Observations
    estimate: Estimate
    shared: SharedErrors
    lines: LineFit
    alignment: Alignment
    halves: tuple[float, float]
    sigma: LabelSigma


def _search(
    alignment: Alignment,
    sources: tuple[Source, Source],
    stores: Sequence[PointStore],
    prior: Floats,
) -> _Found | str:
    """Tie points, estimate, refined alignment and :func:`.adjustment.agreement_of_halves`; or why
    not."""
    sizes = sources[0].size, sources[1].size
    rows = sizes[0][1], sizes[1][1]
    parameters, by_line = np.zeros(12), np.zeros(LINE_UNKNOWNS)
    places, found_at = None, parameters
    radius = FINE
    current = alignment
    for number in range(ROUNDS):
        moved = alignment.left_fit.moved(parameters[:6] - found_at[:6])
        if places is None or _changes(alignment.left_fit, moved)["largest"] > MOVED:
            height = alignment.reference_height
            sites = choose_sites(current.left, current.right, sizes, stores, height)
            if not sites:
                return "there is no ground that both images show and the LiDAR covers"
            places = find_places(current.left, current.right, sources[0], stores, sites)
            found_at = parameters
            if len(places) < MIN_PLACES:
                return f"only {len(places)} places of smooth, textured ground"
        model = epipolar_model(current)
        geometry = Geometry.of(places, current.left, current.right)
        if number == 0:
            design, slopes = linearised_at(current, model, geometry)
            spread = np.sqrt(np.einsum("nap,pq,naq->na", design, prior, design).max())
            if 4.0 * spread > FINE:
                shift, clearness = common_shift(
                    places, geometry, sources, min(int(4.0 * spread), COARSEST)
                )
                log.info("coarse search: %s px at %.1f deviations", shift, clearness)
                if clearness < CLEAR:
                    return "no shift at which the images agree with the LiDAR stands out"
                observed = np.einsum("nab,nbc,c->na", slopes, geometry.carry, shift)
                step = pull_of(design, observed, prior)
                parameters = parameters + step
                current = with_corrections(alignment, parameters)
                continue
        ties = match(places, geometry, sources, radius)
        if len(ties) < MIN_PLACES or np.unique(ties.site).size < MIN_SITES:
            return f"only {len(ties)} tie points in {np.unique(ties.site).size} parts of the scene"
        design, slopes = linearised_at(current, model, ties)
        observed = np.einsum("nab,nb->na", slopes, ties.shift)
        of_lines = line_design(design, np.column_stack([ties.left[:, 1], ties.right[:, 1]]), rows)
        total = observed + design @ parameters + of_lines @ by_line
        equations = Equations(design, total, ties.sigma, ties.site, ties.left, ties.right)
        found, lines = estimate_with_lines(equations, prior, places.guard.common_px, rows)
        of_images = pair_equations(
            alignment, current, model, ties, len(places), places.guard.common_px, of_lines @ by_line
        )
        moved = design @ (found.parameters - parameters) + of_lines @ (lines.coefficients - by_line)
        change = float(np.abs(moved).max())
        log.info("round %d: %d tie points, change %.3f px", number + 1, len(ties), change)
        parameters, by_line = found.parameters, lines.coefficients
        current = with_corrections(alignment, parameters, lines.corrections)
        if change < SETTLED and radius == FINEST:
            break
        radius = FINEST if change < FINEST / 2 or radius == FINEST else FINE
    equations = replace(equations, observed=total - of_lines @ by_line)
    by_scatter = found.covariance
    found, shared = with_shared_errors(found, equations, by_line=lines.stands_out)
    current = with_corrections(alignment, found.parameters, lines.corrections)
    observations = Observations(
        ties,
        np.stack(model.left_to_epipolar(*ties.left.T), axis=1),
        total,
        equations.observed - design @ found.parameters,
        total - design @ found.parameters,
        found.weights > 0.0,
        of_images,
    )
    if reason := _discord(observations):
        return reason
    halves = agreement_of_halves(equations, prior)
    log.info("one half of the sites by the other: misfit %.2f -> %.2f deviations", *halves)
    sigma = LabelSigma.of(
        design[:, 0], ties.left[:, 1], rows[0], (by_scatter, found.covariance), lines, shared
    )
    return _Found(observations, found, shared, lines, current, halves, sigma)


def _placed(
    start: Alignment, result: _Found, sources: tuple[Source, Source], stores: Sequence[PointStore]
) -> tuple[_Found, dict[str, Any]]:
    """What tie points tell, with the place in plan, and the figures of it."""
    found, figures, seen = place_pair(result.alignment, result.estimate, sources, stores)
    of_images = replace(result.observations.of_images, in_plan=seen)
    placed = replace(
        result,
        observations=replace(result.observations, of_images=of_images),
        estimate=found,
        alignment=with_corrections(start, found.parameters, result.lines.corrections),
    )
    return placed, figures


def _discord(observations: Observations) -> str:
    """Why tie points tell nothing, or an empty string."""
    used = observations.used
    scatter = max(robust_sigma(observations.after[used, k], LEAST_SIGMA) for k in (0, 1))
    if scatter <= LOOSE and used.mean() >= MIN_USED:
        return ""
    return (
        f"the tie points contradict each other ({scatter:.2f} px, {100 * (1 - used.mean()):.0f} % "
        "blunders): LiDAR and images do not show the same ground, or not at the same height"
    )


def _doubts(alignment: Alignment, record: Mapping[str, Any], found: Estimate) -> list[str]:
    """What is odd about tie points that fit each other, by what the alignment is known to."""
    with_gcps = any(fit.gcps for fit in alignment.fits)
    before = record["before"]
    height = HeightOffset(**record["lidar_height"])
    if height.doubtful:
        known = "ground control points' own scatter" if with_gcps else "errors of the RPCs"
        return [
            f"LiDAR and images differ by {height.offset_m:+.2f} m of height "
            f"({before['disparity']['median']:+.2f} px of disparity), more than the {known} "
            f"explains ({height.told_from_m:.2f} m); check the LiDAR's vertical datum and unit"
            + (", and the points' heights" if with_gcps else "")
        ]
    if chance_of_contradiction(alignment, found) > DOUBTFUL:
        return []
    others = "the points' coordinates" if with_gcps else "that the RPCs belong to the images"
    return [
        "LiDAR and images differ by more than the uncertainty of the alignment explains: tie "
        f"points alone would move the left image by ({found.alone[2]:+.1f}, "
        f"{found.alone[5]:+.1f}) px, with {before['disparity']['median']:+.2f} px of disparity "
        f"and {before['y_parallax']['median']:+.2f} px of y-parallax; check the LiDAR's "
        f"coordinate system, and {others}"
    ]


def _widening(
    doubts: list[str], refined: Alignment, observations: Observations, found: Estimate
) -> float:
    """What the covariance is multiplied by where there are doubts: which of two is wrong is not
    known, nor by how much (Birge's ratio). Adds a doubt to ``doubts`` where the ground may be
    another."""
    ratio = max(found.contradiction / found.freedom, 1.0) if doubts else 1.0
    if any(fit.gcps for fit in refined.fits):
        return ratio
    scatter, explained = scatter_by_heights(refined, *observations.after[observations.used].T)
    if scatter <= explained:
        return ratio
    doubts.append(
        f"tie points scatter by {scatter:.3f} px of disparity, where the matches and the heights "
        f"of a LiDAR explain {explained:.3f} px at most: without ground control points the images "
        "may have been placed on other ground; check that the RPCs belong to the images, which may "
        "have been cut since"
    )
    return max(ratio, (scatter / explained) ** 2)


def _warn(doubts: Sequence[str], strict: bool, image: str | Path, of: str) -> None:
    for text in doubts:
        log.warning("warning: %s", text)
    if strict and doubts:
        raise InputError(
            f"{doubts[0]}{of}",
            file=image,
            remedy="check LiDAR and GCPs, or set strict or alignment.refine to false",
        )


def refine(
    alignment: Alignment,
    left_image: str | Path,
    right_image: str | Path,
    point_stores: Sequence[str | Path],
    *,
    masks: tuple[str | Path | None, str | Path | None] = (None, None),
    bands: Rectify | None = None,
    strict: bool = False,
    alone: bool = True,
    provenance: Mapping[str, Any] | None = None,
) -> tuple[Alignment, Observations | None]:
    """Refine an alignment by tie points between LiDAR and both images.

    Returns the alignment, with the record of what was done in ``refinement``, and the
    observations. It is the one that came, affines and all, if the tie points do not contradict
    it or are too few. Reads a fixed number of places, whatever the scene's size. ``masks``: of
    both images, see :class:`.images.Source`; ``bands``: which are looked at. ``strict`` makes
    warnings errors. ``alone``: no other pair shares an image, whose tie points could help.

    Raises InputError if there are neither GCPs nor usable tie points, and the pair is ``alone``.
    """
    of = f" (scene {alignment.scene})" if alignment.scene else ""
    with open_pair(left_image, right_image, *masks, bands=bands) as (left, right):
        stores = open_stores(sorted(Path(p) for p in point_stores))
        prior = prior_of(alignment)
        gcps = control_points_of(alignment)
        sensors = alignment.left, alignment.right
        middle = [n / 2 for n in alignment.left_fit.size]
        pixel = pixel_deg(alignment.left, *middle, alignment.reference_height)[1] * DEGREE_M
        doubts = [doubt_at_gcps(gcps, stores, pixel), doubt_by_rpcs(stores, sensors)]
        doubts = [text for text in doubts if text]
        alignment = replace(alignment, model_heights=heights_of_model(stores, sensors))
        result = _search(alignment, (left, right), stores, prior)
        if not isinstance(result, str):
            result, in_plan = _placed(alignment, result, (left, right), stores)
    record_of = dict(provenance or alignment.provenance)
    if isinstance(result, str):
        if not gcps and alone:
            raise InputError(
                f"no alignment without ground control points: {'; '.join([result, *doubts])}{of}",
                file=left_image,
                remedy="check that each of the two images has its own RPC, and that the LiDAR shows "
                "their ground; else measure GCPs",
            )
        doubts = [f"not refined: {result}", *doubts]
        _warn(doubts, strict, left_image, of)
        unrefined = replace(
            alignment,
            warnings=(*alignment.warnings, *doubts),
            refinement={"applied": False, "reason": result},
            provenance=record_of,
        )
        return unrefined, None
    observations, found, refined = result.observations, result.estimate, result.alignment
    reason = _objection(result, bool(gcps))
    offset = (
        height_by_images(alignment, found) if gcps else height_by_rpcs(alignment, refined, found)
    )
    record = _record(alignment, result, reason, offset, in_plan)
    covariance = found.covariance
    if reason:  # what is not applied adds to the uncertainty
        covariance = covariance + np.outer(found.parameters, found.parameters)
        refined = alignment
        observations = replace(
            observations, after=observations.before, by_affines=observations.before
        )
        record["after"] = record["before"]
    odd = _doubts(alignment, record, found)
    ratio = _widening(odd, refined, observations, found)
    if odd:
        record["uncertainty_widened_by"] = round(ratio**0.5, 3)
    covariance, doubts = ratio * covariance, [*doubts, *odd]
    _warn(doubts, strict, left_image, of)
    if not gcps and not doubts:
        doubts = [HEIGHTS_BY_RPCS.format(offset.told_from_m)]
        log.warning("warning: %s", *doubts)
    # once refined, places are known by the LiDAR
    told = [text for text in alignment.warnings if reason or text != PLACES_BY_RPCS]
    height = alignment.reference_height
    if not gcps:  # it was that of the RPCs, far off perhaps
        height = round(float(observations.ties.height[observations.used].mean()), 3)
    refined = replace(
        refined,
        reference_height=height,
        warnings=(*told, *doubts),
        left_fit=replace(refined.left_fit, covariance=covariance[:6, :6]),
        right_fit=replace(refined.right_fit, covariance=covariance[6:, 6:]),
        cross_covariance=covariance[:6, 6:],
        lines_covariance=None if reason else result.lines.used_covariance,
        shared_px=result.shared.label_px,
        refinement=record,
        provenance=record_of,
    )
    _tell(record)
    return refined, observations


def _objection(result: _Found, with_gcps: bool) -> str:
    """Why a refinement is not applied, or an empty string."""
    before, after = result.halves
    # what roofs tell of the place of both images, tie points need not contradict
    told = result.lines.stands_out or bool(result.observations.of_images.in_plan)
    if result.estimate.chance > SIGNIFICANT and not told:
        return "the tie points do not contradict the alignment"
    if after >= before and with_gcps:
        return (
            "it would fit worse than the control points alone: tie points of one half of the scene "
            f"are off by {before:.2f} standard deviations in the mean, and by {after:.2f} once "
            "those of the other half have moved the images"
        )
    return ""


def _tell(record: Mapping[str, Any]) -> None:
    """The figures of a refinement in the log."""
    for name in ("y_parallax", "disparity"):
        a, b = record["before"][name], record["after"][name]
        log.info(
            "%s at %d tie points: median %.3f -> %.3f px, rms %.3f -> %.3f px, trend %.3f -> %.3f",
            name,
            record["used"],
            *(pair[figure] for figure in ("median", "rms", "trend_rms") for pair in (a, b)),
        )
    if remark := record["remark"]:
        log.info("%s", remark)
    log.info(
        "refinement %s",
        f"applied: left moved by up to {record['change_of_left']['largest']:.3f} px, right by "
        f"{record['change_of_right']['largest']:.3f} px"
        if record["applied"]
        else f"not applied: {record['reason']}",
    )


def write_refinement(
    alignment: Alignment,
    observations: Observations | None,
    json_file: str | Path,
    csv_file: str | Path,
) -> None:
    """Write a refined alignment (JSON) and its tie points (CSV); without any the table is empty."""
    places = [f"{view}_{axis}_px" for view in ("left", "right") for axis in ("col", "row")]
    places += ["height_m", "epipolar_x_px", "epipolar_y_px"]
    states = ("before", "after", "by_affines")
    residuals = [f"{name}_{state}_px" for state in states for name in ("disparity", "y_parallax")]
    columns = ["site", *places, "correlation", "match_sigma_px", "used", *residuals]
    rows = []
    if observations is not None:
        o, ties = observations, observations.ties
        at = np.column_stack([ties.left, ties.right + ties.shift, ties.height, o.at])
        quality = np.column_stack([ties.correlation, ties.sigma])
        left = np.column_stack([getattr(o, state) for state in states])
        for k in range(len(ties)):
            row = [str(ties.site[k]), *(f"{v:.3f}" for v in at[k])]
            row += [*(f"{v:.4f}" for v in quality[k]), "yes" if o.used[k] else "no"]
            rows.append(dict(zip(columns, [*row, *(f"{v:.4f}" for v in left[k])])))
    write_table(csv_file, rows, columns)
    alignment.save(json_file)
