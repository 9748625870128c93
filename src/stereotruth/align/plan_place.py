"""The place of a pair in plan, by what its tie points tell and by edges of roofs in both images."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lidar.point_store import PointStore, query_points
from ..sensor.images import Source
from ..sensor.rpc import SensorModel
from .adjustment import Estimate, parameters_of
from .aligned_pair import Alignment, ViewFit, over_the_image
from .edge_offsets import ROOF_RIM_M, PlanOffset, plan_offset
from .equations import PlanObservation
from .plan_frame import COMMON_M, OWN_M, PlanFrame, plan_slopes, with_offsets
from .roof_edges import RoofEdges, find_roof_edges
from .tie_sites import IS_FIRM, choose_sites, query_box

log = logging.getLogger("stereotruth")
Floats = NDArray[np.float64]


WORTH = 0.5  # of COMMON_M: a place that is known better gains nothing by edges
REACH_SIGMAS, LEAST_REACH_M, LARGEST_REACH_M = 3.0, 4.0, 8.0  # of the search for an offset
EDGES = 240  # about, of a scene
AGREE_SIGMAS = 3.0  # of images and halves, that the offsets of either may lie apart


def place_pair(
    refined: Alignment,
    found: Estimate,
    sources: tuple[Source, Source],
    stores: Sequence[PointStore],
) -> tuple[Estimate, dict[str, Any], tuple[PlanObservation, ...]]:
    """The estimate with its place in plan, figures of it, and what both images observe.

    ``found`` and ``refined``: of the tie points.
    """
    height = refined.reference_height
    cols, rows = refined.left_fit.size
    lon, lat = (float(v) for v in refined.left.localize((cols - 1) / 2, (rows - 1) / 2, height))
    sensors = refined.left, refined.right
    frame = PlanFrame.of(refined.fits, [plan_slopes(s, lon, lat, height) for s in sensors])
    to_parameters = found.root @ np.linalg.inv(np.eye(len(found.normal)) + found.normal)
    of_ties = found.covariance - to_parameters @ to_parameters.T
    covariance = frame.widened(found.covariance, of_ties)
    sigma = frame.sigma(covariance)
    figures: dict[str, Any] = {"sigma_by_tie_points_m": sigma.round(3).tolist()}
    seen: list[PlanOffset] | str = "the place is known better than edges tell it"
    if sigma.max() > WORTH * COMMON_M:
        reach = float(np.clip(REACH_SIGMAS * sigma.max(), LEAST_REACH_M, LARGEST_REACH_M))
        seen = _offsets(refined, sources, stores, reach)
    parameters = found.parameters
    observations: tuple[PlanObservation, ...] = ()
    if isinstance(seen, str):
        figures |= {"roof_edges_used": False, "reason": seen}
    else:
        pairs = list(zip(refined.fits, sensors, seen))
        own = [_observation(fit, sensor, o, parameters[6 * k : 6 * k + 6])
               for k, (fit, sensor, o) in enumerate(pairs)]  # fmt: skip
        parameters, covariance = with_offsets(parameters, covariance, list(enumerate(own)))
        figures |= {
            "roof_edges_used": True,
            "reason": "",
            "roof_edges": [o.edges for o in seen],
            "offset_by_roof_edges_m": [o.offset.round(3).tolist() for o in seen],
            "points_inward_m": [round(o.inward_m, 3) for o in seen],
            "moved_m": (frame.mean @ (parameters - found.parameters)).round(3).tolist(),
        }
        log.info("roof edges: %s", figures)
        over = [over_the_image(fit) for fit in refined.fits]
        observations = tuple(
            _observation(fit, sensor, o, parameters_of(fit))
            for fit, sensor, o in zip(over, sensors, seen)
        )
    figures["sigma_m"] = frame.sigma(covariance).round(3).tolist()
    changed = np.round(parameters, 8), np.round(covariance, 14)
    return replace(found, parameters=changed[0], covariance=changed[1]), figures, observations


def _observation(
    fit: ViewFit, sensor: SensorModel, offset: PlanOffset, parameters: Floats
) -> PlanObservation:
    """An offset seen with ``parameters`` [6] of the fit, as an observation of them."""
    px = plan_slopes(sensor, *offset.middle.tolist())
    design = fit.design(*sensor.project(*offset.middle))
    own = offset.covariance + OWN_M**2 * np.eye(2)
    return PlanObservation(design, design @ parameters + px @ offset.offset, px @ own @ px.T, px)


def _offsets(
    alignment: Alignment,
    sources: tuple[Source, Source],
    stores: Sequence[PointStore],
    reach_m: float,
) -> list[PlanOffset] | str:
    """The offsets of both images, or why they tell nothing."""
    edges = _edges(alignment, (sources[0].size, sources[1].size), stores)
    found = []
    for source, sensor in zip(sources, (alignment.left, alignment.right)):
        offset = plan_offset(source, sensor, edges, reach_m)
        if isinstance(offset, str):
            return offset
        found.append(offset)
    every = np.concatenate([o.halves for o in found])
    apart = np.abs(every - every.mean(axis=0)).max()
    own = max(float(np.trace(o.covariance)) for o in found)
    if apart > max(ROOF_RIM_M, AGREE_SIGMAS * np.hypot(OWN_M, np.sqrt(min(own, COMMON_M**2)))):
        return f"the edges of roofs contradict each other by {apart:.1f} m"
    return found


def _edges(
    alignment: Alignment,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    stores: Sequence[PointStore],
) -> RoofEdges:
    """Edges of roofs all over the scene, some EDGES."""
    left, right = alignment.left, alignment.right
    sites = choose_sites(left, right, sizes, stores, alignment.reference_height)
    most = max(EDGES // max(len(sites), 1), 3)
    found = []
    for number, site in enumerate(sites):
        box = query_box(left, right, site)
        points = None if box is None else query_points(stores, *box)
        if points is None or not len(points):
            continue
        firm = IS_FIRM[points.classification]
        lon, lat, height = points.lon[firm], points.lat[firm], points.height[firm]
        if lon.size:
            found.append(find_roof_edges(lon, lat, height, number, most))
    return RoofEdges.concatenate(found)
