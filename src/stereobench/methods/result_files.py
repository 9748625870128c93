"""Disparity maps as other programs write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_disparity, refuse_large

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
    except (OSError, ValueError, TypeError, EOFError, IndexError):
        raise InputError("no image that can be read", file=file, remedy="write it anew") from None
    values[~np.isfinite(values) | (values == np.float32(nodata))] = np.nan
    return values


def _npy(file: Path) -> NDArray[Any]:
    """The array of a file of NumPy; no objects, and no larger than the file."""
    values = np.lib.format.open_memmap(file, mode="r")
    refuse_large(values.shape, file)
    return values


def _pfm(file: Path) -> NDArray[Any]:
    """A portable float map, whose rows run upwards; its scale tells the order of bytes alone."""
    with file.open("rb") as stream:
        kind, size, scale = (stream.readline(LONGEST_LINE).split() for _ in range(3))
        cols, rows = map(int, size)
        refuse_large((rows, cols), file)
        is_map = kind == [b"Pf"] and min(rows, cols) > 0 and float(scale[0])
        if not is_map or file.stat().st_size < 4 * rows * cols:
            raise ValueError("no map of one band, as large as its header says")
        data = stream.read(4 * rows * cols)
    values = np.frombuffer(data, "<f4" if float(scale[0]) < 0 else ">f4", rows * cols)
    return values.reshape(rows, cols)[::-1]
