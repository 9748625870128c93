"""Grey values as a network takes them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import dask
import numpy as np
from numpy.typing import NDArray

from .weights import SavedNetwork

SCALINGS = ("standardise", "us3d", "dfc2019")
SAMPLES = 1 << 22  # pixels that a quantile is taken from
GREY = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R BT.601)


class Scaling(NamedTuple):
    """What the blocks of both images must share, see :func:`image_statistics`."""

    left: tuple[float, float] | None
    right: tuple[float, float] | None


def image_statistics(image: Any, scaling: str) -> tuple[float, float] | None:
    """What the scaling of an image follows from (NumPy or Dask array of any size).

    ``standardise``: mean and standard deviation. Others: 0 and the grey value that becomes the
    brightest of 8 bits, above 99.9 % of the pixels that have data (of large images every k-th pixel
    of every k-th row is looked at); None for images of 8 bits, which stay as they are.
    """
    if scaling == "standardise":
        return image_scaling(image)
    if image.dtype == np.uint8:
        return None
    step = math.ceil(math.sqrt(math.prod(image.shape[:2]) / SAMPLES))
    values = np.asarray(image[::step, ::step])
    values = values[values != 0]
    return 0.0, float(np.quantile(values, 0.999)) if values.size else 1.0


def image_scaling(image: Any) -> tuple[float, float]:
    """Mean and standard deviation over the pixels of an image that are not nodata (0).

    NumPy or Dask array of any size; exact sums, so the same whatever the blocks.
    """
    whole = np.issubdtype(image.dtype, np.integer)
    wide = np.uint64 if whole else np.float64
    sums = (image != 0).sum(), image.sum(dtype=wide), (image.astype(wide) ** 2).sum()
    n, s, q = dask.compute(*sums)
    if not n:
        return 0.0, 1.0
    mean = int(s) / int(n) if whole else float(s) / int(n)
    variance = float(q) / int(n) - mean * mean
    return mean, max(variance, 0.0) ** 0.5 or 1.0


def scaled(
    image: NDArray[Any], model: SavedNetwork, statistics: tuple[float, float] | None
) -> NDArray[np.float32]:
    """[H, W] or [H, W, 3] pixels -> [C, H, W] as the network takes them; nodata becomes 0.

    ``statistics`` of the whole image; None: of this one.
    """
    grey = image.ndim == 2
    first, second = statistics or image_statistics(image, model.scaling) or (0.0, 255.0)
    if model.scaling != "standardise":
        bands = np.repeat(image[..., None], 3, axis=2) if grey else image
        bands = np.minimum(bands.astype(np.float32) * np.float32(255 / second), 255)
        bands = bands / np.float32(127.5) - 1
        if model.channels == 1:
            bands = bands @ np.array(GREY, np.float32)[:, None]
        bands = bands[..., ::-1] if model.scaling == "us3d" else bands / 2
        # copies: of one band, NumPy takes a reversed axis for contiguous, and PyTorch refuses it
        return bands.transpose(2, 0, 1).astype(np.float32, order="C").copy()
    if not grey and model.channels == 1:
        image = image @ np.array(GREY, np.float32)
    out = (image.astype(np.float32) - np.float32(first)) / np.float32(second)
    out[image == 0] = 0
    if out.ndim == 2:
        return np.repeat(out[None], model.channels, axis=0)
    return np.ascontiguousarray(out.transpose(2, 0, 1))
