"""The equations of a pair's tie points, and figures of what they leave."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.statistics import median_and_nmad

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Equations:
    """Observations [n] of what the corrections change: observed = design · parameters + errors.

    ``design`` [n, 2, 12], ``observed`` [n, 2] px, along and across the rows. ``own`` [n] px: the
    matches' own standard deviations, which count as ratios only (poor matches are poorer than that,
    and biased where the surface is not what the points say). Observations of one ``site`` int[n]
    share errors. ``at``, ``there`` [n, 2] px: place in the left and in the right image.
    """

    design: Floats
    observed: Floats
    own: Floats
    site: NDArray[np.int64]
    at: Floats
    there: Floats

    @property
    def lines(self) -> Floats:
        """[n, 2] px: lines of the left and of the right image."""
        return np.column_stack([self.at[:, 1], self.there[:, 1]])

    def part(self, chosen: Bools) -> Equations:
        """Those that are ``chosen`` [n]."""
        return Equations(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def about(self, parameters: Floats) -> Equations:
        """The same of parameters that are counted from given ones [12]."""
        return replace(self, observed=self.observed - self.design @ parameters)


@dataclass(frozen=True, eq=False)
class PlanObservation:
    """The place of an image in plan, in px of (col, row): observed = design @ parameters + error.

    ``design`` [2, 6] of the parameters of :func:`.adjustment.parameters_of`, ``observed`` [2],
    ``covariance`` [2, 2] px² of the image's own error; ``px_per_m`` [2, 2]: by what a metre to the
    east and to the north moves a place, and so the error that all images have in common.
    """

    design: Floats
    observed: Floats
    covariance: Floats
    px_per_m: Floats


@dataclass(frozen=True, eq=False)
class PairEquations:
    """What the tie points of a pair say of its images, whatever alignment they were found with.

    ``equations``: of the parameters [12] of :func:`.adjustment.parameters_of` of both images, left
    first.
    ``start`` [12]: those of the alignment by control points or RPCs; ``linearised_at`` [12]: those
    with which the tie points were matched. ``places``: where the images were compared, with and
    without a match. ``common_px``: see :func:`.adjustment.estimate`. ``in_plan``: the
    place of the left and of the right image in plan, if edges of roofs tell it.
    """

    equations: Equations
    start: Floats
    linearised_at: Floats
    places: int
    common_px: float
    in_plan: tuple[PlanObservation, ...] = ()


def spread_of(values: Floats, at: Floats, size: tuple[int, int]) -> dict[str, float]:
    """Figures of one component [n] in px; the trend is that of a plane over the left image.

    ``at`` [n, 2] px in the left image of ``size`` (cols, rows).
    """
    median, nmad = median_and_nmad(values)
    middle, half = np.array(size) / 2, max(size) / 2
    design = np.column_stack([(at - middle) / half, np.ones(len(values))])
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
