"""Estimates from correlated observations."""

from __future__ import annotations

import numpy as np

from stereotruth.alignment.adjustment import estimate

# ------------------------------------------------------------------------------- the estimate


def system(rng: np.random.Generator, n: int = 600):
    """Design [n, 2, 12] of places on a plane, and the sites that they belong to."""
    u, v = rng.uniform(-1, 1, (2, n))
    basis = np.column_stack([u, v, np.ones(n)])
    design = np.zeros((n, 2, 12))
    design[:, 0, :3] = design[:, 1, 3:6] = -basis
    design[:, 0, 6:9] = design[:, 1, 9:] = basis
    sites = (np.floor(u * 4) * 100 + np.floor(v * 4)).astype(int)
    return design, sites


def test_uncertainty_of_the_estimate_is_honest():
    """True parameters drawn from the prior, errors shared in sites, a fifth blunders."""
    rng = np.random.default_rng(3)
    ratios, chances = [], []
    prior = np.eye(12) * 0.2**2
    for _ in range(60):
        design, sites = system(rng)
        truth = rng.normal(0, 0.2, 12)
        own = rng.uniform(0.02, 0.08, len(design))
        index = np.unique(sites, return_inverse=True)[1]
        shared = rng.normal(0, 0.03, (index.max() + 1, 2))[index]
        errors = rng.normal(0, 1, (len(design), 2)) * own[:, None] + shared
        errors += rng.normal(0, 0.01, 2)
        bad = rng.random(len(design)) < 0.2
        errors[bad] += rng.uniform(-3, 3, (bad.sum(), 2))
        found = estimate(design, design @ truth + errors, own, sites, prior)
        at = design[rng.integers(0, len(design))]
        sigma = np.sqrt(np.diag(at @ found.covariance @ at.T))
        ratios += list(at @ (found.parameters - truth) / sigma)
        nothing = estimate(design, errors, own, sites, prior)
        chances.append(nothing.statistic / nothing.freedom)
    ratios = np.abs(ratios)
    assert 0.55 < (ratios < 1).mean() < 0.85
    assert (ratios < 2).mean() > 0.9
    assert np.median(chances) < 2.0
