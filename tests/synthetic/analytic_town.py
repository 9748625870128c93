"""A town of boxes on hills whose surface is a formula, and points on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyproj

from stereotruth.evaluate.surface_models.reference import BUILDING, GROUND, TREE
from stereotruth.lidar.height_raster import HeightRaster

from .exact_surface import write_heights

EPSG = 32650
WEST, NORTH, SIDE = 500_000.0, 3_300_000.0, 176.0  # m
CELL_M = 0.5
TO_WGS84 = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)


@dataclass(frozen=True)
class Town:
    """``boxes``: rows of them, none without; ``hills_m``: their amplitude; ``trees``: or none."""

    boxes: int = 4
    hills_m: float = 1.0
    trees: bool = False

    @cached_property
    def _boxes(self) -> np.ndarray:
        """Centre x, y, direction, half length, half width, height of each."""
        rng = np.random.default_rng(5)
        step = SIDE / max(self.boxes, 1)
        i, j = np.mgrid[: self.boxes, : self.boxes].reshape(2, -1)
        n = i.size
        return np.column_stack([
            (j + 0.5) * step + rng.uniform(-3, 3, n), (i + 0.5) * step + rng.uniform(-3, 3, n),
            rng.uniform(0, np.pi, n), rng.uniform(8, 13, n), rng.uniform(7, 9, n),
            rng.uniform(5, 20, n),
        ])  # fmt: skip

    def surface(
        self, x: np.ndarray, y: np.ndarray, wider_m: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Height (m) and kind at metres east and south of the corner; roofs so much wider."""
        z = 50.0 + self.hills_m * (np.sin(x / 17.0) + np.cos(y / 23.0 + 1.0))
        kind = np.full(z.shape, GROUND, np.uint8)
        if self.trees:
            on = np.hypot((x % 50.0) - 25.0, (y % 50.0) - 1.0) < 3.0
            z, kind = np.where(on, z + 6.0, z), np.where(on, TREE, kind).astype(np.uint8)
        for bx, by, angle, a, b, height in self._boxes:
            u = (x - bx) * np.cos(angle) + (y - by) * np.sin(angle)
            v = (y - by) * np.cos(angle) - (x - bx) * np.sin(angle)
            on = (np.abs(u) <= a + wider_m) & (np.abs(v) <= b + wider_m)
            top = 50.0 + self.hills_m * (np.sin(bx / 17.0) + np.cos(by / 23.0 + 1.0)) + height
            z, kind = np.where(on, top, z), np.where(on, BUILDING, kind).astype(np.uint8)
        return z, kind

    def heights(self, east: float = 0.0, north: float = 0.0, wider_m: float = 0.0) -> np.ndarray:
        """A surface model [h, w], exact at the cells' centres, moved."""
        n = round(SIDE / CELL_M)
        row, col = np.mgrid[:n, :n]
        x, y = (col + 0.5) * CELL_M - east, (row + 0.5) * CELL_M + north
        return self.surface(x, y, wider_m)[0]


def write(path: Path, heights: np.ndarray) -> Path:
    """A GeoTIFF of the town's ground."""
    return write_heights(path, heights, WEST, NORTH, CELL_M, EPSG)


class Points:
    """Points of a town, 3 cm of noise each; a :class:`.reference.Reference` as LiDAR would be."""

    name, classified = "points", True

    def __init__(self, town: Town, spacing_m: float = 0.5) -> None:
        rng = np.random.default_rng(1)
        self.spacing = spacing_m
        n = round(SIDE / spacing_m)
        i, j = np.mgrid[:n, :n].reshape(2, -1)
        x, y = ((k + rng.uniform(0.2, 0.8, k.size)) * spacing_m for k in (j, i))
        z, self.kind = town.surface(x, y)
        self.z = z + 0.03 * rng.standard_normal(z.size)
        self._of: tuple = (None, None)  # a model's file, and the places in it
        self.lon, self.lat = TO_WGS84.transform(WEST + x, NORTH - y)

    def spacing_m(self, model: HeightRaster) -> float:
        """As they were strewn."""
        del model
        return self.spacing

    def points(self, model: HeightRaster, rows: slice, cols: slice):
        """Those in a window."""
        if model.path != self._of[0]:
            self._of = model.path, model.places(self.lon, self.lat)
        x, y = self._of[1]
        dx, dy = model.cell_m
        on = (x >= cols.start * dx) & (x < cols.stop * dx)
        on &= (-y >= rows.start * dy) & (-y < rows.stop * dy)
        shift = model.to_wgs84.height_shift_m(self.lon[on], self.lat[on])
        return x[on], y[on], self.z[on] - shift, self.kind[on]
