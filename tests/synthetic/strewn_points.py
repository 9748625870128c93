"""Points strewn over a surface of known heights, and the triangles of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stereotruth.disparity.rays import Rays
from stereotruth.disparity.smooth_triangles import GroundSurface, Scale, ground_surface
from stereotruth.disparity.vertices import VertexBuilder
from stereotruth.lidar.lattice import LATTICE_M

Array = np.ndarray
FLAT = Rays(np.zeros((2, 2, 3)), (3000, 3000), 1.0)  # cells of 0.33 m at the equator
CELL_M = 0.33
NOISE_M = 0.03


class Parts(NamedTuple):
    """Triangles of the ground: corners ``x``, ``y``, ``h`` [n, 3] (m), ``area`` [n] (m²)."""

    x: Array
    y: Array
    h: Array
    area: Array


def parts(found: GroundSurface, corner: Array) -> Parts:
    """Triangles ``corner`` [n, 3] of a surface."""
    v = found.vertices
    x, y = (q[corner] / 3000 * CELL_M for q in (v.lon_q, v.lat_q))
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    return Parts(x, y, v.h_q[corner] * LATTICE_M, 0.5 * np.abs(area))


def surface_of(
    height_at: Callable[[Array, Array], Array],
    spacing: float = 1.0,
    side: float = 40.0,
    within: tuple[float, float, float, float] | None = None,
) -> GroundSurface:
    """The surface of points on a jittered grid over x, y (m); 1 px of disparity per m.

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
    builder = VertexBuilder(FLAT, (0, 0), (1_000_000, 1_000_000))
    h = np.rint(height[kept] / LATTICE_M).astype(np.int64)
    builder.add(lon, lat, h, np.full(lon.size, 2, np.uint8), np.ones(lon.size, np.uint8))
    scale = Scale.of(spacing**-2, CELL_M)
    return ground_surface(builder.built(), scale, 1.0, FLAT.cell)
