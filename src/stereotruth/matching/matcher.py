"""The interface of stereo methods."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

DisparityRange = tuple[int, int]


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
