"""How probable is it that what a label shows has changed? For images that share no light.

Such images agree less than those of one light where nothing has changed: shadows have moved, and
what a window holds besides the unchanged surface disagrees. So a label is confirmed by the better
of two agreements (:class:`Evidence`):

- of the *detail* of both images over the surface around a pixel, at its disparity
  (:mod:`.shifted_agreement`), predicted shadows left apart. Many pixels make it sure, but some lie
  up to 12 px off;
- of the *brightness* over the pixels that are alike
  (:mod:`stereotruth.epipolar.alike_correlation`). These lie on one side of the edges of shadows and
  of new roofs, and no more than 8 px off.

A shifted disparity at which the detail agrees better contradicts it. The probability of a change is
logistic in both (eq. 18), then in its own value and the mean over the surface around (eq. 19 of
docs/explanation/surface.md): what has changed is larger than a pixel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.alike_correlation import alike_correlation
from ..epipolar.surface_correlation import wanted_runs
from .pair_window import PairWindow
from .pixel_labels import Labels
from .shifted_agreement import SHIFTS_PX, ShiftedAgreement, shifted_agreement
from .surface_means import left_and_warped, surface_mean

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]

SURROUNDINGS_PX = 8  # pixels up to here are averaged: the detail's agreement, and probabilities
ALIKE_PX = 4  # up to here lie the pixels that are alike, and the means of their agreement
LEAST_AGREEMENT, FULL_AGREEMENT = -0.5, 0.8  # beyond these an agreement counts as these
WEAK = 0.4  # share of signal, with less of which the absence of agreement tells little
SURE = 1e-4  # no probability counts as nearer to 0 or to 1
CHANGED = 0.15  # more probable, a label is left out


class Weights(NamedTuple):
    """Of two logistic regressions, and the probability ``unknown`` where nothing tells.

    The first is of a pixel by itself: a ``constant``, the weights of its ``agreement`` and of the
    ``advantage`` of another disparity. The second has a ``constant_around``, the weights of the
    pixel's ``own`` log odds by the first and of those of the mean ``around``.
    """

    constant: float
    agreement: float
    advantage: float
    constant_around: float
    own: float
    around: float
    unknown: float


# bench/change_probability.py, seeds 1 to 3: without and with predicted shadows
WEIGHTS = Weights(1.11, -6.44, 9.70, 0.79, 0.19, 1.16, 0.08)
WEIGHTS_LIT = Weights(2.30, -7.50, 10.89, 0.70, 0.28, 1.00, 0.09)


class Evidence(NamedTuple):
    """What both images tell of a window's labels; arrays [h, w], NaN where nothing tells.

    ``agreement``: Fisher's z of the better of both; ``advantage``: by how much the detail's at
    another disparity is greater than at the labels', as z, 0 at least. ``is_weak``: whether noise
    or lack of texture may be why nothing agrees.
    """

    agreement: Floats
    advantage: Floats
    is_weak: Bools


def change_evidence(
    labels: Labels,
    window: PairWindow,
    window_px: int,
    noise: tuple[float, float],
    labelled: Bools,
) -> Evidence:
    """Of the ``labelled`` pixels [h, w] of a window.

    ``window_px``: side of the windows in which details are correlated; ``noise``: variances of both
    images, DN².
    """

    def compared(wanted: Bools, shifts: tuple[float, ...]) -> ShiftedAgreement:
        return shifted_agreement(
            labels, window, noise, window_px, SURROUNDINGS_PX, wanted, shifts, by_light=True
        )

    detail = compared(labelled, ())
    # nothing has an advantage over full agreement
    shifted = compared(labelled & (detail.here < FULL_AGREEMENT), SHIFTS_PX)
    alike = _alike_agreement(labels, window, noise, labelled)
    agreement = _z(np.fmax(detail.here, alike))
    advantage = np.maximum(_z(shifted.elsewhere) - _z(detail.here), 0.0)
    is_weak = ~(detail.signal >= WEAK) & ~shifted.is_shifted
    return Evidence(agreement, np.nan_to_num(advantage), is_weak)


def _z(agreement: Singles) -> Floats:
    return np.arctanh(np.clip(agreement.astype(np.float64), LEAST_AGREEMENT, FULL_AGREEMENT))


def _alike_agreement(
    labels: Labels, window: PairWindow, noise: tuple[float, float], labelled: Bools
) -> Singles:
    """Mean over the surface up to ALIKE_PX around each pixel [h, w] of the correlation of both
    images over the pixels that are alike."""
    left, warped = left_and_warped(window, labels.disparity)
    surface, runs = (labels.disparity, labels.slope), wanted_runs(labelled)
    alike = alike_correlation(left, warped, *surface, ALIKE_PX, noise, runs)
    return surface_mean(alike, *surface, ALIKE_PX, 1, runs)


def by_itself(evidence: Evidence, weights: Weights) -> Floats:
    """Probability [h, w] that a pixel has changed, by its own evidence alone."""
    odds = weights.constant + weights.agreement * evidence.agreement
    probability = _logistic(odds + weights.advantage * evidence.advantage)
    return _bounded(probability, evidence, weights)


def log_odds(probability: NDArray[np.floating]) -> Floats:
    """Of probabilities, no nearer to 0 and 1 than SURE."""
    bounded = np.clip(probability.astype(np.float64), SURE, 1.0 - SURE)
    return np.log(bounded / (1.0 - bounded))


def around(probability: Floats, labels: Labels, labelled: Bools) -> Singles:
    """Mean probability of the ``labelled`` pixels [h, w] of the surface around each of them."""
    values = np.where(labelled, probability, np.nan)
    surface = labels.disparity, labels.slope
    return surface_mean(values, *surface, SURROUNDINGS_PX, 2, wanted_runs(labelled))


def probability_of_change(
    labels: Labels,
    window: PairWindow,
    window_px: int,
    noise: tuple[float, float],
    labelled: Bools,
) -> Floats:
    """That what ``labelled`` pixels [h, w] show has changed; anything at other pixels.

    Arguments: see :func:`change_evidence`.
    """
    weights = WEIGHTS if window.shaded is None else WEIGHTS_LIT
    evidence = change_evidence(labels, window, window_px, noise, labelled)
    return probability_with(weights, evidence, labels, labelled)


def probability_with(
    weights: Weights, evidence: Evidence, labels: Labels, labelled: Bools
) -> Floats:
    """:func:`probability_of_change` by its ``weights`` and the ``evidence`` of both images."""
    own = by_itself(evidence, weights)
    odds = weights.constant_around + weights.own * log_odds(own)
    odds += weights.around * log_odds(around(own, labels, labelled))
    return _bounded(_logistic(odds), evidence, weights)


def _bounded(probability: Floats, evidence: Evidence, weights: Weights) -> Floats:
    """The ``probability`` [h, w] with weak evidence no more than the unknown one, which it is
    without any."""
    limited = np.where(evidence.is_weak, np.minimum(probability, weights.unknown), probability)
    return np.where(np.isnan(evidence.agreement), weights.unknown, limited)


def _logistic(odds: Floats) -> Floats:
    return 1.0 / (1.0 + np.exp(-odds))
