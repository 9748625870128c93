"""What both images of a pair tell of each label: whether they show the LiDAR's surface.

The right image is brought to the left by the labels themselves, and is compared with the left one
over the pixels of one surface (:mod:`stereotruth.epipolar.surface_windows`). Windows of a few
pixels agree closely on most labels; such pixels are asked no more. Of the others several things
together tell (:class:`Evidence`): agreement over windows of several kinds, the brightness that both
images have at a pixel, agreement at other disparities, and where the pixel lies.

All is computed in a fixed order from the pixels around each pixel alone, so that results do not
depend on blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.arrays import Bools, Floats, Singles
from ..core.numerics.windows import box_max, summed_area
from ..epipolar.surface_windows import (
    alike_correlation,
    apart_from_steps,
    brightness_of_pair,
    correlation_and_expected,
    surface_mean,
    surface_means,
)
from ..epipolar.window_sums import wanted_runs
from ..lidar.point_store import VEGETATION_CLASSES
from ..sensor.image_noise import ROUNDING
from .pair_window import Labels, PairWindow
from .shifted_agreement import FAR, SHIFTS_PX, shifted_agreement

Bits = NDArray[np.uint32]

CLOSE_PX = 5  # side of the windows that see what is a few pixels wide
AGREED = 0.95  # correlation of these, mean of 3 x 3: with more, hardly anything has changed
WINDOW_PX = 9  # side of the windows in which details are correlated,
SURROUNDINGS_PX = 8  # whose agreement is averaged over the surface up to here
NEAR_PX = 2  # up to here differences of brightness are averaged
ALIKE_PX = 4  # for pixels that are alike, for contrast and gain,
GAIN_PX = 16  # which is held against that up to here
FAR_PX = 8  # steps farther off do not count
# Pixels around one that its evidence follows from: the windows of details far off
EVIDENCE_PX = FAR * SURROUNDINGS_PX + WINDOW_PX // 2 + 2
LEVEL = 500.0  # DN, to which logarithms of brightness refer, so that their squares are small
# Both images of the same ground differ by noise; by labels that are off by so many px over the
# brightness of a slope; and by this share of the brightness.
OFF_PX, OFF_SHARE = 0.1, 0.01


# A crown of the LiDAR is a young one if so few pixels up to YOUNG_REACH_PX around show vegetation:
# 2.4 m wide in pixels of 0.65 m. One that doubles covers 2 px around, and the optics blur it by
# one.
YOUNG_REACH_PX, YOUNG_PIXELS = 3, 14
NO_NOISE = 0.0, 0.0
ASKED = np.uint32(1)
LEARNED = Path(__file__).with_suffix(".tsv")


@dataclass(frozen=True, eq=False)
class LabelledWindow:
    """A ``window`` of a pair whose images are compared by ``labels``; arrays [h, w].

    ``labelled``: pixels that are asked about; ``surface_class`` (ASPRS) of what the labels show;
    ``noise`` of both images, variances.
    """

    window: PairWindow
    labels: Labels
    labelled: Bools
    surface_class: NDArray[np.uint8]
    noise: tuple[float, float]

    @cached_property
    def surface(self) -> tuple[Singles, Singles]:
        """Disparity (px) [h, w] and its slope [2, h, w], which decide what belongs to a surface."""
        disparity, slope = self.labels.disparity, self.labels.slope
        return disparity.astype(np.float32), np.ascontiguousarray(slope, np.float32)

    @property
    def first_row(self) -> int:
        """Number in the grid of the first of the rows."""
        return self.window.rows.start

    @cached_property
    def images(self) -> tuple[Singles, NDArray[np.float64]]:
        """Left image, 0 where it has no value, and the right one brought to it, NaN there."""
        return self.window.images_at(self.labels.disparity)

    @cached_property
    def brightness(self) -> tuple[Singles, Singles]:
        """Of both images."""
        return brightness_of_pair(*self.images)

    @cached_property
    def clear(self) -> Bools:
        """Pixels that no pixel of another surface touches. The optics blur a bright roof into the
        ground beside it, in one view into other ground than in the other."""
        return apart_from_steps(self.labels.disparity)

    @cached_property
    def vegetation(self) -> Bools:
        """Where the LiDAR has some, which changes most."""
        return np.isin(self.surface_class, VEGETATION_CLASSES)

    @cached_property
    def young(self) -> Bools:
        """What is beside a young crown, which grows."""
        return beside_young_crowns(self.surface_class)

    def correlation(self, window_px: int) -> tuple[Singles, Singles]:
        """Of both images over each pixel's surface, and the one expected of the same ground, see
        :func:`.surface_windows.correlation_and_expected`; NaN where a pixel is not labelled."""
        runs = wanted_runs(self.labelled)
        of_runs = correlation_and_expected(
            *self.images, *self.surface, window_px, self.noise, self.clear, runs
        )
        # runs hold other pixels, too; which ones follows from the window's first column
        none = np.float32(np.nan)
        correlation, expected = (np.where(self.labelled, values, none) for values in of_runs)
        return correlation, expected


class Evidence(NamedTuple):
    """What both images tell of pixels [n], float32, NaN where nothing tells.

    ``close``: correlation of the images in a window of CLOSE_PX, as it would be without noise;
    ``close_most``, ``close_least``, ``close_mean``: of the pixels up to 1 px off. ``difference``:
    of the brightness of both images at a pixel, in standard deviations; ``difference_beside`` and
    ``difference_near``: mean of the surface up to 1 px and NEAR_PX off.

    ``agreement``: mean correlation of the images' detail over the surface up to SURROUNDINGS_PX
    around a pixel, at its disparity; ``elsewhere``: the greatest at a shifted disparity, by
    ``shift`` px up or down; ``agreement_far``, ``elsewhere_far``: up to FAR times as far;
    ``signal``: what the same ground would agree by, as noise leaves it.

    ``alike``: correlation of the brightness over the pixels that are alike
    (:func:`.surface_windows.alike_correlation`), which lie on one side of the edges of shadows and
    of new roofs; ``alike_around``: the mean of these up to ALIKE_PX. ``contrast_left`` and
    ``contrast_right``: standard deviation of the surface up to ALIKE_PX in each image, in that of
    its noise. ``gain``: how much the ratio of both images' brightness there differs from that up to
    GAIN_PX, as a logarithm.

    ``from_step``: px to the next step of the surface, FAR_PX at most; ``apart``: share of the
    surface up to ALIKE_PX that touches no other, without which agreement is lent by what lies
    beside; ``slope`` of the disparity.
    ``vegetation``, ``young``: 1 where :class:`LabelledWindow` says so.
    """

    close: Singles
    close_most: Singles
    close_least: Singles
    close_mean: Singles
    difference: Singles
    difference_beside: Singles
    difference_near: Singles
    agreement: Singles
    elsewhere: Singles
    shift: Singles
    signal: Singles
    agreement_far: Singles
    elsewhere_far: Singles
    alike: Singles
    alike_around: Singles
    contrast_left: Singles
    contrast_right: Singles
    gain: Singles
    from_step: Singles
    apart: Singles
    slope: Singles
    vegetation: Singles
    young: Singles


def change_evidence(compared: LabelledWindow) -> tuple[Bools, Evidence]:
    """Which labelled pixels [h, w] of a window do not agree closely or show trees, and the evidence
    of these."""
    with_noise, expected = compared.correlation(CLOSE_PX)
    close = np.minimum(with_noise / expected, np.float32(1.0))
    close_mean = surface_mean(close, *compared.surface, 1, 1, wanted_runs(compared.labelled))
    doubtful = compared.labelled & ~(close_mean > AGREED)
    # What has replaced a tree may agree closely.
    doubtful |= compared.labelled & (compared.vegetation | compared.young)
    known = {
        "close": close,
        "close_most": box_max(np.nan_to_num(close, nan=-1.0), 1),
        "close_least": -box_max(np.nan_to_num(-close, nan=-1.0), 1),
        "close_mean": close_mean,
        **_differences(compared, doubtful),
        "from_step": _from_step(compared.clear),
        "slope": np.abs(compared.labels.slope).sum(axis=0),
        "vegetation": compared.vegetation,
        "young": compared.young,
    }
    detail = shifted_agreement(
        compared.labels,
        compared.window,
        compared.noise,
        WINDOW_PX,
        SURROUNDINGS_PX,
        doubtful,
        SHIFTS_PX,
    )
    runs = wanted_runs(box_max(doubtful, ALIKE_PX))
    alike = alike_correlation(
        *compared.images, compared.brightness, *compared.surface, ALIKE_PX, compared.noise, runs
    )
    around = surface_mean(alike, *compared.surface, ALIKE_PX, 1, wanted_runs(doubtful))
    arrays = Evidence(
        agreement=detail.here,
        elsewhere=detail.elsewhere,
        shift=np.abs(detail.shift),
        signal=detail.signal,
        agreement_far=detail.here_far,
        elsewhere_far=detail.elsewhere_far,
        alike=alike,
        alike_around=around,
        apart=_apart(compared, doubtful),
        **_contrasts_and_gain(compared, doubtful),
        **known,
    )
    return doubtful, Evidence(*(array[doubtful].astype(np.float32) for array in arrays))


def _differences(compared: LabelledWindow, doubtful: Bools) -> dict[str, Singles]:
    """By how much the left image differs from the right one [h, w], whose brightness is brought to
    that of the surface up to GAIN_PX, in standard deviations; and means of that."""
    left, warped = compared.images
    known = (left != 0.0) & np.isfinite(warped)
    runs = wanted_runs(box_max(doubtful, NEAR_PX))
    brightness = np.where(known, compared.images, np.nan)
    levels = surface_means(
        brightness, *compared.surface, GAIN_PX, GAIN_PX // 4, runs, compared.first_row
    )
    down, across = np.gradient(left)
    variance = OFF_PX**2 * (down**2 + across**2) + OFF_SHARE**2 * left**2
    variance += sum(max(noise, ROUNDING) for noise in compared.noise)
    with np.errstate(divide="ignore", invalid="ignore"):  # a black image
        off = np.abs(left - warped * (levels[0] / levels[1])) / np.sqrt(variance)
    difference = np.where(known, off, np.nan).astype(np.float32)
    runs = wanted_runs(doubtful)
    beside, near = (
        surface_mean(difference, *compared.surface, reach, 1, runs) for reach in (1, NEAR_PX)
    )
    return {"difference": difference, "difference_beside": beside, "difference_near": near}


def _contrasts_and_gain(compared: LabelledWindow, doubtful: Bools) -> dict[str, Singles]:
    """Contrast of both images, and how their ratio differs from that around [h, w]."""
    runs = wanted_runs(doubtful)
    left, warped = compared.images
    both = (left != 0.0) & (warped > 0.0)
    logarithms = [np.log(np.where(both, image, np.nan) / LEVEL) for image in (left, warped)]
    values = np.stack([*logarithms, *(image**2 for image in logarithms)])
    means = surface_means(values, *compared.surface, ALIKE_PX, 1, runs)
    contrasts = []
    for level, square, variance in zip(means[:2], means[2:], compared.noise):
        spread = np.maximum(square - level**2, 0.0)
        contrasts.append(np.sqrt(spread / max(variance, ROUNDING)) * np.exp(level) * LEVEL)
    ratio = logarithms[0] - logarithms[1]
    wide = surface_mean(ratio, *compared.surface, GAIN_PX, GAIN_PX // 4, runs, compared.first_row)
    gain = np.abs(means[0] - means[1] - wide)
    return {"contrast_left": contrasts[0], "contrast_right": contrasts[1], "gain": gain}


def _apart(compared: LabelledWindow, doubtful: Bools) -> Singles:
    """Share of the surface around [h, w] that touches no other."""
    of_labels = np.where(compared.labelled, compared.clear, np.nan)
    return surface_mean(of_labels, *compared.surface, ALIKE_PX, 1, wanted_runs(doubtful))


def _from_step(clear: Bools) -> Singles:
    """Pixels [h, w] to the next that is not ``clear`` of steps, in a square, FAR_PX at most."""
    out = np.full(clear.shape, FAR_PX, np.float32)
    for px in range(FAR_PX - 1, -1, -1):
        out[box_max(~clear, px)] = px
    return out


def beside_young_crowns(surface_class: NDArray[np.uint8]) -> Bools:
    """Pixels [h, w] no more than YOUNG_REACH_PX from a crown of the LiDAR that is small, by the
    ``surface_class`` [h, w] (ASPRS)."""
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


@cache
def learned(diachronic: bool) -> Floats:
    """Lowest and greatest value [2, k] of each figure of the evidence that trees are fitted to, but
    for one in a hundred at either end."""
    rows = np.loadtxt(LEARNED, np.float64, delimiter="\t", skiprows=1, usecols=(1, 2, 3))
    return rows[rows[:, 0] == diachronic, 1:].T


def beyond_learned(evidence: Singles, diachronic: bool) -> Bits:
    """Which of the figures of the ``evidence`` [k, n] lie beyond what has been learned [n]: the bit
    ASKED, and from the next one on a bit for each figure."""
    low, high = learned(diachronic)[..., None]
    is_beyond = (evidence < low) | (evidence > high)  # false for NaN
    return ASKED + (np.uint32(2) << np.arange(len(evidence), dtype=np.uint32)) @ is_beyond


def beyond_counts(beyond: Bits) -> NDArray[np.int64]:
    """Of pixels [h, w]: how many were asked, and how many lie beyond by each figure [1 + k]."""
    figures = learned(False).shape[1]
    return np.array([(beyond >> bit & 1).sum(dtype=np.int64) for bit in range(1 + figures)])
