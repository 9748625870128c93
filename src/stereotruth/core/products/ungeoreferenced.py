"""Opening raster files that have no georeference, and need none: tiles, images with RPCs."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from typing import Any

import rasterio
from rasterio.errors import NotGeoreferencedWarning

from .remote_files import gdal_name

_LOCK = Lock()  # what `catch_warnings` changes, all threads share
# Formats that hold their pixels. A list, because GDAL knows others (VRT, WMS, STAC …) that fetch
# them from anywhere, whatever the ending of the file's name.
FORMATS = (
    *("GTiff", "JP2OpenJPEG", "JP2ECW", "JP2KAK", "JP2MrSID", "NITF", "PNG", "JPEG"),
    *("HFA", "ENVI", "EHdr", "PCIDSK"),
)
# Files beside an image (overviews, masks) are opened by GDAL itself: none of them from a network,
# from where it reads what a sheet names, and nothing else (:func:`.remote_files.gdal_name`).
os.environ.setdefault("CPL_VSIL_CURL_ALLOWED_FILENAME", "none")
os.environ.setdefault("GDAL_HTTP_MAX_RETRY", "4")  # of what is read by its parts
os.environ.setdefault("GDAL_HTTP_RETRY_DELAY", "1")  # s, twice as long each time


def open_raster(
    path: str | Path, mode: str = "r", *, formats: Sequence[str] = FORMATS, **options: Any
) -> Any:
    """``rasterio.open`` without its warning that a file has no georeference; for any thread.

    Files to be read have to be of one of the ``formats`` (names of GDAL's drivers). Of stand-ins
    (:mod:`.remote_files`), what they stand for is opened.
    """
    with _LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        if mode != "r":
            return rasterio.open(path, mode, **options)
        name, reading = gdal_name(path)
        # vertical parts of systems are not told otherwise; rasterio.open takes one format only
        with rasterio.Env(GTIFF_REPORT_COMPD_CS=True, **reading):
            return rasterio.DatasetReader(name, driver=list(formats), **options)
