"""One correction per image: the images of a site that share ground, adjusted together.

Observations are the RPCs, control points as measured in each image, the normal equations of each
pair's tie points by its own robust estimate, and edges of roofs. Control points that fit no
correction, and pairs that contradict the others, lose their weight (Tukey's biweight). The result
does not depend on the order of images or pairs. The images of pairs whose lines are off
(:mod:`.line_fit`) get one correction by line each, with the medians of those pairs' processes: an
image that jitters shows it in all of its pairs, its partners in one. See
docs/explanation/refinement.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.statistics import huber_weights, robust_sigma, tukey_weights
from ..sensor.rpc import LineCorrection
from .adjustment import FREE, MATCHING, Estimate, Sums, estimate
from .align import CAREFUL_SIGMA
from .alignment import ViewFit, rpc_prior
from .gcp_checks import BLUNDER_FLOOR
from .line_fit import (
    LineFit,
    covariance_at_lines,
    estimate_with_lines,
    line_design,
    posterior_covariance,
    process,
    sums_of,
)
from .records import Equations, PairEquations, PlanObservation, SiteLines
from .shared_errors import PlanFrame, shared_spread, with_offsets, with_shared_errors

STEPS = 60  # of the reweighting, at most
SETTLED_PX = 1e-6  # change of a step after which no other follows
FIRST_STEPS = 12  # with weights that leave nothing out: the start is not robust
SEEN = 1e-6  # share of the largest eigenvalue from which on a pair tells a direction
LEAST_POINTS = 2  # control points that determine an image's place without tie points, and check it
OTHERS = 3  # observations of a kind from which on their scatter tells a blunder


@dataclass(frozen=True, eq=False)
class PairOfLines:
    """A pair's equations, its own estimate and lines; ``images`` by number, left and right."""

    scene: str
    images: tuple[int, int]
    equations: Equations
    estimate: Estimate
    lines: LineFit


def fit_site_lines(
    pairs: Sequence[PairOfLines], rows: Sequence[int], known: Mapping[int, LineCorrection | None]
) -> SiteLines:
    """Of images of ``rows`` lines; ``known`` ones stay as they are."""
    jittering = [pair for pair in pairs if pair.lines.stands_out]
    found = {image: lines for image, lines in known.items() if lines is not None}
    images = sorted({k for pair in jittering for k in pair.images} - set(known))
    if not images:
        return SiteLines(found, {})
    root = process(float(np.median([pair.lines.length for pair in jittering])))
    rank = root.shape[1]
    deviations = np.median([pair.lines.rms_px for pair in jittering], axis=0)
    start = {image: 2 * rank * k for k, image in enumerate(images)}
    count = 2 * rank * len(images)  # then six of each image's affine
    size = count + 6 * len(rows)
    normal, right = np.zeros((size, size)), np.zeros(size)
    of_known = SiteLines(found, {})
    for pair in pairs:
        columns, design, observed = _of_pair(pair, rows, root, start, count, of_known)
        part, side = sums_of(
            design, observed, pair.estimate.weights, pair.equations.site, pair.lines.of_site
        )
        normal[np.ix_(columns, columns)] += part
        right[columns] += side
    variances = np.tile(np.repeat(deviations**2, rank), len(images))
    prior = np.concatenate([1.0 / variances, np.full(size - count, FREE)])
    mean = np.linalg.solve(normal + np.diag(prior), right)[:count]
    covariance = posterior_covariance(normal[:count, :count], variances)
    for image, at in start.items():
        values = mean[at : at + 2 * rank].reshape(2, rank) @ root.T
        found[image] = LineCorrection((0.0, rows[image] - 1.0), np.round(values, 6))
    padded = np.pad(covariance, (0, 1))  # nothing is unknown of an image without a start

    def own_unknowns(pair: PairOfLines) -> Ints:
        of_images = [start[k] + np.arange(2 * rank) if k in start else np.full(2 * rank, -1)
                     for k in pair.images]  # fmt: skip
        return np.concatenate(of_images)

    return SiteLines(
        found,
        {
            pair.scene: covariance_at_lines(
                padded[np.ix_(*[own_unknowns(pair)] * 2)],
                root,
                pair.equations.lines,
                (rows[pair.images[0]], rows[pair.images[1]]),
            )
            for pair in pairs
            if set(pair.images) & set(start)
        },
    )


