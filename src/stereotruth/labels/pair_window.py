"""A window of a pair's left grid: what both images show in it, and its labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Bytes, Floats, Ints, Singles
from ..core.numerics.windows import window_sums
from ..core.status import Status
from ..epipolar.warping import warp_rows
from ..sensor.image_noise import NoiseCurve, detail

USABLE, MASKED = 1, 2  # bits
# Of what holds of a pixel, its status is the first of these.
PRECEDENCE = (
    Status.MASKED,
    Status.OUT_OF_FRAME,
    Status.HIDDEN_IN_RIGHT,
    Status.CHANGED,
    Status.LABELLED_CROWN,
    Status.EDGE_IN_PIXEL,
    Status.BELOW_MINIMUM_COUNT,
    Status.LABELLED,
    Status.LOW_CORRELATION,
    Status.LABELLED_BETWEEN,
    Status.NO_POINTS,
)


def merged_status(masks: Mapping[Status, Bools], before: Bytes | None = None) -> Bytes:
    """The first status of PRECEDENCE whose mask [h, w] holds, or that a pixel had ``before``."""
    shape = next(iter(masks.values())).shape
    out = np.zeros(shape, np.uint8) if before is None else before.copy()
    rank = np.zeros(len(Status), np.uint8)
    rank[list(PRECEDENCE)] = np.arange(len(PRECEDENCE))
    for status in sorted(masks, key=PRECEDENCE.index, reverse=True):
        out[masks[status] & (rank[out] > rank[status])] = status
    return out


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
    """Part of an image.

    ``pixels`` float32 [rows, cols], zero outside the image, with one more row and column than
    ``usable`` has. ``usable`` uint8: USABLE where a window whose centre lies in [col, col + 1) x
    [row, row + 1) touches neither nodata nor the image's edge, MASKED where it touches what a mask
    hides. (``row``, ``col``) is the image's pixel at the patch's origin.
    """

    pixels: Singles
    usable: Bytes
    row: int
    col: int


@dataclass(frozen=True, eq=False)
class Detail:
    """Of an image: the ``patch`` with the detail in place of its pixels, the share of ``signal``
    of each."""

    patch: Patch
    signal: Singles

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


def _touched(chosen: Bools, half: int) -> Ints:
    """How many pixels are ``chosen`` in [-half, half + 1]² around every pixel that has them."""
    return window_sums(chosen, 2 * half + 2)


@kernel
def _usable_at(patch: Bytes, row: int, col: int) -> int:
    """0 outside the patch."""
    if row < 0 or col < 0 or row >= patch.shape[0] or col >= patch.shape[1]:
        return 0
    return patch[row, col]


@kernel
def _frames(
    left: Bytes, right: Bytes, offset: tuple[int, int, int, int], chosen: Bools, disparity: Floats,
    inside: Bools, masked: Bools,
) -> None:  # fmt: skip
    """Which ``chosen`` pixels [h, w] lie in both frames, and of which a mask hides either place;
    ``offset``: row and column of the window's first pixel in each patch."""
    top, side, top_right, side_right = offset
    for j in range(chosen.shape[0]):
        for i in range(chosen.shape[1]):
            if not chosen[j, i]:
                continue
            match = int(np.floor(side_right + i - disparity[j, i]))
            here = _usable_at(left, top + j, side + i)
            there = _usable_at(right, top_right + j, match)
            inside[j, i] = here & there == USABLE
            masked[j, i] = (here | there) & MASKED != 0


