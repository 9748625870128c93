"""Semi-global matching (Hirschmüller 2008) by OpenCV's ``StereoSGBM``, on images of any depth.

OpenCV takes 8 bits. Grey values of more are mapped by one monotone curve for both images: linear
over the range of all but ``TAIL`` of the pixels at either end, and from there on ever flatter
towards the ends of the 8 bits, so that nothing is clipped. Images of 8 bits stay as they are,
colour becomes grey.

OpenCV computes no pixel whose range of matches leaves the right image. Here the images are padded,
so that every pixel has a disparity; it is invalid (NaN) where its match lies outside the right
image, where either image has no data, outside the disparity range, and where OpenCV says so
(uniqueness, left-right check, speckles).

The defaults are those that did best on eight training and validation tiles of four synthetic
cities: EPE 0.91 px, D1 6.2 %, holes filled. OpenCV's sample (block 5, p2 32 times its pixels,
gradients up to 63) has 1.26 px and 9.1 % there; grey values mapped linearly from end to end 7.2 %,
and by the upper 8 of their 16 bits 44 %. On two pairs of US3D all settings tried were much alike
(D1 25-29 %).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError

from .matcher import WINDOW_PX, DisparityRange, called, spread

MODES = {
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,  # five paths
    "hh": cv2.STEREO_SGBM_MODE_HH,  # eight paths; 2 h w (range) bytes and more
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,  # three paths, several threads
    "hh4": cv2.STEREO_SGBM_MODE_HH4,  # four paths, several threads
}
STEP = 16  # OpenCV's disparities come in units of 1/16 px, and in ranges of multiples of 16 px
TAIL = 0.02
TAIL_LEVELS = 16.0  # of the 8 bits, for each tail
SAMPLES = 1 << 22  # pixels of each image that the grey range is taken from
NO_CHECK = 1 << 14  # px; to OpenCV, what is not positive means 1 px
UNCERTAINTIES = (None, "left_right", "peak_ratio")
PEAK_PX = 2  # disparities closer than these belong to one minimum of the cost
MARGIN_PX = 128  # three tiles: 0.01-0.15 % of the pixels see further than 64 px, none than 128


class GreyMapping(NamedTuple):
    """The grey values between which the mapping to 8 bits is linear."""

    low: float
    high: float

    def __call__(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """An image [h, w] in 8 bits."""
        if image.dtype == np.uint16:
            return np.take(self._mapped(np.arange(1 << 16)), image)
        return self._mapped(image)

    def _mapped(self, grey: NDArray[Any]) -> NDArray[np.uint8]:
        width = 255.0 - 2 * TAIL_LEVELS
        # in levels, 0 … width being the linear part
        level = (grey.astype(np.float32) - self.low) * (width / max(self.high - self.low, 1e-6))
        below = TAIL_LEVELS * np.expm1(np.minimum(level, 0) / TAIL_LEVELS)
        above = -TAIL_LEVELS * np.expm1(np.minimum(width - level, 0) / TAIL_LEVELS)
        return np.rint(np.clip(level, 0, width) + below + above + TAIL_LEVELS).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class SemiGlobalMatcher:
    """OpenCV's semi-global matching as a Matcher. Raises InputError for values that cannot work.

    ``mode``: sgbm (five paths) | hh (eight) | 3way | hh4 (four). ``block_size``: px, odd. ``p1``,
    ``p2``: penalties of disparities that change by one and by more; null: 8 and 64 times the
    pixels of the block. ``uniqueness_percent``: by which the best cost must beat the next.
    ``left_right_px``: largest difference of the two directions; null: no check.
    ``speckle_px``: smaller patches of disparities within ``speckle_range_px`` are invalid; 0: none.
    ``prefilter_cap``: bound of the horizontal gradients that are compared. ``uncertainty``: see
    config/README.md; null: none is stated. ``workers``: threads, in modes that have any.
    """

    mode: str = "hh4"
    block_size: int = 3
    p1: int | None = None
    p2: int | None = None
    uniqueness_percent: int = 5
    left_right_px: int | None = 1
    speckle_px: int = 100
    speckle_range_px: int = 1
    prefilter_cap: int = 31
    uncertainty: str | None = None
    workers: int = 1

    margin_px: ClassVar[int] = MARGIN_PX
    invalid_outside: ClassVar[bool] = True  # what matches outside the right image has no disparity

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise InputError(
                f"SGM has no mode {self.mode!r}", remedy=f"take one of {', '.join(MODES)}"
            )
        if self.block_size < 1 or self.block_size % 2 == 0:
            raise InputError(
                f"SGM's block_size of {self.block_size} px is not odd", remedy="take 1, 3, 5, …"
            )
        if self.uncertainty not in UNCERTAINTIES:
            raise InputError(
                f"SGM has no uncertainty {self.uncertainty!r}",
                remedy=f"take one of {', '.join(filter(None, UNCERTAINTIES))}, or null",
            )
        p1, p2 = self._penalties
        if not 0 < p1 < p2:
            raise InputError(
                f"SGM's penalties p1 = {p1} and p2 = {p2} are not 0 < p1 < p2",
                remedy="take a larger p2",
            )

    @property
    def _penalties(self) -> tuple[int, int]:
        area = self.block_size**2
        return (
            8 * area if self.p1 is None else self.p1,
            64 * area if self.p2 is None else self.p2,
        )

    def opencv(self, disparity_range: tuple[int, int]) -> cv2.StereoSGBM:
        """OpenCV's object for a disparity range: of the next multiple of 16 px."""
        low, high = disparity_range
        count = math.ceil((high - low) / STEP) * STEP
        p1, p2 = self._penalties
        return cv2.StereoSGBM.create(
            minDisparity=low,
            numDisparities=count,
            mode=MODES[self.mode],
            blockSize=self.block_size,
            P1=p1,
            P2=p2,
            uniquenessRatio=self.uniqueness_percent,
            disp12MaxDiff=NO_CHECK if self.left_right_px is None else max(self.left_right_px, 1),
            speckleWindowSize=self.speckle_px,
            speckleRange=self.speckle_range_px,
            preFilterCap=self.prefilter_cap,
        )

    def scaling(self, left: Any, right: Any) -> GreyMapping | None:
        """The mapping to 8 bits that all parts of two images share; None for images of 8 bits."""
        return grey_mapping(left, right)

    def __call__(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: tuple[int, int],
        scaling: GreyMapping | None = None,
    ) -> NDArray[np.float32]:
        """Disparity float32[h, w] px, in steps of 1/16 px; see :class:`.matcher.Matcher`."""
        low, high = disparity_range
        matcher = self.opencv(disparity_range)
        before = max(low + matcher.getNumDisparities(), 0)
        after = max(-low, 0)
        if left.ndim == 2 and left.dtype != np.uint8 and scaling is None:
            scaling = grey_mapping(left, right)
        padded = [pad(to_8_bits(image, scaling), before, after) for image in (left, right)]
        with _threads(self.workers):
            found = matcher.compute(*padded)[:, before : before + left.shape[1]]
        return _valid(found, left, right, low, high)

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: GreyMapping | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The disparity, and its standard uncertainty [h, w] px if one is asked for."""
        found = self(left, right, disparity_range, scaling)
        if self.uncertainty is None:
            return found, None
        scaling = scaling or self.scaling(left, right)
        if self.uncertainty == "peak_ratio":
            images = (to_8_bits(image, scaling) for image in (left, right))
            return found, peak_ratio(found, *images, disparity_range)
        turned = (np.ascontiguousarray(image[:, ::-1]) for image in (right, left))
        of_right = self(*turned, disparity_range, scaling)[:, ::-1]
        return found, spread(found, at_matches(of_right, found))


def at_matches(of_right: NDArray[np.float32], found: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values [h, w] of right pixels at the matches of left ones; NaN where there is none."""
    width = found.shape[1]
    known = np.isfinite(found)
    match = np.rint(np.arange(width) - np.where(known, found, 0)).astype(np.intp)
    known &= (match >= 0) & (match < width)
    taken = np.take_along_axis(of_right, np.clip(match, 0, width - 1), axis=1)
    return np.where(known, taken, np.float32(np.nan))


