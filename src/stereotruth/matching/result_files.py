"""Disparity maps as other programs write them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..products.rasters import read_disparity

SUFFIXES = (".tif", ".tiff", ".npy", ".pfm")


def read_result(file: Path, nodata: float = np.nan) -> NDArray[np.float32]:
    """A disparity map, float32[h, w] px; NaN where it is nodata (given or tagged) or not finite.

    Raises InputError if it cannot be read.
    """
    if file.suffix in (".tif", ".tiff"):
        return read_disparity(file, nodata)
    try:
        values = np.load(file) if file.suffix == ".npy" else cv2.imread(str(file), -1)
    except (OSError, ValueError, EOFError):
        values = None
    if values is None:
        raise InputError("no image that can be read", file=file, remedy="write it anew")
    values = values.astype(np.float32)
    values[~np.isfinite(values) | (values == np.float32(nodata))] = np.nan
    return values
