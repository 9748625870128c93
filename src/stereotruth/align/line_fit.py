"""Corrections by line of both images of a pair, from what an affine leaves at the tie points.

Each image's two functions of the line (roll, pitch) are Gaussian processes, whose standard
deviations and length are those of the greatest marginal likelihood, beside errors of matches and
sites. They have no mean and no trend over the lines, which are the affine's. They are used if the
likelihood rises by more than chance allows, and if one half of the sites fits the other better with
them. See docs/explanation/refinement.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtr

from ..core.numerics.arrays import Floats
from ..core.numerics.statistics import TUKEY, huber_weights, robust_sigma, tukey_weights
from ..sensor.rpc import LineCorrection, line_weights
from .adjustment import (
    BLUNDER_ODDS,
    FREE,
    LEAST_SIGMA,
    MATCHING,
    START_PX,
    Estimate,
    estimate,
    root_of,
)
from .records import Equations
from .shared_errors import WIDEST, Steps, amount, climb

CELLS = 40  # of a spline over the lines: four a period where an image has ten
LENGTHS = (1 / 32, 1 / 23, 1 / 16, 1 / 11, 1 / 8, 1 / 5.6, 1 / 4)  # of a process, in images
KEPT = 1e-7  # share of the largest variance that a direction of a process must have
LOOKED_AT = 3.0  # deviations of the score test, with less of which a length is not looked at
CHANCE = 0.001  # probability of such a rise of the likelihood if no line is off
KINDS = 3  # of unknowns of the processes: two standard deviations and a length
UNKNOWNS = 4 * (CELLS + 3)  # coefficients of a pair
MOST = 0.9  # share of the tie points that an estimate uses if a plane is all there is
STEPS = 6  # of weights where it is not
CAPACITY = 3.0  # log-likelihood that an unknown has to bring: half the log of some hundred ties
RAYLEIGH = 1.7456  # robust deviation about 0 of the length of two normal variates
ROUNDS = 3  # of robust weights and corrections by line, each with what the other has found


@dataclass(frozen=True, eq=False)
class LineFit:
    """Corrections of the left and the right image, and what they rest on.

    ``fitted`` [UNKNOWNS] px, in the order of :func:`line_design`, of images of ``rows`` lines;
    ``affine`` [12]: the affines' parameters beside them; ``freedom``: how many unknowns they are
    worth.
    ``covariance`` [k, 4, 4] px² of (col, row) of the left image's lines and of the right image's
    that show the same ground, at ``k`` equal steps of the left image. ``rms_px`` [2]: standard
    deviations of the processes, along lines and across; ``length``: in images.
    ``noise``: standard deviation of a match in units of its own; ``of_site``: of what a site
    shares, in units of the noise.
    """

    fitted: Floats
    affine: Floats
    freedom: float
    rows: tuple[int, int]
    covariance: Floats
    rms_px: Floats
    length: float
    chance: float
    halves: _Halves
    noise: float
    of_site: float

    @property
    def stands_out(self) -> bool:
        """Whether lines are off by more than chance, and the halves of the sites agree."""
        return self.chance < CHANCE and bool(ndtr(-self.halves.clear) < CHANCE)

    def taken(self) -> LineFit:
        """The same, used whatever chance and halves say."""
        return replace(self, chance=0.0, halves=replace(self.halves, clear=np.inf))

    @property
    def coefficients(self) -> Floats:
        """Those ``fitted`` if they are used, else zeros."""
        return self.fitted if self.stands_out else np.zeros_like(self.fitted)

    @property
    def corrections(self) -> tuple[LineCorrection, LineCorrection] | tuple[None, None]:
        """Of the left and the right image, if they are used."""
        if not self.stands_out:
            return None, None
        left, right = (
            LineCorrection((0.0, count - 1.0), own)
            for count, own in zip(self.rows, self.fitted.reshape(2, 2, -1))
        )
        return left, right

    @property
    def used_covariance(self) -> Floats | None:
        """The ``covariance`` of corrections that are used."""
        return self.covariance if self.stands_out else None

    def figures(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "rms_px": dict(zip(("along_lines", "across"), self.rms_px.round(4).tolist())),
            "length_over_image": round(self.length, 4),
            "probability_by_chance": float(f"{self.chance:.3g}"),
            "one_half_by_the_other": {k: round(v, 3) for k, v in vars(self.halves).items()},
            "used": self.stands_out,
        }


def estimate_with_lines(
    equations: Equations, prior: Floats, common_px: float, rows: tuple[int, int]
) -> tuple[Estimate, LineFit]:
    """The estimate of a pair's affines, and the corrections by line that it goes with.

    Those of a fit that does not :attr:`LineFit.stands_out` have no part in the estimate. Where
    lines are off, the plane that most tie points agree on may leave half of them out. So the fit
    starts with all of them, too, and what gives them the greater likelihood is taken.
    """
    root = root_of(prior)
    expected = np.hypot(equations.own, MATCHING)
    found = estimate(equations, prior, common_px)
    lines = fit_lines(equations, root, expected, found.weights, rows)
    design = line_design(equations.design, equations.lines, rows)
    if np.mean(found.weights > 0.0) < MOST:
        other = _from_all(equations, root, expected, design, rows)
        if other.stands_out and (
            _likelihood(equations, expected, other, design) - other.freedom * CAPACITY
            > _likelihood(equations, expected, replace(lines, affine=found.parameters), design)
        ):
            lines = other
    for _ in range(ROUNDS if lines.stands_out else 0):
        without = replace(equations, observed=equations.observed - design @ lines.coefficients)
        found = estimate(without, prior, common_px)
        lines = fit_lines(equations, root, expected, found.weights, rows)
    return found, lines


def _left(equations: Equations, lines: LineFit, design: Floats) -> Floats:
    """Residuals [n, 2] px of affines and lines; ``design`` of the lines."""
    return equations.observed - equations.design @ lines.affine - design @ lines.coefficients


def _likelihood(equations: Equations, expected: Floats, lines: LineFit, design: Floats) -> float:
    """Logarithm of that of tie points among blunders of any size, as in
    :func:`.adjustment.estimate`."""
    scale = np.hypot(expected, START_PX)
    squares = np.sum(_left(equations, lines, design) ** 2, axis=1) / scale**2
    return float(np.log1p(BLUNDER_ODDS * np.exp(-squares / 2.0) / scale**2).sum())


def _from_all(
    equations: Equations, root: Floats, expected: Floats, design: Floats, rows: tuple[int, int]
) -> LineFit:
    """Corrections by line that start with all tie points, and leave out what does not fit."""
    weights = np.ones(len(expected))
    for step in range(STEPS):
        lines = fit_lines(equations, root, expected, weights, rows)
        size = np.hypot(*_left(equations, lines.taken(), design).T) / expected
        size /= robust_sigma(size, LEAST_SIGMA) / RAYLEIGH
        weights = huber_weights(size) if step < STEPS // 2 else tukey_weights(size)
    return lines


def process(length: float) -> Floats:
    """[n, r]: root of the covariance of a spline's coefficients, of unit variance over the lines.

    Squared exponential, without a mean and a trend; ``length`` in images.
    """
    at = (np.arange(CELLS + 3) - 1.0) / CELLS
    covariance = np.exp(-0.5 * np.subtract.outer(at, at) ** 2 / length**2)
    basis = np.linalg.qr(np.column_stack([np.ones(at.size), at]))[0]
    keep = np.eye(at.size) - basis @ basis.T
    weights = line_weights((0.0, 1.0), at.size, np.linspace(0.0, 1.0, 4 * CELLS + 1))
    values, vectors = np.linalg.eigh(keep @ covariance @ keep)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    root = root[:, values > KEPT * values.max()]
    return root / np.sqrt(np.mean(np.sum((weights @ root) ** 2, axis=1)))


def line_design(design: Floats, lines: Floats, rows: tuple[int, int]) -> Floats:
    """[n, 2, UNKNOWNS]: what the coefficients change, along and across the epipolar rows.

    Of the left image's C and R, then of the right's; images of ``rows`` lines. ``design``
    [n, 2, 12] of the affines; ``lines`` [n, 2] px, in the left and in the right image.
    """
    parts = []
    for at, count, of_shift in zip(lines.T, rows, ((2, 5), (8, 11))):
        weights = line_weights((0.0, count - 1.0), CELLS + 3, at)
        parts += [design[:, :, k, None] * weights[:, None, :] for k in of_shift]
    return np.concatenate(parts, axis=-1)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Normal equations of unknowns [p] in units of the matches, by sites: see :meth:`of`.

    ``normal`` [p, p], ``right`` [p], ``square``: as if sites shared nothing; ``site`` [m, p],
    ``site_right`` [m], ``total`` [m]: sums of each site, along and across apart.
    """

    normal: Floats
    right: Floats
    square: float
    site: Floats
    site_right: Floats
    total: Floats
    count: float

    @classmethod
    def of(cls, design: Floats, observed: Floats, weights: Floats, sites: NDArray) -> _Sums:
        """Of a design [n, 2, p], observations [n, 2] and robust weights [n], all in units of the
        matches' own standard deviations."""
        weighted = design * weights[:, None, None]
        order = np.argsort(sites, kind="stable")
        starts = np.flatnonzero(np.diff(sites[order], prepend=-1))

        def of_sites(values: Floats) -> Floats:
            total = np.add.reduceat(values[order], starts, axis=0)
            return total.reshape(2 * len(starts), *values.shape[2:])

        return cls(
            np.tensordot(weighted, design, ((0, 1), (0, 1))),
            np.tensordot(weighted, observed, ((0, 1), (0, 1))),
            float(np.sum(weights[:, None] * observed**2)),
            of_sites(weighted),
            of_sites(weights[:, None] * observed),
            of_sites(np.broadcast_to(weights[:, None], observed.shape)),
            2.0 * float(weights.sum()),
        )

    def reduced(self, affine: int, root: Floats) -> _Sums:
        """Of the ``affine`` first unknowns and of processes [n, r], in place of coefficients."""
        count, rank = root.shape
        change = np.zeros((affine + 4 * count, affine + 4 * rank))
        change[:affine, :affine] = np.eye(affine)
        for k in range(4):
            rows = slice(affine + k * count, affine + (k + 1) * count)
            change[rows, affine + k * rank : affine + (k + 1) * rank] = root
        return replace(
            self,
            normal=change.T @ self.normal @ change,
            right=change.T @ self.right,
            site=self.site @ change,
        )

    def sharing(self, of_site: float) -> tuple[Floats, Floats, float, float]:
        """Normal matrix, right side and sum of squares where a site shares an error, and the
        logarithm of the determinant that it adds; ``of_site`` in units of the noise."""
        if of_site == 0.0:
            return self.normal, self.right, self.square, 0.0
        share = 1.0 / (of_site**-2.0 + self.total)
        normal = self.normal - (self.site.T * share) @ self.site
        right = self.right - self.site.T @ (share * self.site_right)
        square = self.square - float(np.sum(share * self.site_right**2))
        return normal, right, square, float(np.log1p(of_site**2 * self.total).sum())


