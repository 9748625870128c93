"""Noise of an image, and what resampling leaves of it.

Noise lowers the correlation of two images of the same ground, the more the weaker its texture is.
Whoever takes a low correlation for a change has to know the noise.

The second differences along rows and columns of an original image remove all of a plane and most of
a texture that optics have blurred; white noise remains (Immerkaer, CVIU 64, 1996). Where an image
is flattest, hardly anything else does. Resampled images would not do: noise there is no longer
white.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..numerics.cubic_convolution import TAP_POLYNOMIALS
from .image_reader import Source

Floats = NDArray[np.float64]

PART_PX = 16  # side of the parts that are compared
SAMPLE_PX = 130  # side of what is read at a place,
PLACES = 12  # at so many along each axis at most
FLATTEST = 0.1  # of the parts
SQUARES = 36.0  # of the weights of second differences along both axes, summed
# Second differences of white noise correlate: PART_PX² of them count as so many free ones. Of a
# chi-square distribution of these the quantile FLATTEST (Wilson & Hilferty 1931) lies below 1.
FREE = PART_PX**2 / (35.0 / 18.0) ** 2
FLATTEST_OF_NOISE = (1.0 - 2.0 / (9.0 * FREE) - 1.2816 * (2.0 / (9.0 * FREE)) ** 0.5) ** 3
PHASES = 100  # at which a kernel's weights are averaged


def noise_of(source: Source) -> float:
    """Standard deviation (DN) of the noise of an image; 0 without a part that is free of nodata.

    An upper bound where nothing of the image is flat. Parts of one value alone, as fill values and
    saturated ones, do not count.
    """
    cols, rows = source.size
    wide, high = min(SAMPLE_PX, cols), min(SAMPLE_PX, rows)
    squares = np.concatenate(
        [
            _mean_squares(source.read(col, row, wide, high).astype(np.float64))
            for row in _places(rows)
            for col in _places(cols)
        ]
    )
    if not squares.size:
        return 0.0
    return float(np.sqrt(np.quantile(squares, FLATTEST) / FLATTEST_OF_NOISE))


def resampled_noise(noise: float, widening: Sequence[float]) -> float:
    """Standard deviation (DN) that is left of white ``noise`` on the average over a resampled
    image.

    ``widening`` of the kernel along each axis (:mod:`.resampling`).
    """
    phases = np.arange(PHASES) / PHASES
    weights = np.stack([np.polyval(np.asarray(tap, np.float64), phases) for tap in TAP_POLYNOMIALS])
    kept = float((weights**2).sum(axis=0).mean())
    return float(noise * np.prod([np.sqrt(kept / wider) for wider in widening]))


def _places(size: int) -> NDArray[np.int64]:
    """First pixels of the samples along an axis."""
    count = min(PLACES, max(size // SAMPLE_PX, 1))
    return np.linspace(0, max(size - SAMPLE_PX, 0), count).astype(np.int64)


def _mean_squares(pixels: Floats) -> Floats:
    """Of each part, the mean square of second differences, as variance of the noise; none of parts
    with nodata or of one value."""
    across = pixels[:, 2:] - 2.0 * pixels[:, 1:-1] + pixels[:, :-2]
    both = across[2:] - 2.0 * across[1:-1] + across[:-2]
    rows, cols = (size // PART_PX for size in both.shape)
    parts = both[: rows * PART_PX, : cols * PART_PX].reshape(rows, PART_PX, cols, PART_PX)
    found = (parts**2).mean(axis=(1, 3)) / SQUARES
    return found[found > 0.0]  # also false for NaN
