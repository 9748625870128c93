"""The interface of stereo methods, and a standard uncertainty from two results of one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError

DisparityRange = tuple[int, int]

WINDOW_PX = 5


@runtime_checkable
class Matcher(Protocol):
    """A stereo method.

    ``margin_px``: how far around a pixel the images matter, beside the disparity range.
    """

    margin_px: int

    def __call__(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> NDArray[np.float32]:
        """Disparity x_left − x_right of each left pixel, float32[h, w] px; NaN: invalid.

        ``left`` and ``right``: [h, w] of uint16, uint8 or float32, or [h, w, 3] of uint8; of one
        shape; nodata 0. ``disparity_range``: px, first inclusive, second exclusive. ``scaling``:
        what :meth:`scaling` says of the whole images that these are parts of; None: of these.
        """
        ...

    def scaling(self, left: Any, right: Any) -> Any:
        """Statistics of whole images (NumPy or Dask arrays) that all their parts must share."""
        ...


class ImagePair(NamedTuple):
    """Two images as :class:`Matcher` takes them, and what they are called."""

    name: str
    left: NDArray[Any]
    right: NDArray[Any]


class Matched(NamedTuple):
    """A result with what it took: seconds and peak memory in MB (None: not known).

    ``uncertainty``: standard uncertainty of each disparity, float32[h, w] px, of methods that
    state one.
    """

    disparity: NDArray[np.float32]
    seconds: float | None
    memory_mb: float | None
    uncertainty: NDArray[np.float32] | None = None


@runtime_checkable
class UncertainMatcher(Matcher, Protocol):
    """A stereo method that may state the standard uncertainty of its disparities."""

    def __call__(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> NDArray[np.float32]:
        """The disparity alone."""
        return self.with_uncertainty(left, right, disparity_range, scaling)[0]

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Disparity as :class:`Matcher` has it, and its standard uncertainty [h, w] px or None."""
        ...


@runtime_checkable
class BatchMatcher(Matcher, Protocol):
    """A stereo method that is better asked for many pairs at once, and measures itself."""

    def many(
        self,
        pairs: Iterable[ImagePair],
        disparity_range: DisparityRange,
    ) -> Iterator[Matched]:
        """The results of pairs of images, in their order, each as soon as it is there."""
        ...


def called(name: str, make: Callable[..., Matcher], settings: Mapping[str, Any]) -> Matcher:
    """The method that the settings make. Raises InputError for settings that it does not take."""
    try:
        inspect.signature(make).bind(**settings)
    except TypeError as error:
        raise InputError(
            f"settings of method {name!r}: {error}",
            remedy="config/README.md lists the settings of each kind",
        ) from error
    return make(**settings)


def spread(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """Standard uncertainty [h, w] px of either of two independent disparities [h, w] px.

    The difference of the two has a √2 times larger standard deviation than each; it is taken as the
    root mean square over windows of ``WINDOW_PX`` around each pixel, where both are finite. NaN
    where the first is, or no pixel of the window has both.
    """
    import cv2  # slow to import, and most matchers have no spread

    both = np.isfinite(first) & np.isfinite(second)
    square = np.where(both, first - second, np.float32(0)).astype(np.float32) ** 2
    size = (WINDOW_PX, WINDOW_PX)
    total, count = (
        cv2.boxFilter(
            of.astype(np.float32), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        for of in (square, both)
    )
    known = np.isfinite(first) & (count > 0.5)
    sigma = np.sqrt(np.maximum(total, 0) / (2 * np.maximum(count, 1)))
    return np.where(known, sigma, np.float32(np.nan)).astype(np.float32)