def sums_of(
    design: Floats, observed: Floats, weights: Floats, sites: NDArray, of_site: float
) -> tuple[Floats, Floats]:
    """Normal matrix [p, p] and right side [p] of :class:`_Sums`; ``of_site`` in units of the noise.

    Blunders have ``weights`` [n] of 0; ``sites`` [n] are numbers of any kind.
    """
    used = weights > 0.0
    index = np.unique(sites[used], return_inverse=True)[1]
    sums = _Sums.of(design[used], observed[used], weights[used], index)
    return sums.sharing(of_site)[:2]


@dataclass(frozen=True, eq=False)
class _Posterior:
    """Unknowns [p] and twice the log of their marginal likelihood; ``noise``: variance in units of
    the matches' own."""

    mean: Floats
    noise: float
    twice_log: float


def _posterior(sums: _Sums, of_site: float, variances: Floats) -> _Posterior:
    """By prior ``variances`` [p], in units of the noise's."""
    normal, right, square, determinant = sums.sharing(of_site)
    root = np.sqrt(variances)
    inner = np.eye(len(root)) + root[:, None] * normal * root
    factor = np.linalg.cholesky(inner)
    half = np.linalg.solve(factor, root * right)
    noise = max(square - float(half @ half), 1e-12) / sums.count
    determinant += 2.0 * float(np.log(np.diag(factor)).sum())
    mean = root * np.linalg.solve(factor.T, half)
    return _Posterior(mean, noise, -sums.count * float(np.log(noise)) - determinant)


