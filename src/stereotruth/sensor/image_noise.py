"""Noise of two images of the same ground, images in which it is the same everywhere, their detail.

1. *By brightness*: second differences along rows and columns (Immerkaer, CVIU 64, 1996), where an
   image is flattest at each brightness, give the noise but for a factor, the same at all.
2. *The factor*: parts of the left image are looked for along their rows in the right one. Where the
   ground is flat, noise is all that both images differ by.
3. *Equal noise*: brightness is counted in standard deviations of the noise: a
   variance-stabilising transformation (Anscombe 1948).

The *detail* is each pixel's deviation from the mean of those around it, in standard deviations of
these and of the noise, which shadows and another sun leave as it is. See
docs/explanation/real_sensors.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Floats, Ints, Singles
from ..core.numerics.windows import window_sums

STEPS = 8.0  # whole numbers that a standard deviation of the noise spans in images of equal noise
EQUAL = STEPS**2, STEPS**2  # variances of the noise of two such images
PART_PX, PLACE_PX = 12, 132  # sides of the parts that are compared, and of a place with several
PLACES = 10  # along each axis, at most
NEAR_PX = 10  # the parts of a place are looked for so far around what fits most of it
FLATTEST, LEAST_PARTS = 0.1, 12  # share of the parts of about one brightness; the least number
SQUARES = 36.0  # of the weights of second differences along both axes, summed
CLASSES, RARE = 16, 0.002  # of brightness; share of the parts at either end that make no class
# Share of the parts in which least of the expected difference is left, and how much that is of
# noise whose neighbours correlate by 0.4 (0.62 to 0.78 by the contrast of the texture), with the
# best of the places that are compared.
LEAST, LEAST_OF_NOISE = 0.05, 0.7
ROUNDING = 1.0 / 12.0  # DN²: variance of whole numbers
LEAST_SHARE = 0.003  # of the brightness: no two images of the same ground differ by less
VALUES = 1 << 16  # of uint16

AROUND_PX = 5  # side of what a pixel is compared with for its detail
GREATEST = 1.5  # standard deviations
MEAN = 10.0  # of the detail, so that none of its values is 0, which is nodata
NOISE_SHARE = 2.0  # variances of the noise that are added to that of the pixels
SIGNAL_PX = 9  # side of what the share of the signal is the mean of
WHOLE = 1000  # parts of a share
LEAST_DN2 = 1.0  # variance by rounding, at least


class Grid(Protocol):
    """What is read of an image [y, x], uint16, 0 for nodata."""

    shape: tuple[int, ...]

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]: ...


class NoiseCurve(NamedTuple):
    """Standard ``deviation`` (DN) of an image's noise at some ``brightness`` (DN), which
    increases."""

    brightness: tuple[float, ...]
    deviation: tuple[float, ...]

    def equalised(self, pixels: NDArray[np.floating]) -> Singles:
        """The image [h, w] (whole numbers, 0 for nodata) with STEPS per standard deviation of its
        noise, in whole numbers; 0 stays 0 and nothing else is."""
        at = np.interp(np.arange(VALUES - 1) + 0.5, self.brightness, self.deviation)
        table = np.zeros(VALUES)
        np.cumsum(STEPS / at, out=table[1:])
        table[1:] = np.maximum(np.rint(table[1:]), 1.0)
        return table.astype(np.float32)[pixels.astype(np.int64)]


class Parts(NamedTuple):
    """Parts of the left image and what fits them best in the right one; float64 [n].

    ``brightness``, ``greatest`` (DN) and ``rough`` (DN²: mean square of second differences, as a
    variance of white noise) in either image; ``variance`` (DN²) of the left image less the right
    one, whose brightness is brought to it.
    """

    brightness: tuple[Floats, Floats]
    greatest: tuple[Floats, Floats]
    rough: tuple[Floats, Floats]
    variance: Floats


def pair_noise(
    left: Grid, right: Grid, disparities: tuple[int, int]
) -> tuple[NoiseCurve, NoiseCurve]:
    """Of both images of an epipolar pair, by what they differ by at ``disparities`` (least and
    greatest, px) that they may have.

    No more than rounding where no part of the images can be compared.
    """
    parts = _parts_of(left, right, disparities)
    curves = [_by_brightness(*of_image) for of_image in zip(*parts[:3])]
    expected = sum(
        np.interp(level, curve.brightness, curve.deviation) ** 2 * gain**2
        for level, curve, gain in zip(
            parts.brightness, curves, (1.0, parts.brightness[0] / parts.brightness[1])
        )
    )
    factor = 1.0
    if parts.variance.size >= LEAST_PARTS:
        found = np.quantile(parts.variance / expected, LEAST) / LEAST_OF_NOISE
        factor = max(float(np.sqrt(found)), 1.0)
    return tuple(
        NoiseCurve(curve.brightness, tuple(factor * value for value in curve.deviation))
        for curve in curves
    )


def _parts_of(left: Grid, right: Grid, disparities: tuple[int, int]) -> Parts:
    """Of all places, but for saturated ones."""
    found = [_parts(left, right, place, disparities) for place in _places(left)]
    rows = np.concatenate([np.empty((0, 7)), *found]).T
    parts = Parts(rows[0:2], rows[2:4], rows[4:6], rows[6])
    if not rows.size:
        return parts
    kept = np.all(parts.greatest < parts.greatest.max(axis=1, keepdims=True), axis=0)
    return Parts(*(values[..., kept] for values in parts))


def _places(image: Grid) -> Iterator[tuple[int, int]]:
    """First pixels (row, column) of places all over an image."""
    starts = [
        np.linspace(0, size - PLACE_PX, min(PLACES, size // PLACE_PX)).astype(int)
        for size in image.shape
    ]
    for row in starts[0].tolist():
        for col in starts[1].tolist():
            yield row, col


def _parts(left: Grid, right: Grid, place: tuple[int, int], disparities: tuple[int, int]) -> Floats:
    """Those of a place, a row of the values of :class:`Parts` each; none with nodata or of one
    value."""
    row, col = place
    rows = slice(row, row + PLACE_PX)
    # columns of the right image that may show the place
    first = max(col - disparities[1] - NEAR_PX, 0)
    end = min(col - disparities[0] + PLACE_PX + NEAR_PX, right.shape[1])
    if end - first < PLACE_PX:
        return np.empty((0, 7))
    here = left[rows, col : col + PLACE_PX].astype(np.float64)
    there = right[rows, first:end].astype(np.float64)
    middle = _best_column(here, there)
    columns = range(max(middle - NEAR_PX, 0), min(middle + NEAR_PX, there.shape[1] - PLACE_PX) + 1)
    level, greatest, square = _of_parts(here), _of_parts(here, np.max), _of_parts(here**2)
    rough, all_there = _of_parts(_second_differences(here)), _of_parts(here > 0.0) == 1.0
    # of the right image down the rows of a part; then each column is the first of some parts
    down = [
        of(values.reshape(PLACE_PX // PART_PX, PART_PX, -1), axis=1)
        for values, of in (
            (there, np.mean), (there, np.max), (there**2, np.mean),
            (_second_differences(there), np.mean), (there > 0.0, np.all),
        )
    ]  # fmt: skip
    best = np.full((7, *level.shape), np.inf)
    for column in columns:
        at = slice(column, column + PLACE_PX)
        level_there, greatest_there, square_there, rough_there, values_there = (
            of(values[:, at].reshape(level.shape[0], -1, PART_PX), axis=2)
            for values, of in zip(down, (np.mean, np.max, np.mean, np.mean, np.all))
        )
        gain = level / np.where(values_there, level_there, 1.0)
        product = _of_parts(here * there[:, at])
        variance = square - 2.0 * gain * product + gain**2 * square_there
        variance = np.where(all_there & values_there, variance, np.inf)
        values = level, level_there, greatest, greatest_there, rough, rough_there, variance
        best = np.where(variance < best[6], values, best)
    return best[:, np.isfinite(best[6]) & (best[4:] > 0.0).all(axis=0)].T


def _second_differences(values: Floats) -> Floats:
    """Along both axes, squared, as variances of white noise; 0 at the rim of [h, w]."""
    out = np.zeros_like(values)
    across = values[:, 2:] - 2.0 * values[:, 1:-1] + values[:, :-2]
    out[1:-1, 1:-1] = (across[2:] - 2.0 * across[1:-1] + across[:-2]) ** 2 / SQUARES
    return out


def _of_parts(values: NDArray, of: Callable[..., NDArray] = np.mean) -> Floats:
    """Means, or else, of the parts of a place."""
    count = PLACE_PX // PART_PX
    return of(values.reshape(count, PART_PX, count, PART_PX), axis=(1, 3))


def _best_column(here: Floats, there: Floats) -> int:
    """Column of ``there`` [h, m] from which on it correlates best with ``here`` [h, w], row by
    row."""
    size = 1 << int(np.ceil(np.log2(there.shape[1] + here.shape[1])))
    here, there = (_along_rows(values) for values in (here, there))
    spectrum = (np.fft.rfft(there, size) * np.conj(np.fft.rfft(here, size))).sum(axis=0)
    count = there.shape[1] - here.shape[1] + 1
    product = np.fft.irfft(spectrum, size)[:count]
    energy = np.concatenate([[0.0], np.cumsum((there**2).sum(axis=0))])
    energy = energy[here.shape[1] :] - energy[:count]
    return int(np.argmax(product / np.sqrt(np.maximum(energy, energy.max() / 100.0) + 1.0)))


def _along_rows(values: Floats) -> Floats:
    """Differences of neighbours along the rows, 0 beside nodata."""
    out = np.zeros_like(values)
    known = (values[:, 1:] > 0.0) & (values[:, :-1] > 0.0)
    out[:, 1:] = np.where(known, np.diff(values, axis=1), 0.0)
    return out


def _by_brightness(brightness: Floats, _greatest: Floats, rough: Floats) -> NoiseCurve:
    """By the brightness (DN) of parts [n] and by how ``rough`` they are; but for a factor."""
    levels: list[float] = []
    deviations: list[float] = []
    if brightness.size >= LEAST_PARTS:
        edges = np.geomspace(*np.quantile(brightness, [RARE, 1.0 - RARE]), CLASSES + 1)
        of_class = np.searchsorted(edges[1:-1], brightness)
        for k in range(CLASSES):
            chosen = of_class == k
            if chosen.sum() >= LEAST_PARTS:
                variance = max(np.quantile(rough[chosen], FLATTEST), ROUNDING)
                levels.append(float(np.median(brightness[chosen])))
                deviations.append(max(float(np.sqrt(variance)), LEAST_SHARE * levels[-1]))
    if not levels:
        return NoiseCurve((0.0,), (float(np.sqrt(ROUNDING)),))
    return NoiseCurve(tuple(levels), tuple(deviations))


def detail(image: NDArray[np.floating], noise: float) -> tuple[Singles, Singles]:
    """Detail [h, w] of an image [h, w] of whole numbers (DN), by the variance of its ``noise``; and
    the share of it that is signal, over the SIGNAL_PX² around each pixel.

    0 near the edge of the image, and the detail also within AROUND_PX // 2 px of nodata (0).
    """
    out, signal = np.zeros((2, *image.shape), np.float32)
    if min(image.shape) < AROUND_PX + SIGNAL_PX:
        return out, signal
    half, count = AROUND_PX // 2, AROUND_PX**2
    whole = image.astype(np.int64)
    total = window_sums(whole, AROUND_PX)  # exact, so that no block changes it
    squares = count * window_sums(whole * whole, AROUND_PX) - total * total
    has_values = window_sums(whole == 0, AROUND_PX) == 0
    inner = np.s_[half:-half, half:-half]
    _fill_deviations(whole[inner], has_values, count, total, squares, noise, out[inner])
    variance = squares / count**2
    share = WHOLE * (1.0 - noise / np.maximum(variance, max(noise, LEAST_DN2)))
    half += SIGNAL_PX // 2
    parts = window_sums(share.astype(np.int64), SIGNAL_PX)
    signal[half:-half, half:-half] = parts / (WHOLE * SIGNAL_PX**2)
    return out, signal


@kernel
def _fill_deviations(
    values: Ints,
    here: Bools,
    n: int,
    total: Ints,
    squares: Ints,
    noise: float,
    out: NDArray[np.floating],
) -> None:
    """Of ``values`` [h, w] from the mean of ``n`` pixels of the sum ``total``, whose variance
    is ``squares`` / n²; with MEAN. To ``out``, at the pixels ``here``."""
    for j in range(values.shape[0]):
        for i in range(values.shape[1]):
            if here[j, i]:
                deviation = (n * values[j, i] - total[j, i]) / n
                deviation /= np.sqrt(squares[j, i] / (n * n) + NOISE_SHARE * noise + LEAST_DN2)
                out[j, i] = min(max(deviation, -GREATEST), GREATEST) + MEAN
