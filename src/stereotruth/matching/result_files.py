"""Disparity maps as other programs write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..products.rasters import read_disparity, refuse_large

LONGEST_LINE = 100  # of the header of a portable float map
SUFFIXES = (".tif", ".tiff", ".npy", ".pfm")


def read_result(file: Path, nodata: float = np.nan) -> NDArray[np.float32]:
    """A disparity map, float32[h, w] px; NaN where it is nodata (given or tagged) or not finite.

    Raises InputError if it cannot be read.
    """
    if file.suffix in (".tif", ".tiff"):
        return read_disparity(file, nodata)
    try:
        values = (_npy if file.suffix == ".npy" else _pfm)(file).astype(np.float32)
    except InputError:
        raise
    except (OSError, ValueError, TypeError, EOFError, cv2.error):
        raise InputError("no image that can be read", file=file, remedy="write it anew") from None
    values[~np.isfinite(values) | (values == np.float32(nodata))] = np.nan
    return values


def _npy(file: Path) -> NDArray[Any]:
    """The array of a file of NumPy; no objects, and no larger than the file."""
    values = np.lib.format.open_memmap(file, mode="r")
    refuse_large(values.shape, file)
    return values


def _pfm(file: Path) -> NDArray[Any]:
    """A portable float map, which is as large as its header says."""
    with file.open("rb") as stream:
        kind, size = (stream.readline(LONGEST_LINE).split() for _ in range(2))
    cols, rows = map(int, size)
    refuse_large((rows, cols), file)
    bands = {b"Pf": 1, b"PF": 3}[kind[0]] if kind and kind[0] in (b"Pf", b"PF") else 0
    if not bands or min(rows, cols) < 1 or file.stat().st_size < 4 * bands * rows * cols:
        raise ValueError("not as large as its header says")
    values = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError("no image")
    return values
