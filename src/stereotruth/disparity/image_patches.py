"""Parts of an image, and where a window around a place can be sampled in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Array2D(Protocol):
    """What is read of an image: a NumPy or Zarr array [y, x], uint16, 0 for nodata."""

    shape: tuple[int, ...]

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]: ...


@dataclass(frozen=True)
class Patch:
    """Part of an image, ready for the filter.

    ``pixels`` float32 [rows, cols], zero outside the image, with one more row and column than
    ``usable`` has. ``usable`` uint8: 1 where a window whose centre lies in [col, col + 1) x
    [row, row + 1) touches neither nodata nor the image's edge. (``row``, ``col``) is the image's
    pixel at the patch's origin.
    """

    pixels: NDArray[np.float32]
    usable: NDArray[np.uint8]
    row: int
    col: int


def read_patch(image: Array2D, rows: slice, cols: slice, window: int) -> Patch:
    """The patch that serves points with ``rows``, ``cols`` [start, stop) as nearest pixels.

    ``rows`` and ``cols`` may reach beyond the image. ``window`` (odd, px) = 1 asks for no more
    than the four pixels of a bilinear interpolation.
    """
    half = window // 2
    row, col = rows.start - half - 1, cols.start - half - 1
    height, width = rows.stop + half + 1 - row, cols.stop + half + 1 - col
    pixels = np.zeros((height + 1, width + 1), dtype=np.float32)
    top, bottom = max(row, 0), min(row + height + 1, image.shape[0])
    left, right = max(col, 0), min(col + width + 1, image.shape[1])
    if top < bottom and left < right:
        pixels[top - row : bottom - row, left - col : right - col] = image[top:bottom, left:right]
    # Count of nodata pixels in [-half, half + 1]² around every pixel, by an integral image.
    bad = np.zeros((height + 2, width + 2), dtype=np.int32)
    np.cumsum(pixels == 0.0, axis=0, dtype=np.int32, out=bad[1:, 1:])
    np.cumsum(bad, axis=1, out=bad)
    n = 2 * half + 2
    usable = np.zeros((height, width), dtype=np.uint8)
    inner = bad[n:, n:] - bad[:-n, n:] - bad[n:, :-n] + bad[:-n, :-n] == 0
    usable[half : half + inner.shape[0], half : half + inner.shape[1]] = inner
    return Patch(pixels, usable, row, col)
