"""Parts of an image, and where a window around a place can be sampled in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.windows import window_sums
from ..sensor.image_noise import detail

USABLE, MASKED = 1, 2  # bits


class Array2D(Protocol):
    """What is read of an image: a NumPy or Zarr array [y, x], uint16, 0 for nodata."""

    shape: tuple[int, ...]

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]: ...


@dataclass(frozen=True, eq=False)
class MaskedImage:
    """An image [y, x] of which a ``mask`` [y, x] hides pixels: there it is 0, as at nodata."""

    image: Array2D
    mask: Array2D

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, cols)."""
        return self.image.shape

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]:
        return np.where(self.mask[key] == 0, self.image[key], np.uint16(0))


@dataclass(frozen=True)
class Patch:
    """Part of an image, ready for the filter.

    ``pixels`` float32 [rows, cols], zero outside the image, with one more row and column than
    ``usable`` has. ``usable`` uint8: USABLE where a window whose centre lies in [col, col + 1) x
    [row, row + 1) touches neither nodata nor the image's edge, MASKED where it touches what a mask
    hides. (``row``, ``col``) is the image's
    pixel at the patch's origin.
    """

    pixels: NDArray[np.float32]
    usable: NDArray[np.uint8]
    row: int
    col: int


@dataclass(frozen=True, eq=False)
class Detail:
    """Of an image: the ``patch`` with the detail in place of its pixels, the share of ``signal``
    of each."""

    patch: Patch
    signal: NDArray[np.float32]

    @classmethod
    def of(cls, patch: Patch, noise: float) -> Detail:
        """By the variance of the ``noise``, DN²."""
        pixels, signal = detail(patch.pixels, noise)
        return cls(replace(patch, pixels=pixels), signal)


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
    usable = np.zeros((height, width), dtype=np.uint8)
    inner = _touched(pixels == 0.0, half) == 0
    where = np.s_[half : half + inner.shape[0], half : half + inner.shape[1]]
    usable[where] = inner
    if isinstance(image, MaskedImage) and top < bottom and left < right:
        masked = np.zeros(pixels.shape, np.bool_)
        there = np.s_[top - row : bottom - row, left - col : right - col]
        masked[there] = image.mask[top:bottom, left:right] != 0
        usable[where][_touched(masked, half) > 0] = MASKED
    return Patch(pixels, usable, row, col)


def _touched(chosen: NDArray[np.bool_], half: int) -> NDArray[np.int64]:
    """How many pixels are ``chosen`` in [-half, half + 1]² around every pixel that has them."""
    return window_sums(chosen, 2 * half + 2)
