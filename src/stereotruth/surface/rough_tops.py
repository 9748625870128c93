"""Rough surfaces, as crowns are: their tops, and the triangles of these.

On a rough surface no triangle of points goes on the plane of its neighbours, so that all of them
are undecided (:mod:`.facets`). Points far below others all around them went through the surface
(:func:`_passed`): they are left out, and the others, its tops, are triangulated anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inner, kernel
from .delaunay import Triangles, triangulate
from .scale import ROUGH_REACH, SurfaceScale, height_steps
from .vertices import Vertices, height_ranges

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

# A point went through the surface if points higher than it by ``SurfaceScale.passed_m`` lie in all
# directions around it, no farther than ROUGH_REACH spacings of points, and are no fewer than the
# others there: a gap between crowns keeps its ground.
SECTORS = 12
WIDEST_GAP = 4  # empty sectors in a row, which leave no half of the directions without a point
FEWEST_HIGHER = 3
_ROOT_3 = np.sqrt(3.0)


class _Squares(NamedTuple):
    """Vertices by squares, ``cols`` in a row: those of square k are ``member[start[k] : start[k +
    1]]``, in their order."""

    start: Steps
    member: Steps
    cols: int


@kernel
def _by_square(x: Ints, y: Ints, side: int, cols: int, rows: int) -> tuple[Steps, Steps]:
    """``start`` and ``member`` of :class:`_Squares` of ``side`` parts of a cell."""
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
def _passed(vertices: Vertices, squares: _Squares, radius: float, lift: float) -> Bools:
    """Which vertices lie below a surface around them, lower than it by ``lift`` (lattice steps):
    see SECTORS."""
    start, member, cols = squares.start, squares.member, squares.cols
    # in the order of their squares, as they are looked at
    x, y, h = (
        vertices.x[member].astype(np.int32),
        vertices.y[member].astype(np.int32),
        vertices.h_q[member].astype(np.int32),
    )
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
    squares = _Squares(*_by_square(points.x, points.y, side, cols, rows), cols)
    top = np.flatnonzero(~_passed(points, squares, radius, height_steps(scale.passed_m)))
    tops = points.taken(top)
    triangles = triangulate(tops.x, tops.y, scale.facet_radius)
    rise = np.diff(height_ranges(tops.h_q, triangles.corner))[:, 0]
    is_flat = rise <= height_steps(scale.steep_m)
    residual = _rms_residuals(tops, triangles, is_flat)
    corner = number[top].take(triangles.corner)
    return RoughTops(corner, residual, rise, is_flat & np.isfinite(residual))