def posterior_covariance(normal: Floats, variances: Floats) -> Floats:
    """[p, p] of unknowns by a normal matrix and prior ``variances`` [p], over the noise's."""
    root = np.sqrt(variances)
    inner = np.eye(len(root)) + root[:, None] * normal * root
    return root[:, None] * np.linalg.inv(inner) * root


def fit_lines(
    equations: Equations,
    affine_root: Floats,
    expected: Floats,
    weights: Floats,
    rows: tuple[int, int],
) -> LineFit:
    """Corrections by line of images of ``rows`` lines (left, right).

    ``affine_root`` [12, r]: of the covariance that bounds the affines; ``expected`` [n] px and
    ``weights`` [n]: standard deviations of the matches, and what is left of blunders.
    """
    used = weights > 0.0
    equations, expected, weights = equations.part(used), expected[used], weights[used]
    design = equations.design / expected[:, None, None]  # in deviations of the matches
    observed = equations.observed / expected[:, None]
    of_affine = design @ affine_root
    of_lines = line_design(design, equations.lines, rows)
    sites = np.unique(equations.site, return_inverse=True)[1]
    affine = affine_root.shape[1]
    free = np.full(affine, 1.0 / FREE)
    # a process of unit variance is worth as much as a match, in px
    unit = float(np.sqrt(np.average(expected**2, weights=weights)))
    every = _Sums.of(
        np.concatenate([of_affine, of_lines * unit], axis=-1), observed, weights, sites
    )
    length, steps, gain = _likeliest(every, free)
    root = process(length)
    parts = [part @ root * unit for part in np.split(of_lines, 4, axis=-1)]
    both = np.concatenate([of_affine, *parts], axis=-1)
    variances = _variances(free, steps, root.shape[1])
    sums = every.reduced(affine, root)
    found = _posterior(sums, amount(steps[2]), variances)
    halves = _Halves.of(
        both, observed, weights, sites, variances, amount(steps[2]), affine,
        np.sqrt(found.noise),
    )  # fmt: skip
    own = slice(affine, None)
    lines = found.mean[own].reshape(4, -1) * unit @ root.T
    # Of the lines where the affines are known, whose own uncertainty is that of the estimate: what
    # both share is known better than either.
    beside = posterior_covariance(sums.sharing(amount(steps[2]))[0][own, own], variances[own])
    known = variances[own] > 0.0
    freedom = known.sum() - np.sum(np.diag(beside)[known] / variances[own][known])
    noise = float(np.sqrt(found.noise))
    return LineFit(
        np.round(lines, 6).ravel(),  # so that the count of threads leaves no trace
        affine_root @ found.mean[:affine],
        float(freedom),
        rows,
        covariance_at_lines(
            beside * found.noise * unit**2 * halves.spread, root, equations.lines, rows
        ),
        np.array([amount(k) for k in steps[:2]]) * noise * unit,
        length,
        float(chdtrc(KINDS, max(gain, 0.0))),
        halves,
        noise,
        amount(steps[2]),
    )


