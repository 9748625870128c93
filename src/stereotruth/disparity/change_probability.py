"""How probable is it that what a label shows has changed? For images that share no light.

Such images agree less than those of one light where nothing has changed: shadows have moved, and
what a window holds besides the unchanged surface disagrees. Where the detail of both images agrees
over the surface around a pixel, all the same, hardly anything has changed. Elsewhere several things
together tell (:class:`Evidence`): agreements over windows of two kinds, one at another disparity,
how much each image has to tell, and where the pixel lies. What they tell is learned from simulated
cities of which all changes are known: decision trees, whose values sum up to the log odds of a
change (eq. 17 of docs/explanation/surface.md, bench/change_probability.py). What has changed is
larger than a pixel, so that other trees ask the probabilities of the surface around, too, and of
that part of it which looks like the pixel in both images (eq. 18).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.alike_correlation import alike_correlation, brightness_of_pair
from ..epipolar.alike_means import alike_mean
from ..epipolar.surface_correlation import wanted_runs
from ..numerics.decision_trees import DecisionTrees
from .pair_window import PairWindow
from .pixel_labels import Labels
from .seen_surface import box_max
from .shifted_agreement import SHIFTS_PX, shifted_agreement
from .surface_means import VOTE_PX, apart_from_steps, left_and_warped, surface_mean

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]

SURROUNDINGS_PX = 8  # pixels of the surface up to here: for the detail's agreement
ALIKE_PX = 4  # for pixels that are alike, for contrast and gain,
GAIN_PX = 16  # which is held against that up to here
FAR_PX = 8  # steps farther off do not count
# px up to which, one of so many, probabilities are averaged; labels are compared up to VOTE_PX off
AROUND = (4, 1), (8, 2), (VOTE_PX, 3)
ALIKE_AROUND = (8, 1), (VOTE_PX, 2)  # and over pixels that are alike
FULL_AGREEMENT = 0.8  # of the detail, with which hardly anything has changed:
SURE = 1e-4  # no mean of probabilities counts as less, nor as nearer to 1
LEAST_SIGNAL = 0.2  # share, with less of which images tell nothing, and the probability is
UNKNOWN = 0.05  # the share that has changed there
AGREED = 0.0007  # at least the share that has: 0.00045 of the cities that trees are fitted to
LEVEL = 500.0  # DN, to which logarithms of brightness refer, so that their squares are small
ROUNDING = 1.0 / 12.0  # DN²: variance of whole numbers, the least of an image's noise
CHANGED = 0.3  # more probable, a label is left out
TREES = Path(__file__).with_suffix(".tsv")


class Evidence(NamedTuple):
    """What both images tell of pixels [n], float32, NaN where nothing tells.

    ``agreement``: mean correlation of the images' detail over the surface up to SURROUNDINGS_PX
    around a pixel, at its disparity; ``elsewhere``: the greatest at a shifted disparity, by
    ``shift`` px up or down; ``signal``: what the same ground would agree by, as noise leaves it.
    ``alike``: correlation of the brightness over the pixels that are alike
    (:mod:`stereotruth.epipolar.alike_correlation`), which lie on one side of the edges of shadows
    and of new roofs; ``alike_around``: the mean of these up to ALIKE_PX. ``contrast_left`` and
    ``contrast_right``: standard deviation of the surface up to ALIKE_PX in each image, in that of
    its noise. ``gain``: how much the ratio of both images' brightness there differs from that up to
    GAIN_PX, as a logarithm. ``from_step``: px to the next step of the surface, FAR_PX at most;
    ``slope`` of the disparity.
    """

    agreement: Singles
    elsewhere: Singles
    shift: Singles
    signal: Singles
    alike: Singles
    alike_around: Singles
    contrast_left: Singles
    contrast_right: Singles
    gain: Singles
    from_step: Singles
    slope: Singles


def change_evidence(
    labels: Labels,
    window: PairWindow,
    window_px: int,
    noise: tuple[float, float],
    labelled: Bools,
) -> tuple[Bools, Evidence]:
    """Which of the ``labelled`` pixels [h, w] of a window do not agree fully, and the evidence of
    these.

    ``window_px``: side of the windows in which details are correlated; ``noise``: variances of both
    images, DN².
    """
    compared = labels, window, noise, window_px, SURROUNDINGS_PX
    detail = shifted_agreement(*compared, labelled, ())
    doubtful = labelled & ~(detail.here >= FULL_AGREEMENT)
    shifted = shifted_agreement(*compared, doubtful, SHIFTS_PX)
    left, warped = left_and_warped(window, labels.disparity)
    surface, runs = (labels.disparity, labels.slope), wanted_runs(doubtful)

    def mean(values: NDArray[np.floating], reach: int, every: int = 1) -> Singles:
        return surface_mean(values, *surface, reach, every, runs)

    nearby = wanted_runs(box_max(doubtful, ALIKE_PX))
    alike = alike_correlation(left, warped, *surface, ALIKE_PX, noise, nearby)
    both = (left != 0.0) & (warped > 0.0)
    logarithms = [np.log(np.where(both, image, np.nan) / LEVEL) for image in (left, warped)]
    levels = [mean(image, ALIKE_PX) for image in logarithms]
    contrasts = []
    for image, level, variance in zip(logarithms, levels, noise):
        spread = np.maximum(mean(image**2, ALIKE_PX) - level**2, 0.0)
        contrasts.append(np.sqrt(spread / max(variance, ROUNDING)) * np.exp(level) * LEVEL)
    wide = mean(logarithms[0] - logarithms[1], GAIN_PX, GAIN_PX // 4)
    gain = np.abs(levels[0] - levels[1] - wide)
    arrays = Evidence(
        detail.here,
        shifted.elsewhere,
        np.abs(shifted.shift),
        shifted.signal,
        alike,
        mean(alike, ALIKE_PX),
        *contrasts,
        gain,
        _from_step(labels.disparity),
        np.abs(labels.slope).sum(axis=0),
    )
    return doubtful, Evidence(*(array[doubtful].astype(np.float32) for array in arrays))


def _from_step(disparity: Floats) -> Singles:
    """Pixels [h, w] to the next that lies beside a step, in a square, FAR_PX at most."""
    beside = ~apart_from_steps(disparity)
    out = np.full(disparity.shape, FAR_PX, np.float32)
    for px in range(FAR_PX - 1, -1, -1):
        out[box_max(beside, px)] = px
    return out


def with_surroundings(
    own: Floats, doubtful: Bools, labels: Labels, window: PairWindow, labelled: Bools
) -> list[Singles]:
    """Log odds [n] of the ``doubtful`` pixels' ``own`` probability [h, w], and of its means over
    the ``labelled`` surface around them, see AROUND, and over its pixels that are alike, see
    ALIKE_AROUND."""
    surface, runs = (labels.disparity, labels.slope), wanted_runs(doubtful)
    known = np.where(labelled, own, np.nan)
    bright = brightness_of_pair(*left_and_warped(window, labels.disparity))
    means = [surface_mean(known, *surface, *around, runs) for around in AROUND]
    means += [alike_mean(known, bright, *surface, *around, runs) for around in ALIKE_AROUND]
    return [_log_odds(values[doubtful]) for values in (own, *means)]


def _log_odds(probability: NDArray[np.floating]) -> Singles:
    bounded = np.clip(probability.astype(np.float64), SURE, 1.0 - SURE)
    return np.log(bounded / (1.0 - bounded)).astype(np.float32)


@cache
def trees() -> list[DecisionTrees]:
    """Those of the log odds by a pixel's own evidence, and those that ask its surroundings, too."""
    return DecisionTrees.load(TREES)


def by_itself(evidence: Evidence, doubtful: Bools) -> Floats:
    """Probability [h, w] that a pixel has changed, by its own evidence alone; AGREED where it is
    not ``doubtful``."""
    own, _ = trees()
    out = np.full(doubtful.shape, AGREED)
    out[doubtful] = _probability(own, np.stack(evidence), evidence.signal)
    return out


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
    doubtful, evidence = change_evidence(labels, window, window_px, noise, labelled)
    _, with_others = trees()
    out = by_itself(evidence, doubtful)
    others = with_surroundings(out, doubtful, labels, window, labelled)
    out[doubtful] = _probability(with_others, np.stack([*evidence, *others]), evidence.signal)
    return out


def _probability(fitted: DecisionTrees, features: Singles, signal: Singles) -> Floats:
    """By trees that sum up to log odds; UNKNOWN where noise leaves nothing to tell by."""
    probability = 1.0 / (1.0 + np.exp(-fitted.sum_at(features).astype(np.float64)))
    return np.where(signal >= LEAST_SIGNAL, probability, UNKNOWN)