@dataclass(frozen=True, eq=False)
class PairWindow:
    """Pixels ``rows``, ``cols`` of the left epipolar grid, and what both images show there.

    The outer ``margin`` pixels have no labels of their own, but take part in those of others.
    ``left``, ``right``: patches; the right one holds all that the window's labels can be seen in.
    """

    rows: slice
    cols: slice
    margin: int
    left: Patch
    right: Patch

    @property
    def first(self) -> tuple[int, int]:
        """(row, col) of the first pixel."""
        return self.rows.start, self.cols.start

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.rows.stop - self.rows.start, self.cols.stop - self.cols.start

    def details(self, noise: tuple[float, float]) -> tuple[Detail, Detail]:
        """Of both images, by the variances of their ``noise``, DN²; kept for the next call."""
        if noise not in self._details:
            left, right = map(Detail.of, (self.left, self.right), noise)
            self._details[noise] = left, right
        return self._details[noise]

    @cached_property
    def _details(self) -> dict[tuple[float, float], tuple[Detail, Detail]]:
        return {}

    def of_equal_noise(self, noise: tuple[NoiseCurve, NoiseCurve]) -> PairWindow:
        """With brightness counted in standard deviations of the images' ``noise``, see
        :meth:`.image_noise.NoiseCurve.equalised`: :data:`.image_noise.EQUAL` are its variances
        then."""
        left, right = (
            replace(patch, pixels=curve.equalised(patch.pixels))
            for patch, curve in zip((self.left, self.right), noise)
        )
        return replace(self, left=left, right=right)

    def images_at(self, disparity: Floats) -> tuple[Singles, Floats]:
        """Left image [h, w], and the right one brought to it by the ``disparity`` (px): its value
        at (x - disparity, y) of each pixel, NaN where there is none."""
        top, side = self.rows.start - self.left.row, self.cols.start - self.left.col
        rows, cols = self.shape
        left = self.left.pixels[top : top + rows, side : side + cols]
        top = self.rows.start - self.right.row
        right = self.right.pixels[top : top + rows, : self.right.usable.shape[1]]
        at = np.arange(self.cols.start, self.cols.stop) - disparity - self.right.col
        return left, warp_rows(right, at)

    @property
    def inner(self) -> tuple[slice, slice]:
        """The window without its margin."""
        rows, cols = self.shape
        return slice(self.margin, rows - self.margin), slice(self.margin, cols - self.margin)

    def grown(self, px: int) -> tuple[slice, slice]:
        """The window without its margin, and as much of this as lies up to ``px`` off."""
        cut = max(self.margin - px, 0)
        rows, cols = self.shape
        return slice(cut, rows - cut), slice(cut, cols - cut)

    def usable(self, chosen: Bools, disparity: Floats) -> tuple[Bools, Bools]:
        """Which ``chosen`` pixels [h, w] of a ``disparity`` lie in both frames, and of which a mask
        hides either place; False of others."""
        inside, masked = np.zeros((2, *chosen.shape), np.bool_)
        (row, col), left, right = self.first, self.left, self.right
        offset = row - left.row, col - left.col, row - right.row, col - right.col
        _frames(left.usable, right.usable, offset, chosen, disparity, inside, masked)
        return inside, masked


def usable_at(patch: Patch, row: Ints, col: Ints) -> Bytes:
    """Of :class:`Patch`, at pixels [n]; 0 outside the patch."""
    r, c = row - patch.row, col - patch.col
    inside = (r >= 0) & (c >= 0) & (r < patch.usable.shape[0]) & (c < patch.usable.shape[1])
    out = np.zeros(r.size, np.uint8)
    out[inside] = patch.usable[r[inside], c[inside]]
    return out


@dataclass(frozen=True, eq=False)
class Labels:
    """Disparities (px) at the centres of pixels, arrays [h, w], NaN where there is none.

    ``slope`` [2, h, w]: of the disparity along x and y; ``variance`` (px²) of the disparity from
    the points alone.
    """

    disparity: Floats
    slope: Floats
    variance: Floats


@dataclass(frozen=True, eq=False)
class WindowLabels:
    """Labels of a window and why its other pixels have none; arrays [h, w].

    ``status`` (:class:`.status.Status`); ``labels``: disparity, slope, variance; ``height`` (m) and
    ``surface_class`` (ASPRS) of what a pixel shows; ``day``: when that was measured, since
    1970-01-01, 0 for not known; ``point_count``: points used.
    """

    status: Bytes
    labels: Labels
    height: Floats
    surface_class: Bytes
    day: NDArray[np.uint16]
    point_count: Ints

    def within(self, part: tuple[slice, slice]) -> WindowLabels:
        """A part of the window."""
        labels = Labels(
            self.labels.disparity[part], self.labels.slope[:, *part], self.labels.variance[part]
        )
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "labels"}
        return replace(self, labels=labels, **{name: a[part] for name, a in arrays.items()})
