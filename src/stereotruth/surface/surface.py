"""The surface over the ground that LiDAR's points lie on: facets, and what is undecided between.

1. The points become vertices, one for each ground cell at most (:mod:`.vertices`).
2. Vertices become Delaunay triangles over the ground, the same in any window (:mod:`.delaunay`).
3. Triangles whose vertices lie on the planes of each other are facets (:mod:`.facets`).
4. Other triangles may span a height step. Where the points on both sides determine a breakline,
   a triangle is cut along it into facets and a strip (:mod:`.breaklines`).
5. What is left is undecided: it may hold any height between its lowest and its highest vertex.
6. On rough surfaces, as crowns are, no triangle goes on the plane of its neighbours. Points far
   below others all around them went through the surface (:func:`_passed`): they are left out, and
   the others, its tops, are triangulated anew.

The surface knows no image: :class:`.scale.SurfaceScale` says what its cells and tolerances are.
It is made once for all pairs of a site, block by block (:mod:`.make_surface`). Equations and a
figure: docs/explanation/surface.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Bools, Floats, Ints
from .breaklines import Breaklines, breaklines
from .delaunay import Triangles, height_ranges, triangulate
from .facets import facets, height_variances
from .feasible_lines import clip
from .scale import PART, ROUGH_REACH, SurfaceScale, height_steps
from .vertices import Vertices

Steps = NDArray[np.int32]

FACET_PARTS, STRIP_PARTS = 4, 3  # triangles that a cut triangle has at most

# A point went through the surface if points higher than it by ``SurfaceScale.passed_m`` lie in all
# directions around it, no farther than ROUGH_REACH spacings of points, and are no fewer than the
# others there: a gap between crowns keeps its ground.
SECTORS = 12
WIDEST_GAP = 4  # empty sectors in a row, which leave no half of the directions without a point
FEWEST_HIGHER = 3
_ROOT_3 = np.sqrt(3.0)

Parts = NDArray[np.int16]


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
    parts: Floats, origin: Ints, size: int, cell: tuple[int, int], out: Vertices
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


@kernel
def _by_square(x: Ints, y: Ints, side: int, cols: int, rows: int) -> tuple[Steps, Steps]:
    """Vertices by squares of ``side`` parts of a cell, ``cols`` in a row: those of square k are
    ``member[start[k] : start[k + 1]]``, in their order."""
    start = np.zeros(rows * cols + 1, np.int32)
    for k in range(x.size):
        start[y[k] // side * cols + x[k] // side + 1] += 1
    for k in range(rows * cols):
        start[k + 1] += start[k]
    filled = start[:-1].copy()
    out = np.empty(x.size, np.int32)
    for k in range(x.size):
        b = y[k] // side * cols + x[k] // side
        out[filled[b]] = k
        filled[b] += 1
    return start, out


@inner
def _sector(dx: int, dy: int) -> int:
    """One of SECTORS directions of 30 degrees, counter-clockwise from east."""
    across, along = float(abs(dx)), float(abs(dy))
    part = 0 if along * _ROOT_3 < across else 1 if along < across * _ROOT_3 else 2
    if dy >= 0:
        return part if dx > 0 else 5 - part
    return 6 + part if dx < 0 else 11 - part


@kernel
def _passed(
    vertices: Vertices, start: Steps, member: Steps, cols: int, radius: float, lift: float
) -> Bools:
    """Which vertices lie below a surface around them, lower than it by ``lift`` (lattice steps):
    see SECTORS. ``start``, ``member``, ``cols``: of :func:`_by_square`."""
    # in the order of their squares, as they are looked at
    x, y = vertices.x[member].astype(np.int32), vertices.y[member].astype(np.int32)
    h = vertices.h_q[member].astype(np.int32)
    out = np.zeros(member.size, np.bool_)
    rows = (start.size - 1) // cols
    reach, higher_by = np.int32(radius * radius), np.int32(np.floor(lift))
    filled = np.empty(SECTORS, np.bool_)
    for j in range(rows):
        for i in range(cols):
            west, east = max(i - 1, 0), min(i + 2, cols)
            for k in range(start[j * cols + i], start[j * cols + i + 1]):
                higher = inside = np.int32(0)
                for b in range(max(j - 1, 0), min(j + 2, rows)):
                    for v in range(start[b * cols + west], start[b * cols + east]):
                        dx, dy = x[v] - x[k], y[v] - y[k]
                        near = np.int32(dx * dx + dy * dy <= reach)
                        inside += near
                        higher += near & np.int32(h[v] - h[k] > higher_by)
                if higher < FEWEST_HIGHER or higher < inside - 1 - higher:  # itself is inside
                    continue
                filled[:] = False
                for b in range(max(j - 1, 0), min(j + 2, rows)):
                    for v in range(start[b * cols + west], start[b * cols + east]):
                        dx, dy = x[v] - x[k], y[v] - y[k]
                        if h[v] - h[k] > higher_by and dx * dx + dy * dy <= reach:
                            filled[_sector(dx, dy)] = True
                empty = widest = 0
                for s in range(2 * SECTORS):
                    empty = 0 if filled[s % SECTORS] else empty + 1
                    widest = max(widest, empty)
                out[member[k]] = widest <= WIDEST_GAP
    return out


@kernel
def _rms_residuals(vertices: Vertices, triangles: Triangles, chosen: Bools) -> Floats:
    """Root mean square of the residuals of the far vertices of the ``chosen`` triangles beside each
    one, as the noise of one point (m of eq. 12 of docs/explanation/surface.md), lattice steps; NaN
    where there is none beside."""
    x, y, h = vertices.x, vertices.y, vertices.h_q
    corner, neighbour = triangles.corner, triangles.neighbour
    size = len(corner)
    total, number = np.zeros(size), np.zeros(size)
    for t in range(size):
        if not chosen[t]:
            continue
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        u, v, s, w = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
        area = float(u * w - v * s)
        for i in range(3):
            other = neighbour[t, i]
            if other < 0 or not chosen[other]:
                continue
            shared = a + b + c - corner[t, i]
            far = corner[other, 0] + corner[other, 1] + corner[other, 2] - shared
            p, q = float(x[far] - x[a]), float(y[far] - y[a])
            wb, wc = (p * w - q * s) / area, (q * u - p * v) / area
            wa = 1.0 - wb - wc
            off = h[far] - wa * h[a] - wb * h[b] - wc * h[c]
            total[t] += off * off / (1.0 + wa * wa + wb * wb + wc * wc)
            number[t] += 1.0
    out = np.full(size, np.nan)
    for t in range(size):
        squares, n = total[t], number[t]
        for i in range(3):
            other = neighbour[t, i]
            if other >= 0:
                squares += total[other]
                n += number[other]
        if n > 0.0:
            out[t] = np.sqrt(squares / n)
    return out


@dataclass(frozen=True, eq=False)
class RoughTops:
    """Triangles of the tops of rough surfaces.

    ``corner`` [m, 3]: of the surface's vertices; ``residual`` [m]: root mean square of these to the
    planes of the triangles beside; ``rise`` [m]: height of a triangle, both in lattice steps;
    ``is_gentle`` [m]: neither steep nor alone.
    """

    corner: Steps
    residual: Floats
    rise: Ints
    is_gentle: Bools

    def taken(self, chosen: NDArray[np.integer]) -> RoughTops:
        """The triangles of an index."""
        values = self.corner, self.residual, self.rise, self.is_gentle
        return RoughTops(*(one.take(chosen, axis=0) for one in values))


def rough_tops(vertices: Vertices, near_undecided: Bools, scale: SurfaceScale) -> RoughTops:
    """The rough surfaces of the ``vertices`` [n] that are ``near_undecided`` triangles."""
    number = np.flatnonzero(near_undecided).astype(np.int32)
    points = vertices.taken(number)
    radius = ROUGH_REACH * scale.spacing
    side = int(np.ceil(radius))
    cols, rows = (int(v.max(initial=0)) // side + 1 for v in (points.x, points.y))
    squares = _by_square(points.x, points.y, side, cols, rows)
    passed = _passed(points, *squares, cols, radius, height_steps(scale.passed_m))
    top = np.flatnonzero(~passed)
    tops = points.taken(top)
    triangles = triangulate(tops.x, tops.y, scale.facet_radius)
    rise = np.diff(height_ranges(tops.h_q, triangles.corner))[:, 0]
    is_flat = rise <= height_steps(scale.steep_m)
    residual = _rms_residuals(tops, triangles, is_flat)
    corner = number[top].take(triangles.corner)
    return RoughTops(corner, residual, rise, is_flat & np.isfinite(residual))


class Core(NamedTuple):
    """A box of the ground, of whose first and last cell ``low`` and ``high`` are the parts (x, y):
    the first belongs to it, the last does not."""

    low: tuple[int, int]
    high: tuple[int, int]

    def holds(self, vertices: Vertices, halo_cells: int = 0) -> Bools:
        """Which vertices [n] lie in it or up to so many cells around."""
        halo = halo_cells * PART
        out = np.ones(vertices.x.size, np.bool_)
        for values, low, high in zip((vertices.x, vertices.y), self.low, self.high):
            out &= (values >= low - halo) & (values < high + halo)
        return out


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Facets over the ground, and the triangles that may hold a height step.

    ``facet`` [m, 3]: triangles of ``vertices`` that lie on one surface, with the ``variance`` [m]
    of a point's height there (lattice steps²) and the ``bulge`` [m] of the surface above each
    (lattice steps, see :class:`.facets.Facets`). ``undecided`` [k, 3]: triangles that may hold any
    height in ``height_range`` [k, 2] (lattice steps). The first ``whole`` of these are triangles
    between unknown surfaces; the others are strips along breaklines, between two known ones.
    ``tops``: of rough surfaces. ``facet_origin`` [m], ``undecided_origin`` [k]: first vertex of
    the triangle that each is or was cut from.
    """

    vertices: Vertices
    facet: Steps
    variance: NDArray[np.floating]
    bulge: NDArray[np.floating]
    undecided: Steps
    height_range: Ints
    whole: int
    tops: RoughTops
    facet_origin: Steps
    undecided_origin: Steps

    @property
    def strips(self) -> slice:
        """Those of the undecided triangles that are strips along breaklines."""
        return slice(self.whole, len(self.undecided))

    def split(self, part: Parts, parts: int) -> Iterator[GroundSurface]:
        """The triangles whose first vertex lies in each of so many ``parts``, with all vertices.

        ``part`` [n] of each vertex, -1 for none. Of a triangle that is cut, the part is that of the
        whole triangle.
        """
        origins = self.facet_origin, self.undecided_origin, self.tops.corner[:, 0]
        facets, undecided, tops = (_by_part(part, origin, parts) for origin in origins)
        for facet, triangle, top in zip(facets, undecided, tops):
            yield replace(
                self,
                facet=self.facet.take(facet, axis=0),
                variance=self.variance.take(facet),
                bulge=self.bulge.take(facet),
                undecided=self.undecided.take(triangle, axis=0),
                height_range=self.height_range.take(triangle, axis=0),
                whole=int(np.searchsorted(triangle, self.whole)),
                tops=self.tops.taken(top),
                facet_origin=self.facet_origin.take(facet),
                undecided_origin=self.undecided_origin.take(triangle),
            )


