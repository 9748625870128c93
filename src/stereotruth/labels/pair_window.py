"""A window of a pair's left grid: what both images show in it, and its labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.summed_area import window_sums
from ..core.status import Status
from ..epipolar.image_noise import NoiseCurve
from ..epipolar.warping import warp_rows
from ..sensor.image_detail import detail
from .pixel_labels import Labels

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class PairWindow:
    """Pixels ``rows``, ``cols`` of the left epipolar grid, and what both images show there.

    The outer ``margin`` pixels have no labels of their own, but take part in those of others.
    ``left``, ``right``: patches; the right one holds all that the window's points can be seen in.
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
        :meth:`.NoiseCurve.equalised`: :data:`.image_noise.EQUAL` are its variances then."""
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
        inner = slice(self.margin, -self.margin)
        return inner, inner

    def grown(self, px: int) -> tuple[slice, slice]:
        """The window without its margin, and as much of this as lies up to ``px`` off."""
        cut = max(self.margin - px, 0)
        rows, cols = self.shape
        return slice(cut, rows - cut), slice(cut, cols - cut)

    def usable(self, row: Ints, col: Ints, disparity: Floats) -> tuple[Bools, Bools]:
        """Which pixels [n] (from the window's first) of a disparity lie in both frames, and of
        which a mask hides either place."""
        y, x = row + self.first[0], col + self.first[1]
        match = np.floor(x - disparity).astype(np.int64)
        in_left, in_right = usable_at(self.left, y, x), usable_at(self.right, y, match)
        return in_left & in_right == USABLE, (in_left | in_right) & MASKED != 0


def usable_at(patch: Patch, row: Ints, col: Ints) -> Bytes:
    """Of :class:`.pair_window.Patch`, at pixels [n]; 0 outside the patch."""
    r, c = row - patch.row, col - patch.col
    inside = (r >= 0) & (c >= 0) & (r < patch.usable.shape[0]) & (c < patch.usable.shape[1])
    out = np.zeros(r.size, np.uint8)
    out[inside] = patch.usable[r[inside], c[inside]]
    return out


@dataclass(frozen=True, eq=False)
class WindowLabels:
    """Labels of a window and why its other pixels have none; arrays [h, w], margin included.

    ``status`` (:class:`.Status`); ``labels``: disparity, slope, variance; ``height`` (m) and
    ``surface_class`` (ASPRS) of what a pixel shows; ``day``: when that was measured, since
    1970-01-01, 0 for not known; ``point_count``: points used; ``correlation``: coefficient of both
    images; ``change``: why a pixel has changed (:class:`.reason.Reason`); ``beyond``: which figures
    of what the images tell lie beyond what was learned, as :func:`.change_probability.beyond_learned`
    has it.
    """

    status: Bytes
    labels: Labels
    height: Floats
    surface_class: Bytes
    day: NDArray[np.uint16]
    point_count: Ints
    correlation: NDArray[np.floating]
    change: Bytes
    beyond: NDArray[np.uint32]

    def within(self, part: tuple[slice, slice]) -> WindowLabels:
        """A part of the window."""
        labels = Labels(
            self.labels.disparity[part], self.labels.slope[:, *part], self.labels.variance[part]
        )
        return WindowLabels(
            status=self.status[part],
            labels=labels,
            height=self.height[part],
            surface_class=self.surface_class[part],
            day=self.day[part],
            point_count=self.point_count[part],
            correlation=self.correlation[part],
            change=self.change[part],
            beyond=self.beyond[part],
        )

    def around(self, part: tuple[slice, slice]) -> WindowLabels:
        """Those of a ``part`` of the window; other pixels have none."""
        status = np.full_like(self.status, Status.NO_POINTS)
        status[part] = self.status[part]
        return replace(self, status=status)

    def counts(self, in_frames: NDArray[np.int32], outside: NDArray[np.int32]) -> Ints:
        """Points of a window: all, in both frames, used; from those of its pixels."""
        labelled = np.isin(self.status, (Status.LABELLED, Status.BELOW_MINIMUM_COUNT))
        framed = in_frames.sum()
        return np.array([framed + outside.sum(), framed, self.point_count[labelled].sum()])


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
