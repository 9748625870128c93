"""The detail of an image: what remains of it where shadows and another sun change its brightness.

Each pixel's deviation from the mean of the pixels around it, in standard deviations of these. A
shadow divides brightness and contrast alike, so that its detail is that of the lit ground; only at
its edge is it another, and there no value exceeds GREATEST. Noise counts as part of the standard
deviation: where it is all that an image shows, the detail is near its mean.

Where it is known what lies in shadow, pixels in shadow are compared with those in shadow, lit ones
with lit ones, and what touches the edge between with nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import kernel
from ..numerics.summed_area import window_sums

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

AROUND_PX = 5  # side of what a pixel is compared with
GREATEST = 1.5  # standard deviations
MEAN = 10.0  # of the detail, so that none of its values is 0, which is nodata
NOISE_SHARE = 2.0  # variances of the noise that are added to that of the pixels
SIGNAL_PX = 9  # side of what the share of the signal is the mean of
PARTS = 1000  # of a share, whole ones
LEAST_DN2 = 1.0  # variance by rounding, at least
LEAST_PIXELS = 8  # of one light, that a pixel is compared with


def detail(
    image: NDArray[np.floating], noise: float, shaded: NDArray[np.bool_] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Detail [h, w] of an image [h, w] of whole numbers (DN), by the variance of its ``noise``; and
    the share of it that is signal, over the SIGNAL_PX² around each pixel.

    0 near the edge of the image, and the detail also within AROUND_PX // 2 px of nodata (0).
    ``shaded`` [h, w]: what lies in shadow, if that is known; then the detail is also 0 beside the
    edge of a shadow, and where fewer than LEAST_PIXELS around have the same light.
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
    if shaded is None:
        counts = np.full(total.shape, count)
        _fill_deviations(whole[inner], has_values, counts, total, squares, noise, out[inner])
    else:
        out[inner] = _of_one_light(whole, shaded, has_values, noise)
    variance = squares / count**2
    share = PARTS * (1.0 - noise / np.maximum(variance, max(noise, LEAST_DN2)))
    half += SIGNAL_PX // 2
    parts = window_sums(share.astype(np.int64), SIGNAL_PX)
    signal[half:-half, half:-half] = parts / (PARTS * SIGNAL_PX**2)
    return out, signal


@kernel
def _fill_deviations(
    values: Ints,
    here: Bools,
    count: Ints,
    total: Ints,
    squares: Ints,
    noise: float,
    out: NDArray[np.floating],
) -> None:
    """Of ``values`` [h, w] from the mean of ``count`` pixels of the sum ``total``, whose variance
    is ``squares`` / count²; with MEAN. To ``out``, at the pixels ``here``."""
    for j in range(values.shape[0]):
        for i in range(values.shape[1]):
            if here[j, i]:
                n = count[j, i]
                deviation = (n * values[j, i] - total[j, i]) / n
                deviation /= np.sqrt(squares[j, i] / (n * n) + NOISE_SHARE * noise + LEAST_DN2)
                out[j, i] = min(max(deviation, -GREATEST), GREATEST) + MEAN


def _of_one_light(
    whole: Ints, shaded: Bools, has_values: Bools, noise: float
) -> NDArray[np.float32]:
    """The detail of the inner pixels of an image, by the pixels around of their own light."""
    half = AROUND_PX // 2
    inner = np.s_[half:-half, half:-half]
    in_shadow = window_sums(np.pad(shaded, 1, mode="edge"), 3)
    out = np.zeros(has_values.shape, np.float32)
    for pixels in (0, 9):  # of 3 x 3, in shadow
        use = in_shadow == pixels
        count, of_these = window_sums(use, AROUND_PX), np.where(use, whole, 0)
        total = window_sums(of_these, AROUND_PX)
        squares = count * window_sums(of_these * of_these, AROUND_PX) - total * total
        here = use[inner] & has_values & (count >= LEAST_PIXELS)
        _fill_deviations(whole[inner], here, count, total, squares, noise, out)
    return out
