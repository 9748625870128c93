"""Errors that tie points share, which their number does not average away.

**Near each other.** Their covariance is that of the greatest restricted likelihood (Patterson &
Thompson 1971), exponential in the distance, beside errors that each site has for itself
(docs/explanation/uncertainty.md).

**All of them, in plan.** What tie points tell of the place that all images have in common is stated
with twice its variance, and edges of roofs (:mod:`.roof_edges`) enter as observations beside them,
with COMMON_M of error that all images share (docs/explanation/real_sensors.md).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtrc

from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.geometry import metres_per_degree
from ..lidar.point_store import PointStore, query_points
from ..sensor.images import Source
from ..sensor.rpc import SensorModel
from .adjustment import MATCHING, Estimate
from .alignment import Alignment, ViewFit, over_the_image, parameters_of
from .images import IS_FIRM, choose_sites, query_box
from .records import Equations, PlanObservation
from .roof_edges import ROOF_RIM_M, PlanOffset, RoofEdges, find_roof_edges, plan_offset

log = logging.getLogger("stereotruth")


CHANCE = 0.05  # probability of such a rise of the likelihood where sites share nothing
SURE = 0.001  # the same, from which on their form is told
UNKNOWNS = 2  # a standard deviation and a length
LENGTHS = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)  # of the covariance, in spacings of the sites
FEWEST = 12  # sites that tell a covariance
LEAST = 0.5  # of the variance that labels have at least, whatever the corrections take of it
# Standard deviations are found on a grid of ratios: the same on any machine.
STEP = 2.0**0.5
WIDEST = 12  # steps to either side of one; none at the lowest
Steps = tuple[int, ...]
COMMON_M = 0.25  # m, standard deviation of what all images see alike of roofs' edges: half a rim
OWN_M = 0.1  # m: of what each sees by itself, besides the scatter of its edges
SLOPES_SHARE = 1.0  # variance that matches on slopes share, by that which their scatter shows
WORTH = 0.5  # of COMMON_M: a place that is known better gains nothing by edges
REACH_SIGMAS, LEAST_REACH_M, LARGEST_REACH_M = 3.0, 4.0, 8.0  # of the search for an offset
EDGES = 240  # about, of a scene
AGREE_SIGMAS = 3.0  # of images and halves, that the offsets of either may lie apart


def amount(step: int) -> float:
    """A standard deviation by its step, in a unit of the caller's."""
    return 0.0 if step <= -WIDEST else STEP**step


