"""Triangles cut at their breaklines: facets on both sides, and the strip in between."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from .breaklines import Breaklines
from .feasible_lines import clip
from .scale import PART
from .vertices import Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

FACET_PARTS, STRIP_PARTS = 4, 3  # triangles that a cut triangle has at most


class Pieces(NamedTuple):
    """Parts of the triangles [m] that a breakline cuts; x, y count from a triangle's first vertex.

    ``facet`` [n, 3, 3]: triangles on a plane, corners (x, y in parts of a cell, height in lattice
    steps); ``facet_of`` [n]: number of the triangle; ``facet_side`` [n]: 1 on the high plane.
    ``strip`` [k, 3, 2]: triangles that may hold any height between ``heights`` [k, 2]; ``strip_of``
    [k].
    """

    facet: Floats
    facet_of: Steps
    facet_side: Steps
    strip: Floats
    strip_of: Steps
    heights: Floats


@inlined
def _cut_facets(
    corner: tuple[Floats, Floats],
    lines: Breaklines,
    room: tuple[Floats, Floats],
    t: int,
    n: int,
    out: Pieces,
) -> int:
    """The parts of a triangle on either side of its strip, from part ``n`` on; where they end."""
    line, planes = lines.line, lines.planes
    p, q, r, w = line[t, 0], line[t, 1], line[t, 2], line[t, 3]
    lowest, highest = planes[t, 6], planes[t, 7]
    ax, ay = room
    for side in range(2):
        sign = 1.0 if side == 0 else -1.0
        m = clip(corner[0], corner[1], 3, sign * p, sign * q, sign * r - w, ax, ay)
        level, gx, gy = planes[t, 3 * side], planes[t, 3 * side + 1], planes[t, 3 * side + 2]
        for j in range(1, m - 1):
            for at, c in enumerate((0, j, j + 1)):
                out.facet[n, at, 0], out.facet[n, at, 1] = ax[c], ay[c]
                height = level + gx * ax[c] + gy * ay[c]
                out.facet[n, at, 2] = min(max(height, lowest), highest)
            out.facet_of[n], out.facet_side[n] = t, side
            n += 1
    return n


@kernel
def _cut(x: Ints, y: Ints, corner: Steps, lines: Breaklines, out: Pieces) -> tuple[int, int]:
    """Cuts triangles [m, 3] at their strips (eq. 6 of docs/explanation/surface.md), to ``out``; how
    many facets and strips there are."""
    px, py = np.empty(8), np.empty(8)
    ax, ay = np.empty(8), np.empty(8)
    bx, by = np.empty(8), np.empty(8)
    line, planes = lines.line, lines.planes
    n = k = 0
    for t in range(len(corner)):
        p, q, r, w = line[t, 0], line[t, 1], line[t, 2], line[t, 3]
        lowest, highest = planes[t, 6], planes[t, 7]
        for i in range(3):
            v = corner[t, i]
            px[i], py[i] = float(x[v] - x[corner[t, 0]]), float(y[v] - y[corner[t, 0]])
        n = _cut_facets((px, py), lines, (ax, ay), t, n, out)
        m = clip(px, py, 3, p, q, r + w, ax, ay)
        m = clip(ax, ay, m, -p, -q, w - r, bx, by)
        bottom, top = np.inf, -np.inf
        for c in range(m):
            bottom = min(bottom, planes[t, 0] + planes[t, 1] * bx[c] + planes[t, 2] * by[c])
            top = max(top, planes[t, 3] + planes[t, 4] * bx[c] + planes[t, 5] * by[c])
        for j in range(1, m - 1):
            for at, c in enumerate((0, j, j + 1)):
                out.strip[k, at, 0], out.strip[k, at, 1] = bx[c], by[c]
            out.heights[k, 0] = min(max(bottom, lowest), highest)
            out.heights[k, 1] = min(max(top, lowest), highest)
            out.strip_of[k] = t
            k += 1
    return n, k


def cut_triangles(vertices: Vertices, corner: Steps, lines: Breaklines) -> Pieces:
    """The parts of the triangles ``corner`` [m, 3] that ``lines`` [m] cut."""
    most_facets, most_strips = FACET_PARTS * len(corner), STRIP_PARTS * len(corner)
    out = Pieces(
        np.empty((most_facets, 3, 3)),
        np.empty(most_facets, np.int32),
        np.empty(most_facets, np.int32),
        np.empty((most_strips, 3, 2)),
        np.empty(most_strips, np.int32),
        np.empty((most_strips, 2)),
    )
    n, k = _cut(vertices.x, vertices.y, corner, lines, out)
    return Pieces(*(values[:n] for values in out[:3]), *(values[:k] for values in out[3:]))


@kernel
def _fill_positions(
    parts: Floats,
    origin: Ints,
    size: int,
    cell: tuple[int, int],
    out: Vertices,
) -> None:
    """Positions of the corners of ``parts`` [n, 3, :], which count from the vertices ``origin``
    [n], to the vertices of ``out`` from ``size`` on."""
    lon_q, lat_q, x, y = out.lon_q, out.lat_q, out.x, out.y
    for n in range(len(origin)):
        first = origin[n]
        for i in range(3):
            k = size + 3 * n + i
            across, along = parts[n, i, 0], parts[n, i, 1]
            lon_q[k] = lon_q[first] + np.int64(np.rint(across * (cell[0] / PART)))
            lat_q[k] = lat_q[first] + np.int64(np.rint(along * (cell[1] / PART)))
            x[k], y[k] = x[first] + np.int64(np.rint(across)), y[first] + np.int64(np.rint(along))


def with_pieces(
    vertices: Vertices, corner: Steps, lines: Breaklines, pieces: Pieces, cell: tuple[int, int]
) -> tuple[Vertices, Steps, Steps]:
    """The vertices and the corners of pieces; corners of their facets [n, 3] and strips [k, 3].

    ``corner`` [m, 3], ``lines`` [m]: the triangles that are cut.
    """
    size = vertices.x.size
    facets, strips = 3 * len(pieces.facet_of), 3 * len(pieces.strip_of)
    out = Vertices(*(np.empty(size + facets + strips, own.dtype) for own in vertices))
    for whole, own in zip(out, vertices):
        whole[:size] = own
    _fill_positions(pieces.facet, corner[pieces.facet_of, 0], size, cell, out)
    _fill_positions(pieces.strip, corner[pieces.strip_of, 0], size + facets, cell, out)
    height, classes = out.h_q[size:], out.surface_class[size:]
    np.rint(pieces.facet[..., 2].reshape(-1), out=height[:facets], casting="unsafe")
    height[facets:] = np.repeat(np.rint(pieces.heights[:, 0]), 3)
    anchor = lines.anchor[pieces.facet_of, pieces.facet_side]
    classes[:facets] = np.repeat(vertices.surface_class[anchor], 3)
    classes[facets:] = np.repeat(vertices.surface_class[corner[pieces.strip_of, 0]], 3)
    out.day[size : size + facets] = np.repeat(vertices.day[anchor], 3)
    out.day[size + facets :] = np.repeat(vertices.day[corner[pieces.strip_of, 0]], 3)
    out.count[size:] = 1
    index = np.arange(size, size + facets + strips, dtype=np.int32).reshape(-1, 3)
    return out, index[: facets // 3], index[facets // 3 :]
