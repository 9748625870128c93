"""What an image shows of a surface: facets and prisms, rasterised with depth into any image.

1. A pixel's centre sees the facet that is nearest to the camera. What is linear in a facet is
   interpolated in it, or quadratic where it bulges.
2. An undecided triangle may hold any height between its lowest and highest vertex: the prism over
   it is rasterised, too. What a pixel shows is unknown where its ray may meet a prism first.
   Without prisms, 6 to 10 % of the hidden pixels of pairs had labels at 0.25 to 4 points/m², with
   them 0.05 to 0.2 %, for 0.5 to 3 % of the visible ones.
3. Of a pair, the ray to the right camera starts at the pixel's own position in the right image:
   each triangle is tested at the pixels that it covers there, so that no grid of the right view
   rounds edges.

Depth is a disparity: the greater, the nearer. Positions ``xy`` [4, vertices] are x_left, y_left,
x_right, y_right in px; a disparity is x_left - x_right. Of one image alone, x_right is the column
less the disparity that a height stands for, and y_right the row. Rows and columns of pixels count
from the (row, col) ``first`` of a window.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.geometry import plane_slopes, row_span
from ..epipolar.window_sums import SURFACE_PX
from ..lidar.lattice import LATTICE_M
from .facet_values import Facets, PixelValues, interpolate, triple
from .surface import GroundSurface

Steps = NDArray[np.int32]

# What lies in front of a surface by less is the surface itself.
OCCLUSION_TOLERANCE_PX = 0.25
# A facet that turns away from the right camera is hidden. So obliquely that a pixel shrinks to this
# width there, points and their noise do not say (forests, 6 points/m²: with 0.2 1 % more of the
# visible pixels and 0.2 of the hidden ones had labels, with 0.4 1.3 and 0.1 fewer).
LEAST_FACET_WIDTH = 0.3
NO_FACET, VISIBLE, PRISM_IN_LEFT, PRISM_IN_RIGHT, FACET_IN_RIGHT = range(5)
_ROUNDING_PX = 1e-6  # of where an edge meets a row


class RightPixels(NamedTuple):
    """Pixels [n] of a window in the order of their row and whole column in the right image.

    ``first``: (row, col) of the first pixel there, ``width``: number of columns; those of column
    ``first[1] + k`` in row ``first[0] + j`` from ``start[j * width + k]`` on. ``column`` of each,
    px; ``limit``: a greater disparity hides it, px. ``order``: where each was in what was given.
    """

    first: tuple[int, int]
    width: int
    start: Steps
    column: Floats
    limit: Floats
    order: Ints

    def as_given(self, hidden: Bools) -> Bools:
        """Of pixels in the order of these, in that in which they were given."""
        out = np.empty_like(hidden)
        out[self.order] = hidden
        return out


class _Prisms(NamedTuple):
    """Prisms over triangles ``corner`` [k, 3] of vertices [n], from the least to the greatest
    height of ``height_range`` [k, 2], lattice steps.

    ``xy`` [4, n]: positions of the vertices at their height ``h``; ``rise`` [4, n]: what a lattice
    step of height adds. Over 100 m positions are linear in height within 0.02 px, a tenth of
    OCCLUSION_TOLERANCE_PX.
    """

    corner: Steps
    height_range: Ints
    xy: Floats
    rise: NDArray[np.float32]
    h: Ints


@inlined
def _misses(low: float, high: float, first: int, count: int) -> bool:
    """Whether no centre of the ``count`` rows or columns from the ``first`` one on lies in a range,
    as in those of most triangles."""
    return max(np.ceil(low), first) > min(np.floor(high), first + count - 1)


@inlined
def _raster_triangle(
    x: tuple,
    y: tuple,
    d: tuple,
    first: tuple[int, int],
    number: int,
    z_buffer: Floats,
    index: Steps,
) -> None:
    """Raises ``z_buffer`` [rows, cols] to a triangle's disparity, and sets ``index`` to its
    ``number`` there.

    Of triangles of equal disparity the first one stays.
    """
    rows, cols = z_buffer.shape
    top = max(int(np.ceil(min(y[0], y[1], y[2]))), first[0])
    bottom = min(int(np.floor(max(y[0], y[1], y[2]))), first[0] + rows - 1)
    left = max(int(np.ceil(min(x[0], x[1], x[2]))), first[1])
    right = min(int(np.floor(max(x[0], x[1], x[2]))), first[1] + cols - 1)
    if top > bottom or left > right:  # most triangles lie between the centres of pixels
        return
    gx, gy = plane_slopes(x, y, d)
    if not np.isfinite(gx + gy):
        return
    lowest, highest = min(d[0], d[1], d[2]), max(d[0], d[1], d[2])
    for row in range(top, bottom + 1):
        low, high = row_span(x, y, float(row))
        if not low <= high:
            continue
        left = max(int(np.ceil(low)), first[1])
        right = min(int(np.floor(high)), first[1] + cols - 1)
        for col in range(left, right + 1):
            value = d[0] + gx * (col - x[0]) + gy * (row - y[0])
            value = min(max(value, lowest), highest)
            j, i = row - first[0], col - first[1]
            if value > z_buffer[j, i]:
                z_buffer[j, i] = value
                index[j, i] = number


@kernel
def _raster_facets(
    xy: Floats, corner: Steps, first: tuple[int, int], z_buffer: Floats, index: Steps
) -> None:
    """The triangle of the greatest disparity at each pixel's centre, and that disparity (eq. 7 of
    docs/explanation/surface.md).

    Raises ``z_buffer`` [rows, cols] and sets ``index``. Of equals, the triangle of the lower
    number.
    """
    rows, cols = z_buffer.shape
    x_left, y_left, x_right = xy[0], xy[1], xy[2]
    for t in range(len(corner)):
        v = corner[t, 0], corner[t, 1], corner[t, 2]
        y = triple(y_left, v)
        if _misses(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), first[0], rows):
            continue
        x = triple(x_left, v)
        if _misses(min(x[0], x[1], x[2]), max(x[0], x[1], x[2]), first[1], cols):
            continue
        xr = triple(x_right, v)
        d = (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
        _raster_triangle(x, y, d, first, t, z_buffer, index)


@inlined
def _may_hide(
    left: float,
    right: float,
    top: int,
    bottom: int,
    highest: float,
    pixels: RightPixels,
    hidden: Bools,
) -> bool:
    """Whether a disparity of ``highest`` exceeds the ``limit`` of any pixel that is not ``hidden``
    yet, in rows ``top`` to ``bottom`` whose column in the right image lies between ``left`` and
    ``right``; most surfaces hide nothing, or what others hide."""
    first, width, start, limit = pixels.first, pixels.width, pixels.start, pixels.limit
    begin = max(int(np.floor(left - _ROUNDING_PX)) - first[1], 0)
    end = min(int(np.floor(right + _ROUNDING_PX)) - first[1], width - 1) + 1
    if begin >= end:
        return False
    for row in range(top, bottom + 1):
        base = (row - first[0]) * width
        for k in range(start[base + begin], start[base + end]):
            if limit[k] < highest and not hidden[k]:
                return True
    return False


@inlined
def _hide_right(x: tuple, y: tuple, d: tuple, pixels: RightPixels, hidden: Bools) -> None:
    """Marks the pixels that a triangle covers in the right view, and whose ``limit`` it exceeds."""
    first, width, start = pixels.first, pixels.width, pixels.start
    column, limit = pixels.column, pixels.limit
    rows = (start.size - 1) // width
    top = max(int(np.ceil(min(y[0], y[1], y[2]))), first[0])
    bottom = min(int(np.floor(max(y[0], y[1], y[2]))), first[0] + rows - 1)
    if top > bottom:
        return
    lowest, highest = min(d[0], d[1], d[2]), max(d[0], d[1], d[2])
    low, high = min(x[0], x[1], x[2]), max(x[0], x[1], x[2])
    if not _may_hide(low, high, top, bottom, highest, pixels, hidden):
        return
    gx, gy = plane_slopes(x, y, d)
    if not np.isfinite(gx + gy):
        return
    for row in range(top, bottom + 1):
        low, high = row_span(x, y, float(row))
        if not low <= high:
            continue
        left = max(int(np.floor(low)) - first[1], 0)
        right = min(int(np.floor(high)) - first[1], width - 1)
        if left > right:
            continue
        base = (row - first[0]) * width
        for k in range(start[base + left], start[base + right + 1]):
            if hidden[k] or not low <= column[k] <= high or highest <= limit[k]:
                continue
            value = d[0] + gx * (column[k] - x[0]) + gy * (row - y[0])
            hidden[k] = min(max(value, lowest), highest) > limit[k]


@kernel
def _hide_by_facets(xy: Floats, corner: Steps, pixels: RightPixels, hidden: Bools) -> None:
    """Marks the pixels that triangles hide from the right camera (eq. 8 of
    docs/explanation/surface.md)."""
    rows = (pixels.start.size - 1) // pixels.width
    x_left, x_right, y_right = xy[0], xy[2], xy[3]
    for t in range(len(corner)):
        v = corner[t, 0], corner[t, 1], corner[t, 2]
        y = triple(y_right, v)
        if _misses(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), pixels.first[0], rows):
            continue
        x, xr = triple(x_left, v), triple(x_right, v)
        d = (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
        _hide_right(xr, y, d, pixels, hidden)


@inlined
def _at_heights(prisms: _Prisms, t: int, axis: int, out: Floats) -> None:
    """Positions [6] of a prism's corners along an axis, px: first those at its top."""
    low, high = prisms.height_range[t, 0], prisms.height_range[t, 1]
    for k in range(3):
        v = prisms.corner[t, k]
        at, rise = prisms.xy[axis, v], prisms.rise[axis, v]
        out[k] = at + (high - prisms.h[v]) * rise
        out[3 + k] = at + (low - prisms.h[v]) * rise


