"""Robust least squares of small corrections in image space: affine, similarity or shift.

Blunders are found by least trimmed squares over all minimal samples (Rousseeuw & Van Driessen 2006,
"Computing LTS regression for large data sets"), then by studentised residuals; the result is the
exact least-squares solution (by ``cv2.solve``) on the other points. ``cv2.estimateAffine2D``, the
paper's way, draws random samples and refines its result only in part, so that it depends on the
order of the points.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]


MINIMAL = {"affine": 3, "similarity": 2, "shift": 1}  # points that determine the model
BLUNDER_FLOOR = 1.25  # px: 5 sigma of a careful measurement (0.25 px)
BLUNDER_SIGMAS = 4.5  # of a Rayleigh distributed length: a good point in 25 000 is beyond
RAYLEIGH_MEDIAN = 1.1774  # median length of a 2-D Gaussian vector of unit sigma
PRIOR_NOISE = 0.5  # px of a measurement, and
PRIOR_TILT = (1.0, 0.0005)  # px plus share of the extent that RPCs may be tilted: for ties only
MAX_SAMPLES = 2000  # minimal samples tried: all of them up to 23 GCPs


@dataclass(frozen=True, eq=False)
class System:
    """Linear system of a view: measured − predicted [n, 2] = design [n, 2, p] @ parameters [p].

    ``embed`` float64[6, p] takes the parameters to those of the affine in normalised coordinates.
    """

    design: Floats
    delta: Floats
    embed: Floats
    origin: Floats
    scale: float
    minimal: int

    @classmethod
    def of(cls, model: str, predicted: Floats, measured: Floats) -> System:
        """The system of a model for projected and measured (col, row) [n, 2] px."""
        # Normalised by the measurements: they lie inside the image, whatever is predicted.
        origin = np.median(measured, axis=0)
        scale = max(float(np.ptp(measured, axis=0).max()) / 2, 1.0)
        if model == "affine":
            embed = np.eye(6)
        elif model == "similarity":
            embed = np.zeros((6, 4))
            embed[[0, 4], 0] = 1.0  # change of scale
            embed[[1, 3], 1] = -1.0, 1.0  # rotation
            embed[2, 2] = embed[5, 3] = 1.0
        else:
            embed = np.zeros((6, 2))
            embed[2, 0] = embed[5, 1] = 1.0
        u = (predicted - origin) / scale
        basis = np.column_stack([u, np.ones(len(u))])
        full = np.zeros((len(u), 2, 6))
        full[:, 0, :3] = full[:, 1, 3:] = basis
        return cls(full @ embed, measured - predicted, embed, origin, scale, MINIMAL[model])

    def solve(self, used: Bools) -> Floats:
        """Exact least squares on the used points."""
        design = np.ascontiguousarray(self.design[used].reshape(-1, self.design.shape[2]))
        good, parameters = cv2.solve(
            design, self.delta[used].reshape(-1, 1).copy(), flags=cv2.DECOMP_SVD
        )
        assert good
        return parameters[:, 0]

    def residuals(self, parameters: Floats) -> Floats:
        """[n, 2] px, measured minus corrected."""
        return self.delta - self.design @ parameters

    def cofactors(self, used: Bools) -> Floats:
        """[p, p]: inverse of the normal matrix of the used points."""
        design = self.design[used].reshape(-1, self.design.shape[2])
        return np.linalg.pinv(design.T @ design)

    def leverages(self, used: Bools) -> Floats:
        """[n, 2, 2]: cofactors of the corrections at all points."""
        q = self.cofactors(used)
        return np.einsum("nap,pq,nbq->nab", self.design, q, self.design)

    def affine(self, parameters: Floats) -> Floats:
        """float64[2, 3] for (col, row, 1) of the RPC."""
        normalised = (self.embed @ parameters).reshape(2, 3)
        linear = normalised[:, :2] / self.scale
        shift = normalised[:, 2] - linear @ self.origin
        return np.column_stack([np.eye(2) + linear, shift])


def trimmed(system: System, seed: int) -> Bools:
    """The half of the points (and a little more) that agree best: least trimmed squares.

    Each minimal sample starts concentration steps: fit, keep the h points that fit best, repeat.
    Up to n − h blunders do no harm: 6 of 15 points for an affine, 1 of 5, none of 4. Among few
    points a sample with a blunder may fit as well as the good one, by a correction that no RPC
    needs: that is held against it (5 random points, one 20 px off, 0.25 px noise: the blunder alone
    is left out in 99 % of the cases, 96 % without).
    """
    n, k = len(system.delta), system.minimal
    h = (n + k + 1) // 2
    if math.comb(n, k) <= MAX_SAMPLES:
        samples = np.array(list(itertools.combinations(range(n), k)))
    else:
        rng = np.random.default_rng(seed)
        samples = np.array([rng.choice(n, k, replace=False) for _ in range(MAX_SAMPLES)])
    kept = np.zeros((len(samples), n))
    np.put_along_axis(kept, samples, 1.0, axis=1)
    normal = np.einsum("nap,naq->npq", system.design, system.design)
    right = np.einsum("nap,na->np", system.design, system.delta)
    p = normal.shape[1]
    for _ in range(20):
        matrix = (kept @ normal.reshape(n, -1)).reshape(-1, p, p)
        ridge = 1e-12 * np.trace(matrix, axis1=1, axis2=2)  # samples on one line or one spot
        matrix = matrix + ridge[:, None, None] * np.eye(p)
        parameters = np.linalg.solve(matrix, (kept @ right)[:, :, None])[:, :, 0]
        misfit = system.delta - np.einsum("nap,kp->kna", system.design, parameters)
        squares = np.sum(misfit**2, axis=2)
        best = np.argsort(squares, axis=1, kind="stable")[:, :h]
        again = np.zeros_like(kept)
        np.put_along_axis(again, best, 1.0, axis=1)
        if (again == kept).all():
            break
        kept = again
    tilt = (parameters @ system.embed.T)[:, [0, 1, 3, 4]]
    allowed = PRIOR_TILT[0] + PRIOR_TILT[1] * system.scale
    cost = np.take_along_axis(squares, best, axis=1).sum(axis=1) / PRIOR_NOISE**2
    cost += np.square(tilt / allowed).sum(axis=1)
    return kept[np.argmin(cost)] > 0


def studentised(system: System, used: Bools) -> Floats:
    """[n] lengths in px of the residuals, brought to the deviation of a measurement.

    A residual of a used point varies by 1 − leverage of the measurement's variance, that of
    another point by 1 + leverage. So a good point far from the others is not taken for a blunder.
    """
    lengths = np.hypot(*system.residuals(system.solve(used)).T)
    leverage = np.trace(system.leverages(used), axis1=1, axis2=2) / 2
    variance = np.where(used, 1 - leverage, 1 + leverage)
    return lengths / np.sqrt(np.maximum(variance, 1e-6))


def find_blunders(system: System, *, floor: float, seed: int) -> tuple[Bools, Floats, float]:
    """Which points are used, the studentised residuals [n] in px, and the threshold in px."""
    n = len(system.delta)
    if n <= system.minimal + 1:  # nothing to tell a blunder from the others
        used = np.ones(n, dtype=bool)
        return used, np.zeros(n), np.inf
    used = trimmed(system, seed)
    for _ in range(30):
        lengths = studentised(system, used)
        sigma = float(np.median(lengths)) / RAYLEIGH_MEDIAN
        # Wider for few points, whose deviation is not well known (as Student's t is).
        threshold = (1 + 1 / (n - system.minimal)) * max(floor, BLUNDER_SIGMAS * sigma)
        again = lengths <= threshold
        if again.sum() <= system.minimal or (again == used).all():
            break
        used = again
    return used, lengths, threshold


def leave_one_out_residuals(system: System, used: Bools) -> Floats:
    """[n, 2] residuals px of every point by the fit without it, in closed form.

    For a used point (I − H)⁻¹ r, H its 2 × 2 leverage; NaN where the others leave it undetermined.
    """
    residuals = system.residuals(system.solve(used))
    left = np.eye(2) - system.leverages(used)
    out = residuals.copy()
    for i in np.flatnonzero(used):
        determined = np.linalg.eigvalsh(left[i])[0] > 1e-9
        out[i] = np.linalg.solve(left[i], residuals[i]) if determined else np.nan
    return out
