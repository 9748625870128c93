"""Do the images agree with the labels? Correlation over a pixel's own surface, not a square window.

The paper's filter (:mod:`stereotruth.disparity.paper_correlation`) compares square windows around
each point. Where heights step, such a window mixes surfaces and fails although the label is right.
Here the right image is brought to the left by the labels themselves, and windows hold the pixels of
one surface only:

- :mod:`stereotruth.epipolar.surface_correlation`: correlation coefficient of the left and the
  warped right image in a window around each pixel, over the pixels of its surface;
- :func:`.surface_means.apart_from_steps`: of these, only those that no pixel of another surface
  touches. The optics blur a bright roof into the ground beside it, in one view into other ground
  than in the other, which made two thirds of what was taken for a change at 1 point/m²;
- :meth:`Agreement.outvoted`: whether most pixels of the same surface around a pixel fail the
  threshold. A building that only the LiDAR or only the images have fails as a whole; single
  failures among agreeing pixels, by noise or in shadow, do not;
- :meth:`Agreement.unusual`: whether pixels together correlate less than is usual around them;
- :mod:`.shifted_agreement`: whether the images agree better at another disparity. Crowns are
  compared over fewer pixels, too;
- :mod:`.change_probability`: of images that share no light, how probable a change is. That alone
  counts there, and is what is left to doubt of the labels that stay;
- :meth:`Agreement.outvoted_nearby`: the same as the votes for what is
  smaller, by what is usual around it;
- :meth:`Agreement.beside`: the rim of such things, which most of its surroundings outvote;
- crowns, and what is beside young ones, change most: they have labels where the images confirm
  these.

All is computed in a fixed order from the pixels around each pixel alone, so that results do not
depend on blocks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.one_surface import SURFACE_PX
from ..epipolar.surface_correlation import correlation_and_expected, wanted_runs
from ..numerics.summed_area import summed_area, window_sums
from .change_probability import CHANGED, probability_of_change
from .pair_window import PairWindow, WindowLabels
from .pixel_labels import Labels
from .seen_surface import box_max
from .shifted_agreement import (
    INDEPENDENT_PX2,
    SHIFTS_PX,
    SIGNAL,
    ShiftedAgreement,
    shifted_agreement,
)
from .status import VEGETATION_CLASSES, WATER_CLASS, Status, is_labelled
from .surface_means import apart_from_steps, left_and_warped, surface_mean

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


DENSE = 2.0  # points in a pixel, that miss nothing of a pixel's size
NEARBY_PX = 8  # for what is small, pixels up to here vote,
NEARBY_SHARE = 0.35  # of which so many fail
DROWNED_FAIL = 0.25  # what a pixel counts for that noise keeps from telling
TOGETHER_PX = 4  # pixels up to here are averaged
CLOSE_PX = 5  # side of the windows for what is a few pixels wide
# At the rim of what has changed more than RIM_SHARE of the surface up to NEARBY_PX around has not.
# There a pixel is held where a window of CLOSE_PX, centred up to HELD_PX off, correlates by more
# than HELD, as by chance about one of a hundred changed ones does.
HELD_PX, HELD, RIM_SHARE = 1, 0.95, 0.3
# A crown of the LiDAR is a young one if so few pixels up to YOUNG_REACH_PX around show vegetation:
# 2 m wide in pixels of 0.65 m. One that doubles covers 2 px around, and the optics blur it by one.
YOUNG_REACH_PX, YOUNG_PIXELS = 3, 12
CONFIRMED = 0.3  # of what the same crown would agree by, as noise leaves it
DOUBT = 0.85  # of their mean correlation: with more, no other disparity is compared
# Crowns that have been felled: both images see the ground below, over a few pixels
CROWN_REACH_PX = 2
CROWN_SHIFTS = tuple(shift for shift in SHIFTS_PX if abs(shift) >= 2.0)
CROWN_AGREEMENT = 0.6  # of the images there, at least
DOUBTS = 2.0  # standard deviations by which noise may lower a correlation that does not fail
USUAL = 0.8  # of the correlation around: with less, a pixel fails


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well left and right image agree over each pixel's surface; arrays of a window.

    ``correlation`` [h, w]: their coefficient around each pixel as it would be without noise, NaN
    where there is none or noise leaves nothing to tell, which is ``drowned``; ``disparity`` (px)
    [h, w] and its ``slope`` [2, h, w] decide what belongs to a surface. With less than
    ``threshold`` a pixel fails. ``weight`` in [0, 1] that no object fits between the points.
    ``doubt``: standard deviation [h, w] that noise leaves the correlation of the same ground.
    """

    correlation: NDArray[np.floating]
    disparity: NDArray[np.floating]
    slope: NDArray[np.floating]
    threshold: float
    weight: float = 1.0
    drowned: Bools | bool = False
    doubt: Singles | float = 0.0

    def outvoted(self) -> Bools:
        """Pixels [h, w] around which most of their surface fails.

        Drowned pixels count as DROWNED_FAIL of a failure: where noise leaves but few to be told,
        these are chosen by chance and do not speak for the surface.
        """
        return surface_mean(self._against(self.threshold, DROWNED_FAIL), *self._surface) > 0.5

    @property
    def _surface(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        return self.disparity, self.slope

    def _against(self, least: float | Singles, drowned: float) -> Floats:
        """1 where pixels [h, w] correlate less than ``least``, else 0; ``drowned`` where they are;
        NaN where there is nothing to correlate."""
        fails = self._with_doubt() < least
        against = np.where(np.isfinite(self.correlation), fails, np.nan)
        return np.where(self.drowned, drowned, against)

    def _with_doubt(self) -> NDArray[np.floating]:
        """The correlation [h, w] that noise may have lowered to the one that is there."""
        return self.correlation + DOUBTS * self.doubt

    def _usual(self, correlation: NDArray[np.floating]) -> Singles:
        """What pixels [h, w] correlate by at least if they are as usual on their surface around
        them, by the ``correlation`` [h, w] there.

        That is the threshold, or more: the share USUAL of the mean up to VOTE_PX off, since noise
        lowers both. With less weight the limit is higher.
        """
        usual = 1.0 - (1.0 - USUAL) * self.weight
        mean = surface_mean(correlation, *self._surface)
        return np.fmax(usual * mean, self.threshold)

    def together(self) -> Singles:
        """Mean correlation of the surface up to TOGETHER_PX around each pixel [h, w]."""
        return surface_mean(self.correlation, *self._surface, TOGETHER_PX, 1)

    def unusual(self) -> Bools:
        """Pixels [h, w] that correlate less, together with those beside them, than is usual."""
        return self.together() < self._usual(self.correlation)

    def outvoted_nearby(self) -> Bools:
        """Pixels [h, w] within NEARBY_PX of which NEARBY_SHARE correlate less than is usual there.

        Small things are found that :meth:`outvoted` lets their surroundings outvote. With less
        weight fewer failures are enough.
        """
        against = self._against(self._usual(self.correlation), 0.0)
        share = NEARBY_SHARE * float(np.sqrt(self.weight))
        return surface_mean(against, *self._surface, NEARBY_PX, 1) > share

    def beside(self, changed: Bools) -> Bools:
        """Pixels [h, w] no more than NEARBY_PX from ``changed`` ones that correlate less than is
        usual among those that are not.

        Of the hidden pixels that had labels at 4 points/m² in a city two thirds lay so, on ground
        that a building hides which only the images have.
        """
        if not changed.any():
            return changed.copy()
        near = window_sums(np.pad(changed, NEARBY_PX), 2 * NEARBY_PX + 1)
        unchanged = np.where(changed, np.nan, self.correlation)
        return (near > 0) & (self._with_doubt() < self._usual(unchanged))


class Comparison(NamedTuple):
    """How both images are compared: side of the ``window_px``, ``threshold`` of the correlation,
    mean number of ``points_per_px``, ``weight`` in [0, 1] that no object fits between the
    points; ``noise`` of both images, variances in DN²; ``diachronic``: whether they share no
    light."""

    window_px: int
    threshold: float
    points_per_px: float
    weight: float
    noise: tuple[float, float]
    diachronic: bool = False


def window_agreement(
    labels: Labels, window: PairWindow, comparison: Comparison, wanted: Bools | None = None
) -> tuple[Agreement, Singles]:
    """Of both images of a window, over the surfaces of its ``labels``: free of noise, and their
    correlation [h, w] as it is. Of the ``wanted`` [h, w] pixels alone where these are given."""
    left, warped = left_and_warped(window, labels.disparity)
    surface = labels.disparity, labels.slope
    runs = None if wanted is None else wanted_runs(wanted)
    clear = apart_from_steps(labels.disparity)
    with_noise, expected = correlation_and_expected(
        left, warped, *surface, comparison.window_px, comparison.noise, clear, runs
    )
    limits = comparison.threshold, comparison.weight, comparison.window_px
    return free_of_noise(with_noise, expected, *surface, *limits), with_noise


def free_of_noise(
    with_noise: Singles,
    expected: Singles,
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    threshold: float,
    weight: float,
    window_px: int,
) -> Agreement:
    """The agreement by the correlation ``with_noise`` and the one ``expected`` of the same ground,
    arrays [h, w] of windows of ``window_px``
    (:func:`stereotruth.epipolar.surface_correlation.correlation_and_expected`)."""
    drowned = np.isfinite(with_noise) & np.isnan(expected)
    correlation = np.minimum(with_noise / expected, np.float32(1.0))
    # of a coefficient of n pixels: (1 - r²) / sqrt(n), where r is the one expected
    doubt = (1.0 - expected**2) / expected * np.float32(np.sqrt(INDEPENDENT_PX2) / window_px)
    return Agreement(correlation, disparity, slope, threshold, weight, drowned, doubt)


class Contradicted(NamedTuple):
    """What the images of a window say of its labels; arrays [h, w].

    ``changed``: where they contradict these; ``correlation`` of the images over each pixel's
    surface; ``variance`` (px²) of labels that they do not contradict, though these may have
    changed.
    """

    changed: Bools
    correlation: Singles
    variance: Floats | float


def contradicted(
    labels: Labels,
    window: PairWindow,
    comparison: Comparison,
    labelled: Bools,
    surface_class: NDArray[np.uint8],
) -> Contradicted:
    """Which of the ``labelled`` pixels [h, w] the images contradict; or do not confirm, where that
    is asked: crowns, since they are felled and leaves come and go, and what is beside young ones.
    ``surface_class`` [h, w] (ASPRS): of what the labels show."""
    agreement, correlation = window_agreement(labels, window, comparison)
    unseen: Floats | float = 0.0
    crowns = labelled & np.isin(surface_class, VEGETATION_CLASSES)
    beside = labelled & beside_young_crowns(surface_class)
    if comparison.diachronic:
        probability = probability_of_change(
            labels, window, comparison.window_px, comparison.noise, labelled
        )
        changed = labelled & (probability > CHANGED)
        unseen = probability * SURFACE_PX**2
        by_detail = crowns | beside
    else:
        changed, rim = _contradicted_together(labels, window, comparison, labelled, agreement)
        changed = _compared_closely(labels, window, comparison, changed, rim, beside)
        by_detail = crowns

    def close_detail(wanted: Bools, shifts: tuple[float, ...], apart: bool) -> ShiftedAgreement:
        return shifted_agreement(
            labels, window, comparison.noise, CLOSE_PX, CROWN_REACH_PX, wanted, shifts, apart
        )

    detail = close_detail(by_detail & ~changed, (), apart=False)
    changed |= crowns & ~(detail.here > CONFIRMED * detail.signal)
    if comparison.diachronic:
        changed |= beside & ~(detail.here > DOUBT * detail.signal)
    felled = close_detail(crowns & ~changed, CROWN_SHIFTS, apart=True)
    changed |= felled.is_shifted & (felled.elsewhere > CROWN_AGREEMENT)
    return Contradicted(changed, correlation, unseen)


def _compared_closely(
    labels: Labels,
    window: PairWindow,
    comparison: Comparison,
    changed: Bools,
    rim: Bools,
    beside: Bools,
) -> Bools:
    """Which pixels [h, w] have ``changed`` by windows of CLOSE_PX, of images of one light: those of
    the ``rim`` that agree there have not, those ``beside`` young crowns that do not agree have."""
    near, close = box_max(rim | beside, HELD_PX), comparison._replace(window_px=CLOSE_PX)
    closely = window_agreement(labels, window, close, near)[0].correlation
    is_held = rim & (box_max(np.nan_to_num(closely, nan=-1.0), HELD_PX) > HELD)
    together = surface_mean(
        closely, labels.disparity, labels.slope, HELD_PX, 1, wanted_runs(beside)
    )
    return changed & ~is_held | beside & ~(together > DOUBT)


def beside_young_crowns(surface_class: NDArray[np.uint8]) -> Bools:
    """Pixels [h, w] no more than YOUNG_REACH_PX from a crown of the LiDAR that is small, by the
    ``surface_class`` [h, w] (ASPRS).

    Young trees grow most. That is known before any image is compared, so that what is beside them
    has a label only where the images confirm it.
    """
    is_young = np.isin(surface_class, VEGETATION_CLASSES)
    row, col = np.nonzero(is_young)
    margin = 2 * YOUNG_REACH_PX
    table = summed_area(np.pad(is_young, margin))

    def count(px: int) -> NDArray[np.int64]:
        """Of vegetation up to ``px`` around each of its pixels."""
        top, side = row + margin - px, col + margin - px
        end, far = top + 2 * px + 1, side + 2 * px + 1
        return table[end, far] - table[top, far] - table[end, side] + table[top, side]

    around = count(YOUNG_REACH_PX)
    is_small = (around <= YOUNG_PIXELS) & (count(margin) <= 2 * YOUNG_PIXELS)
    is_young[row, col] = is_small & (2 * count(1) >= around)  # compact, no branches of a canopy
    return box_max(is_young, YOUNG_REACH_PX)


def _contradicted_together(
    labels: Labels,
    window: PairWindow,
    comparison: Comparison,
    labelled: Bools,
    agreement: Agreement,
) -> tuple[Bools, Bools]:
    """:func:`contradicted` of images of one light, by their ``agreement``; and which of these are
    at the rim of a change, where the images agree at no other disparity better."""
    changed = agreement.outvoted()
    doubtful = labelled & (agreement.together() < DOUBT)
    shifted = shifted_agreement(
        labels, window, comparison.noise, comparison.window_px, TOGETHER_PX, doubtful
    )
    changed |= shifted.contradicts()
    has_signal = shifted.signal > SIGNAL
    changed |= has_signal & agreement.unusual()
    rim = agreement.beside(changed)
    inner = changed & labelled
    if comparison.points_per_px < DENSE:
        # Points far apart miss what is small: the pixels of one window vote once more.
        changed |= agreement.outvoted_nearby()
    changed = (changed | rim) & labelled
    # votes widen what has changed over the same surface
    goes_on = np.where(labelled, ~inner, np.nan)
    unchanged = surface_mean(
        goes_on, labels.disparity, labels.slope, NEARBY_PX, 2, wanted_runs(changed)
    )
    return changed, changed & ~shifted.is_shifted & (unchanged > RIM_SHARE)


def without_changes(
    labels: WindowLabels, window: PairWindow, comparison: Comparison
) -> WindowLabels:
    """Labels without those that the images contradict, and without water; with the correlation of
    the images over each pixel's surface."""
    labelled = is_labelled(labels.status)
    by_images = contradicted(labels.labels, window, comparison, labelled, labels.surface_class)
    changed = by_images.changed | labelled & (labels.surface_class == WATER_CLASS)
    status = labels.status.copy()
    status[changed] = Status.CHANGED
    with_unseen = replace(labels.labels, variance=labels.labels.variance + by_images.variance)
    return replace(labels, status=status, labels=with_unseen, correlation=by_images.correlation)
