"""Estimates from correlated observations."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.align.adjustment import estimate
from stereotruth.align.records import Equations

# ------------------------------------------------------------------------------- the estimate


def system(rng: np.random.Generator, n: int = 600):
    """Design [n, 2, 12] of places on a plane, their sites and their positions [n, 2]."""
    u, v = rng.uniform(-1, 1, (2, n))
    basis = np.column_stack([u, v, np.ones(n)])
    design = np.zeros((n, 2, 12))
    design[:, 0, :3] = design[:, 1, 3:6] = -basis
    design[:, 0, 6:9] = design[:, 1, 9:] = basis
    sites = (np.floor(u * 4) * 100 + np.floor(v * 4)).astype(int)
    return design, sites, np.column_stack([u, v])


@pytest.mark.slow
@pytest.mark.parametrize("of_class", [0.0, 0.02])
def test_uncertainty_of_the_estimate_is_honest(of_class):
    """True parameters drawn from the prior, errors shared in sites, a fifth blunders.

    ``of_class``: standard deviation, px, of what matches of like quality have in common, which is
    of more weight than all that is independent.
    """
    rng = np.random.default_rng(3)
    ratios, chances, shared = [], [], []
    prior = np.eye(12) * 0.2**2
    for _ in range(60):
        design, sites, where = system(rng)
        truth = rng.normal(0, 0.2, 12)
        own = rng.uniform(0.02, 0.08, len(design))
        index = np.unique(sites, return_inverse=True)[1]
        errors = rng.normal(0, 1, (len(design), 2)) * own[:, None]
        errors += rng.normal(0, 0.4, (index.max() + 1, 2))[index] * own[:, None]
        fifth = np.searchsorted(np.quantile(own, [0.2, 0.4, 0.6, 0.8]), own)
        errors += rng.normal(0, of_class, (5, 2))[fifth]
        bad = rng.random(len(design)) < 0.2
        errors[bad] += rng.uniform(-3, 3, (bad.sum(), 2))
        found = estimate(
            Equations(design, design @ truth + errors, own, sites, where, where), prior
        )
        at = design[:5].reshape(-1, 12)
        sigma = np.sqrt(np.einsum("na,ab,nb->n", at, found.covariance, at))
        ratios.append(at @ (found.parameters - truth) / sigma)
        shared.append(found.shared)
        nothing = estimate(Equations(design, errors, own, sites, where, where), prior)
        chances.append(nothing.statistic / nothing.freedom)
    ratios = np.abs(ratios)
    assert 0.6 < (ratios < 1).mean() < 0.76
    assert 0.9 < (ratios < 2).mean() < 0.99
    assert np.median(chances) < 2.0
    # Of the weighted mean: the best fifth has about half of the weight.
    assert np.sqrt(np.mean(np.square(shared))) == pytest.approx(0.6 * of_class, abs=0.003)


def test_observations_of_which_no_two_agree_are_blunders():
    """As of an image that shows other ground, each in a site of its own."""
    rng = np.random.default_rng(8)
    design, _, where = system(rng, 24)
    observed = rng.uniform(-6, 6, (24, 2))
    alone = np.arange(24)
    found = estimate(
        Equations(design, observed, np.full(24, 0.01), alone, where, where), np.eye(12)
    )
    assert np.isfinite(found.covariance).all()
    assert (found.weights > 0.0).mean() < 0.5
