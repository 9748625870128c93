"""The surface over the ground that LiDAR's points lie on: facets, and what is undecided between.

1. The points become vertices, one for each ground cell at most (:mod:`.vertices`).
2. Vertices become Delaunay triangles over the ground, the same in any window (:mod:`.delaunay`).
3. Triangles whose vertices lie on the planes of each other are facets (:mod:`.facets`).
4. Other triangles may span a height step. Where the points on both sides determine a breakline,
   a triangle is cut along it into facets and a strip (:mod:`.breaklines`, :mod:`.cut_triangles`).
5. What is left is undecided: it may hold any height between its lowest and its highest vertex.
6. Rough surfaces, of which no triangle is a facet, are triangles of their tops
   (:mod:`.rough_tops`).

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

from ..core.kernels import kernel
from .breaklines import breaklines
from .cut_triangles import cut_triangles, with_pieces
from .delaunay import triangulate
from .facets import facets, height_variances
from .rough_tops import RoughTops, rough_tops
from .scale import PART, SurfaceScale
from .vertices import Vertices, height_ranges

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]
Parts = NDArray[np.int16]


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
        facets = _by_part(part, self.facet_origin, parts)
        undecided = _by_part(part, self.undecided_origin, parts)
        tops = _by_part(part, self.tops.corner[:, 0], parts)
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
    wanted = np.ones(len(corner), np.bool_)
    near_undecided = _near_undecided(corner, planes.is_facet, vertices.x.size)
    if core is not None:
        own = core.holds(vertices)
        wanted = own.take(corner[:, 0])
        near_undecided &= core.holds(vertices, scale.rough_halo_cells)
    tops = rough_tops(vertices, near_undecided, scale)
    if core is not None:
        tops = tops.taken(np.flatnonzero(own.take(tops.corner[:, 0])))

    to_cut = np.flatnonzero(~planes.is_facet & wanted & (triangles.radius <= scale.facet_radius))
    lines = breaklines(
        vertices, triangles, planes.slopes, planes.is_facet, to_cut, scale, height_variances()
    )
    has_line = ~np.isnan(lines.line[:, 3])
    found = np.flatnonzero(has_line)
    to_cut, lines = to_cut[found], type(lines)(*(values.take(found, axis=0) for values in lines))
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