def peak_ratio(
    found: NDArray[np.float32],
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    disparity_range: DisparityRange,
) -> NDArray[np.float32]:
    """Cost at the disparity over the least one ``PEAK_PX`` and more away, 1 at most; NaN as found.

    The cost is the mean absolute grey difference of windows.
    """
    low, high = disparity_range
    before, after = max(high, 0), max(-low, 0)
    wide = pad(right, before, after)
    with np.errstate(invalid="ignore"):
        chosen = np.where(np.isfinite(found), np.rint(found), low).astype(np.int32)
    own = np.full(found.shape, np.inf, np.float32)
    other = own.copy()
    for disparity in range(low, high):
        moved = wide[:, before - disparity :][:, : left.shape[1]]
        cost = cv2.blur(cv2.absdiff(left, moved).astype(np.float32), (WINDOW_PX, WINDOW_PX))
        apart = np.abs(chosen - disparity)
        own = np.where(apart == 0, cost, own)
        other = np.where(apart >= PEAK_PX, np.minimum(other, cost), other)
    ratio = np.minimum((own + 1) / (other + 1), 1)  # of 8 bits: one grey value is noise
    return np.where(np.isfinite(found), ratio, np.float32(np.nan)).astype(np.float32)


def grey_mapping(left: Any, right: Any) -> GreyMapping | None:
    """The mapping to 8 bits of two images (NumPy or Dask arrays); None for images of 8 bits.

    Of images larger than ``SAMPLES`` px, every k-th pixel of every k-th row counts. Nodata (0) does
    not.
    """
    if left.ndim == 3 or left.dtype == np.uint8:
        return None
    step = math.ceil(math.sqrt(math.prod(left.shape) / SAMPLES))
    samples = [np.asarray(image[::step, ::step]) for image in (left, right)]
    if left.dtype == np.uint16:
        count = sum(np.bincount(grey.ravel(), minlength=1 << 16) for grey in samples)
        count[0] = 0
        if not count.any():
            return GreyMapping(0.0, 1.0)
        total = np.cumsum(count)
        low, high = np.searchsorted(total, total[-1] * np.array([TAIL, 1 - TAIL]))
    else:
        grey = np.concatenate([values[values != 0] for values in samples])
        if not grey.size:
            return GreyMapping(0.0, 1.0)
        low, high = np.percentile(grey, (100 * TAIL, 100 * (1 - TAIL)))
    return GreyMapping(float(low), float(max(high, low + 1e-6)))