def _of_pair(
    pair: PairOfLines,
    rows: Sequence[int],
    root: Floats,
    start: Mapping[int, int],
    count: int,
    known: SiteLines,
) -> tuple[Ints, Floats, Floats]:
    """Which unknowns a pair tells of, its design [n, 2, p] of them and observations [n, 2], in
    standard deviations of its matches."""
    equations = pair.equations
    own = equations.design
    of_pair = rows[pair.images[0]], rows[pair.images[1]]
    parts = np.split(line_design(own, equations.lines, of_pair), 4, axis=-1)
    columns, design = [], []
    for k, image in enumerate(pair.images):
        if image in start:
            columns.append(start[image] + np.arange(2 * root.shape[1]))
            design += [part @ root for part in parts[2 * k : 2 * k + 2]]
        columns.append(count + 6 * image + np.arange(6))
        design.append(own[:, :, 6 * k : 6 * k + 6])
    scale = 1.0 / (pair.lines.noise * np.hypot(equations.own, MATCHING))
    observed = equations.observed - known.effect(own, equations.lines, pair.images)
    return (
        np.concatenate(columns),
        np.concatenate(design, axis=-1) * scale[:, None, None],
        observed * scale[:, None],
    )


@dataclass(frozen=True, eq=False)
class PointsOfImage:
    """n control points of an image: ``lon``, ``lat`` degrees, ``height`` m; (col, row) [n, 2] px.

    ``predicted`` by the RPC alone.
    """

    ids: tuple[str, ...]
    lon: Floats
    lat: Floats
    height: Floats
    measured: Floats
    predicted: Floats


@dataclass(frozen=True, eq=False)
class ImageToFit:
    """An image: its fit by the RPC alone in coordinates of the image, its control points, and
    ``px_per_m`` [2, 2] as of :func:`.shared_errors.plan_slopes` in its middle."""

    name: str
    start: ViewFit
    points: PointsOfImage
    px_per_m: Floats


@dataclass(frozen=True, eq=False)
class PairToFit:
    """A pair of images by name; ``ties`` None: it has none, for a ``reason``."""

    scene: str
    left: str
    right: str
    ties: PairEquations | None
    reason: str = ""


@dataclass(frozen=True, eq=False)
class FixedImages:
    """Corrections that stay: parameters [6] by name, their covariance [6 n, 6 n] in px², and by
    line, of those images that have one."""

    parameters: Mapping[str, Floats]
    covariance: Floats
    by_line: Mapping[str, LineCorrection] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PairFit:
    """What all images together make of a pair.

    ``residuals`` [n, 2] px along and across the rows; ``used`` bool[n]: not a blunder; ``misfit``:
    the pair against all, in standard deviations; ``weight`` in [0, 1]. ``lines_covariance`` and
    ``shared_px``: see :data:`.alignment.OF_MISFITS`.
    """

    residuals: Floats
    used: Bools
    misfit: float
    weight: float
    lines_covariance: Floats | None
    shared_px: float


@dataclass(frozen=True, eq=False)
class SiteFit:
    """Corrections of all images. ``names`` in ascending order.

    ``parameters`` by name [6], of the affine against none in the image's own coordinates
    (:func:`.alignment.over_the_image`); ``covariance`` [6 n, 6 n] px² in the order of ``names``.
    ``residuals``, ``leave_one_out`` by name [n, 2] px and ``used`` bool[n] of the control points,
    ``point_sigma`` px of one. ``pairs`` by scene, of those that have tie points. ``scatter``: of
    the pairs against each other, in the standard deviations that each states, at least 1.
    ``by_line``: corrections by line, of the images that have one.
    """

    names: tuple[str, ...]
    parameters: Mapping[str, Floats]
    covariance: Floats
    residuals: Mapping[str, Floats]
    leave_one_out: Mapping[str, Floats]
    used: Mapping[str, Bools]
    point_sigma: float
    pairs: Mapping[str, PairFit]
    scatter: float
    by_line: Mapping[str, LineCorrection]

    def covariance_of(self, *names: str) -> Floats:
        """[6 k, 6 k] px² of the parameters of some images."""
        index = np.concatenate([_six(self.names.index(name)) for name in names])
        return self.covariance[np.ix_(index, index)]


