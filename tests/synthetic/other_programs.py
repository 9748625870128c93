"""What others open rasters with, by name: functions from a path to the values [h, w] or [h, w, 3].

Pillow has 8 bits at most of each colour, and gives those of most weight.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import rioxarray
from PIL import Image


def _last(bands: np.ndarray) -> np.ndarray:
    return bands[0] if len(bands) == 1 else np.moveaxis(bands, 0, -1)


def _opencv(path: Path) -> np.ndarray:
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert values is not None, f"OpenCV cannot read {path}"
    return values if values.ndim == 2 else values[..., ::-1]


def _pillow(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def _gdal(path: Path) -> np.ndarray:
    with rasterio.open(path) as dataset:
        return _last(dataset.read())


def _rioxarray(path: Path) -> np.ndarray:
    with rioxarray.open_rasterio(path) as array:
        return _last(array.values)


def _tifffile(path: Path) -> np.ndarray:
    reason = "tifffile is not installed"
    return pytest.importorskip("tifffile", reason=reason).imread(path)


PROGRAMS = {
    "OpenCV": _opencv,
    "Pillow": _pillow,
    "GDAL": _gdal,
    "rioxarray": _rioxarray,
    "tifffile": _tifffile,
}
