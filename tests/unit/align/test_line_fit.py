"""Corrections by line and errors that near sites share, on made equations whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.align.adjustment import estimate
from stereotruth.align.line_fit import LineFit, estimate_with_lines, line_design
from stereotruth.align.records import Equations
from stereotruth.align.shared_errors import with_shared_errors

SIDE = 1100
ROWS = (SIDE, SIDE)
PRIOR = np.diag([1.0, 1.0, 10.0] * 4) ** 2
NOISE = 0.03


def made(seed: int, jitter_px: float = 0.0, strips_px: float = 0.0) -> tuple[Equations, np.ndarray]:
    """Equations, and jitter [n, 2] along and across; strips across the image step by ``strips_px``.

    Tie points see the difference of both images, and a twentieth of what they share (slopes).
    """
    rng = np.random.default_rng(seed)
    corner = np.stack(np.meshgrid(*[np.arange(0, SIDE - 100, 155.0)] * 2), axis=-1).reshape(-1, 2)
    site = np.repeat(np.arange(len(corner)), 9)
    at = corner[site] + rng.uniform(0, 150, (site.size, 2))
    there = at * [1.0, 0.9] + [0.0, 60.0] + rng.normal(0, 3.0, at.shape)
    slopes = np.eye(2) * (1.0 + rng.normal(0, 0.05, (site.size, 1, 1)))
    design = np.zeros((site.size, 2, 12))
    for own, place, slope in ((0, at, -slopes), (6, there, np.eye(2)[None])):
        basis = np.column_stack([(place - SIDE / 2) / (SIDE / 2), np.ones(len(place))])
        for axis in (0, 1):
            part = slice(own + 3 * axis, own + 3 * axis + 3)
            design[:, :, part] = slope[:, :, axis, None] * basis[:, None]
    swing = np.zeros((site.size, 2))
    for own, place in ((0, at), (6, there)):
        for axis in (0, 1):
            line = sum(
                np.sin(2 * np.pi * (periods * place[:, 1] / SIDE + rng.random()))
                for periods in (1.3, 2.1, 3.0)
            )
            shift = jitter_px * np.sqrt(2 / 3) * line
            swing += design[:, :, own + 2 + 3 * axis] * shift[:, None]
    strip = ((at @ [0.8, 0.6]) // 400).astype(int)
    observed = design @ rng.normal(0, 0.3, 12) + swing + rng.normal(0, NOISE, swing.shape)
    observed[:, 0] += strips_px * np.array([1.0, -1.2, 0.8, -0.9])[strip]
    own = np.full(site.size, NOISE)
    return Equations(design, observed, own, site, at, there), swing


def left_of(equations: Equations, swing: np.ndarray, lines: LineFit) -> np.ndarray:
    """[n, 2] px that affines and lines leave of the jitter alone: a linear trend is no jitter."""
    rest = swing - line_design(equations.design, equations.lines, ROWS) @ lines.coefficients
    basis = equations.design.reshape(-1, 12)
    return rest - (basis @ np.linalg.lstsq(basis, rest.ravel(), rcond=None)[0]).reshape(-1, 2)


@pytest.mark.slow
def test_jitter_is_found_and_its_uncertainty_holds():
    ratios = []
    for seed in range(3):
        equations, swing = made(seed, jitter_px=0.18)
        found, lines = estimate_with_lines(equations, PRIOR, 0.0, ROWS)
        assert lines.stands_out
        assert np.mean(found.weights > 0) > 0.95
        rest = left_of(equations, swing, lines)
        assert np.sqrt(np.mean(swing**2)) > 0.15
        assert np.sqrt(np.mean(rest**2)) < 0.025
        nodes = lines.covariance
        at = np.rint(equations.at[:, 1] / (SIDE - 1) * (len(nodes) - 1)).astype(int)
        shifts = equations.design[:, :, [2, 5, 8, 11]]
        ratios.append(rest / np.sqrt(np.einsum("nap,npq,naq->na", shifts, nodes[at], shifts)))
    ratios = np.abs(ratios)
    assert 0.5 < np.mean(ratios < 1.0) < 0.9
    assert np.mean(ratios < 2.0) > 0.88


def test_nothing_is_corrected_where_no_line_is_off():
    for seed in range(2):
        equations = made(seed)[0]
        found, lines = estimate_with_lines(equations, PRIOR, 0.0, ROWS)
        assert not lines.stands_out
        assert lines.corrections == (None, None)
        assert not any(with_shared_errors(found, equations)[1].sigma_px)
        alone = estimate(equations, PRIOR)
        assert np.array_equal(found.parameters, alone.parameters)


def test_jitter_larger_than_all_else_leaves_no_half_out():
    """The plane that most tie points agree on holds a half of them: all are looked at, too."""
    equations, swing = made(3, jitter_px=0.5)
    found, lines = estimate_with_lines(equations, PRIOR, 0.0, ROWS)
    assert np.mean(found.weights > 0) > 0.95
    assert np.sqrt(np.mean(left_of(equations, swing, lines) ** 2)) < 0.04


@pytest.mark.slow
def test_blunders_have_no_say():
    equations, swing = made(5, jitter_px=0.18)
    rng = np.random.default_rng(0)
    bad = rng.random(len(equations.own)) < 0.15
    observed = equations.observed + bad[:, None] * rng.uniform(0.5, 3.0, swing.shape)
    _, lines = estimate_with_lines(replace(equations, observed=observed), PRIOR, 0.0, ROWS)
    assert np.sqrt(np.mean(left_of(equations, swing, lines) ** 2)) < 0.04


def test_strips_are_part_of_what_labels_state():
    """What is left of steps between strips is within the standard deviation that is told."""
    for seed in range(3):
        equations = made(seed, strips_px=0.06)[0]
        found, lines = estimate_with_lines(equations, PRIOR, 0.0, ROWS)
        effect = line_design(equations.design, equations.lines, ROWS) @ lines.coefficients
        without = replace(equations, observed=equations.observed - effect)
        counted, shared = with_shared_errors(found, without)
        # Made disparities are off by the steps, less what corrections take of them.
        rest = without.observed[:, 0] - without.design[:, 0] @ counted.parameters
        sites = [rest[equations.site == k].mean() for k in np.unique(equations.site)]
        sigma = np.sqrt(
            np.einsum(
                "np,pq,nq->n", equations.design[:, 0], counted.covariance, equations.design[:, 0]
            ).mean()
            + shared.label_px**2
        )
        assert shared.sigma_px[0] > 0.02
        assert shared.sigma_px[1] == 0.0
        assert 0.4 < np.std(sites) / sigma < 1.2
        assert not shared.smooth


def test_a_bend_of_the_rpc_is_told_from_steps():
    equations, _ = made(2)
    u, v = ((equations.at - SIDE / 2) / (SIDE / 2)).T
    bent = equations.observed + 0.1 * np.column_stack([u * u - u * v, np.zeros_like(v)])
    equations = replace(equations, observed=bent)
    _, shared = with_shared_errors(estimate(equations, PRIOR), equations)
    assert shared.smooth
    assert shared.label_px > 0.02
