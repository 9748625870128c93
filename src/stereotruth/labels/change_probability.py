"""How probable is it that what a label shows has changed, or is hidden by what has?

Where the images agree closely, hardly anything has changed. Elsewhere several things together tell
(:class:`.change_evidence.Evidence`). What they tell is learned from simulated cities of which all
changes are known: decision trees, whose values sum up to the log odds of a change (eq. 17 of
docs/explanation/surface.md, bench/change_probability.py). What has changed is larger than a pixel,
so that other trees ask the probabilities of the surface around, too, and of that part of it which
looks like the pixel in both images (eq. 18). Images that share no light have trees of their own:
these agree less where nothing has changed, since shadows have moved.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.arrays import Bools, Floats, Singles
from ..epipolar.surface_windows import alike_mean, surface_mean
from ..epipolar.window_sums import SURFACE_PX, wanted_runs
from .change_evidence import LabelledWindow, beyond_learned, change_evidence
from .decision_trees import DecisionTrees

MEANS_PX = 12  # pixels up to here have a say in the probability of one
AROUND = (2, 1), (4, 1), (8, 2), (MEANS_PX, 3)  # px up to which, one of so many, it is averaged;
ALIKE_AROUND = (4, 1), (8, 2), (MEANS_PX, 3)  # and over pixels that are alike
SURE = 1e-4  # no mean of probabilities counts as less, nor as nearer to 1
UNCHANGED = 0.0005  # probability where the images agree closely
# More probable, a label is left out; one of a crown, and one beside a young crown, sooner: trees
# change more than all else.
CHANGED, CROWN_CHANGED, YOUNG_CHANGED = 0.4, 0.2, 0.05
TREES = Path(__file__).with_suffix(".tsv")


def with_surroundings(own: Floats, doubtful: Bools, compared: LabelledWindow) -> list[Singles]:
    """Log odds [n] of the ``doubtful`` pixels' ``own`` probability [h, w], and of its means over
    the labelled surface around them, see AROUND, and over its pixels that are alike, see
    ALIKE_AROUND."""
    runs, known = wanted_runs(doubtful), np.where(compared.labelled, own, np.nan)
    means = [
        surface_mean(known, *compared.surface, *around, runs, compared.first_row)
        for around in AROUND
    ]
    means += [
        alike_mean(known, compared.brightness, *compared.surface, *around, compared.noise, runs)
        for around in ALIKE_AROUND
    ]
    return [_log_odds(values[doubtful]) for values in (own, *means)]


def _log_odds(probability: NDArray[np.floating]) -> Singles:
    bounded = np.clip(probability.astype(np.float64), SURE, 1.0 - SURE)
    return np.log(bounded / (1.0 - bounded)).astype(np.float32)


@cache
def trees(diachronic: bool) -> list[DecisionTrees]:
    """Those of the log odds by a pixel's own evidence, and those that ask its surroundings, too.

    ``diachronic``: whether the images share no light. The table has both of either by turns.
    """
    return DecisionTrees.load(TREES)[diachronic::2]


class ChangeProbability(NamedTuple):
    """What the images of a window tell of its pixels [h, w]: the ``probability`` that what a
    labelled one shows has changed, and which figures of the evidence lie ``beyond`` what was
    learned, see :func:`.change_evidence.beyond_learned`, 0 where the images agree closely."""

    probability: Floats
    beyond: NDArray[np.uint32]


def change_probability(compared: LabelledWindow, diachronic: bool) -> ChangeProbability:
    """Of a window; ``diachronic``: whether the images share no light."""
    doubtful, evidence = change_evidence(compared)
    return probability_by_evidence(compared, doubtful, np.stack(evidence), diachronic)


def probability_by_evidence(
    compared: LabelledWindow, doubtful: Bools, evidence: Singles, diachronic: bool
) -> ChangeProbability:
    """The same, by the ``evidence`` [k, n] of the ``doubtful`` pixels [h, w]."""
    by_own, with_others = trees(diachronic)
    out = ChangeProbability(np.full(doubtful.shape, UNCHANGED), np.zeros(doubtful.shape, np.uint32))
    out.probability[doubtful] = probability_by(by_own, evidence)
    others = with_surroundings(out.probability, doubtful, compared)
    by_trees = probability_by(with_others, np.concatenate([evidence, others]))
    out.probability[doubtful] = by_trees
    out.beyond[doubtful] = beyond_learned(evidence, diachronic)
    return out


def probability_by(fitted: DecisionTrees, features: Singles) -> Floats:
    """By trees that sum up to log odds, of the ``features`` [k, n], evidence first."""
    return 1.0 / (1.0 + np.exp(-fitted.sum_at(features).astype(np.float64)))


class Contradicted(NamedTuple):
    """What the images of a window say of its labels; arrays [h, w].

    ``changed``: where they contradict these; ``variance`` (px²) of labels that they do not
    contradict, though these may have changed; ``beyond``: see :class:`ChangeProbability`.
    """

    changed: Bools
    variance: Floats | float
    beyond: NDArray[np.uint32]


def least_probability(compared: LabelledWindow) -> Floats:
    """Of a change, more than which leaves a pixel [h, w] without a label."""
    by_ground = np.where(compared.young, YOUNG_CHANGED, CHANGED)
    return np.where(compared.vegetation, CROWN_CHANGED, by_ground)


def contradicted(compared: LabelledWindow, diachronic: bool) -> Contradicted:
    """Which labelled pixels [h, w] the images contradict.

    Labels of images of one light count as right where these do not contradict them; of images that
    share no light (``diachronic``) they may have changed.
    """
    probability, beyond = change_probability(compared, diachronic)
    changed = compared.labelled & (probability > least_probability(compared))
    variance = probability * SURFACE_PX**2 if diachronic else 0.0
    return Contradicted(changed, variance, beyond)
