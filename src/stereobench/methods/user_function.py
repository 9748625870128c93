"""The user's own functions as stereo methods: ``function`` of an entry names one.

It is ``package.module:name`` (modules of the working directory are found), ``path.py:name``, or an
entry point of the group ``stereotruth.methods``. It takes ``(left, right, disparity_range)`` and
the entry's ``options`` as keyword arguments, and returns the disparity as :class:`matcher.Matcher`
says; or a tuple of it and of its standard uncertainty in px, [h, w] as well. What has ``scaling``
and ``margin_px`` is taken for a Matcher as it is; of a class, the options make the object.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError

from .kinds import place_of
from .matcher import DisparityRange, Matcher, UncertainMatcher, called

MARGIN_PX = 128  # of a function that states none


class FunctionMethod(UncertainMatcher):
    """A plain function ``(left, right, disparity_range) -> disparity`` as a Matcher.

    It may return a tuple of the disparity and its standard uncertainty.
    """

    def __init__(
        self, function: Callable[..., Any], margin_px: int = MARGIN_PX, name: str = "function"
    ) -> None:
        self.function = function
        self.margin_px = margin_px
        self.name = name

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The function's disparity, and its standard uncertainty if the function states one.

        Raises InputError if one of them is none of the images' size.
        """
        found = self.function(left, right, disparity_range)
        if not isinstance(found, tuple):
            return self._map(found, left), None
        if len(found) != 2:
            raise InputError(
                f"method {self.name!r} returned {len(found)} values",
                remedy="return the disparity, or a tuple of it and its standard uncertainty",
            )
        disparity, uncertainty = (self._map(values, left) for values in found)
        return disparity, uncertainty

    def _map(self, values: Any, left: NDArray[Any]) -> NDArray[np.float32]:
        of_pixels = np.ma.filled(np.ma.asarray(values, dtype=np.float32), np.nan)
        if of_pixels.shape != left.shape[:2]:
            raise InputError(
                f"method {self.name!r} returned shape {of_pixels.shape} for images of "
                f"{left.shape[:2]}",
                remedy="return the disparity of each pixel of the left image, [h, w]",
            )
        return of_pixels

    def scaling(self, left: Any, right: Any) -> None:
        """None: nothing is known of what the function does."""


def make(name: str, kind: str, settings: Mapping[str, Any], workers: int) -> Matcher:
    """The method of a configuration entry; ``workers`` are left to the user's code."""
    return called(name, _function_method, {**settings, "name": name})


def _function_method(
    name: str,
    function: str,
    margin_px: int = MARGIN_PX,
    options: Mapping[str, Any] | None = None,
) -> Matcher:
    found = _find(function)
    options = dict(options or {})
    if isinstance(found, type):
        found = found(**options)
    elif options:
        found = partial(found, **options)
    return found if isinstance(found, Matcher) else FunctionMethod(found, margin_px, name)


def _find(function: str) -> Any:
    place, attribute = place_of(function)
    try:
        module = _module_of_file(Path(place)) if place.endswith(".py") else _module(place)
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise InputError(
            f"cannot import {place}: {error}",
            remedy="install it, or call the workflow from the folder that it lies in",
        ) from error
    try:
        return attrgetter(attribute)(module)
    except AttributeError:
        raise InputError(
            f"module {place} has no {attribute!r}", remedy="name a function of the module"
        ) from None


def _module(name: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    return importlib.import_module(name)


def _module_of_file(file: Path) -> Any:
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
