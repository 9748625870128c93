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

from .breaklines import breaklines
from .cut_triangles import cut_triangles, with_pieces
from .delaunay import Triangles, triangulate
from .facets import Facets, facets, height_variances
from .rough_tops import RoughTops, rough_tops
from .scale import PART, SurfaceScale
from .vertices import Vertices

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
        facets = _by_part(part[self.facet_origin], parts)
        undecided = _by_part(part[self.undecided_origin], parts)
        tops = _by_part(part[self.tops.corner[:, 0]], parts)
        for facet, triangle, top in zip(facets, undecided, tops):
            yield replace(
                self,
                facet=self.facet[facet],
                variance=self.variance[facet],
                bulge=self.bulge[facet],
                undecided=self.undecided[triangle],
                height_range=self.height_range[triangle],
                whole=int(np.searchsorted(triangle, self.whole)),
                tops=self.tops.taken(top),
                facet_origin=self.facet_origin[facet],
                undecided_origin=self.undecided_origin[triangle],
            )


def _by_part(part: Parts, parts: int) -> list[Ints]:
    """Which triangles, of the ``part`` [m] of each, lie in each of so many; in their order."""
    order = np.argsort(part, kind="stable")
    ends = np.searchsorted(part[order], np.arange(parts + 1))
    return [order[first:end] for first, end in pairwise(ends)]


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
    near_undecided = _near_undecided(vertices, triangles, planes)
    if core is not None:
        own = core.holds(vertices)
        wanted = own[corner[:, 0]]
        near_undecided &= core.holds(vertices, scale.rough_halo_cells)
    tops = rough_tops(vertices, near_undecided, scale)
    if core is not None:
        tops = tops.taken(own[tops.corner[:, 0]])

    to_cut = np.flatnonzero(~planes.is_facet & wanted & (triangles.radius <= scale.facet_radius))
    lines = breaklines(
        vertices, triangles, planes.slopes, planes.is_facet, to_cut, scale, height_variances()
    )
    has_line = ~np.isnan(lines.line[:, 3])
    to_cut, lines = to_cut[has_line], type(lines)(*(values[has_line] for values in lines))
    pieces = cut_triangles(vertices, corner[to_cut], lines)
    every, cut_facets, strips = with_pieces(vertices, corner[to_cut], lines, pieces, scale.cell)

    is_facet = planes.is_facet & wanted
    is_whole = ~planes.is_facet & wanted
    is_whole[to_cut] = False
    whole = corner[is_whole]
    whole_range = np.stack([vertices.h_q[whole].min(axis=1), vertices.h_q[whole].max(axis=1)], 1)
    first = corner[to_cut, 0]
    cut_variance = lines.variance[pieces.facet_of, pieces.facet_side]
    return GroundSurface(
        vertices=every,
        facet=np.concatenate([corner[is_facet], cut_facets]),
        variance=np.concatenate([planes.variance[is_facet], cut_variance]),
        bulge=np.concatenate([planes.bulge[is_facet], np.zeros(len(cut_facets))]),
        undecided=np.concatenate([whole, strips]),
        height_range=np.concatenate([whole_range, np.rint(pieces.heights).astype(np.int64)]),
        whole=len(whole),
        tops=tops,
        facet_origin=np.concatenate([corner[is_facet, 0], first[pieces.facet_of]]),
        undecided_origin=np.concatenate([whole[:, 0], first[pieces.strip_of]]),
    )


def _near_undecided(vertices: Vertices, triangles: Triangles, planes: Facets) -> Bools:
    """Vertices [n] that share a triangle with one of an undecided triangle."""
    near = np.zeros(vertices.x.size, np.bool_)
    near[triangles.corner[~planes.is_facet].reshape(-1)] = True
    touched = near[triangles.corner].any(axis=1)
    near = np.zeros(vertices.x.size, np.bool_)
    near[triangles.corner[touched].reshape(-1)] = True
    return near
