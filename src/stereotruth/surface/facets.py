"""Facets: the triangles that lie on one surface.

A triangle is a *facet* if its vertices lie on the planes that the surface has at each of them (the
slopes of the gentlest triangle there), or on the plane of a facet beside it (creases, ridges), with
a residual of ``SurfaceScale.residual_m`` at most, and if MIN_FACET_NEIGHBOURS of its neighbours do,
too; or if it is part of a dome (a crown), that falls away from those planes to all sides. Every
other triangle is *undecided*: it may span a height step.

All follows from the triangles around a place alone, so that results have the same bytes in any
window that has the points of its halo (:class:`.scale.SurfaceScale`). Heights, residuals and
variances are in lattice steps, slopes in lattice steps per part of a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from .delaunay import Triangles
from .scale import HEIGHT_NOISE_M, PART, PRIOR_NOISE_M, SurfaceScale, height_steps
from .vertices import Vertices

Steps = NDArray[np.int32]

# The slopes of a triangle count if it is no sliver: least altitude in spacings, and in cells.
SLIVER_SPACINGS = 0.25
SLIVER_CELLS = 0.5
# Of a facet's three neighbours so many lie on the surface, too: in crowns single triangles are
# level by chance (0.26 instead of 0.47 % of the hidden pixels of a forest had labels at 1
# point/m²).
MIN_FACET_NEIGHBOURS = 2
# The slopes are those of the gentlest triangles, on the inner side of a dome, and have this share
# of its curvature.
CURVATURE_SHARE = 0.6


class Facets(NamedTuple):
    """What the triangles [m] are.

    ``is_facet`` [m]; ``variance`` [m]: of the height of a point at each facet; ``bulge`` [m]: the
    surface lies above the facet by this times the sum of the products of two barycentric
    coordinates, the form of a quadratic function between its values at the vertices; ``slopes``
    [n, 2] of the facets at each vertex, NaN for none.
    """

    is_facet: Bools
    variance: Floats
    bulge: Floats
    slopes: Floats


def height_variances() -> tuple[float, float]:
    """Prior and least variance of a point's height."""
    return height_steps(PRIOR_NOISE_M) ** 2, height_steps(HEIGHT_NOISE_M) ** 2


@inlined
def _slopes(x: Ints, y: Ints, h: Ints, a: int, b: int, c: int) -> tuple[float, float, float]:
    """Slopes of a triangle (eq. 1 of docs/explanation/surface.md), and twice its area."""
    u, v, s, t = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
    p, q = h[b] - h[a], h[c] - h[a]
    area = float(u * t - v * s)
    return float(p * t - q * v) / area, float(q * u - p * s) / area, area


@inlined
def _far_vertex(corner: Steps, t: int, i: int, u: int) -> int:
    """The vertex of triangle u, opposite vertex i of triangle t, that t has not."""
    shared = corner[t, 0] + corner[t, 1] + corner[t, 2] - corner[t, i]
    return corner[u, 0] + corner[u, 1] + corner[u, 2] - shared


@inlined
def _residual(x: Ints, y: Ints, h: Ints, v: int, w: int, gx: float, gy: float) -> float:
    """Height of vertex w above the plane of slopes (gx, gy) through vertex v (eq. 2 of
    docs/explanation/surface.md)."""
    return float(h[w] - h[v]) - gx * float(x[w] - x[v]) - gy * float(y[w] - y[v])


@kernel
def _vertex_slopes(
    vertices: Vertices, triangles: Triangles, chosen: Bools, least_altitude: float
) -> Floats:
    """Slopes [n, 2] of the gentlest ``chosen`` triangle at each vertex (eq. 1 of
    docs/explanation/surface.md), slivers apart; NaN where none is."""
    x, y, h, corner = vertices.x, vertices.y, vertices.h_q, triangles.corner
    out, least = np.full((x.size, 2), np.nan), np.full(x.size, np.inf)
    for t in range(len(corner)):
        if not chosen[t]:
            continue
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        gx, gy, area = _slopes(x, y, h, a, b, c)
        longest = 0
        for p, q in ((a, b), (b, c), (c, a)):
            longest = max(longest, (x[p] - x[q]) ** 2 + (y[p] - y[q]) ** 2)
        if area * area < least_altitude * least_altitude * longest:
            continue
        steep = gx * gx + gy * gy
        for v in (a, b, c):
            # Equally steep ones: by their slopes, so that the order does not count.
            if steep == least[v] and (gx, gy) > (out[v, 0], out[v, 1]):
                continue
            gentler = steep <= least[v]  # the processor could not predict a branch
            out[v, 0] = gx if gentler else out[v, 0]
            out[v, 1] = gy if gentler else out[v, 1]
            least[v] = steep if gentler else least[v]
    return out


