"""The interface of stereo methods, and from a configuration entry to a method.

A method is a :class:`Matcher`. Kinds of entries (``benchmark.methods.<name>``):

==============================  ====================================================================
``sgm``                         OpenCV's semi-global matching (:mod:`.sgm`)
``stereonet, psmnet, hmsmnet``  the networks (:mod:`.networks`; needs PyTorch)
``function``                    the user's own, named by ``function``: ``package.module:name``
                                (modules of the working directory are found), ``path.py:name``, or
                                the entry point ``name`` of the group ``stereotruth.methods``
``folder``                      a folder of disparities made elsewhere: scored, never run
==============================  ====================================================================

The user's function takes ``(left, right, disparity_range)`` and the entry's ``options`` as keyword
arguments, and returns the disparity as :class:`Matcher` says. What has ``scaling`` and
``margin_px`` is taken for a Matcher as it is; of a class, the options make the object.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .kinds import FOLDER, KINDS, MODULES, NETWORKS

DisparityRange = tuple[int, int]


ENTRY_POINTS = "stereotruth.methods"
SHOWN = ("kind", "label", "fine_tuned_of")  # keys of an entry that are no settings
MARGIN_PX = 128  # of a user's function that states none


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


class FunctionMethod:
    """A plain function ``(left, right, disparity_range) -> disparity`` as a Matcher."""

    def __init__(
        self, function: Callable[..., Any], margin_px: int = MARGIN_PX, name: str = "function"
    ) -> None:
        self.function = function
        self.margin_px = margin_px
        self.name = name

    def __call__(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> NDArray[np.float32]:
        """The function's disparity; raises InputError if it is none of the images' size."""
        found = self.function(left, right, disparity_range)
        disparity = np.ma.filled(np.ma.asarray(found, dtype=np.float32), np.nan)
        if disparity.shape != left.shape[:2]:
            raise InputError(
                f"method {self.name!r} returned shape {disparity.shape} for images of "
                f"{left.shape[:2]}",
                remedy="return the disparity of each pixel of the left image, [h, w]",
            )
        return disparity

    def scaling(self, left: Any, right: Any) -> None:
        """None: nothing is known of what the function does."""


def make_method(name: str, settings: Mapping[str, Any], workers: int = 1) -> Matcher:
    """The method of a configuration entry; ``workers`` are the threads that it may use.

    ``label`` (how tables call the method) and ``fine_tuned_of`` (the method whose training was
    carried on) are no settings.

    Raises InputError for an unknown kind, a function that cannot be found, and settings that the
    method does not take.
    """
    kind, options = settings.get("kind"), {k: v for k, v in settings.items() if k not in SHOWN}
    if kind in NETWORKS:
        return _module_of(kind).network_method(kind, options, workers)
    if kind == "sgm":
        make = _module_of(kind).SemiGlobalMatcher
        return _called(name, make, {**options, "workers": workers})
    if kind == "function":
        return _called(name, _function_method, {**options, "name": name})
    if kind == FOLDER:
        raise InputError(f"method {name!r} is a folder of results", remedy="take one that can run")
    raise InputError(
        f"method {name!r} is of unknown kind {kind!r}", remedy=f"take one of {', '.join(KINDS)}"
    )


def _module_of(kind: str) -> Any:
    """Imported by its name, so that code digests of one method do not hold the others' code."""
    try:
        return importlib.import_module(f"stereotruth.{MODULES[kind]}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "stereotruth":
            raise
        raise InputError(
            f"{kind} needs {error.name}, which is not installed",
            remedy="pip install '.[networks]'",
        ) from error


def _called(name: str, make: Callable[..., Matcher], settings: Mapping[str, Any]) -> Matcher:
    try:
        inspect.signature(make).bind(**settings)
    except TypeError as error:
        raise InputError(
            f"settings of method {name!r}: {error}",
            remedy="config/README.md lists the settings of each kind",
        ) from error
    return make(**settings)


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
    place, colon, attribute = function.rpartition(":")
    if not colon:
        (*found,) = entry_points(group=ENTRY_POINTS, name=function)
        if not found:
            raise InputError(
                f"no entry point {function!r} of group {ENTRY_POINTS}",
                remedy="install the package that has it, or write package.module:function",
            )
        return found[0].load()
    try:
        module = _module_of_file(Path(place)) if place.endswith(".py") else _module(place)
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise InputError(
            f"cannot import {place}: {error}",
            remedy="install it, or call the workflow from the folder that it lies in",
        ) from error
    try:
        return getattr(module, attribute)
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
