"""Uniform cubic B-splines: weights of the four coefficients around a place, and their slopes."""

from __future__ import annotations

from ..kernels import inlined

Four = tuple[float, float, float, float]


@inlined
def cubic_weights(f: float) -> Four:
    """Weights of the four coefficients around a place ``f`` in [0, 1] of a cell; their sum is 1."""
    e = 1.0 - f
    return (
        e * e * e / 6.0,
        ((3.0 * f - 6.0) * f * f + 4.0) / 6.0,
        ((3.0 * e - 6.0) * e * e + 4.0) / 6.0,
        f * f * f / 6.0,
    )


@inlined
def cubic_slopes(f: float) -> Four:
    """Derivatives of :func:`cubic_weights` by ``f``; their sum is 0."""
    e = 1.0 - f
    return -0.5 * e * e, (1.5 * f - 2.0) * f, (2.0 - 1.5 * e) * e, 0.5 * f * f
