"""Methods that see positive disparities only, as methods of any range: ``polarity: positive``.

Most networks look for disparities x_left − x_right from 0 upwards, as ordinary stereo cameras have
them; satellite pairs have both signs. For a range [low, high) with low < 0, the right image is
moved by low columns against the left one, so that every disparity is larger by −low and lies in
[0, high − low); what the method finds is moved back. A range without negative disparities is left
as it is.

The images are widened rather than cut, with the grey of their edges: each row goes on with its last
pixel, as most networks pad their input. The left image gets high − low columns before its first one
(−low if high is not positive: high is then taken as 0), so that the match of each of its pixels
lies in the widened right image at every disparity of the range, and methods that compute no pixel
whose range of matches leaves the right image (OpenCV's) compute all of them. The right image gets
max(high, 0) columns before, and −low after. Both get one more after that (:data:`RIM_PX`), since
such methods know no gradient in the last column. Columns that were added are cut from the result.

So a method that looks at windows of the images says the same of every pixel, to the rims, whether
it is moved or sees both signs by itself. One whose paths or layers run across the whole width
begins them one column further right: OpenCV's SGM of positive disparities differs from that of both
signs in up to one pixel of a hundred, most near the rims.

What the method says of pixels whose match lies in such columns, outside the right image, is kept:
networks say something of every pixel, with a negative range as with a positive one. Methods that
leave these pixels out cannot do so here, since they do not see where the image ends; theirs become
NaN with ``outside: invalid`` (SGM has it so by itself).

``polarity: mirrored`` is for pairs whose disparity falls with height, and methods that learned
relief from cameras whose disparity grows with it. Both images are flipped from left to right, each
in its place: x becomes w − 1 − x, so that the disparity becomes −d, still of the left image's
pixels. The method is asked as with ``positive`` in [1 − high, 1 − low), and its result is flipped
back and changes sign. (Images that are exchanged besides keep the sign of d, and their disparities
are those of the right image's pixels.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError

from .matcher import BatchMatcher, DisparityRange, ImagePair, Matched, Matcher, UncertainMatcher

RIM_PX = 1
POLARITIES = ("any", "positive", "mirrored")
OUTSIDE = ("kept", "invalid")


def widened(image: NDArray[Any], before: int, after: int) -> NDArray[Any]:
    """An image [h, w] or [h, w, 3] with columns added on either side, of the grey of the edge."""
    more = [(0, 0), (before, after), *[(0, 0)] * (image.ndim - 2)]
    return np.pad(image, more, mode="edge")


class PositiveMethod(UncertainMatcher):
    """A method that sees no negative disparities, as a Matcher of any range.

    ``method``: the one that is asked. ``invalid_outside``: disparities whose match lies outside the
    right image become NaN.
    """

    def __init__(self, method: Matcher, invalid_outside: bool = False) -> None:
        self._method = method
        self._invalid_outside = invalid_outside
        self.margin_px = method.margin_px
        if hasattr(method, "device"):
            self.device = method.device

    def scaling(self, left: Any, right: Any) -> Any:
        """What the method says of whole images, without the columns that are added."""
        return self._method.scaling(left, right)

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The disparity, and its standard uncertainty if the method states one."""
        if scaling is None:
            scaling = self._method.scaling(left, right)
        moved = _moved(left, right, disparity_range)
        seen = _seen(disparity_range)
        if isinstance(self._method, UncertainMatcher):
            found, sigma = self._method.with_uncertainty(*moved, seen, scaling)
        else:
            found, sigma = self._method(*moved, seen, scaling), None
        return self._back(found, disparity_range), _cut(sigma, disparity_range)

    def _back(
        self, found: NDArray[np.float32], disparity_range: DisparityRange
    ) -> NDArray[np.float32]:
        low, _ = disparity_range
        disparity = _cut(found, disparity_range) + np.float32(min(low, 0))
        if self._invalid_outside:
            width = disparity.shape[1]
            match = np.arange(width) - disparity
            disparity[~((match >= -0.5) & (match < width - 0.5))] = np.nan
        return disparity


class PositiveBatchMethod(PositiveMethod):
    """Such a method that takes many pairs at once."""

    _method: BatchMatcher

    def many(
        self,
        pairs: Iterable[ImagePair],
        disparity_range: DisparityRange,
    ) -> Iterator[Matched]:
        """The results of many pairs, in their order; see :class:`matcher.BatchMatcher`."""
        moved = (
            ImagePair(name, *_moved(left, right, disparity_range)) for name, left, right in pairs
        )
        for found in self._method.many(moved, _seen(disparity_range)):
            yield found._replace(
                disparity=self._back(found.disparity, disparity_range),
                uncertainty=_cut(found.uncertainty, disparity_range),
            )


