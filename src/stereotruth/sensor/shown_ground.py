"""The ground that images of a site show, by their RPCs as they were delivered.

No control point has a say in it, so that what is made for the ground of a site stays as it is when
one is edited. Such RPCs are off by some ten pixels, and the frames are taken wider by SPARE_PX.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.errors import RasterioError

from ..core.errors import InputError
from ..core.products.rasters import open_raster
from .rpc import SensorModel
from .rpc_files import read_rpc

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SPARE_PX = 64.0


@dataclass(frozen=True, eq=False)
class GroundOfImages:
    """Sensor models of images, one at least, and their ``sizes`` (cols, rows) px."""

    sensors: Sequence[SensorModel]
    sizes: Sequence[tuple[int, int]]

    @classmethod
    def open(cls, images: Sequence[str | Path]) -> GroundOfImages:
        """Of image files with RPCs. Raises InputError if one cannot be read."""
        sensors, sizes = [], []
        for image in map(Path, images):
            sensors.append(SensorModel(read_rpc(image)))
            try:
                with open_raster(image) as dataset:
                    sizes.append((dataset.width, dataset.height))
            except RasterioError as error:
                raise InputError(
                    f"cannot be opened as an image ({error})", file=image, remedy="check the file"
                ) from None
        return cls(sensors, sizes)

    @property
    def pixel_deg(self) -> tuple[float, float]:
        """(lon, lat) size in degrees of a square on the ground, of the area of a pixel in the
        middle of the finest image.

        Raises InputError if an RPC reaches no ground there.
        """
        pixels = [_pixel_deg(*image) for image in zip(self.sensors, self.sizes)]
        return min(pixels, key=lambda pixel: pixel[::-1])

    def shows(self, lon: Floats, lat: Floats, height: Floats) -> Bools:
        """Whether an image shows places [n] (degrees, degrees, m)."""
        out = np.zeros(lon.size, np.bool_)
        for sensor, size in zip(self.sensors, self.sizes):
            col, row = sensor.project(lon, lat, height)
            with np.errstate(invalid="ignore"):
                out |= _inside(col, row, col, row, size)
        return out

    def box(self, heights: tuple[float, float]) -> tuple[float, float, float, float]:
        """West, south, east, north (degrees) of what the images show between two heights, m."""
        places = []
        for sensor, (cols, rows) in zip(self.sensors, self.sizes):
            col, row = np.meshgrid([0.0, cols / 2, cols - 1.0], [0.0, rows / 2, rows - 1.0])
            places += [sensor.localize(col.ravel(), row.ravel(), height) for height in heights]
        lon, lat = np.concatenate(places, axis=1)
        ends = np.nanmin(lon), np.nanmin(lat), np.nanmax(lon), np.nanmax(lat)
        return tuple(map(float, ends))

    def may_show(self, boxes: Floats) -> Bools:
        """Whether an image may show something of boxes [n, 6] (west, south, lowest, east, north,
        highest; degrees, m)."""
        out = np.zeros(len(boxes), np.bool_)
        corners = [
            boxes[:, [3 * i, 3 * j + 1, 3 * k + 2]]
            for i in range(2)
            for j in range(2)
            for k in range(2)
        ]
        places = np.stack(corners, axis=1).reshape(-1, 3)
        for sensor, size in zip(self.sensors, self.sizes):
            col, row = (v.reshape(-1, 8) for v in sensor.project(*places.T))
            edges = col.min(axis=1), row.min(axis=1), col.max(axis=1), row.max(axis=1)
            with np.errstate(invalid="ignore"):
                out |= _inside(edges[0], edges[1], edges[2], edges[3], size)
        return out


def _inside(
    left: Floats, top: Floats, right: Floats, bottom: Floats, size: tuple[int, int]
) -> Bools:
    """Which boxes [n] (px) touch a frame."""
    across = (right >= -SPARE_PX) & (left <= size[0] - 1 + SPARE_PX)
    return across & (bottom >= -SPARE_PX) & (top <= size[1] - 1 + SPARE_PX)


def _pixel_deg(sensor: SensorModel, size: tuple[int, int]) -> tuple[float, float]:
    col, row = size[0] / 2, size[1] / 2
    height = float(sensor.rpc.height_off)
    lon, lat = sensor.localize([col, col + 1, col], [row, row, row + 1], height)
    if not np.isfinite(lon).all():
        raise InputError(
            "the RPC reaches no ground in the middle of the image",
            remedy="check that the RPC belongs to the image",
        )
    shrink = float(np.cos(np.radians(lat[0])))
    east, north = (lon[1:] - lon[0]) * shrink, lat[1:] - lat[0]
    side = float(np.sqrt(abs(east[0] * north[1] - east[1] * north[0])))
    return side / shrink, side