@inlined
def _range(values: Floats) -> tuple[float, float]:
    """Least and greatest of a prism's corners."""
    low, high = values[0], values[0]
    for k in range(1, 6):
        low, high = min(low, values[k]), max(high, values[k])
    return low, high


@inlined
def _faces_seen(x: Floats, y: Floats, d: Floats, faces: Steps) -> int:
    """Triangles [n, 3] of a prism's corners [6] that a camera sees from outside, to ``faces``
    [7, 3]; their number. ``x``, ``y``: positions in its image, ``d``: disparity.

    That is the top, and each side whose plane the third corner lies behind. Both the upper and the
    lower corners have one height, so that sides are planes.
    """
    faces[0] = 0, 1, 2
    n = 1
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        side = i, j, 3 + i
        gx, gy = plane_slopes(triple(x, side), triple(y, side), triple(d, side))
        if d[i] + gx * (x[k] - x[i]) + gy * (y[k] - y[i]) > d[k]:
            faces[n] = side
            faces[n + 1] = j, 3 + i, 3 + j
            n += 2
    return n


@kernel
def _raster_prisms(prisms: _Prisms, first: tuple[int, int], z_buffer: Floats) -> None:
    """Raises ``z_buffer`` to the greatest disparity that prisms may have (eq. 7 of
    docs/explanation/surface.md)."""
    rows, cols = z_buffer.shape
    any_prism, faces = np.empty(z_buffer.shape, np.int32), np.empty((7, 3), np.int32)
    x, y, xr, d = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for t in range(len(prisms.corner)):
        _at_heights(prisms, t, 1, y)
        low, high = _range(y)
        if _misses(low, high, first[0], rows):
            continue
        _at_heights(prisms, t, 0, x)
        low, high = _range(x)
        if _misses(low, high, first[1], cols):
            continue
        _at_heights(prisms, t, 2, xr)
        for k in range(6):
            d[k] = x[k] - xr[k]
        for k in range(_faces_seen(x, y, d, faces)):
            face = faces[k, 0], faces[k, 1], faces[k, 2]
            corners = triple(x, face), triple(y, face), triple(d, face)
            _raster_triangle(*corners, first, t, z_buffer, any_prism)