class MirroredMethod(UncertainMatcher):
    """A method that is given both images flipped from left to right, as a Matcher.

    ``method``: the one that is asked, of any range.
    """

    def __init__(self, method: UncertainMatcher) -> None:
        self._method = method
        self.margin_px = method.margin_px
        if hasattr(method, "device"):
            self.device = method.device

    def scaling(self, left: Any, right: Any) -> Any:
        """What the method says of whole images."""
        return self._method.scaling(left[:, ::-1], right[:, ::-1])

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The disparity, and its standard uncertainty if the method states one."""
        found, sigma = self._method.with_uncertainty(
            flipped(left), flipped(right), _negated(disparity_range), scaling
        )
        return -flipped(found), None if sigma is None else flipped(sigma)


class MirroredBatchMethod(MirroredMethod):
    """Such a method that takes many pairs at once."""

    _method: PositiveBatchMethod

    def many(
        self,
        pairs: Iterable[ImagePair],
        disparity_range: DisparityRange,
    ) -> Iterator[Matched]:
        """The results of many pairs, in their order; see :class:`matcher.BatchMatcher`."""
        turned = (ImagePair(name, flipped(left), flipped(right)) for name, left, right in pairs)
        for found in self._method.many(turned, _negated(disparity_range)):
            sigma = found.uncertainty
            yield found._replace(
                disparity=-flipped(found.disparity),
                uncertainty=None if sigma is None else flipped(sigma),
            )


def flipped(image: NDArray[Any]) -> NDArray[Any]:
    """An image [h, w] or [h, w, 3] with its columns from right to left."""
    return image[:, ::-1].copy()  # no view: PyTorch takes no array that runs backwards


def _negated(disparity_range: DisparityRange) -> DisparityRange:
    """The range of −d for whole disparities d of a range."""
    low, high = disparity_range
    return 1 - high, 1 - low


def _added(disparity_range: DisparityRange) -> tuple[tuple[int, int], tuple[int, int]]:
    """Columns before and after the left image, and the right one."""
    low, high = disparity_range
    if low >= 0:
        return (0, 0), (0, 0)
    high = max(high, 0)
    return (high - low, RIM_PX), (high, RIM_PX - low)


def _cut(
    values: NDArray[np.float32] | None, disparity_range: DisparityRange
) -> NDArray[np.float32] | None:
    """What a method says of the widened left image, without the columns that were added."""
    if values is None:
        return None
    (before, after), _ = _added(disparity_range)
    return values[:, before : values.shape[1] - after]


def _moved(
    left: NDArray[Any], right: NDArray[Any], disparity_range: DisparityRange
) -> tuple[NDArray[Any], NDArray[Any]]:
    """The widened images, of one shape."""
    of_left, of_right = _added(disparity_range)
    return widened(left, *of_left), widened(right, *of_right)


def _seen(disparity_range: DisparityRange) -> DisparityRange:
    """The range that the method is asked for."""
    low, high = disparity_range
    return (low, high) if low >= 0 else (0, high - low)


def with_polarity(
    name: str, method: Matcher, polarity: str = "any", outside: str | None = None
) -> Matcher:
    """The method of an entry with these keys (``outside`` None: as the method has it).

    Raises InputError for other values, and for ``outside`` of a method that is not moved.
    """
    for key, value, known in (
        ("polarity", polarity, POLARITIES),
        ("outside", outside, (*OUTSIDE, None)),
    ):
        if value not in known:
            raise InputError(
                f"method {name!r}: {key} is {value!r}",
                remedy=f"take one of {', '.join(filter(None, known))}",
            )
    if polarity == "any":
        if outside is not None:
            raise InputError(
                f"method {name!r} has outside without polarity: positive or mirrored",
                remedy="take outside away, or add the polarity",
            )
        return method
    invalid = outside == "invalid" or (
        outside is None and getattr(method, "invalid_outside", False)
    )
    is_batch = isinstance(method, BatchMatcher)
    made = (PositiveBatchMethod if is_batch else PositiveMethod)(method, invalid)
    if polarity == "positive":
        return made
    return (MirroredBatchMethod if is_batch else MirroredMethod)(made)
