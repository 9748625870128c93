"""Surface models as GeoTIFFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from .las import SOUTH, WEST

UTM = "EPSG:32650"


def write_raster(file: Path, heights: np.ndarray, cell: float = 0.5, **profile) -> Path:
    """A GeoTIFF of heights [rows, cols], its upper left corner 100 m north of SOUTH."""
    options = {
        "driver": "GTiff",
        "height": heights.shape[-2],
        "width": heights.shape[-1],
        "count": 1,
        "dtype": heights.dtype,
        "crs": UTM,
        "transform": from_origin(WEST, SOUTH + 100, cell, cell),
        "nodata": -9999,
    } | profile
    units, scales = options.pop("units", None), options.pop("scales", None)
    with rasterio.open(file, "w", **options) as raster:
        if units:
            raster.units = (units,)
        if scales:
            raster.scales, raster.offsets = ((value,) for value in scales)
        raster.write(heights if heights.ndim == 3 else heights[None])
    return file
