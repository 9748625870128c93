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
from ..kernels import inner, kernel
from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from ..numerics.degrees import exact_metres_per_degree
from ..numerics.triangles import corner_shares
from ..surface.surface_store import Block, SurfaceStore
from .facet_raster import LEFT, RIGHT, misses, raster_facets, raster_triangle, triple
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


class _Lattice(NamedTuple):
    """Lattice coordinates [n]."""

    lon_q: Ints
    lat_q: Ints
    h_q: Ints


class _Axes(NamedTuple):
    """See :class:`SunView`."""

    cell: tuple[int, int]
    shift: tuple[float, float]


@inner
def _position(lattice: _Lattice, k: int, axes: _Axes) -> tuple[float, float]:
    """Of the ``k``-th, cells."""
    h = lattice.h_q[k]
    return (
        lattice.lon_q[k] / axes.cell[0] - axes.shift[0] * h,
        lattice.lat_q[k] / axes.cell[1] - axes.shift[1] * h,
    )


@kernel
def _positions(lattice: _Lattice, axes: _Axes, out: Floats) -> None:
    for k in range(lattice.h_q.size):
        out[0, k], out[1, k] = _position(lattice, k, axes)


@kernel
def _extent(lattice: _Lattice, axes: _Axes, out: Floats) -> None:
    """Least and greatest position, ``out`` [2, 2], (lon, lat) each."""
    out[0], out[1] = np.inf, -np.inf
    for k in range(lattice.h_q.size):
        x, y = _position(lattice, k, axes)
        out[0, 0], out[0, 1] = min(out[0, 0], x), min(out[0, 1], y)
        out[1, 0], out[1, 1] = max(out[1, 0], x), max(out[1, 1], y)


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

    @property
    def axes(self) -> _Axes:
        """For kernels."""
        return _Axes(self.cell, self.shift)

    def position(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> Floats:
        """[2, n], cells, of lattice coordinates [n]."""
        out = np.empty((2, lon_q.size))
        _positions(_Lattice(lon_q, lat_q, h_q), self.axes, out)
        return out

    def no_tops(self, lattice: _Lattice) -> _Tops:
        """Of the part of the view that holds some places, one at least."""
        extent = np.empty((2, 2))
        _extent(lattice, self.axes, extent)
        low, high = np.floor(extent[0]).astype(np.int64), np.ceil(extent[1]).astype(np.int64)
        cols, rows = (high - low + 1).tolist()
        return _Tops(np.full((rows, cols), -np.inf), (int(low[1]), int(low[0])))

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


class _Triangles(NamedTuple):
    """What casts shadows and lies in them: corners [n, 3] among the vertices."""

    facet: Steps
    whole: Steps
    top: Steps


@lru_cache(maxsize=KEPT)
def _tops_of(
    store: SurfaceStore, block: Block, views: tuple[SunView, SunView]
) -> tuple[_Tops, _Tops]:
    """Of a block of the surface, in the view of each sun."""
    arrays = store.arrays(block, ["lon", "lat", "height", "facet", "whole", "top"])
    lattice = _Lattice(*store.positions(block, arrays))
    triangles = _Triangles(arrays["facet"], arrays["whole"], arrays["top"])
    left, right = (_rastered(view, lattice, triangles) for view in views)
    return left, right


def _rastered(view: SunView, lattice: _Lattice, triangles: _Triangles) -> _Tops:
    """Of triangles in a sun's view."""
    tops, position = view.no_tops(lattice), view.position(*lattice)
    for corner in triangles:
        _raster(position, lattice.h_q, corner, tops.first, tops.z)
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
def _raster(position: Floats, h: Ints, corner: Steps, first: tuple[int, int], z: Floats) -> None:
    """Raises ``z`` [rows, cols] (m) by triangles at ``position`` [2, n] (cells) in a sun's view."""
    index = np.empty(z.shape, np.int32)
    for t in range(len(corner)):
        y = triple(position[1], corner[t])
        if misses(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), first[0], z.shape[0]):
            continue
        a, b, c = triple(h, corner[t])
        d = a * LATTICE_M, b * LATTICE_M, c * LATTICE_M
        raster_triangle(triple(position[0], corner[t]), y, d, first, t, z, index)