def _likeliest(every: _Sums, free: Floats) -> tuple[float, Steps, float]:
    """Length and steps (of both standard deviations, of what sites share) of the greatest
    likelihood, and twice the logarithm of what it gains on no process."""
    affine = len(free)
    plain = every.reduced(affine, np.zeros((CELLS + 3, 0)))
    (of_site,), without = climb(lambda k: _posterior(plain, amount(k[0]), free).twice_log, (-2,))
    best = (without, LENGTHS[-1], (-WIDEST, -WIDEST, of_site))
    start = (2, 2, of_site)
    for length in LENGTHS:
        root = process(length)
        sums = every.reduced(affine, root)
        if _clearness(sums, amount(of_site), free) < LOOKED_AT:
            continue

        def score(steps: Steps, sums: _Sums = sums, rank: int = root.shape[1]) -> float:
            variances = _variances(free, steps, rank)
            return _posterior(sums, amount(steps[2]), variances).twice_log

        start, top = climb(score, start)
        if top > best[0] + 1e-9:
            best = top, length, start
    top, length, steps = best
    return length, steps, top - without


def _clearness(sums: _Sums, of_site: float, free: Floats) -> float:
    """By how many standard deviations the likelihood rises with a process of small variance.

    The score test of a variance; the greater of processes along and across the lines.
    """
    affine = len(free)
    normal, right, square, _ = sums.sharing(of_site)
    known = np.linalg.inv(normal[:affine, :affine] + np.diag(1.0 / free))
    taken = known @ normal[:affine, affine:]
    noise = (square - right[:affine] @ known @ right[:affine]) / sums.count
    gradient = right[affine:] - taken.T @ right[:affine]
    information = normal[affine:, affine:] - normal[affine:, :affine] @ taken
    found = -np.inf
    rank = len(gradient) // 4
    for kind in (0, 1):  # of both images
        own = np.concatenate([np.arange(rank) + rank * k for k in (kind, kind + 2)])
        part = information[np.ix_(own, own)]
        rise = gradient[own] @ gradient[own] / noise - np.trace(part)
        found = max(found, float(rise / np.sqrt(2.0 * np.sum(part**2))))
    return found


