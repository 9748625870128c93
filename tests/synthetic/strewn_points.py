"""Points strewn over a surface of known heights, and the triangles of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stereotruth.lidar.lattice import LATTICE_M
from stereotruth.surface.scale import SurfaceScale
from stereotruth.surface.surface import GroundSurface, ground_surface
from stereotruth.surface.vertices import VertexBuilder

Array = np.ndarray
CELL = (3000, 3000)  # lattice steps
CELL_M = 0.33  # at the equator
NOISE_M = 0.03


class Parts(NamedTuple):
    """Triangles of the ground: corners ``x``, ``y``, ``h`` [n, 3] (m), ``area`` [n] (m²)."""

    x: Array
    y: Array
    h: Array
    area: Array


def scale_of(points_per_m2: float, cell: tuple[int, int] = CELL) -> SurfaceScale:
    """Of points of a density; a px of disparity is 1.1 m of height."""
    return SurfaceScale.of(points_per_m2, cell)


def parts(surface: GroundSurface, corner: Array) -> Parts:
    """Triangles ``corner`` [n, 3] of a surface."""
    v = surface.vertices
    x, y = (q[corner] / 3000 * CELL_M for q in (v.lon_q, v.lat_q))
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    return Parts(x, y, v.h_q[corner] * LATTICE_M, 0.5 * np.abs(area))


def surface_of(
    height_at: Callable[[Array, Array], Array],
    spacing: float = 1.0,
    side: float = 40.0,
    within: tuple[float, float, float, float] | None = None,
) -> GroundSurface:
    """The surface of points on a jittered grid over x, y (m).

    ``within``: of the points in a box (x, y from, x, y to) alone, with the places of all.
    """
    rng = np.random.default_rng(0)
    x, y = np.mgrid[0:side:spacing, 0:side:spacing].reshape(2, -1)
    x, y = (c + rng.uniform(-0.3, 0.3, c.size) * spacing + 5.0 for c in (x, y))
    height = height_at(x, y) + rng.normal(0.0, NOISE_M, x.size)
    kept = np.ones(x.size, np.bool_)
    if within is not None:
        kept = (x > within[0]) & (y > within[1]) & (x < within[2]) & (y < within[3])
    lon, lat = (np.rint(c[kept] / CELL_M * 3000).astype(np.int64) for c in (x, y))
    scale = scale_of(spacing**-2)
    builder = VertexBuilder(scale, (0, 0), (1_000_000, 1_000_000))
    h = np.rint(height[kept] / LATTICE_M).astype(np.int64)
    classes, returns = np.full(lon.size, 2, np.uint8), np.ones(lon.size, np.uint8)
    builder.add(lon, lat, h, classes, returns, np.zeros(lon.size, np.uint16))
    return ground_surface(builder.built(), scale)