@kernel
def _hide_by_prisms(prisms: _Prisms, pixels: RightPixels, hidden: Bools) -> None:
    """Marks the pixels that prisms may hide from the right camera (eq. 8 of
    docs/explanation/surface.md)."""
    first, width = pixels.first, pixels.width
    rows = (pixels.start.size - 1) // width
    faces = np.empty((7, 3), np.int32)
    x, y, xr, d = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for t in range(len(prisms.corner)):
        _at_heights(prisms, t, 3, y)
        low, high = _range(y)
        if _misses(low, high, first[0], rows):
            continue
        top = max(int(np.ceil(low)), first[0])
        bottom = min(int(np.floor(high)), first[0] + rows - 1)
        _at_heights(prisms, t, 2, xr)
        low, high = _range(xr)
        if np.floor(high) < first[1] or np.floor(low) >= first[1] + width:
            continue
        _at_heights(prisms, t, 0, x)
        for k in range(6):
            d[k] = x[k] - xr[k]
        if not _may_hide(low, high, top, bottom, _range(d)[1], pixels, hidden):
            continue
        for k in range(_faces_seen(xr, y, d, faces)):
            face = faces[k, 0], faces[k, 1], faces[k, 2]
            _hide_right(triple(xr, face), triple(y, face), triple(d, face), pixels, hidden)