@kernel
def _sorted_by_part(part: Parts, origin: Steps, parts: int) -> tuple[Steps, Ints]:
    """Triangles by the ``part`` [n] of their first vertex ``origin`` [m], in their order, and where
    those of each one begin."""
    begin = np.zeros(parts + 1, np.int64)
    for v in origin:
        begin[part[v] + 1] += part[v] >= 0
    for k in range(parts):
        begin[k + 1] += begin[k]
    order, filled = np.empty(begin[parts], np.int32), begin.copy()
    for t in range(origin.size):
        k = part[origin[t]]
        if k >= 0:
            order[filled[k]] = t
            filled[k] += 1
    return order, begin


def _by_part(part: Parts, origin: Steps, parts: int) -> list[Steps]:
    """Which triangles of first vertices ``origin`` [m] lie in each of so many ``parts``."""
    order, begin = _sorted_by_part(part, origin, parts)
    return [order[first:end] for first, end in pairwise(begin.tolist())]


def ground_surface(
    vertices: Vertices, scale: SurfaceScale, core: Core | None = None
) -> GroundSurface:
    """The surface of ``vertices``; with a ``core``, the triangles whose first vertex lies in it.

    With the vertices up to ``scale.halo_cells`` around, these have the same bytes for any core.
    """
    triangles = triangulate(vertices.x, vertices.y, scale.swept_radius)
    planes = facets(vertices, triangles, scale)
    corner = triangles.corner
    wanted = fitted = np.ones(len(corner), np.bool_)
    near_undecided = _near_undecided(corner, planes.is_facet, vertices.x.size)
    if core is not None:
        own = core.holds(vertices)
        wanted = own.take(corner[:, 0])
        fitted = core.holds(vertices, scale.shared_cells).take(corner[:, 0])
        near_undecided &= core.holds(vertices, scale.rough_halo_cells)
    tops = rough_tops(vertices, near_undecided, scale)
    if core is not None:
        tops = tops.taken(np.flatnonzero(own.take(tops.corner[:, 0])))

    to_cut = np.flatnonzero(~planes.is_facet & fitted & (triangles.radius <= scale.facet_radius))
    lines = breaklines(
        vertices, triangles, planes.slopes, planes.is_facet, to_cut, scale, height_variances()
    )
    lined = np.flatnonzero(~np.isnan(lines.line[:, 3]) & wanted[to_cut])
    to_cut, lines = (
        to_cut[lined],
        type(lines)(*(values.take(lined, axis=0) for values in lines)),
    )
    cut = corner.take(to_cut, axis=0)
    pieces = cut_triangles(vertices, cut, lines)
    every, cut_facets, strips = with_pieces(vertices, cut, lines, pieces, scale.cell)

    uncut = np.flatnonzero(planes.is_facet & wanted)
    facet = corner.take(uncut, axis=0)
    is_whole = ~planes.is_facet & wanted
    is_whole[to_cut] = False
    whole = corner.take(np.flatnonzero(is_whole), axis=0)
    first = cut[:, 0]
    cut_variance = lines.variance[pieces.facet_of, pieces.facet_side]
    return GroundSurface(
        vertices=every,
        facet=np.concatenate([facet, cut_facets]),
        variance=np.concatenate([planes.variance.take(uncut), cut_variance]),
        bulge=np.concatenate([planes.bulge.take(uncut), np.zeros(len(cut_facets))]),
        undecided=np.concatenate([whole, strips]),
        height_range=np.concatenate(
            [height_ranges(vertices.h_q, whole), np.rint(pieces.heights).astype(np.int64)]
        ),
        whole=len(whole),
        tops=tops,
        facet_origin=np.concatenate([facet[:, 0], first[pieces.facet_of]]),
        undecided_origin=np.concatenate([whole[:, 0], first[pieces.strip_of]]),
    )


@kernel
def _near_undecided(corner: Steps, is_facet: Bools, vertices: int) -> Bools:
    """Vertices [n] that share a triangle with one of an undecided triangle."""
    of_undecided, out = np.zeros(vertices, np.bool_), np.zeros(vertices, np.bool_)
    for t in range(len(corner)):
        if not is_facet[t]:
            for i in range(3):
                of_undecided[corner[t, i]] = True
    for t in range(len(corner)):
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        if of_undecided[a] or of_undecided[b] or of_undecided[c]:
            out[a] = out[b] = out[c] = True
    return out
