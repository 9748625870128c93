"""From a configuration entry (``benchmark.methods.<name>``) to a stereo method of any range.

A method is a :class:`.matcher.Matcher`; :mod:`.kinds` lists the kinds of entries, and names the
module that makes the methods of each. Methods that see positive disparities only are given wider
images, the right one moved against the left one, and what they find is moved back
(``polarity: positive``); with ``polarity: mirrored`` both images are flipped besides, which turns
the sign of the disparity. config/README.md has the columns that are added.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError, install_extra
from stereotruth.core.products.provenance import PACKAGES

from .kinds import MOVED, TOLD, kind_of
from .matcher import BatchMatcher, DisparityRange, ImagePair, Matched, Matcher, UncertainMatcher

RIM_PX = 1
POLARITIES = ("any", "positive", "mirrored")
OUTSIDE = ("kept", "invalid")
Map = NDArray[np.float32]


def make_method(name: str, settings: Mapping[str, Any], workers: int = 1) -> Matcher:
    """The method of a configuration entry; ``workers`` are the threads that it may use.

    Raises InputError for an unknown kind, a function that cannot be found, and settings that the
    method does not take or lacks.
    """
    kind = kind_of(name, settings)
    options = {k: v for k, v in settings.items() if k not in ("kind", *TOLD, *MOVED)}
    moved = {key: settings[key] for key in MOVED if key in settings}
    if kind.module is None:
        raise InputError(f"method {name!r} is a folder of results", remedy="take one that can run")
    try:  # by its name, so that code digests of one method do not hold the others' code
        module = importlib.import_module(kind.module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in PACKAGES:
            raise
        raise InputError(
            f"{settings['kind']} needs {error.name}, which is not installed",
            remedy=install_extra(kind.extra) if kind.extra else "install it",
        ) from error
    made = module.make(name, settings["kind"], options, workers)
    return with_polarity(name, made, **moved)


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
    if outside is None:
        is_invalid = getattr(method, "invalid_outside", False)
    else:
        is_invalid = outside == "invalid"
    make = MovedBatchMethod if isinstance(method, BatchMatcher) else MovedMethod
    return make(method, mirrored=polarity == "mirrored", invalid_outside=is_invalid)


class MovedMethod(UncertainMatcher):
    """A method that sees no negative disparities, as a Matcher of any range; see the module.

    ``method``: the one that is asked; ``mirrored``: in flipped images. ``invalid_outside``:
    disparities whose match lies outside the right image become NaN.
    """

    def __init__(
        self, method: Matcher, *, mirrored: bool = False, invalid_outside: bool = False
    ) -> None:
        self._method, self._mirrored = method, mirrored
        self._invalid_outside = invalid_outside
        self.margin_px = method.margin_px
        if hasattr(method, "device"):
            self.device = method.device

    def scaling(self, left: Any, right: Any) -> Any:
        """What the method says of whole images, without the columns that are added."""
        if self._mirrored:
            left, right = left[:, ::-1], right[:, ::-1]
        return self._method.scaling(left, right)

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[Map, Map | None]:
        """The disparity, and its standard uncertainty if the method states one."""
        if scaling is None:
            scaling = self.scaling(left, right)
        asked = *self._asked(left, right, disparity_range), self._range(disparity_range), scaling
        if isinstance(self._method, UncertainMatcher):
            return self._back(*self._method.with_uncertainty(*asked), disparity_range)
        return self._back(self._method(*asked), None, disparity_range)

    def _span(self, disparity_range: DisparityRange) -> DisparityRange:
        """The range of whole disparities in the images as they are matched."""
        low, high = disparity_range
        return (1 - high, 1 - low) if self._mirrored else (low, high)

    def _range(self, disparity_range: DisparityRange) -> DisparityRange:
        """The range that the method is asked for."""
        low, high = self._span(disparity_range)
        return (low, high) if low >= 0 else (0, high - low)

    def _columns(self, disparity_range: DisparityRange) -> list[tuple[int, int]]:
        """Columns that are added before and after the left image, and the right one."""
        low, high = self._span(disparity_range)
        if low >= 0:
            return [(0, 0), (0, 0)]
        high = max(high, 0)
        return [(high - low, RIM_PX), (high, RIM_PX - low)]

    def _asked(
        self, left: NDArray[Any], right: NDArray[Any], disparity_range: DisparityRange
    ) -> Iterator[NDArray[Any]]:
        """Both images [h, w] or [h, w, 3] as the method gets them, of one shape."""
        for image, columns in zip((left, right), self._columns(disparity_range)):
            # padding copies: PyTorch takes no array that runs backwards
            flipped = image[:, ::-1] if self._mirrored else image
            yield np.pad(flipped, [(0, 0), columns, *[(0, 0)] * (image.ndim - 2)], mode="edge")

    def _back(
        self, found: Map, sigma: Map | None, disparity_range: DisparityRange
    ) -> tuple[Map, Map | None]:
        """What the method says of the left image's own pixels."""
        (before, after), _ = self._columns(disparity_range)
        disparity, sigma = (
            None if values is None else values[:, before : values.shape[1] - after]
            for values in (found, sigma)
        )
        disparity = disparity + np.float32(min(self._span(disparity_range)[0], 0))
        if self._invalid_outside:
            width = disparity.shape[1]
            match = np.arange(width) - disparity
            disparity[~((match >= -0.5) & (match < width - 0.5))] = np.nan
        if self._mirrored:
            disparity = -disparity[:, ::-1]
            sigma = None if sigma is None else sigma[:, ::-1].copy()
        return disparity, sigma


class MovedBatchMethod(MovedMethod):
    """Such a method that takes many pairs at once."""

    _method: BatchMatcher

    def many(
        self, pairs: Iterable[ImagePair], disparity_range: DisparityRange
    ) -> Iterator[Matched]:
        """The results of many pairs, in their order; see :class:`.matcher.BatchMatcher`."""
        asked = (
            ImagePair(name, *self._asked(left, right, disparity_range))
            for name, left, right in pairs
        )
        for found in self._method.many(asked, self._range(disparity_range)):
            disparity, sigma = self._back(found.disparity, found.uncertainty, disparity_range)
            yield found._replace(disparity=disparity, uncertainty=sigma)
