"""What of both images lies in the shadow that the LiDAR's surface casts.

The sun sees the surface from one direction, like a camera that is far away: what it does not see
lies in shadow. So the surface is rasterised into the view of the sun, where what is highest is
nearest, and into both images; a pixel lies in shadow where something is higher than it at its
position in the view of the sun, or where its triangle turns away from the sun (eq. 18 of
docs/explanation/surface.md).

The view of the sun is a lattice over the ground that no window moves, and each block of the surface
is read of which a shadow may fall into the window, however far off. So no block of the grid changes
a shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.sun import toward_sun
from ..kernels import kernel
from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..numerics.degrees import exact_metres_per_degree
from ..numerics.triangles import plane_slopes
from ..surface.surface_store import Block, SurfaceStore
from ..surface.vertices import Vertices
from .facet_raster import raster_facets
from .image_patches import Patch
from .view_geometry import ViewGeometry
from .visibility import ProjectedSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

ABOVE_M = 0.5  # what is higher than a pixel by less is the surface itself


@dataclass(frozen=True)
class SunView:
    """The ground as a sun sees it.

    A position of lattice coordinates (lon, lat) and height h lies at (lon, lat) / ``cell`` −
    ``shift`` h, cells: there its shadow would fall at height 0. ``cell``: (lon, lat), lattice
    steps; ``shift``: (lon, lat), cells per lattice step of height.
    """

    cell: tuple[int, int]
    shift: tuple[float, float]

    @classmethod
    def of(cls, sun: tuple[float, float], model: ViewGeometry, cell: tuple[int, int]) -> SunView:
        """Of a ``sun`` (azimuth, elevation, degrees) over the middle of an epipolar grid."""
        rows, cols = model.shape
        height = float(model.reference_height)
        middle = np.array([cols / 2.0]), np.array([rows / 2.0]), np.array([height])
        _, lat = model.epipolar_to_ground(*middle)
        east, north, up = toward_sun(*sun)
        degrees = np.array([east, north]) / up / exact_metres_per_degree(float(lat[0]), height)
        cells = degrees * LATTICE_M / LATTICE_DEG / np.array(cell)
        return cls(cell, tuple(np.round(cells, 15).tolist()))

    def position(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> Floats:
        """[2, n], cells, of lattice coordinates [n]."""
        plan = (q / side for q, side in zip((lon_q, lat_q), self.cell))
        return np.stack([at - shift * h_q for at, shift in zip(plan, self.shift)])

    def _box(self, blocks: Sequence[Block]) -> Floats:
        """Least and greatest position [2, 2] of blocks."""
        west, south, east, north = np.array([block.box for block in blocks]).T
        corners = [
            self.position(lon, lat, h)
            for lon in (west, east)
            for lat in (south, north)
            for h in np.array([block.heights for block in blocks]).T
        ]
        return np.stack([np.min(corners, axis=(0, 2)), np.max(corners, axis=(0, 2))])

    def casters(self, blocks: Sequence[Block], every: Sequence[Block]) -> tuple[Block, ...]:
        """Of ``every`` block those that may cast a shadow on some ``blocks``."""
        if not blocks:
            return ()
        low, high = self._box(blocks)
        lowest = min(block.heights[0] for block in blocks)
        out = []
        for block in every:
            least, most = self._box([block])
            if (least <= high).all() and (most >= low).all() and block.heights[1] >= lowest:
                out.append(block)
        return tuple(out)


class _Tops(NamedTuple):
    """Greatest height ``z`` (m) [rows, cols] at each cell of a sun's view from (row, col) ``first``
    on, −∞ for none."""

    z: Floats
    first: tuple[int, int]


def _triangles(arrays: dict[str, NDArray]) -> Steps:
    return np.concatenate([arrays["facet"], arrays["whole"], arrays["top"]])


def _tops(store: SurfaceStore, blocks: Sequence[Block], view: SunView, positions: Floats) -> _Tops:
    """Of the surface's ``blocks``, around the ``positions`` [2, n]; one block after another."""
    low = np.floor(positions.min(axis=1)).astype(np.int64)
    high = np.ceil(positions.max(axis=1)).astype(np.int64)
    cols, rows = (high - low + 1).tolist()
    z, first = np.full((rows, cols), -np.inf), (int(low[1]), int(low[0]))
    unused = np.empty(z.shape, np.int32)
    for block in blocks:
        vertices = store.window([block]).vertices
        corner = _triangles(store.arrays(block, ["facet", "whole", "top"]))
        raster_facets(_seen_by_sun(vertices, view), corner, first, z, unused)
    return _Tops(z, first)


