"""Triangles rasterised into both views: z-buffer of the left one, visibility from the right one.

Positions ``xy`` [4, vertices] are x_left, y_left, x_right, y_right in px of the epipolar grid; a
disparity is x_left - x_right. Rows and columns of pixels count from the (row, col) ``first`` of a
window.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from ..numerics.triangles import corner_shares, plane_slopes, row_span

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

# What lies in front of a surface by less is the surface itself.
OCCLUSION_TOLERANCE_PX = 0.25
ROUNDING_PX = 1e-6  # of where an edge meets a row


class RightPixels(NamedTuple):
    """Pixels [n] of a window in the order of their row and whole column in the right image.

    ``first``: (row, col) of the first pixel there, ``width``: number of columns; those of column
    ``first[1] + k`` in row ``first[0] + j`` from ``start[j * width + k]`` on. ``column`` of each,
    px; ``limit``: a greater disparity hides it, px.
    """

    first: tuple[int, int]
    width: int
    start: Steps
    column: Floats
    limit: Floats


class Prisms(NamedTuple):
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


class FacetValues(NamedTuple):
    """Triangles ``corner`` [m, 3] of vertices [n] at ``xy`` [4, n], and what is interpolated in
    them.

    ``h`` (lattice steps), ``surface_class``, ``day``, ``count`` of each vertex; ``variance``
    (lattice steps²) and ``bulge`` (lattice steps) of each triangle.
    """

    xy: Floats
    corner: Steps
    h: Ints
    surface_class: NDArray[np.uint8]
    day: NDArray[np.uint16]
    count: Steps
    variance: NDArray[np.floating]
    bulge: NDArray[np.floating]


class PixelValues(NamedTuple):
    """What triangles have at the centres of pixels [h, w]: ``slope`` [2, h, w] of the disparity;
    ``variance`` (lattice steps²), ``height`` and ``rise`` of the surface above its triangle
    (lattice steps); ``surface_class`` and ``day`` of the nearest vertex."""

    slope: Floats
    variance: Floats
    height: Floats
    rise: Floats
    surface_class: NDArray[np.uint8]
    day: NDArray[np.uint16]

    @classmethod
    def none(cls, shape: tuple[int, int]) -> PixelValues:
        """Of pixels without a triangle."""
        height, classes = np.full(shape, np.nan), np.zeros(shape, np.uint8)
        values = np.zeros((2, *shape)), np.zeros(shape), height, np.zeros(shape)
        return cls(*values, classes, np.zeros(shape, np.uint16))


@inner
def triple(values: Floats, t: Steps | tuple) -> tuple[float, float, float]:
    """Of a triangle's three corners ``t``."""
    return values[t[0]], values[t[1]], values[t[2]]


@inner
def misses(low: float, high: float, first: int, count: int) -> bool:
    """Whether no centre of the ``count`` rows or columns from the ``first`` one on lies in a range,
    as in those of most triangles."""
    return max(np.ceil(low), first) > min(np.floor(high), first + count - 1)


