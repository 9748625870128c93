"""Do the images agree with the labels? Comparison over a pixel's own surface, not a square window.

The paper's filter (:mod:`stereotruth.labels.paper_correlation`) compares square windows around
each point. Where heights step, such a window mixes surfaces and fails although the label is right.
Here the right image is brought to the left by the labels themselves, and windows hold the pixels of
one surface only:

- :mod:`stereotruth.epipolar.surface_windows`: correlation coefficient of the left and the
  warped right image in a window around each pixel, over the pixels of its surface;
- :mod:`.change_evidence`: what both images tell of a label;
- :mod:`.change_probability`: how probable it is by that, that what a label shows has changed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.status import Status, is_labelled
from ..epipolar.window_sums import SURFACE_PX
from ..lidar.point_store import WATER_CLASS
from .change_evidence import LabelledWindow
from .change_probability import CHANGED, CROWN_CHANGED, YOUNG_CHANGED, change_probability
from .pair_window import PairWindow, WindowLabels
from .pixel_labels import Labels

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


NO_NOISE = 0.0, 0.0


class Comparison(NamedTuple):
    """How both images are compared: side of the ``window_px`` of the layer ``correlation``;
    ``noise`` of both images, variances; ``diachronic``: whether they share no light."""

    window_px: int
    noise: tuple[float, float]
    diachronic: bool = False


class Contradicted(NamedTuple):
    """What the images of a window say of its labels; arrays [h, w].

    ``changed``: where they contradict these; ``variance`` (px²) of labels that they do not
    contradict, though these may have changed; ``beyond``: see :class:`.ChangeProbability`.
    """

    changed: Bools
    variance: Floats | float
    beyond: NDArray[np.uint32]


def least_probability(compared: LabelledWindow) -> Floats:
    """Of a change, more than which leaves a pixel [h, w] without a label."""
    by_ground = np.where(compared.young, YOUNG_CHANGED, CHANGED)
    return np.where(compared.vegetation, CROWN_CHANGED, by_ground)


def contradicted(
    labels: Labels,
    window: PairWindow,
    comparison: Comparison,
    labelled: Bools,
    surface_class: NDArray[np.uint8],
) -> Contradicted:
    """Which of the ``labelled`` pixels [h, w] the images contradict.

    ``surface_class`` [h, w] (ASPRS): of what the labels show. Labels of images of one light count
    as right where these do not contradict them.
    """
    compared = LabelledWindow(window, labels, labelled, surface_class, comparison.noise)
    probability, beyond = change_probability(compared, comparison.diachronic)
    changed = labelled & (probability > least_probability(compared))
    variance = probability * SURFACE_PX**2 if comparison.diachronic else 0.0
    return Contradicted(changed, variance, beyond)


def without_changes(
    labels: WindowLabels, window: PairWindow, equal: PairWindow, comparison: Comparison
) -> WindowLabels:
    """Labels without those that the images contradict, and without water; with the correlation of
    the images over each pixel's surface.

    ``equal``: the ``window`` with images of equal noise, as ``comparison`` has it.
    """
    labelled = is_labelled(labels.status)
    by_images = contradicted(labels.labels, equal, comparison, labelled, labels.surface_class)
    as_it_is = LabelledWindow(window, labels.labels, labelled, labels.surface_class, NO_NOISE)
    correlation, _ = as_it_is.correlation(comparison.window_px)
    changed = by_images.changed | labelled & (labels.surface_class == WATER_CLASS)
    status = labels.status.copy()
    status[changed] = Status.CHANGED
    with_unseen = replace(labels.labels, variance=labels.labels.variance + by_images.variance)
    by_both = {"correlation": correlation, "beyond": by_images.beyond}
    return replace(labels, status=status, labels=with_unseen, **by_both)
