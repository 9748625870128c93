"""Surface models of synthetic cities, exact at the centres of their cells, as GeoTIFF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import rasterio
from rasterio.transform import from_origin

from stereocities.cities import CitySpec, SceneSpec
from stereocities.layout import half_size
from stereocities.surfaces import IN_LIDAR
from stereocities.world import top_surface


def grid_of(city: CitySpec, scene: SceneSpec, cell_m: float, inset_m: float = 10.0):
    """(west, north, shape) in the city's UTM zone of a square in the middle of a scene."""
    to_utm = pyproj.Transformer.from_crs(4326, city.epsg, always_xy=True)
    east, north = to_utm.transform(city.lon, city.lat)
    east, north = east + scene.centre_m[0], north + scene.centre_m[1]
    half = float(half_size(scene).min()) - inset_m
    size = round(2 * half / cell_m)
    return east - half, north + half, (size, size)


def exact_heights(
    city: CitySpec, scene: SceneSpec, cell_m: float, view: int = IN_LIDAR, **move: float
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Heights (m), kinds, and west, north of the grid; ``east``, ``north``: move the surface (m).

    ``view``: the world that the LiDAR sees, or that of the images.
    """
    west, top, shape = grid_of(city, scene, cell_m)
    row, col = np.mgrid[: shape[0], : shape[1]]
    x = west + (col + 0.5) * cell_m - move.get("east", 0.0)
    y = top - (row + 0.5) * cell_m - move.get("north", 0.0)
    to_wgs84 = pyproj.Transformer.from_crs(city.epsg, 4326, always_xy=True)
    return (*top_surface(city, *to_wgs84.transform(x, y), view), west, top)


def write_heights(
    path: Path, heights: np.ndarray, west: float, north: float, cell_m: float, crs: object
) -> Path:
    """A GeoTIFF with nodata −9999."""
    values = np.where(np.isfinite(heights), heights, -9999.0).astype(np.float32)
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": -9999.0, "crs": crs}
    size = {"height": values.shape[0], "width": values.shape[1]}
    transform = from_origin(west, north, cell_m, cell_m)
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(path, "w", transform=transform, **profile, **size) as target:
        target.write(values, 1)
    return path
