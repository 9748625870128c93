"""The detail of an image: what remains of it where shadows and another sun change its brightness.

Each pixel's deviation from the mean of the pixels around it, in standard deviations of these. A
shadow divides brightness and contrast alike, so that its detail is that of the lit ground; only at
its edge is it another, and there no value exceeds GREATEST. Noise counts as part of the standard
deviation: where it is all that an image shows, the detail is near its mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.windows import window_sums

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


def detail(
    image: NDArray[np.floating], noise: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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
    share = PARTS * (1.0 - noise / np.maximum(variance, max(noise, LEAST_DN2)))
    half += SIGNAL_PX // 2
    parts = window_sums(share.astype(np.int64), SIGNAL_PX)
    signal[half:-half, half:-half] = parts / (PARTS * SIGNAL_PX**2)
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
