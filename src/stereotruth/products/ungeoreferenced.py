"""Opening raster files that have no georeference, and need none: tiles, images with RPCs."""

from __future__ import annotations

import warnings
from pathlib import Path
from threading import Lock
from typing import Any

import rasterio
from rasterio.errors import NotGeoreferencedWarning

_LOCK = Lock()  # what `catch_warnings` changes, all threads share


def open_raster(path: str | Path, mode: str = "r", **options: Any) -> Any:
    """``rasterio.open`` without its warning that a file has no georeference; for any thread."""
    with _LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return rasterio.open(path, mode, **options)