def _six(k: int) -> Ints:
    return np.arange(6 * k, 6 * k + 6)


@dataclass(frozen=True, eq=False)
class _Points:
    """Control points of all images as a system: ``index`` [n, 6] of parameters."""

    design: Floats
    delta: Floats
    index: Ints

    @classmethod
    def of(cls, images: Sequence[ImageToFit], lines: SiteLines) -> _Points:
        design, delta, index = [np.zeros((0, 2, 6))], [np.zeros((0, 2))], [np.zeros((0, 6), int)]
        for k, image in enumerate(images):
            points = image.points
            if len(points.ids):
                measured = points.measured
                if k in lines.corrections:
                    measured = np.stack(lines.corrections[k].take(*measured.T), axis=1)
                design.append(image.start.design(*points.predicted.T))
                delta.append(measured - points.predicted)
                index.append(np.tile(_six(k), (len(points.ids), 1)))
        return cls(np.concatenate(design), np.concatenate(delta), np.concatenate(index))

    def residuals(self, x: Floats) -> Floats:
        """[n, 2] px, measured minus corrected."""
        return self.delta - np.einsum("nap,np->na", self.design, x[self.index])

    def add_to(self, normal: Floats, right: Floats, information: Floats) -> None:
        """Add the normal equations by ``information`` [n] px⁻² of each point."""
        for design, delta, index, weight in zip(self.design, self.delta, self.index, information):
            normal[np.ix_(index, index)] += weight * design.T @ design
            right[index] += weight * design.T @ delta


@dataclass(frozen=True, eq=False)
class _Pair:
    """A pair's normal equations; ``index`` [12] of its parameters among all."""

    scene: str
    index: Ints
    equations: Equations
    estimate: Estimate
    sums: Sums
    spread: Floats
    lines_covariance: Floats | None
    shared_px: float

    @classmethod
    def of(cls, pair: PairToFit, own: PairOfLines, lines: SiteLines) -> _Pair:
        """Without what corrections by line change, and with what near sites share."""
        equations, ties = own.equations, pair.ties
        found = own.estimate
        if lines.corrections:
            effect = lines.effect(equations.design, equations.lines, own.images)
            equations = replace(equations, observed=equations.observed - effect)
            prior = found.root @ found.root.T
            found = estimate(equations.about(ties.linearised_at), prior, ties.common_px)
        about = equations.about(ties.linearised_at)
        shared = with_shared_errors(found, about, by_line=bool(lines.corrections))[1]
        sums = Sums.of(equations.design, equations.observed, found.information)
        spread = sums.spread(found.shared) + shared_spread(found, equations, shared)
        index = np.concatenate([_six(k) for k in own.images])
        covariance = lines.covariance.get(pair.scene)
        return cls(
            pair.scene, index, equations, found, sums, spread, covariance, shared.label_px
        )  # fmt: skip

    def misfit(self, x: Floats) -> float:
        """By how many of their standard deviations the observations are off, rms."""
        gradient = self.sums.right - self.sums.normal @ x[self.index]
        values, vectors = np.linalg.eigh(self.spread)
        seen = values > SEEN * values.max()
        amounts = (vectors[:, seen].T @ gradient) ** 2 / values[seen]
        return float(np.sqrt(amounts.mean()))


def _by_themselves(
    pairs: Sequence[PairToFit], images: Mapping[str, ImageToFit]
) -> list[PairOfLines]:
    """What the tie points of each pair say, RPCs being all that is known besides."""
    names = list(images)
    found = []
    for pair in pairs:
        left, right = (images[name].start for name in (pair.left, pair.right))
        prior = block_diag(rpc_prior(left), rpc_prior(right))
        # Blunders are looked for where the tie points were matched.
        about = pair.ties.equations.about(pair.ties.linearised_at)
        rows = left.size[1], right.size[1]
        told = estimate_with_lines(about, prior, pair.ties.common_px, rows)
        numbers = names.index(pair.left), names.index(pair.right)
        found.append(PairOfLines(pair.scene, numbers, pair.ties.equations, *told))
    return found