def to_8_bits(image: NDArray[Any], mapping: GreyMapping | None) -> NDArray[np.uint8]:
    """An image [h, w] or [h, w, 3] as SGM sees it, uint8[h, w]."""
    if image.ndim == 3:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return image if mapping is None else mapping(image)


def pad(image: NDArray[np.uint8], before: int, after: int) -> NDArray[np.uint8]:
    """An image with columns added on either side, of the grey of the edge."""
    return cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE)


def _valid(
    found: NDArray[np.int16], left: NDArray[Any], right: NDArray[Any], low: int, high: int
) -> NDArray[np.float32]:
    """OpenCV's disparities in px; NaN where they are out of range, or an image has no data."""
    disparity = found.astype(np.float32) / STEP
    column = np.arange(left.shape[1], dtype=np.int32)
    match = column - ((found + STEP // 2) >> 4)
    inside = (match >= 0) & (match < right.shape[1])
    seen = np.take_along_axis(_has_data(right), np.clip(match, 0, right.shape[1] - 1), axis=1)
    good = (found >= low * STEP) & (found < high * STEP) & inside & seen & _has_data(left)
    disparity[~good] = np.nan
    return disparity


def _has_data(image: NDArray[Any]) -> NDArray[np.bool_]:
    return image != 0 if image.ndim == 2 else image.any(axis=2)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def make(name: str, kind: str, settings: Mapping[str, Any], workers: int) -> SemiGlobalMatcher:
    """The method of a configuration entry, with so many threads."""
    return called(name, SemiGlobalMatcher, {**settings, "workers": workers})
