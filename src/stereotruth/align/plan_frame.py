"""The place that all images of a pair or a site have in common in plan, and what is known of it.

Tie points bind images to each other. Of the place that all have in common they tell by slopes only,
and what they tell is stated with twice the variance that their scatter shows: light and shade
change with the slope, and so do errors of matches, in all of a scene alike. Edges of roofs enter as
observations beside them (:mod:`.edge_offsets`). All images look at the same roofs, so that they
share COMMON_M of error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import metres_per_degree
from ..sensor.rpc import SensorModel
from .aligned_pair import ViewFit
from .equations import PlanObservation

Floats = NDArray[np.float64]


COMMON_M = 0.25  # m, standard deviation of what all images see alike of roofs' edges: half a rim
OWN_M = 0.1  # m: of what each sees by itself, besides the scatter of its edges
SLOPES_SHARE = 1.0  # variance that matches on slopes share, by that which their scatter shows


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
