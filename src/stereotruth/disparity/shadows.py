"""What of both images lies in the shadow that the LiDAR's surface casts.

The sun sees the surface from one direction, like a camera that is far away: what it does not see
lies in shadow. So the surface is rasterised into the view of the sun, where what is highest is
nearest, and into both images; a pixel lies in shadow where something is higher than it at its
position in the view of the sun, or where its triangle turns away from the sun (eq. 17 of
docs/explanation/surface.md).

The view of the sun is a lattice over the ground that no window moves, and each block of the surface
is read of which a shadow may fall into the window, however far off. So no block of the grid changes
a shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..epipolar.sun import toward_sun
from ..kernels import kernel
from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..numerics.degrees import exact_metres_per_degree
from ..numerics.triangles import corner_shares
from ..surface.surface_store import Block, SurfaceStore
from .facet_raster import misses, raster_facets, raster_triangle, triple
from .image_patches import Patch
from .view_geometry import ViewGeometry
from .visibility import ProjectedSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

CELLS = 2  # of the ground along the side of a cell of a sun's view: a pixel
ABOVE_M = 0.5  # what is higher than a pixel by less is the surface itself
KEPT = 512  # blocks whose tops are kept for the next windows, some 0.3 MB each


@kernel
def _positions(
    lon_q: Ints,
    lat_q: Ints,
    h_q: Ints,
    cell: tuple[int, int],
    shift: tuple[float, float],
    out: Floats,
) -> None:
    for k in range(lon_q.size):
        out[0, k] = lon_q[k] / cell[0] - shift[0] * h_q[k]
        out[1, k] = lat_q[k] / cell[1] - shift[1] * h_q[k]


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
        """Of a ``sun`` (azimuth, elevation, degrees) over the middle of an epipolar grid; ``cell``
        of the ground: (lon, lat), lattice steps."""
        rows, cols = model.shape
        height = float(model.reference_height)
        middle = np.array([cols / 2.0]), np.array([rows / 2.0]), np.array([height])
        _, lat = model.epipolar_to_ground(*middle)
        east, north, up = toward_sun(*sun)
        degrees = np.array([east, north]) / up / exact_metres_per_degree(float(lat[0]), height)
        side = cell[0] * CELLS, cell[1] * CELLS
        cells = degrees * LATTICE_M / LATTICE_DEG / np.array(side)
        return cls(side, tuple(np.round(cells, 15).tolist()))

    def position(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> Floats:
        """[2, n], cells, of lattice coordinates [n]."""
        out = np.empty((2, lon_q.size))
        _positions(lon_q, lat_q, h_q, self.cell, self.shift, out)
        return out

    def _boxes(self, blocks: Sequence[Block]) -> tuple[Floats, Floats]:
        """Least and greatest position [2, n] of each of n blocks."""
        west, south, east, north = np.array([block.box for block in blocks]).T.copy()
        corners = [
            self.position(lon, lat, h)
            for lon in (west, east)
            for lat in (south, north)
            for h in np.array([block.heights for block in blocks]).T.copy()
        ]
        return np.min(corners, axis=0), np.max(corners, axis=0)

    def casters(self, blocks: Sequence[Block], every: Sequence[Block]) -> tuple[Block, ...]:
        """Of ``every`` block those that may cast a shadow on some ``blocks``."""
        if not blocks:
            return ()
        low, high = self._boxes(blocks)
        lowest = min(block.heights[0] for block in blocks)
        least, most = self._boxes(every)
        meets = (least <= high.max(axis=1)[:, None]) & (most >= low.min(axis=1)[:, None])
        return tuple(
            block
            for block, near in zip(every, meets.all(axis=0))
            if near and block.heights[1] >= lowest
        )


class _Tops(NamedTuple):
    """Greatest height ``z`` (m) [rows, cols] at each cell of a sun's view from (row, col) ``first``
    on, −∞ for none."""

    z: Floats
    first: tuple[int, int]


def _triangles(arrays: dict[str, NDArray]) -> Steps:
    return np.concatenate([arrays["facet"], arrays["whole"], arrays["top"]])


def _no_tops(positions: Floats) -> _Tops:
    """Of the part of a sun's view that holds ``positions`` [2, n]."""
    low = np.floor(positions.min(axis=1)).astype(np.int64)
    high = np.ceil(positions.max(axis=1)).astype(np.int64)
    cols, rows = (high - low + 1).tolist()
    return _Tops(np.full((rows, cols), -np.inf), (int(low[1]), int(low[0])))