def climb(score: Callable[[Steps], float], start: Steps) -> tuple[Steps, float]:
    """Steps from ``start`` on to where no neighbour along an axis scores higher, and the score."""
    scores: dict[Steps, float] = {}

    def known(steps: Steps) -> float:
        if steps not in scores:
            scores[steps] = score(steps)
        return scores[steps]

    best, top = start, known(start)
    moved = True
    while moved:
        moved = False
        for axis in range(len(start)):
            for step in (-1, 1):
                while abs(best[axis] + step) <= WIDEST:
                    there = (*best[:axis], best[axis] + step, *best[axis + 1 :])
                    if not (value := known(there)) > top + 1e-9:
                        break
                    best, top, moved = there, value, True
    return best, top


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Errors [2] along and across the rows that sites near each other share.

    ``sigma_px``: standard deviations, 0 where they are no more than chance; ``length_px`` of the
    left image, over which they fall to 1/e; ``chance``; ``label_px``: the standard deviation of a
    label's disparity by them, beside the corrections' own. ``smooth``: a curved surface
    of second degree over the scene takes them away.
    """

    sigma_px: tuple[float, float]
    length_px: tuple[float, float]
    chance: tuple[float, float]
    label_px: float = 0.0
    smooth: bool = False

    @property
    def are_told(self) -> bool:
        """Whether sites share more of the disparity than chance explains."""
        return self.sigma_px[0] > 0.0 and self.chance[0] < CHANCE

    def figures(self) -> dict[str, Any]:
        """JSON-ready."""
        found: dict[str, Any] = {
            "sigma_of_labels_px": round(self.label_px, 4),
            "smooth": self.smooth,
        }
        for k, name in enumerate(("disparity", "y_parallax")):
            found[name] = {
                "sigma_px": round(self.sigma_px[k], 4),
                "length_px": round(self.length_px[k], 1),
                "probability_by_chance": float(f"{self.chance[k]:.3g}"),
            }
        return found


@dataclass(frozen=True, eq=False)
class _Sites:
    """Means of m sites: ``value`` and ``variance`` [m]; ``distance`` [m, m] px and ``trend``
    [m, t], which has no part in the likelihood."""

    value: Floats
    variance: Floats
    distance: Floats
    trend: Floats

    @classmethod
    def of(cls, at: Floats, value: Floats, variance: Floats, *, curved: bool = False) -> _Sites:
        """At places [m, 2] px; ``curved``: the trend is of second degree, else the affines'."""
        distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
        u, v = ((at - at.mean(axis=0)) / max(float(np.ptp(at)), 1.0)).T
        squares = [u * u, u * v, v * v] if curved else []
        trend = np.column_stack([np.ones(len(at)), u, v, *squares])
        return cls(value, variance, distance, trend)

    def twice_log(self, own: float, shared: float, length: float) -> float:
        """Twice the log of the restricted likelihood; standard deviations and a length, px."""
        covariance = np.diag(self.variance + own**2)
        if shared:
            covariance += shared**2 * np.exp(-self.distance / length)
        factor = np.linalg.cholesky(covariance)
        both = solve_triangular(factor, np.column_stack([self.trend, self.value]), lower=True)
        trend, value = both[:, :-1], both[:, -1]
        basis, corner = np.linalg.qr(trend)
        left = value - basis @ (basis.T @ value)
        determinant = np.log(np.diag(factor)).sum() + np.log(np.abs(np.diag(corner))).sum()
        return -float(left @ left) - 2.0 * float(determinant)


def _shared_of(sites: _Sites) -> tuple[float, float, float]:
    """Standard deviation and length (px) of what sites share, and its probability by chance."""
    unit = float(np.sqrt(np.median(sites.variance)))
    near = sites.distance + np.diag(np.full(len(sites.value), np.inf))
    spacing = float(np.median(near.min(axis=1)))
    (own,), without = climb(lambda k: sites.twice_log(amount(k[0]) * unit, 0.0, 1.0), (0,))
    best = (without, 0.0, spacing, (own, 0))
    for length in (spacing * times for times in LENGTHS):
        steps, top = climb(
            lambda k, length=length: sites.twice_log(
                amount(k[0]) * unit, amount(k[1]) * unit, length
            ),
            best[3],
        )
        if top > best[0] + 1e-9:
            best = top, amount(steps[1]) * unit, length, steps
    top, sigma, length, _ = best
    return sigma, length, float(chdtrc(UNKNOWNS, max(top - without, 0.0)))


def with_shared_errors(
    found: Estimate, equations: Equations, *, by_line: bool = False
) -> tuple[Estimate, SharedErrors]:
    """The estimate of a pair's affines with what near sites share counted, and these errors.

    Then the parameters are those of generalised least squares; without such errors nothing changes.
    ``equations``: of ``found``, corrections by line taken off. ``by_line``: there are some. They
    take a part of what near sites share, so that the rest counts whatever its probability.
    """
    index = np.unique(equations.site, return_inverse=True)[1]
    residuals = equations.observed - equations.design @ found.parameters
    known = np.bincount(index, found.weights) > 0.0
    information = (
        found.weights[:, None] / (np.hypot(equations.own, MATCHING)[:, None] * found.ratio) ** 2
    )
    total = np.stack([np.bincount(index, i) for i in information.T], axis=1)
    at = np.stack([np.bincount(index, found.weights * c) for c in equations.at.T], axis=1)
    at = at[known] / np.bincount(index, found.weights)[known, None]
    if known.sum() < FEWEST:
        return found, SharedErrors((0.0, 0.0), (0.0, 0.0), (1.0, 1.0))
    means = [
        (np.bincount(index, i * r)[known] / t[known], 1.0 / t[known])
        for i, r, t in zip(information.T, residuals.T, total.T)
    ]
    told = [_shared_of(_Sites.of(at, *mean)) for mean in means]
    sigma = tuple(s if by_line or chance < CHANCE else 0.0 for s, _, chance in told)
    smooth = told[0][2] < SURE and _shared_of(_Sites.of(at, *means[0], curved=True))[2] > CHANCE
    shared = SharedErrors(
        sigma,
        tuple(length for _, length, _ in told),
        tuple(chance for _, _, chance in told),
        smooth=smooth,
    )
    if not any(sigma):
        return found, shared
    return _counted(found, equations, shared, index, known, at)


