"""What others open rasters with, by name: functions from a path to the values [h, w]."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import rioxarray
from PIL import Image


def _opencv(path: Path) -> np.ndarray:
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert values is not None, f"OpenCV cannot read {path}"
    return values


def _pillow(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def _gdal(path: Path) -> np.ndarray:
    with rasterio.open(path) as dataset:
        return dataset.read(1)


def _rioxarray(path: Path) -> np.ndarray:
    with rioxarray.open_rasterio(path) as array:
        return array.values[0]


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
