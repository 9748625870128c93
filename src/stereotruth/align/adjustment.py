"""Corrections of both RPCs from tie points and control points, by robust least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.statistics import TUKEY, robust_sigma, tukey_weights
from ..epipolar.fit import fit_epipolar
from ..epipolar.model import EpipolarModel
from .alignment import Alignment, over_the_image, parameters_of
from .records import Equations, PairEquations
from .tie_points import Geometry, TiePoints

MATCHING = 0.01  # px, what even the best match may be off
LEAST_SIGMA = 1e-4  # of observations, in units of their own deviation
SYSTEMATIC = 0.01  # px that all tie points are taken to share, to weigh them against a prior
CLASSES = 5  # of matches, from the best to the poorest
FREE = 1e-4  # share of the prior's weight that keeps a fit without it determined
STARTS = 300  # planes, and shifts, from which the adjustment starts
START_PX = 0.03  # px of an observation, besides its own, when blunders are looked for
BLUNDER_ODDS = 1.0  # px²: of no blunder to a blunder in a square pixel


@dataclass(frozen=True, eq=False)
class Observations:
    """n tie points against an alignment, in px of the epipolar grid; [n, 2] is along, across rows.

    ``at``: place in the left grid.
    ``before``: disparity of LiDAR minus that of the images, and y-parallax (y of the right position
    found minus that of the left), with the alignment as it came; ``after`` with the refined one.
    ``used`` bool[n]: not a blunder. ``of_images``: the same, as equations of both images.
    """

    ties: TiePoints
    at: Floats
    before: Floats
    after: Floats
    by_affines: Floats
    used: Bools
    of_images: PairEquations


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters [12] in the order of ``Alignment.covariance``, and what they rest on.

    ``ratio``, ``site_ratio`` [2]: standard deviation of a match along and across the rows, and the
    part that a site shares, in units of the match's own; ``shared`` [2] px: of what all share.
    ``statistic``: chi-square of the observations against no change, ``contradiction``: that of the
    observations against the prior, the uncertainties of both counted.

    ``information`` [n, 2] px⁻²: weight over variance of each observation, along and across.
    ``root`` [12, r]: a root of the prior's covariance; ``normal`` [r, r]: information of the
    observations about parameters / root; ``alone`` [12]: what they say by themselves.
    """

    parameters: Floats
    covariance: Floats
    weights: Floats
    ratio: Floats
    site_ratio: Floats
    shared: Floats
    statistic: float
    freedom: int
    contradiction: float
    root: Floats
    normal: Floats
    alone: Floats
    information: Floats

    @property
    def chance(self) -> float:
        """Probability of so large a change by chance."""
        return float(f"{chdtrc(self.freedom, self.statistic):.3g}")

    def amount_along(self, direction: Floats) -> tuple[float, float]:
        """By how much of a direction [12] observations and prior differ, and its deviation.

        The direction's amount is unknown to the prior: generalised least squares of the difference
        of both, whose covariance is the sum of theirs.
        """
        rank = len(self.normal)
        along = np.linalg.pinv(self.root) @ direction
        both = np.linalg.solve(np.eye(rank) + self.normal, self.normal)
        information = float(along @ both @ along)
        observed = np.linalg.pinv(self.root) @ self.alone
        return float(along @ both @ observed) / information, information**-0.5


def root_of(covariance: Floats) -> Floats:
    """[12, r] with covariance = root · rootᵀ, without the directions that are fixed."""
    values, vectors = np.linalg.eigh(covariance)
    keep = values > 1e-12 * values.max()
    return vectors[:, keep] * np.sqrt(values[keep])


def _site_sigma(residuals: Floats, weights: Floats, sites: Ints, s: float) -> float:
    """Standard deviation that the places of a site share, from the scatter of the sites' means."""
    total = np.bincount(sites, weights)
    full = total > 1.0
    if not full.any():  # each stands by itself
        return 0.0
    mean = np.bincount(sites, weights * residuals)[full] / total[full]
    own = s**2 * np.bincount(sites, weights**2)[full] / total[full] ** 2
    return float(np.sqrt(max(robust_sigma(mean, LEAST_SIGMA) ** 2 - np.median(own), 0.0)))


def _shared_sigma(residuals: Floats, information: Floats, own: Floats) -> float:
    """Standard deviation px of an error that all observations [n] share, in their weighted mean.

    Poor matches are not only noisier: they are off to one side, where the surface is not what the
    points say. So classes of like ``own`` differ by more than their scatter explains. By how much
    is the variance between studies of a meta-analysis (DerSimonian & Laird 1986); as it is known
    from few classes only, Student's t takes the place of the normal distribution.
    """
    classes = np.argsort(np.argsort(own, kind="stable"), kind="stable") * CLASSES // own.size
    weight = np.bincount(classes, information)
    known = weight > 0.0
    mean = np.bincount(classes, information * residuals)[known] / weight[known]
    weight = weight[known]
    freedom = weight.size - 1
    if freedom < 3:  # of less, the variance of Student's t is infinite
        return 0.0
    total, squares = weight.sum(), np.sum(weight**2)
    scatter = np.sum(weight * (mean - np.sum(weight * mean) / total) ** 2)
    between = max(scatter - freedom, 0.0) / (total - squares / total)
    of_mean = between * squares / total**2
    return float(np.sqrt(of_mean * freedom / (freedom - 2)))


