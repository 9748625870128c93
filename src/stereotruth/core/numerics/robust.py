"""Robust scale, weights and least squares: what does not fit loses its weight."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner

Floats = NDArray[np.float64]


TO_SIGMA = 1.4826  # standard deviation over median absolute deviation, of a normal distribution
TUKEY = 4.685  # standard deviations at which the biweight is 0: 95 % efficient for normal errors
HUBER = 1.345  # standard deviations up to which Huber's weight is 1: the same efficiency


@inner
def robust_sigma(residuals: Floats, least: float) -> float:
    """Standard deviation about zero by the median absolute residual, ``least`` at least."""
    return max(TO_SIGMA * np.median(np.abs(residuals)), least)


def median_and_nmad(errors: Floats) -> tuple[float, float]:
    """Median and normalised median absolute deviation (1.4826 MAD) of errors."""
    median = float(np.median(errors))
    return median, TO_SIGMA * float(np.median(np.abs(errors - median)))


@inner
def biweight(t: float) -> float:
    """Tukey's weight of a residual, or of each of an array: (1 - t²)², 0 from |t| = 1 on."""
    return np.fmax(1.0 - t * t, 0.0) ** 2


def tukey_weights(residuals: Floats) -> Floats:
    """The biweight of residuals in standard deviations."""
    return biweight(residuals / TUKEY)


def huber_weights(residuals: Floats) -> Floats:
    """Huber's weights of residuals in standard deviations: 1, and HUBER / \\|r\\| beyond."""
    return HUBER / np.maximum(np.abs(residuals), HUBER)


def reweighted_fit(
    design: Floats,
    values: Floats,
    weights_of: Callable[[Floats], Floats],
    *,
    least_sigma: float,
    start: Floats | None = None,
    rounds: int = 50,
) -> Floats:
    """Coefficients [p] of ``values`` [n] on ``design`` [n, p] by reweighted least squares.

    ``weights_of`` the residuals in standard deviations: :func:`tukey_weights`, which needs a
    ``start`` near the result, or :func:`huber_weights`. The deviation is that of the residuals
    about zero, ``least_sigma`` at least. Ends when a step is below 1e-6 of the deviation.
    """
    found = np.zeros(design.shape[1]) if start is None else np.array(start, np.float64)
    for _ in range(rounds):
        residuals = values - design @ found
        sigma = robust_sigma(residuals, least_sigma)
        root = np.sqrt(weights_of(residuals / sigma))
        step = np.linalg.lstsq(design * root[:, None], residuals * root, rcond=None)[0]
        found += step
        if np.abs(step).max() < 1e-6 * sigma:
            break
    return found