def _seen_by_sun(vertices: Vertices, view: SunView) -> Floats:
    """Positions [4, n] whose disparity is the height (m)."""
    u, v = view.position(vertices.lon_q, vertices.lat_q, vertices.h_q)
    return np.stack([u, v, u - vertices.h_q * LATTICE_M, v])


@kernel
def _shaded(
    xy: Floats,
    corner: Steps,
    index: Steps,
    first: tuple[int, int],
    position: Floats,
    height: Floats,
    shift: tuple[float, float],
    tops: _Tops,
    out: Bools,
) -> None:
    """``xy`` [4, n]: positions of vertices in an image; ``position`` [2, n] (cells): in the view of
    the sun; ``height`` [n], m; ``shift`` of a position, cells per m."""
    rows, cols = index.shape
    for j in range(rows):
        for i in range(cols):
            t = index[j, i]
            if t < 0:
                continue
            k, m, n = corner[t, 0], corner[t, 1], corner[t, 2]
            x, y = (xy[0, k], xy[0, m], xy[0, n]), (xy[1, k], xy[1, m], xy[1, n])
            across, down = first[1] + i - x[0], first[0] + j - y[0]
            bx, by = plane_slopes(x, y, (0.0, 1.0, 0.0))
            cx, cy = plane_slopes(x, y, (0.0, 0.0, 1.0))
            b = min(max(bx * across + by * down, 0.0), 1.0)
            c = min(max(cx * across + cy * down, 0.0), 1.0 - b)
            ub, vb = position[0, m] - position[0, k], position[1, m] - position[1, k]
            uc, vc = position[0, n] - position[0, k], position[1, n] - position[1, k]
            hb, hc = height[m] - height[k], height[n] - height[k]
            seen = ub * vc - vb * uc
            above = (ub + shift[0] * hb) * (vc + shift[1] * hc)
            above -= (vb + shift[1] * hb) * (uc + shift[0] * hc)
            if seen * above <= 0.0:  # it turns its lower side to the sun
                out[j, i] = True
                continue
            col = int(np.floor(position[0, k] + b * ub + c * uc + 0.5)) - tops.first[1]
            row = int(np.floor(position[1, k] + b * vb + c * vc + 0.5)) - tops.first[0]
            if 0 <= row < tops.z.shape[0] and 0 <= col < tops.z.shape[1]:
                out[j, i] = tops.z[row, col] > height[k] + b * hb + c * hc + ABOVE_M


def shaded(
    projected: ProjectedSurface,
    patch: Patch,
    is_right: bool,
    view: SunView,
    store: SurfaceStore,
    casters: Sequence[Block],
) -> Bools:
    """Which pixels [h, w] of a ``patch`` of the left or right image lie in shadow.

    ``projected``: the surface that the images show there; ``view`` of the image's sun; ``casters``:
    blocks of the ``store`` that may cast a shadow there. Without a surface a pixel counts as lit.
    """
    surface, shape = projected.surface, patch.pixels.shape
    xy, first = projected.xy, (patch.row, patch.col)
    if is_right:  # mirrored, so that the greatest disparity is the nearest there, too
        xy = np.stack([-xy[2], xy[3], -xy[0], xy[1]])
        first = patch.row, -(patch.col + shape[1] - 1)
    corner = np.concatenate(
        [surface.facet, surface.undecided[: surface.whole], surface.tops.corner]
    )
    out = np.zeros(shape, np.bool_)
    vertices = surface.vertices
    if len(corner) == 0:
        return out
    index = np.full(shape, -1, np.int32)
    raster_facets(xy, corner, first, np.full(shape, -np.inf), index)
    position = view.position(vertices.lon_q, vertices.lat_q, vertices.h_q)
    shift = view.shift[0] / LATTICE_M, view.shift[1] / LATTICE_M
    tops = _tops(store, casters, view, position)
    _shaded(xy, corner, index, first, position, vertices.h_q * LATTICE_M, shift, tops, out)
    return out[:, ::-1].copy() if is_right else out