def _point_sigma(lengths: Floats, used: Bools, unknowns: float) -> float:
    """Standard deviation px of a coordinate; beside few points stands a careful measurement's."""
    careful, weight = CAREFUL_SIGMA
    redundancy = max(2.0 * used.sum() - unknowns, 0.0)
    if not used.any():
        return careful
    sigma = robust_sigma(lengths[used], 1e-3) / 1.7456  # NMAD about 0 of a Rayleigh length
    return float(np.sqrt((redundancy * sigma**2 + weight * careful**2) / (redundancy + weight)))


def fit_site(
    images: Sequence[ImageToFit], pairs: Sequence[PairToFit], fixed: FixedImages | None = None
) -> SiteFit:
    """Adjust the corrections of all images together; those ``fixed`` keep theirs."""
    by_name = {image.name: image for image in sorted(images, key=lambda image: image.name)}
    names = list(by_name)
    tied = [pair for pair in sorted(pairs, key=lambda pair: pair.scene) if pair.ties]
    by_itself = _by_themselves(tied, by_name)
    held = () if fixed is None else fixed.parameters
    lines = fit_site_lines(
        by_itself,
        [image.start.size[1] for image in by_name.values()],
        {k: fixed.by_line.get(name) for k, name in enumerate(names) if name in held},
    )
    points = _Points.of(list(by_name.values()), lines)
    known = [_Pair.of(*both, lines) for both in zip(tied, by_itself)]
    count = 6 * len(names)
    prior = block_diag(*(np.linalg.inv(rpc_prior(image.start)) for image in by_name.values()))
    free, x, of_fixed = _unknowns(names, fixed)
    point_weights, pair_weights = np.ones(len(points.delta)), np.ones(len(known))
    sigma, scatter = CAREFUL_SIGMA[0], 1.0
    for step in range(STEPS):
        normal, right = prior.copy(), np.zeros(count)
        points.add_to(normal, right, point_weights / sigma**2)
        for pair, weight in zip(known, pair_weights / scatter**2):
            normal[np.ix_(pair.index, pair.index)] += weight * pair.sums.normal
            right[pair.index] += weight * pair.sums.right
        last = x.copy()
        bound = right[free] - normal[np.ix_(free, ~free)] @ x[~free]
        x[free] = np.linalg.solve(normal[np.ix_(free, free)], bound)
        lengths = np.hypot(*points.residuals(x).T)
        misfits = np.array([pair.misfit(x) for pair in known])
        first = step < FIRST_STEPS
        used = point_weights > 0.0
        sigma = _point_sigma(lengths, used, min(6.0 * len(names), used.sum()))
        size = lengths / max(sigma, BLUNDER_FLOOR / 5.0)
        point_weights = huber_weights(size) if first else tukey_weights(size)
        if len(known) >= OTHERS:
            scatter = max(float(np.median(misfits)), 1.0)
            size = misfits / scatter
            pair_weights = huber_weights(size) if first else tukey_weights(size)
        if step > FIRST_STEPS and np.abs(x - last).max() < SETTLED_PX:
            break
    x[free] = np.round(x[free], 8)  # so that the count of threads leaves no trace
    covariance, of_ties, formal = _covariances(
        normal, prior, points, point_weights / sigma**2, known, pair_weights / scatter**2,
        scatter, free, of_fixed,
    )  # fmt: skip
    if fixed is None:  # else the place of all is that of the fixed images
        frame = PlanFrame.of(*zip(*((im.start, im.px_per_m) for im in by_name.values())))
        seen = _plan_observations(pairs, names)
        x, covariance = with_offsets(x, frame.widened(covariance, of_ties), seen)
        x = np.round(x, 8)
    residuals = points.residuals(x)
    one_out = _leave_one_out(points, residuals, point_weights / sigma**2, formal)
    own = points.index[:, 0] // 6
    return SiteFit(
        names=tuple(names),
        parameters={name: x[_six(k)] for k, name in enumerate(names)},
        covariance=np.round(covariance, 12),
        residuals={name: residuals[own == k] for k, name in enumerate(names)},
        leave_one_out={name: one_out[own == k] for k, name in enumerate(names)},
        used={name: point_weights[own == k] > 0.0 for k, name in enumerate(names)},
        point_sigma=float(sigma),
        pairs={
            pair.scene: PairFit(
                pair.equations.observed - pair.equations.design @ x[pair.index],
                pair.estimate.weights > 0.0,
                float(misfit),
                float(weight),
                pair.lines_covariance,
                pair.shared_px,
            )
            for pair, misfit, weight in zip(known, misfits, pair_weights)
        },
        scatter=scatter,
        by_line={names[k]: one for k, one in lines.corrections.items()},
    )