@kernel
def _on_vertex_planes(
    vertices: Vertices, corner: Steps, small: Bools, slopes: Floats, tolerance: float
) -> Bools:
    """Which of the ``small`` triangles lie on the planes of all three vertices (eq. 2 of
    docs/explanation/surface.md)."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    out = np.zeros(len(corner), np.bool_)
    for t in range(len(corner)):
        if not small[t]:
            continue
        good = True
        for i in range(3):
            v = corner[t, i]
            for k in range(1, 3):
                w = corner[t, (i + k) % 3]
                if not abs(_residual(x, y, h, v, w, slopes[v, 0], slopes[v, 1])) <= tolerance:
                    good = False
        out[t] = good
    return out


@kernel
def _incident(corner: Steps, chosen: Bools, vertices: int) -> tuple[Steps, Steps]:
    """The ``chosen`` triangles at each vertex: ``list[start[v] : start[v + 1]]``."""
    start = np.zeros(vertices + 1, np.int32)
    for t in range(len(corner)):
        for i in range(3):
            start[corner[t, i] + 1] += chosen[t]
    for v in range(vertices):
        start[v + 1] += start[v]
    filled = start[:-1].copy()
    out = np.empty(start[vertices], np.int32)
    for t in range(len(corner)):
        if chosen[t]:
            for i in range(3):
                v = corner[t, i]
                out[filled[v]] = t
                filled[v] += 1
    return start, out


@kernel
def _with_creases(
    vertices: Vertices, corner: Steps, small: Bools, on_planes: Bools, tolerance: float
) -> Bools:
    """The triangles ``on_planes`` of their vertices, and the ``small`` ones on the plane of such a
    triangle that shares a vertex with them (eq. 2 of docs/explanation/surface.md)."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    start, around = _incident(corner, on_planes, x.size)
    out = on_planes.copy()
    for t in range(len(corner)):
        if on_planes[t] or not small[t]:
            continue
        for i in range(3):
            v = corner[t, i]
            for k in range(start[v], start[v + 1]):
                f = around[k]
                gx, gy, _ = _slopes(x, y, h, corner[f, 0], corner[f, 1], corner[f, 2])
                b, c = corner[t, (i + 1) % 3], corner[t, (i + 2) % 3]
                if (
                    abs(_residual(x, y, h, v, b, gx, gy)) <= tolerance
                    and abs(_residual(x, y, h, v, c, gx, gy)) <= tolerance
                ):
                    out[t] = True
                    break
            if out[t]:
                break
    return out


@kernel
def _domes(
    vertices: Vertices,
    triangles: Triangles,
    small: Bools,
    slopes: Floats,
    tolerance: float,
    height: float,
) -> Bools:
    """The ``small`` triangles no higher than ``height`` that bulge: the vertices beside them lie on
    their planes or below, and their own on the planes of each other or below, by ``tolerance`` at
    most above (eq. 3 of docs/explanation/surface.md)."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    corner, neighbour = triangles.corner, triangles.neighbour
    out = np.zeros(len(corner), np.bool_)
    for t in range(len(corner)):
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        low, high = min(h[a], h[b], h[c]), max(h[a], h[b], h[c])
        good = small[t] and high - low <= height
        for v, w, u in ((a, b, c), (b, c, a), (c, a, b)):
            if not good:
                break
            for other in (w, u):
                if not _residual(x, y, h, v, other, slopes[v, 0], slopes[v, 1]) <= tolerance:
                    good = False
        if not good:
            continue
        gx, gy, _ = _slopes(x, y, h, a, b, c)
        for i in range(3):
            u = neighbour[t, i]
            if u < 0:
                good = False
                break
            far = _far_vertex(corner, t, i, u)
            if _residual(x, y, h, a, far, gx, gy) > tolerance:
                good = False
        out[t] = good
    return out


@kernel
def _with_neighbours(chosen: Bools, neighbour: Steps) -> Bools:
    """The ``chosen`` triangles of which MIN_FACET_NEIGHBOURS neighbours are chosen, too."""
    out = np.zeros(len(chosen), np.bool_)
    for t in range(len(chosen)):
        number = 0
        for i in range(3):
            u = neighbour[t, i]
            number += u >= 0 and chosen[u]
        out[t] = chosen[t] and number >= MIN_FACET_NEIGHBOURS
    return out


@kernel
def _bulges(
    vertices: Vertices, corner: Steps, is_facet: Bools, slopes: Floats, least: float
) -> Floats:
    """Mean residual by which the vertices of each facet lie below the planes of each other (B of
    eq. 11 of docs/explanation/surface.md); 0 for less than ``least``."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    out = np.zeros(len(corner))
    for t in range(len(corner)):
        if not is_facet[t]:
            continue
        below = 0.0
        for i in range(3):
            v = corner[t, i]
            for k in range(1, 3):
                w = corner[t, (i + k) % 3]
                below -= _residual(x, y, h, v, w, slopes[v, 0], slopes[v, 1]) / 6.0
        if below >= least:
            out[t] = below
    return out


