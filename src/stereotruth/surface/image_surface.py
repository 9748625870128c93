"""A surface in the geometry of one original image, for who asks what its pixels show.

Vertices are projected as (col, row, col - disparity, row), with the disparity that a height has in
the pair of BASE_OVER_HEIGHT, by which all tolerances of the surface count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..sensor.rpc import SensorModel
from .raster import ProjectedSurface, SeenSurface
from .region import SQUARE_BITS, Region
from .scale import BASE_OVER_HEIGHT, PART
from .surface import GroundSurface
from .surface_store import Box, SurfaceStore
from .vertices import Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_RISE = 10_000  # lattice steps between two heights, for what one of them changes


@dataclass(frozen=True, eq=False)
class ImageProjection:
    """Where one image shows points: see :class:`.raster.Projection`.

    ``pixel_m``: side of a pixel on the ground.
    """

    sensor: SensorModel
    pixel_m: float

    @property
    def px_per_m(self) -> float:
        """Disparity of a metre of height."""
        return BASE_OVER_HEIGHT / self.pixel_m

    def with_rise(
        self, lon_q: Ints, lat_q: Ints, h_q: Ints, lifted: NDArray[np.bool_]
    ) -> tuple[Floats, NDArray[np.float32]]:
        """(col, row, col - disparity, row) of lattice points, and what a step of height adds."""
        xy = self._project(lon_q, lat_q, h_q)
        rise = np.empty(xy.shape, np.float32)
        higher = self._project(lon_q[lifted], lat_q[lifted], h_q[lifted] + _RISE)
        rise[:, lifted] = (higher - xy[:, lifted]) / _RISE
        return xy, rise

    def _project(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> Floats:
        height = h_q * LATTICE_M
        col, row = self.sensor.project(lon_q * LATTICE_DEG, lat_q * LATTICE_DEG, height)
        disparity = (height - float(self.sensor.rpc.height_off)) * self.px_per_m
        return np.stack([col, row, col - disparity, row])

    def seen(self, store: SurfaceStore, box: Box, rows: slice, cols: slice) -> SeenSurface | None:
        """What the pixels of a window see; None where the surface has nothing.

        ``box``: (west, south, east, north) in degrees of all ground that they may show.
        """
        surface = surface_in_box(store, box)
        if surface is None:
            return None
        shape = rows.stop - rows.start, cols.stop - cols.start
        projected = ProjectedSurface.of(surface, self, (rows.start, cols.start))
        return projected.seen(shape, self.px_per_m)


def surface_in_box(store: SurfaceStore, box: Box) -> GroundSurface | None:
    """The triangles of a store in a box (west, south, east, north, degrees); None without any."""
    blocks = store.blocks(box)
    if not blocks:
        return None
    around = store.window(blocks)
    surface = around.surface(_region(around.vertices, store.scale.cell, box))
    return surface if surface.vertices.x.size else None


def _region(vertices: Vertices, cell: tuple[int, int], box: Box) -> Region:
    """The squares of a box from the vertices' origin on."""
    size = [int(values.max()) >> SQUARE_BITS for values in (vertices.y, vertices.x)]
    squares = np.zeros((size[0] + 1, size[1] + 1), np.bool_)
    part = []
    for low, high, q, at, side in (
        (box[1], box[3], vertices.lat_q[0], vertices.y[0], cell[1]),
        (box[0], box[2], vertices.lon_q[0], vertices.x[0], cell[0]),
    ):
        first, last = (
            int(np.floor((edge / LATTICE_DEG - q) / side * PART + at)) >> SQUARE_BITS
            for edge in (low, high)
        )
        part.append(slice(max(first - 1, 0), max(last + 2, 0)))
    squares[part[0], part[1]] = True
    return Region(squares)