def _agreement(at: Floats, observed: Floats, scale: Floats) -> Floats:
    """Residuals [n, 2] px of observations from the plane over the image that most agree with.

    ``at`` [n, 2] positions, ``scale`` [n] px of an observation. Blunders may be most, and all of
    them off to one side, as long as they agree less with each other than the others do. Shifts by
    one observation each and planes through three each are tried, and the one of the greatest
    likelihood is taken, blunders of any size being as probable as good observations.
    """
    count = len(at)
    basis = np.column_stack([np.ones(count), (at - at.mean(axis=0)) / max(np.ptp(at), 1.0)])
    rng = np.random.default_rng(count)
    planes = [np.stack([o, np.zeros(2), np.zeros(2)]) for o in observed[:: 1 + count // STARTS]]
    for _ in range(STARTS):
        chosen = rng.choice(count, 3, replace=False)
        if abs(np.linalg.det(basis[chosen])) > 0.02:
            planes.append(np.linalg.solve(basis[chosen], observed[chosen]))

    def likelihood(plane: Floats) -> float:
        squared = np.sum((observed - basis @ plane) ** 2, axis=1) / scale**2
        return float(np.log1p(BLUNDER_ODDS * np.exp(-squared / 2) / scale**2).sum())

    best = max(planes, key=likelihood)
    for _ in range(20):
        squared = np.sum((observed - basis @ best) ** 2, axis=1) / scale**2
        odds = BLUNDER_ODDS * np.exp(-squared / 2) / scale**2
        root = np.sqrt(odds / (1.0 + odds))[:, None] / scale[:, None]
        best = np.linalg.lstsq(
            np.vstack([basis * root, np.diag([0.0, 1e-3, 1e-3])]),
            np.vstack([observed * root, np.zeros((3, 2))]),
            rcond=None,
        )[0]
    return observed - basis @ best


@dataclass(frozen=True, eq=False)
class Sums:
    """Normal equations of observations that share an unknown error of SYSTEMATIC px.

    ``normal`` [r, r] and ``right`` [r] without that error; ``single`` [r, r]: normal matrix as if
    there were none; ``shared`` [r, 2]: what parameters and the error have in common; ``total`` [2]
    px⁻²: information about the error, along and across.
    """

    normal: Floats
    right: Floats
    single: Floats
    shared: Floats
    total: Floats

    @classmethod
    def of(cls, design: Floats, observed: Floats, information: Floats) -> Sums:
        """Of a design [n, 2, r], observations [n, 2] px and their ``information`` [n, 2] px⁻²."""
        weighted = design * information[:, :, None]
        normal = np.einsum("nap,naq->pq", weighted, design)
        right = np.einsum("nap,na->p", weighted, observed)
        shared = weighted.sum(axis=0).T  # [r, 2], with what all observations have in common
        total = information.sum(axis=0) + SYSTEMATIC**-2.0
        single = normal.copy()
        normal -= (shared / total) @ shared.T
        right -= (shared / total) @ np.sum(information * observed, axis=0)
        return cls(normal, right, single, shared, total)

    def spread(self, common: Floats) -> Floats:
        """Covariance [r, r] of ``right``, by errors that have ``common`` [2] px in common."""
        floor, total = SYSTEMATIC**-2.0, self.total
        share = self.shared * (total + floor - (common * floor) ** 2) / total**2
        return self.single - share @ self.shared.T


def estimate(equations: Equations, prior: Floats, common_px: float = 0.0) -> Estimate:
    """Parameters [12] from the equations and the prior, a covariance [12, 12] about zero.

    ``common_px``: standard deviation of an error that all observations have in common and that no
    residual shows. All are weighed as if they shared SYSTEMATIC px, which decides between them and
    the prior only; the covariance is that of this estimate under the errors that the observations
    show.
    """
    design, observed, own = equations.design, equations.observed, equations.own
    root = root_of(prior)
    sites = np.unique(equations.site, return_inverse=True)[1]
    counts = np.bincount(sites)[sites]
    expected = np.hypot(own, MATCHING)[:, None]
    inner = design @ root
    rank = root.shape[1]
    residuals = _agreement(equations.at, observed, np.hypot(expected[:, 0], START_PX))
    used = np.hypot(*residuals.T) < 3.0 * np.hypot(expected[:, 0], START_PX)
    z = np.zeros(rank)
    sigma, site_sigma = np.ones(2), np.zeros(2)
    weights = np.ones(len(observed))
    for step in range(40):
        relative = residuals / expected
        sigma = np.array([robust_sigma(relative[used, k], LEAST_SIGMA) for k in (0, 1)])
        length = np.hypot(*(relative / sigma).T)
        weights = tukey_weights(length)
        used = weights > 0.0
        sigma = np.array([robust_sigma(relative[used, k], LEAST_SIGMA) for k in (0, 1)])
        site_sigma = np.array(
            [_site_sigma(relative[:, k], weights, sites, sigma[k]) for k in (0, 1)]
        )
        variance = expected**2 * (sigma**2 + counts[:, None] * site_sigma**2)
        information = weights[:, None] / variance
        sums = Sums.of(inner, observed, information)
        normal, right = sums.normal, sums.right
        last = z
        # Weights and scatter are those about what the tie points say by themselves: an alignment
        # that is far off and sure of itself shall not make them look bad.
        z = np.linalg.solve(FREE * np.eye(rank) + normal, right)
        residuals = observed - inner @ z
        if step > 12 and np.abs(inner @ (z - last)).max() < 1e-5:
            break
    alone, z = z, np.linalg.solve(np.eye(rank) + normal, right)
    values, vectors = np.linalg.eigh(normal)
    seen = values > 1e-9 * values.max()
    values, squares = values[seen], (vectors[:, seen].T @ right) ** 2
    own = expected[:, 0]
    common = np.array([_shared_sigma(residuals[:, k], information[:, k], own) for k in (0, 1)])
    common = np.hypot(common, common_px)
    to_parameters = root @ np.linalg.inv(np.eye(rank) + normal)
    covariance = to_parameters @ (np.eye(rank) + sums.spread(common)) @ to_parameters.T
    return Estimate(
        np.round(root @ z, 8),  # so that the count of threads leaves no trace
        np.round(covariance, 14),
        weights,
        sigma,
        site_sigma,
        common,
        float(np.sum(squares / values)),
        int(seen.sum()),
        float(np.sum(squares / (values + values**2))),
        root,
        normal,
        root @ alone,
        information,
    )


def agreement_of_halves(equations: Equations, prior: Floats) -> tuple[float, float]:
    """Mean misfit of one half of the sites, in deviations: as they came, and by the other half.

    A misfit counts TUKEY deviations at most, so that blunders say nothing.
    """
    halves = np.unique(equations.site, return_inverse=True)[1] % 2
    before, after = 0.0, 0.0
    for half in (0, 1):
        estimated = estimate(equations.part(halves != half), prior)
        check = equations.part(halves == half)
        scale = np.hypot(check.own, MATCHING)[:, None] * estimated.ratio
        residuals = check.observed - check.design @ estimated.parameters
        before += float(np.minimum(np.hypot(*(check.observed / scale).T), TUKEY).sum())
        after += float(np.minimum(np.hypot(*(residuals / scale).T), TUKEY).sum())
    return before / halves.size, after / halves.size


def linearised_at(
    alignment: Alignment, model: EpipolarModel, ties: TiePoints | Geometry
) -> tuple[Floats, Floats]:
    """Change [n, 2, 12] of (along, across) with the parameters, and [n, 2, 2] with the shift."""
    slopes = model.right_image.slopes(ties.right[:, 0], ties.right[:, 1])
    left, right = (
        fit.design(at[:, 0], at[:, 1]) for fit, at in zip(alignment.fits, (ties.left, ties.right))
    )
    return np.concatenate([-slopes @ ties.carry @ left, slopes @ right], axis=-1), slopes


def pair_equations(
    start: Alignment,
    current: Alignment,
    model: EpipolarModel,
    ties: TiePoints,
    places: int,
    common_px: float,
    by_line: Floats | float = 0.0,
) -> PairEquations:
    """The equations of tie points that were matched with an alignment ``current``.

    ``start``: that by control points or RPCs; ``model``: of the current one; ``by_line`` [n, 2] px:
    what its corrections by line have changed, along and across.
    """

    def parameters(alignment: Alignment) -> Floats:
        return np.concatenate([parameters_of(over_the_image(fit)) for fit in alignment.fits])

    left, right = (over_the_image(fit) for fit in current.fits)
    design, slopes = linearised_at(replace(current, left_fit=left, right_fit=right), model, ties)
    at = parameters(current)
    observed = np.einsum("nab,nb->na", slopes, ties.shift) + design @ at + by_line
    equations = Equations(design, observed, ties.sigma, ties.site, ties.left, ties.right)
    return PairEquations(equations, parameters(start), at, places, common_px)


def epipolar_model(alignment: Alignment) -> EpipolarModel:
    """The epipolar model of the corrected RPCs."""
    return fit_epipolar(
        alignment.left,
        alignment.right,
        alignment.left_fit.size,
        alignment.right_fit.size,
        alignment.reference_height,
        height_range=alignment.model_heights,
    )


def pull_of(design: Floats, observed: Floats, prior: Floats) -> Floats:
    """Parameters [12] for places [n] that all together tell one shift, to a pixel."""
    root = root_of(prior)
    inner = (design @ root).reshape(-1, root.shape[1])
    normal = np.eye(root.shape[1]) + inner.T @ inner / len(design)
    return root @ np.linalg.solve(normal, inner.T @ observed.ravel() / len(design))