@kernel
def _residual_sums(
    vertices: Vertices, triangles: Triangles, is_facet: Bools
) -> tuple[Floats, Floats]:
    """Per facet, of the far vertices of the facets beside it: sum of the squared residuals, number.

    A residual is divided by its standard deviation where all points have a variance of one (eq. 9
    of docs/explanation/surface.md).
    """
    x, y, h, count = vertices.x, vertices.y, vertices.h_q, vertices.count
    corner, neighbour = triangles.corner, triangles.neighbour
    total, number = np.zeros(len(corner)), np.zeros(len(corner))
    for t in range(len(corner)):
        if not is_facet[t]:
            continue
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        gx, gy, area = _slopes(x, y, h, a, b, c)
        for i in range(3):
            u = neighbour[t, i]
            if u < 0 or not is_facet[u]:
                continue
            far = _far_vertex(corner, t, i, u)
            # Barycentric coordinates of the far vertex.
            wa = ((x[b] - x[far]) * (y[c] - y[far]) - (y[b] - y[far]) * (x[c] - x[far])) / area
            wb = ((x[c] - x[far]) * (y[a] - y[far]) - (y[c] - y[far]) * (x[a] - x[far])) / area
            wc = 1.0 - wa - wb
            off = _residual(x, y, h, a, far, gx, gy)
            scale = wa * wa / count[a] + wb * wb / count[b] + wc * wc / count[c]
            total[t] += off * off / (1.0 / count[far] + scale)
            number[t] += 1.0
    return total, number


@kernel
def _height_variances(
    neighbour: Steps, is_facet: Bools, total: Floats, number: Floats, prior: float, least: float
) -> Floats:
    """Variance of a point's height at each facet, pooled with its neighbours (eq. 9 of
    docs/explanation/surface.md).

    ``prior`` counts as one residual more, ``least`` is the floor.
    """
    out = np.zeros(len(is_facet))
    for t in range(len(is_facet)):
        if not is_facet[t]:
            continue
        s, n = total[t] + prior, number[t] + 1.0
        for i in range(3):
            u = neighbour[t, i]
            if u >= 0:
                s += total[u]
                n += number[u]
        out[t] = max(s / n, least)
    return out


def facets(vertices: Vertices, triangles: Triangles, scale: SurfaceScale) -> Facets:
    """Which of the ``triangles`` lie on one surface, and how it goes on there."""
    corner, neighbour = triangles.corner, triangles.neighbour
    small = triangles.radius <= scale.facet_radius
    tolerance = height_steps(scale.residual_m)
    altitude = max(SLIVER_SPACINGS * scale.spacing, SLIVER_CELLS * PART)
    gentlest = _vertex_slopes(vertices, triangles, small, altitude)
    on_planes = _on_vertex_planes(vertices, corner, small, gentlest, tolerance)
    on_planes = _with_creases(vertices, corner, small, on_planes, tolerance)
    is_facet = _with_neighbours(on_planes, neighbour)
    dome = height_steps(scale.dome_m)
    is_facet |= _domes(vertices, triangles, small, gentlest, tolerance, dome)
    total, number = _residual_sums(vertices, triangles, is_facet)
    variance = _height_variances(neighbour, is_facet, total, number, *height_variances())
    bulge = _bulges(vertices, corner, is_facet, gentlest, height_steps(scale.bulge_m))
    slopes = _vertex_slopes(vertices, triangles, is_facet & small, altitude)
    return Facets(is_facet, variance, bulge / CURVATURE_SHARE, slopes)