def shared_spread(found: Estimate, equations: Equations, shared: SharedErrors) -> Floats:
    """Covariance [12, 12] that shared errors add to the right side of a pair's normal equations."""
    index = np.unique(equations.site, return_inverse=True)[1]
    count = np.bincount(index)
    at = np.stack([np.bincount(index, c) / count for c in equations.at.T], axis=1)
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    spread = np.zeros((12, 12))
    for k in (0, 1):
        covariance = shared.sigma_px[k] ** 2 * np.exp(-distance / max(shared.length_px[k], 1.0))
        weighted = found.information[:, k, None] * equations.design[:, k]
        pull = np.stack([np.bincount(index, w) for w in weighted.T], axis=1)
        spread += pull.T @ covariance @ pull
    return spread


def _counted(
    found: Estimate,
    equations: Equations,
    shared: SharedErrors,
    index: Ints,
    known: Bools,
    at: Floats,
) -> tuple[Estimate, SharedErrors]:
    """The estimate by generalised least squares, with the errors that are shared."""
    inner = equations.design @ found.root
    rank = inner.shape[-1]
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    normal, right = np.zeros((rank, rank)), np.zeros(rank)
    of_disparity: Floats = np.zeros((0, rank))
    for k in (0, 1):
        weight = found.information[:, k]

        def of_sites(values: Floats, weight: Floats = weight) -> Floats:
            total = np.bincount(index, weight)
            return (np.bincount(index, weight * values) / np.where(total > 0.0, total, 1.0))[known]

        design = np.stack([of_sites(column) for column in inner[:, k].T], axis=1)
        value = of_sites(equations.observed[:, k])
        total = np.bincount(index, weight)[known]
        covariance = shared.sigma_px[k] ** 2 * np.exp(-distance / shared.length_px[k])
        covariance += found.shared[k] ** 2
        inverse = np.linalg.inv(covariance + np.diag(1.0 / total))
        by_itself = weight[:, None] * inner[:, k]
        normal += by_itself.T @ inner[:, k] - (design.T * total) @ design
        right += by_itself.T @ equations.observed[:, k] - (design.T * total) @ value
        normal += design.T @ inverse @ design
        right += design.T @ inverse @ value
        if k == 0:
            of_disparity, taken_by = design, inverse @ covariance
    posterior = np.linalg.inv(np.eye(rank) + normal)
    values, vectors = np.linalg.eigh(normal)
    seen = values > 1e-9 * values.max()
    values, squares = values[seen], (vectors[:, seen].T @ right) ** 2
    alone = vectors[:, seen] @ ((vectors[:, seen].T @ right) / values)
    # Of a label's error by what is shared, the corrections take a part.
    variance = shared.sigma_px[0] ** 2
    taken = np.mean(np.sum((of_disparity @ posterior @ of_disparity.T) * taken_by.T, axis=1))
    label = float(np.sqrt(max(variance - 2.0 * float(taken), LEAST * variance)))
    counted = replace(
        found,
        parameters=np.round(found.root @ (posterior @ right), 8),
        covariance=np.round(found.root @ posterior @ found.root.T, 14),
        normal=normal,
        alone=found.root @ alone,
        statistic=float(np.sum(squares / values)),
        freedom=int(seen.sum()),
        contradiction=float(np.sum(squares / (values + values**2))),
    )
    return counted, replace(shared, label_px=label)


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