def _variances(free: Floats, steps: Steps, rank: int) -> Floats:
    """Prior variances of the affine's unknowns and those of the processes, in the noise's."""
    own = np.repeat([amount(k) ** 2 for k in steps[:2]], rank)
    return np.concatenate([free, own, own])


@dataclass(frozen=True)
class _Halves:
    """What one half of the sites says of the other: mean misfits (standard deviations, TUKEY at
    most) by its affine alone, ``before``, and by its lines too, ``after``; by how many standard
    errors the latter is less, ``clear``; ``spread``: variance of what the fit errs by, in that
    which it states, at least 1."""

    before: float
    after: float
    clear: float
    spread: float

    @classmethod
    def of(
        cls,
        design: Floats,
        observed: Floats,
        weights: Floats,
        sites: NDArray,
        variances: Floats,
        of_site: float,
        affine: int,
        noise: float,
    ) -> _Halves:
        """Of a design [n, 2, p], the first ``affine`` of whose unknowns are the affine's."""
        misfits = np.zeros((2, len(sites)))
        seen_squares = stated = 0.0
        for half in (0, 1):
            seen = sites % 2 != half
            for k, count in enumerate((affine, design.shape[-1])):
                part = design[:, :, :count]
                sums = _Sums.of(part[seen], observed[seen], weights[seen], sites[seen])
                found = _posterior(sums, of_site, variances[:count])
                left = (observed[~seen] - part[~seen] @ found.mean) / noise
                misfits[k, ~seen] = np.minimum(np.hypot(*left.T), TUKEY)
            covariance = posterior_covariance(sums.sharing(of_site)[0], variances)
            effect = np.einsum("nap,pq,naq->n", design[~seen], covariance, design[~seen])
            share = weights[~seen]
            seen_squares += float(np.sum(share * (np.sum(left**2, axis=1) - 2 - 2 * of_site**2)))
            stated += float(np.sum(share * effect))
        gain = np.bincount(sites, misfits[0] - misfits[1])
        error = np.sqrt(np.sum((gain - gain.mean()) ** 2) / max(len(gain) - 1, 1) * len(gain))
        before, after = misfits.mean(axis=1)
        return cls(
            float(before),
            float(after),
            float(gain.sum() / max(error, 1e-12)),
            max(seen_squares / max(stated, 1e-12), 1.0),
        )


def covariance_at_lines(
    covariance: Floats, root: Floats, lines: Floats, rows: tuple[int, int]
) -> Floats:
    """[CELLS + 1, 4, 4] px²: see :class:`LineFit`; ``covariance`` of the processes' unknowns."""
    left = np.linspace(0.0, rows[0] - 1.0, CELLS + 1)
    right = np.polyval(np.polyfit(lines[:, 0], lines[:, 1], 1), left)
    rank = root.shape[1]
    effects = np.zeros((left.size, 4, 4 * rank))
    for k, (at, count) in enumerate(zip((left, right), rows)):
        values = line_weights((0.0, count - 1.0), CELLS + 3, at) @ root
        for axis in (0, 1):
            part = 2 * k + axis
            effects[:, part, part * rank : (part + 1) * rank] = values
    return np.round(np.einsum("kip,pq,kjq->kij", effects, covariance, effects), 10)
