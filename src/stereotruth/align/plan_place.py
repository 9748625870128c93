"""The place that all images of a pair or a site have in common in plan, and what is known of it.

Tie points bind images to each other. Of the place that all have in common they tell by slopes only,
and what they tell is stated with twice the variance that their scatter shows: light and shade
change with the slope, and so do errors of matches, in all of a scene alike. Edges of roofs enter as
observations beside them (:mod:`.roof_edges`). All images look at the same roofs, so that they share
COMMON_M of error.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.degrees import metres_per_degree
from ..lidar.point_store import PointStore, query_points
from ..sensor.image_reader import Source
from ..sensor.rpc import SensorModel
from .adjustment import Estimate
from .alignment import Alignment, ViewFit, over_the_image, parameters_of
from .records import PlanObservation
from .roof_edges import ROOF_RIM_M, PlanOffset, RoofEdges, find_roof_edges, plan_offset
from .tie_sites import IS_FIRM, choose_sites, query_box

Floats = NDArray[np.float64]


COMMON_M = 0.25  # m, standard deviation of what all images see alike of roofs' edges: half a rim
OWN_M = 0.1  # m: of what each sees by itself, besides the scatter of its edges
SLOPES_SHARE = 1.0  # variance that matches on slopes share, by that which their scatter shows
log = logging.getLogger("stereotruth")
WORTH = 0.5  # of COMMON_M: a place that is known better gains nothing by edges
REACH_SIGMAS, LEAST_REACH_M, LARGEST_REACH_M = 3.0, 4.0, 8.0  # of the search for an offset
EDGES = 240  # about, of a scene
AGREE_SIGMAS = 3.0  # of images and halves, that the offsets of either may lie apart


def plan_slopes(sensor: SensorModel, lon: float, lat: float, height: float) -> Floats:
    """[2, 2] px: by how much (col, row) change for a metre to the east and to the north."""
    step = 1.0 / metres_per_degree(lat)
    here = np.array(sensor.project(lon, lat, height))
    east, north = (
        np.array(sensor.project(lon + d * step[0], lat + (1 - d) * step[1], height)) for d in (1, 0)
    )
    return np.column_stack([east - here, north - here])


@dataclass(frozen=True, eq=False)
class PlanFrame:
    """What a metre of plan is to the parameters [6 n] of n images.

    ``shift`` [6 n, 2]: change of the parameters that moves all images by a metre to the east, to
    the north; ``mean`` [2, 6 n]: mean place of all images (m) by the parameters.
    """

    shift: Floats
    mean: Floats

    @classmethod
    def of(cls, fits: Sequence[ViewFit], slopes: Sequence[Floats]) -> PlanFrame:
        """Of images with ``slopes`` [2, 2] as of :func:`plan_slopes`, in their middles."""
        count = 6 * len(fits)
        shift, mean = np.zeros((count, 2)), np.zeros((2, count))
        for k, (fit, px) in enumerate(zip(fits, slopes)):
            cols, rows = fit.size
            design = fit.design((cols - 1) / 2, (rows - 1) / 2)
            shift[[6 * k + 2, 6 * k + 5]] = px
            mean[:, 6 * k : 6 * k + 6] = np.linalg.solve(px, design) / len(fits)
        return cls(shift, mean)

    def widened(self, covariance: Floats, of_ties: Floats) -> Floats:
        """The ``covariance`` with what tie points share in the place that all images have in
        common; ``of_ties``: the part of it that their errors make up."""
        in_plan = SLOPES_SHARE * self.mean @ of_ties @ self.mean.T
        return covariance + self.shift @ in_plan @ self.shift.T

    def sigma(self, covariance: Floats) -> Floats:
        """Standard uncertainty [2] m of the common place, to the east and to the north."""
        return np.sqrt(np.diag(self.mean @ covariance @ self.mean.T))


def with_offsets(
    parameters: Floats,
    covariance: Floats,
    observations: Sequence[tuple[int, PlanObservation]],
) -> tuple[Floats, Floats]:
    """Parameters [6 n] and covariance with the ``observations`` of images (index, observation).

    Least squares, the parameters and their covariance being the prior.
    """
    if not observations:
        return parameters, covariance
    count = 2 * len(observations)
    design, observed = np.zeros((count, parameters.size)), np.zeros(count)
    own, common = np.zeros((count, count)), np.zeros((count, 2))
    for k, (image, seen) in enumerate(observations):
        rows = slice(2 * k, 2 * k + 2)
        design[rows, 6 * image : 6 * image + 6] = seen.design
        observed[rows], own[rows, rows] = seen.observed, seen.covariance
        common[rows] = COMMON_M * seen.px_per_m
    errors = own + common @ common.T
    gain = np.linalg.solve(design @ covariance @ design.T + errors, design @ covariance).T
    kept = np.eye(parameters.size) - gain @ design
    moved = parameters + gain @ (observed - design @ parameters)
    covariance = kept @ covariance @ kept.T + gain @ errors @ gain.T
    return moved, (covariance + covariance.T) / 2.0


def place_pair(
    refined: Alignment,
    found: Estimate,
    sources: tuple[Source, Source],
    stores: Sequence[PointStore],
) -> tuple[Estimate, dict[str, Any], tuple[PlanObservation, ...]]:
    """The estimate with its place in plan, figures of it, and what both images observe.

    ``found`` and ``refined``: of the tie points.
    """
    sensors = refined.left, refined.right
    frame = PlanFrame.of(refined.fits, [plan_slopes(s, *refined.middle) for s in sensors])
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