@lru_cache(maxsize=KEPT)
def _tops_of(
    store: SurfaceStore, block: Block, views: tuple[SunView, SunView]
) -> tuple[_Tops, _Tops]:
    """Of a block of the surface, in the view of each sun."""
    arrays = store.arrays(block, ["lon", "lat", "height", "facet", "whole", "top"])
    lattice, corner = store.positions(block, arrays), _triangles(arrays)
    left, right = (_rastered(view.position(*lattice), lattice[2], corner) for view in views)
    return left, right


def _rastered(position: Floats, h: Ints, corner: Steps) -> _Tops:
    """Of triangles at ``position`` [2, n] (cells) in a sun's view."""
    tops = _no_tops(position)
    _raster(position, h, corner, tops.first, tops.z, np.empty(tops.z.shape, np.int32))
    return tops


def _raise_tops(
    tops: Sequence[_Tops],
    views: tuple[SunView, SunView],
    store: SurfaceStore,
    casters: Sequence[Sequence[Block]],
) -> None:
    """By the surface's blocks that cast shadows in each view."""
    of_view = [set(blocks) for blocks in casters]
    for block in sorted(set().union(*of_view)):
        for top, of_block, blocks in zip(tops, _tops_of(store, block, views), of_view):
            if block in blocks:
                _raise(top, of_block)


def _raise(tops: _Tops, others: _Tops) -> None:
    """To those of ``others`` that are higher, where both views overlap."""
    here, there = [], []
    for axis in range(2):
        start = max(tops.first[axis], others.first[axis])
        stop = min(one.first[axis] + one.z.shape[axis] for one in (tops, others))
        if start >= stop:
            return
        here.append(slice(start - tops.first[axis], stop - tops.first[axis]))
        there.append(slice(start - others.first[axis], stop - others.first[axis]))
    part = tops.z[tuple(here)]
    np.maximum(part, others.z[tuple(there)], out=part)


@kernel
def _raster(
    position: Floats, h: Ints, corner: Steps, first: tuple[int, int], z: Floats, index: Steps
) -> None:
    """Raises ``z`` [rows, cols] (m) by triangles at ``position`` [2, n] (cells) in a sun's view."""
    for t in range(len(corner)):
        y = triple(position[1], corner[t])
        if misses(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), first[0], z.shape[0]):
            continue
        a, b, c = triple(h, corner[t])
        d = a * LATTICE_M, b * LATTICE_M, c * LATTICE_M
        raster_triangle(triple(position[0], corner[t]), y, d, first, t, z, index)


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
            k, m, n = corner[t]
            x, y = triple(xy[0], corner[t]), triple(xy[1], corner[t])
            b, c = corner_shares(x, y, first[1] + i - x[0], first[0] + j - y[0])
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
    patches: tuple[Patch, Patch],
    views: tuple[SunView, SunView],
    store: SurfaceStore,
    casters: Sequence[Sequence[Block]],
) -> tuple[Bools, Bools]:
    """Which pixels [h, w] of each of the ``patches`` of the left and the right image lie in shadow.

    ``projected``: the surface that the images show there; ``views`` of the images' suns;
    ``casters``: of each, blocks of the ``store`` that may cast a shadow there. Without a surface a
    pixel counts as lit.
    """
    surface = projected.surface
    corner = np.concatenate(
        [surface.facet, surface.undecided[: surface.whole], surface.tops.corner]
    )
    left, right = (np.zeros(patch.pixels.shape, np.bool_) for patch in patches)
    if len(corner) == 0:
        return left, right
    vertices = surface.vertices
    positions = [view.position(vertices.lon_q, vertices.lat_q, vertices.h_q) for view in views]
    tops = [_no_tops(position) for position in positions]
    _raise_tops(tops, views, store, casters)
    # the right image mirrored, so that the greatest disparity is the nearest there, too
    xy = (
        projected.xy,
        np.stack([-projected.xy[2], projected.xy[3], -projected.xy[0], projected.xy[1]]),
    )
    first_right = patches[1].row, -(patches[1].col + right.shape[1] - 1)
    first = (patches[0].row, patches[0].col), first_right
    for k, out in enumerate((left, right)):
        index = np.full(out.shape, -1, np.int32)
        raster_facets(xy[k], corner, first[k], np.full(out.shape, -np.inf), index)
        shift = views[k].shift[0] / LATTICE_M, views[k].shift[1] / LATTICE_M
        height = vertices.h_q * LATTICE_M
        _shaded(xy[k], corner, index, first[k], positions[k], height, shift, tops[k], out)
    return left, right[:, ::-1].copy()