@inner
def _corner(triangles: _Triangles, t: int) -> Steps:
    """Of the ``t``-th of all."""
    facets, whole = len(triangles.facet), len(triangles.whole)
    if t < facets:
        return triangles.facet[t]
    if t < facets + whole:
        return triangles.whole[t - facets]
    return triangles.top[t - facets - whole]


@kernel
def _shaded(
    xy: Floats,
    view: int,
    triangles: _Triangles,
    index: Steps,
    first: tuple[int, int],
    lattice: _Lattice,
    axes: _Axes,
    tops: _Tops,
    out: Bools,
) -> None:
    """``xy`` [4, n]: positions of vertices in both images; ``index`` of the triangle that each
    pixel of the ``view`` shows, -1 for none; ``axes`` and ``tops`` of its sun."""
    rows, cols = index.shape
    across, up = axes.shift[0] / LATTICE_M, axes.shift[1] / LATTICE_M  # cells per m
    for j in range(rows):
        for i in range(cols):
            if index[j, i] < 0:
                continue
            corner = _corner(triangles, index[j, i])
            k, m, n = corner
            x, y = triple(xy[view], corner), triple(xy[view + 1], corner)
            b, c = corner_shares(x, y, first[1] + i - x[0], first[0] + j - y[0])
            u, v = _position(lattice, k, axes)
            um, vm = _position(lattice, m, axes)
            un, vn = _position(lattice, n, axes)
            ub, vb, uc, vc = um - u, vm - v, un - u, vn - v
            height = lattice.h_q[k] * LATTICE_M
            hb, hc = lattice.h_q[m] * LATTICE_M - height, lattice.h_q[n] * LATTICE_M - height
            seen = ub * vc - vb * uc
            above = (ub + across * hb) * (vc + up * hc)
            above -= (vb + up * hb) * (uc + across * hc)
            if seen * above <= 0.0:  # it turns its lower side to the sun
                out[j, i] = True
                continue
            col = int(np.floor(u + b * ub + c * uc + 0.5)) - tops.first[1]
            row = int(np.floor(v + b * vb + c * vc + 0.5)) - tops.first[0]
            if 0 <= row < tops.z.shape[0] and 0 <= col < tops.z.shape[1]:
                out[j, i] = tops.z[row, col] > height + b * hb + c * hc + ABOVE_M


def _nearest_triangles(
    xy: Floats, view: int, triangles: _Triangles, first: tuple[int, int], shape: tuple[int, ...]
) -> Steps:
    """Which of all triangles each pixel of a part of a view shows, -1 for none."""
    index, nearest = np.full(shape, -1, np.int32), np.full(shape, -np.inf)
    number = 0
    for corner in triangles:
        raster_facets(xy, corner, first, nearest, index, view, number)
        number += len(corner)
    return index


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
    surface, xy = projected.surface, projected.xy
    whole = surface.undecided[: surface.whole]
    triangles = _Triangles(surface.facet, whole, surface.tops.corner)
    left, right = (np.zeros(patch.pixels.shape, np.bool_) for patch in patches)
    if not any(map(len, triangles)):
        return left, right
    vertices = surface.vertices
    lattice = _Lattice(vertices.lon_q, vertices.lat_q, vertices.h_q)
    tops = [view.no_tops(lattice) for view in views]
    _raise_tops(tops, views, store, casters)
    for out, image, patch, sun, top in zip((left, right), (LEFT, RIGHT), patches, views, tops):
        first = patch.row, patch.col
        index = _nearest_triangles(xy, image, triangles, first, out.shape)
        _shaded(xy, image, triangles, index, first, lattice, sun.axes, top, out)
    return left, right