@inner
def raster_triangle(
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
def raster_facets(
    xy: Floats, corner: Steps, first: tuple[int, int], z_buffer: Floats, index: Steps
) -> None:
    """The triangle of the greatest disparity at each pixel's centre, and that disparity (eq. 7 of
    docs/explanation/surface.md).

    Raises ``z_buffer`` [rows, cols] and sets ``index``. Of equals, the triangle of the lower
    number.
    """
    rows, cols = z_buffer.shape
    for t in range(len(corner)):
        y = triple(xy[1], corner[t])
        if misses(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), first[0], rows):
            continue
        x = triple(xy[0], corner[t])
        if misses(min(x[0], x[1], x[2]), max(x[0], x[1], x[2]), first[1], cols):
            continue
        xr = triple(xy[2], corner[t])
        d = (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
        raster_triangle(x, y, d, first, t, z_buffer, index)


@inner
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
    begin = max(int(np.floor(left - ROUNDING_PX)) - first[1], 0)
    end = min(int(np.floor(right + ROUNDING_PX)) - first[1], width - 1) + 1
    if begin >= end:
        return False
    for row in range(top, bottom + 1):
        base = (row - first[0]) * width
        for k in range(start[base + begin], start[base + end]):
            if limit[k] < highest and not hidden[k]:
                return True
    return False


@inner
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
def hide_by_facets(xy: Floats, corner: Steps, pixels: RightPixels, hidden: Bools) -> None:
    """Marks the pixels that triangles hide from the right camera (eq. 8 of
    docs/explanation/surface.md)."""
    rows = (pixels.start.size - 1) // pixels.width
    for t in range(len(corner)):
        y = triple(xy[3], corner[t])
        if misses(min(y[0], y[1], y[2]), max(y[0], y[1], y[2]), pixels.first[0], rows):
            continue
        x, xr = triple(xy[0], corner[t]), triple(xy[2], corner[t])
        d = (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
        _hide_right(xr, y, d, pixels, hidden)


@inner
def _at_heights(prisms: Prisms, t: int, axis: int, out: Floats) -> None:
    """Positions [6] of a prism's corners along an axis, px: first those at its top."""
    low, high = prisms.height_range[t, 0], prisms.height_range[t, 1]
    for k in range(3):
        v = prisms.corner[t, k]
        at, rise = prisms.xy[axis, v], prisms.rise[axis, v]
        out[k] = at + (high - prisms.h[v]) * rise
        out[3 + k] = at + (low - prisms.h[v]) * rise


@inner
def _range(values: Floats) -> tuple[float, float]:
    """Least and greatest of a prism's corners."""
    low, high = values[0], values[0]
    for k in range(1, 6):
        low, high = min(low, values[k]), max(high, values[k])
    return low, high


@inner
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
def raster_prisms(prisms: Prisms, first: tuple[int, int], z_buffer: Floats) -> None:
    """Raises ``z_buffer`` to the greatest disparity that prisms may have (eq. 7 of
    docs/explanation/surface.md)."""
    rows, cols = z_buffer.shape
    any_prism, faces = np.empty(z_buffer.shape, np.int32), np.empty((7, 3), np.int32)
    x, y, xr, d = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for t in range(len(prisms.corner)):
        _at_heights(prisms, t, 1, y)
        low, high = _range(y)
        if misses(low, high, first[0], rows):
            continue
        _at_heights(prisms, t, 0, x)
        low, high = _range(x)
        if misses(low, high, first[1], cols):
            continue
        _at_heights(prisms, t, 2, xr)
        for k in range(6):
            d[k] = x[k] - xr[k]
        for face in faces[: _faces_seen(x, y, d, faces)]:
            corners = triple(x, face), triple(y, face), triple(d, face)
            raster_triangle(*corners, first, t, z_buffer, any_prism)


@kernel
def hide_by_prisms(prisms: Prisms, pixels: RightPixels, hidden: Bools) -> None:
    """Marks the pixels that prisms may hide from the right camera (eq. 8 of
    docs/explanation/surface.md)."""
    first, width = pixels.first, pixels.width
    rows = (pixels.start.size - 1) // width
    faces = np.empty((7, 3), np.int32)
    x, y, xr, d = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for t in range(len(prisms.corner)):
        _at_heights(prisms, t, 3, y)
        low, high = _range(y)
        if misses(low, high, first[0], rows):
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
        for face in faces[: _faces_seen(xr, y, d, faces)]:
            _hide_right(triple(xr, face), triple(y, face), triple(d, face), pixels, hidden)


@kernel
def interpolate(
    facets: FacetValues, index: Steps, first: tuple[int, int], out: PixelValues
) -> None:
    """What the triangle ``index`` [h, w] of each pixel has at its centre (eq. 10 and 11 of
    docs/explanation/surface.md), to ``out``."""
    xy, corner, h, count = facets.xy, facets.corner, facets.h, facets.count
    classes, noise, bulge = facets.surface_class, facets.variance, facets.bulge
    slope, variance, height, rise = out.slope, out.variance, out.height, out.rise
    surface_class, day = out.surface_class, out.day
    rows, cols = index.shape
    for j in range(rows):
        for i in range(cols):
            t = index[j, i]
            if t < 0:
                continue
            v = corner[t]
            x, y, xr = triple(xy[0], v), triple(xy[1], v), triple(xy[2], v)
            slope[0, j, i], slope[1, j, i] = plane_slopes(
                x, y, (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
            )
            b, c = corner_shares(x, y, first[1] + i - x[0], first[0] + j - y[0])
            a = 1.0 - b - c
            variance[j, i] = noise[t] * (
                a * a / count[v[0]] + b * b / count[v[1]] + c * c / count[v[2]]
            )
            rise[j, i] = bulge[t] * (a * b + b * c + c * a)
            height[j, i] = h[v[0]] + b * float(h[v[1]] - h[v[0]]) + c * float(h[v[2]] - h[v[0]])
            nearest = v[0] if a >= b and a >= c else v[1] if b >= c else v[2]
            surface_class[j, i], day[j, i] = classes[nearest], facets.day[nearest]


def right_pixels(
    row: Ints, col: Ints, disparity: Floats, first: tuple[int, int]
) -> tuple[Ints, RightPixels]:
    """Pixels [n] of a window, one at least, in their order in the right image, and where they are
    there."""
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
    return order, RightPixels((first[0], low), width, start, column[order], limit)
