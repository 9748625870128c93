"""Georeferenced quick looks of a scene: north-up GeoTIFFs of 8 bits, for maps.

The left image and its labels, thinned, are laid on the ground at the heights of the labels around:
not an orthophoto, but a map that fits to some pixels of its own.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pyproj
import rasterio
import zarr
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from scipy.ndimage import distance_transform_edt

from ..pages import pictures
from .scene_stores import SceneStores

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

LONGEST_PX = 1000  # of a picture
SMOOTH = 5  # px over which heights are smoothed
ROWS = 1024  # read at a time


def write_ground_looks(folder: Path, source: SceneStores) -> list[Path]:
    """Write ``<scene>_left.tif`` and ``<scene>_disparity.tif`` to a folder that exists.

    UTM on WGS 84; red, green, blue and alpha; disparities in colour as on the contact sheet.
    """
    scale = max(1, math.ceil(max(source.left.shape) / LONGEST_PX))
    disparity, height = _thin(source.disparity, scale), _thin(source.height, scale)
    bands = source.colours[0] if source.colours else (source.left,)
    image = np.stack([_thin(band, scale) for band in bands], axis=-1)
    known = np.isfinite(height)
    if not known.any():
        return []
    y, x = (index[known] * float(scale) for index in np.indices(height.shape))
    lon, lat = source.model.epipolar_to_ground(x, y, height[known].astype(np.float64))
    crs = _utm(float(np.mean(lon)), float(np.mean(lat)))
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east, north = to_map.transform(lon, lat)
    surface, origin, step = _heights(east, north, height[known], _spacing(known, east, north))
    rows, cols = np.indices(surface.shape)
    ground = to_map.transform(
        origin[0] + (cols + 0.5) * step, origin[1] - (rows + 0.5) * step, direction="INVERSE"
    )
    at = source.model.ground_to_epipolar(*(v.ravel() for v in ground), surface.ravel())[:2]
    x, y = (value.reshape(surface.shape) / scale for value in at)
    inside = (x >= 0) & (y >= 0) & (x <= height.shape[1] - 1) & (y <= height.shape[0] - 1)
    j, i = (np.where(inside, np.rint(value), 0).astype(int) for value in (y, x))
    left = np.stack([_linear(band, y, x) for band in np.moveaxis(image, -1, 0)], axis=-1)
    left[_linear((image != 0).any(axis=-1), y, x) < 1.0 - 1e-6] = 0
    labels = np.where(inside, disparity[j, i], np.nan)
    made = []
    for name, picture, alpha in (
        ("left", _coloured(pictures.stretch(left)), (left != 0).any(axis=-1)),
        ("disparity", pictures.colours(labels), np.isfinite(labels)),
    ):
        made.append(folder / f"{source.scene}_{name}.tif")
        _write(made[-1], picture, alpha, crs, origin, step)
    return made


def _coloured(picture: Picture) -> Picture:
    """Three bands of one or three."""
    return np.broadcast_to(picture, (*picture.shape[:2], 3))


def _thin(array: zarr.Array, scale: int) -> NDArray:
    """Every ``scale``-th pixel of a grid."""
    rows = ROWS // scale * scale
    parts = (array[r : r + rows][::scale, ::scale] for r in range(0, array.shape[0], rows))
    return np.concatenate(list(parts))


def _utm(lon: float, lat: float) -> pyproj.CRS:
    zone = min(int((lon + 180.0) // 6.0) + 1, 60)
    return pyproj.CRS.from_epsg((32600 if lat >= 0 else 32700) + zone)


def _spacing(known: NDArray[np.bool_], east: Floats, north: Floats) -> float:
    """Metres between neighbouring pixels of the thinned grid, by the median."""
    at = np.full((2, *known.shape), np.nan)
    at[:, known] = east, north
    steps = [np.hypot(*np.diff(at, axis=axis)) for axis in (1, 2)]
    found = np.concatenate([s[np.isfinite(s)] for s in steps])
    return float(np.median(found)) if found.size else 1.0


def _heights(
    east: Floats, north: Floats, height: Floats, step: float
) -> tuple[Floats, tuple[float, float], float]:
    """Heights of a map's pixels, its upper-left corner and its pixel size, all in m."""
    span = max(np.ptp(east), np.ptp(north))
    step = max(step, span / LONGEST_PX)
    origin = math.floor(east.min() / step) * step, math.ceil(north.max() / step) * step
    cols = ((east - origin[0]) / step).astype(int)
    rows = ((origin[1] - north) / step).astype(int)
    shape = rows.max() + 1, cols.max() + 1
    where = rows * shape[1] + cols
    count = np.bincount(where, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(where, height, minlength=shape[0] * shape[1]).reshape(shape)
    nearest = distance_transform_edt(count == 0, return_distances=False, return_indices=True)
    filled = (total / np.maximum(count, 1))[tuple(nearest)]
    low = filled.min()  # in 32 bits, heights are to be small
    smooth = cv2.medianBlur((filled - low).astype(np.float32), SMOOTH)
    return smooth.astype(np.float64) + low, origin, step


def _linear(band: NDArray, y: Floats, x: Floats) -> NDArray[np.float32]:
    """Bilinear values; beyond the border 0 has a say."""
    at = x.astype(np.float32), y.astype(np.float32)
    return cv2.remap(band.astype(np.float32), *at, cv2.INTER_LINEAR)


def _write(
    path: Path,
    picture: Picture,
    alpha: NDArray[np.bool_],
    crs: pyproj.CRS,
    origin: tuple[float, float],
    step: float,
) -> None:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=picture.shape[1],
        height=picture.shape[0],
        count=4,
        dtype="uint8",
        crs=f"EPSG:{crs.to_epsg()}",
        transform=rasterio.Affine(step, 0.0, origin[0], 0.0, -step, origin[1]),
        photometric="RGB",
        alpha="YES",
        compress="deflate",
        predictor=2,
        tiled=True,
    ) as dataset:
        dataset.write(np.moveaxis(picture, -1, 0), [1, 2, 3])
        dataset.write(alpha.astype(np.uint8) * 255, 4)
        dataset.colorinterp = (
            ColorInterp.red,
            ColorInterp.green,
            ColorInterp.blue,
            ColorInterp.alpha,
        )