def _plan_observations(
    pairs: Sequence[PairToFit], names: Sequence[str]
) -> list[tuple[int, PlanObservation]]:
    """What edges of roofs tell of each image (index, observation), by the surest of its pairs."""
    best: dict[str, tuple[float, str, PlanObservation]] = {}
    for pair in pairs:
        for name, seen in zip((pair.left, pair.right), pair.ties.in_plan if pair.ties else ()):
            rank = float(np.trace(seen.covariance)), pair.scene, seen
            if name not in best or rank[:2] < best[name][:2]:
                best[name] = rank
    return [(names.index(name), best[name][2]) for name in sorted(best)]


def _unknowns(names: Sequence[str], fixed: FixedImages | None) -> tuple[Bools, Floats, Floats]:
    """Which parameters are unknown, a start of all, and the covariance of those that are not."""
    free, x = np.ones(6 * len(names), bool), np.zeros(6 * len(names))
    if fixed is None:
        return free, x, np.zeros((0, 0))
    order = list(fixed.parameters)
    index = [np.zeros(0, int)]
    for k, name in enumerate(names):
        if name in fixed.parameters:
            free[_six(k)], x[_six(k)] = False, fixed.parameters[name]
            index.append(_six(order.index(name)))
    return free, x, fixed.covariance[np.ix_(*[np.concatenate(index)] * 2)]


def _covariances(
    normal: Floats,
    prior: Floats,
    points: _Points,
    point_information: Floats,
    pairs: Sequence[_Pair],
    pair_weights: Floats,
    scatter: float,
    free: Bools,
    of_fixed: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Covariance of all parameters under the errors that show, its part by the tie points, and the
    inverse normal matrix.

    The fixed images' errors carry over to the others.
    """
    spread = prior.copy()  # of the right side
    points.add_to(spread, np.zeros(len(spread)), point_information)
    ties = np.zeros_like(spread)
    for pair, weight in zip(pairs, pair_weights):
        ties[np.ix_(pair.index, pair.index)] += (weight * scatter) ** 2 * pair.spread
    spread += ties
    both = np.ix_(free, free)
    inverse = np.zeros_like(normal)
    inverse[both] = np.linalg.inv(normal[both])
    covariance = inverse @ spread @ inverse
    carried = -inverse[both] @ normal[np.ix_(free, ~free)]
    covariance[both] += carried @ of_fixed @ carried.T
    covariance[np.ix_(free, ~free)] = carried @ of_fixed
    covariance[np.ix_(~free, free)] = (carried @ of_fixed).T
    covariance[np.ix_(~free, ~free)] = of_fixed
    return (covariance + covariance.T) / 2.0, inverse @ ties @ inverse, inverse


def _leave_one_out(
    points: _Points, residuals: Floats, information: Floats, inverse: Floats
) -> Floats:
    """[n, 2] px: residuals of each control point by the adjustment without it, in closed form."""
    out = residuals.copy()
    for k in np.flatnonzero(information > 0.0):
        design, index = points.design[k], points.index[k]
        leverage = information[k] * design @ inverse[np.ix_(index, index)] @ design.T
        out[k] = np.linalg.solve(np.eye(2) - leverage, residuals[k])
    return out