def right_pixels(row: Ints, col: Ints, disparity: Floats, first: tuple[int, int]) -> RightPixels:
    """Pixels [n] of a window, one at least, by where the right image shows surfaces of their
    ``disparity``."""
    column = col + first[1] - disparity
    whole = np.floor(column).astype(np.int64)
    low = int(whole.min())
    width = int(whole.max()) - low + 1
    rows = int(row.max()) + 1
    key = row.astype(np.int64) * width + whole - low
    order = np.argsort(key, kind="stable")
    start = np.zeros(rows * width + 1, np.int32)
    np.cumsum(np.bincount(key, minlength=rows * width), out=start[1:])
    limit = disparity[order] + OCCLUSION_TOLERANCE_PX
    return RightPixels((first[0], low), width, start, column[order], limit, order)


class Projection(Protocol):
    """Where points of the ground are seen in one image or two."""

    def with_rise(
        self, lon_q: Ints, lat_q: Ints, h_q: Ints, lifted: Bools
    ) -> tuple[Floats, NDArray[np.float32]]:
        """Positions [4, n] px of lattice points, and by how much a lattice step of height changes
        them: of the points that are ``lifted`` [n], undefined of the others."""


@dataclass(frozen=True, eq=False)
class ProjectedSurface:
    """A surface in images: ``xy`` [4, n] px of its vertices, in a window of the left one whose
    first pixel is (row, col) ``first``; ``rise`` [4, n] of those of undecided triangles by a
    lattice step of height."""

    surface: GroundSurface
    xy: Floats
    rise: NDArray[np.float32]
    first: tuple[int, int]

    @classmethod
    def of(
        cls, surface: GroundSurface, projection: Projection, first: tuple[int, int]
    ) -> ProjectedSurface:
        """By a ``projection`` of all that lies in the box of the vertices."""
        vertices = surface.vertices
        lifted = np.zeros(vertices.x.size, np.bool_)
        lifted[surface.undecided.reshape(-1)] = True
        xy, rise = projection.with_rise(vertices.lon_q, vertices.lat_q, vertices.h_q, lifted)
        return cls(surface, xy, rise, first)

    def raster(self, corner: Steps, shape: tuple[int, int]) -> tuple[Floats, Steps]:
        """Greatest disparity [h, w] of triangles ``corner`` [m, 3] at the centres of pixels, −∞ for
        none, and which of them has it, -1 for none."""
        z_buffer, index = np.full(shape, -np.inf), np.full(shape, -1, np.int32)
        _raster_facets(self.xy, corner, self.first, z_buffer, index)
        return z_buffer, index

    def raise_to_prisms(self, undecided: slice, z_buffer: Floats) -> None:
        """Raises ``z_buffer`` [h, w] to the greatest disparity that some undecided triangles may
        have at the centres of pixels."""
        _raster_prisms(self._prisms(undecided), self.first, z_buffer)

    def values(self, facets: Facets, index: Steps) -> PixelValues:
        """What the facet ``index`` [h, w] of each pixel has there, -1 for none."""
        out = PixelValues.none(index.shape)
        interpolate(facets, self.surface.vertices, self.xy, index, self.first, out)
        return out

    def hidden_by_facets(self, corner: Steps, pixels: RightPixels) -> Bools:
        """Which pixels [n] triangles ``corner`` [m, 3] hide from the right camera."""
        hidden = np.zeros(pixels.limit.size, np.bool_)
        _hide_by_facets(self.xy, corner, pixels, hidden)
        return pixels.as_given(hidden)

    def hidden_by_prisms(self, undecided: slice, pixels: RightPixels) -> Bools:
        """Which pixels [n] some undecided triangles may hide from the right camera."""
        hidden = np.zeros(pixels.limit.size, np.bool_)
        _hide_by_prisms(self._prisms(undecided), pixels, hidden)
        return pixels.as_given(hidden)

    def _prisms(self, undecided: slice) -> _Prisms:
        surface = self.surface
        corner, heights = surface.undecided[undecided], surface.height_range[undecided]
        return _Prisms(corner, heights, self.xy, self.rise, surface.vertices.h_q)

    def near_edge(
        self, disparity: Floats, slope: Floats, reach_px: float, corner: Steps, undecided: slice
    ) -> Bools:
        """Whether triangles ``corner`` or prisms show another surface than one of a ``disparity``
        [h, w] and ``slope`` [2, h, w] at a pixel's centre, or none, ``reach_px`` off in one of
        eight directions; False where the disparity is NaN."""
        out = np.zeros(disparity.shape, np.bool_)
        for angle in np.arange(8) * np.pi / 4:
            x, y = reach_px * np.cos(angle), reach_px * np.sin(angle)
            moved = replace(self, xy=self.xy - np.array([[x], [y]] * 2))
            there, _ = moved.raster(corner, disparity.shape)
            moved.raise_to_prisms(undecided, there)
            out |= np.abs(there - disparity - slope[0] * x - slope[1] * y) > SURFACE_PX
        return out

    def seen(self, shape: tuple[int, int], px_per_m: float) -> SeenSurface:
        """What the pixels of a window of ``shape`` (rows, cols) see in the left image;
        ``px_per_m``: disparity of a metre of height."""
        surface = self.surface
        z_buffer, index = self.raster(surface.facet, shape)
        strips = np.full(shape, -np.inf)
        self.raise_to_prisms(surface.strips, strips)
        prisms = strips.copy()
        self.raise_to_prisms(slice(0, surface.whole), prisms)
        visibility = np.where(index >= 0, np.uint8(VISIBLE), np.uint8(NO_FACET))
        visibility[prisms > z_buffer + OCCLUSION_TOLERANCE_PX] = PRISM_IN_LEFT
        facets = Facets(surface.facet, surface.variance, surface.bulge)
        values = self.values(facets, index)
        step_px = LATTICE_M * px_per_m
        return SeenSurface(
            visibility=visibility,
            plane=z_buffer,
            disparity=np.where(index >= 0, z_buffer + values.rise * LATTICE_M * px_per_m, np.nan),
            slope=values.slope,
            variance=values.variance * step_px**2,
            height=(values.height + values.rise) * LATTICE_M,
            surface_class=values.surface_class,
            day=values.day,
            bulging=values.rise > 0.0,
            strips=strips,
            projected=self,
        )


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What the facets show at the centres of an image's pixels; arrays [h, w].

    ``visibility``: NO_FACET, VISIBLE, PRISM_IN_LEFT (an undecided triangle may be nearer); once
    both views are asked, PRISM_IN_RIGHT (one may be nearer to the right camera) and FACET_IN_RIGHT
    (a facet hides it from there). Of the nearest facet, NaN (0) for none: ``disparity`` px, its
    ``slope`` [2, h, w] and ``variance`` px² (of the points alone), ``height`` m, ``surface_class``
    (ASPRS) and ``day`` (both of the nearest vertex); ``plane``: disparity without the bulge, −∞ for
    none. ``bulging``: whether the surface bulges out of its facet. ``strips``: greatest disparity
    of the strips between known surfaces, −∞ for none. ``projected``: all of it.
    """

    visibility: NDArray[np.uint8]
    plane: Floats
    disparity: Floats
    slope: Floats
    variance: Floats
    height: Floats
    surface_class: NDArray[np.uint8]
    day: NDArray[np.uint16]
    bulging: Bools
    strips: Floats
    projected: ProjectedSurface

    def from_both_cameras(self) -> SeenSurface:
        """The same with the ``visibility`` from the right camera, too."""
        visibility, projected = self.visibility.copy(), self.projected
        row, col = np.nonzero(visibility == VISIBLE)
        if row.size:
            pixels = right_pixels(row, col, self.plane[row, col], projected.first)
            by_facet = projected.hidden_by_facets(projected.surface.facet, pixels)
            by_prism = projected.hidden_by_prisms(slice(None), pixels)
            in_right = np.where(by_prism, np.uint8(PRISM_IN_RIGHT), np.uint8(VISIBLE))
            visibility[row, col] = np.where(by_facet, np.uint8(FACET_IN_RIGHT), in_right)
        turned = (visibility == VISIBLE) & (1.0 - self.slope[0] < LEAST_FACET_WIDTH)
        visibility[turned] = FACET_IN_RIGHT
        return replace(self, visibility=visibility)
