"""The surface over the ground that LiDAR's points lie on: facets, and what is undecided between.

1. The points become vertices, one for each ground cell at most (:mod:`.vertices`).
2. Vertices become Delaunay triangles over the ground, the same in any window (:mod:`.delaunay`).
3. Triangles whose vertices lie on the planes of each other are facets (:mod:`.facets`).
4. Other triangles may span a height step. Where the points on both sides determine a breakline,
   a triangle is cut along it into facets and a strip (:mod:`.breaklines`, :mod:`.cut_triangles`).
5. What is left is undecided: it may hold any height between its lowest and its highest vertex.

The surface knows no image: :class:`.scale.SurfaceScale` says what a pixel is on the ground and in
height, :class:`.region.Region` which part of the ground is wanted. Equations and a figure:
docs/explanation/surface.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .breaklines import breaklines
from .cut_triangles import cut_triangles, with_pieces
from .delaunay import Triangles, triangulate
from .facets import Facets, facets, height_variances
from .region import Region
from .scale import SurfaceScale
from .vertices import Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Facets over the ground, and the triangles that may hold a height step.

    ``facet`` [m, 3]: triangles of ``vertices`` that lie on one surface, with the ``variance`` [m]
    of a point's height there (lattice steps²) and the ``bulge`` [m] of the surface above each
    (lattice steps, see :class:`.facets.Facets`). ``undecided`` [k, 3]: triangles that may hold any
    height in ``height_range`` [k, 2] (lattice steps). The first ``whole`` of these are triangles
    between unknown surfaces; the others are strips along breaklines, between two known ones.
    ``near_undecided`` [n]: which of the first vertices, those of points, are near an undecided
    triangle, and may belong to a rough surface.
    """

    vertices: Vertices
    facet: Steps
    variance: Floats
    bulge: Floats
    undecided: Steps
    height_range: Ints
    whole: int
    near_undecided: Bools

    @property
    def strips(self) -> slice:
        """Those of the undecided triangles that are strips along breaklines."""
        return slice(self.whole, len(self.undecided))


def ground_surface(
    vertices: Vertices, scale: SurfaceScale, region: Region | None = None
) -> GroundSurface:
    """The surface of ``vertices``; with a ``region``, that over its squares alone."""
    if region is not None:
        vertices = region.with_halo(vertices, scale.halo_cells)
    triangles = triangulate(vertices.x, vertices.y, scale.swept_radius)
    planes = facets(vertices, triangles, scale)
    corner = triangles.corner
    wanted = np.ones(len(corner), np.bool_)
    near_undecided = _near_undecided(vertices, triangles, planes)
    if region is not None:
        wanted = region.touching(vertices, corner)
        near_undecided &= region.near(vertices, scale.rough_halo_cells)

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
    cut_variance = lines.variance[pieces.facet_of, pieces.facet_side]
    return GroundSurface(
        vertices=every,
        facet=np.concatenate([corner[is_facet], cut_facets]),
        variance=np.concatenate([planes.variance[is_facet], cut_variance]),
        bulge=np.concatenate([planes.bulge[is_facet], np.zeros(len(cut_facets))]),
        undecided=np.concatenate([whole, strips]),
        height_range=np.concatenate([whole_range, np.rint(pieces.heights).astype(np.int64)]),
        whole=len(whole),
        near_undecided=near_undecided,
    )


def _near_undecided(vertices: Vertices, triangles: Triangles, planes: Facets) -> Bools:
    """Vertices [n] that share a triangle with one of an undecided triangle."""
    near = np.zeros(vertices.x.size, np.bool_)
    near[triangles.corner[~planes.is_facet].reshape(-1)] = True
    touched = near[triangles.corner].any(axis=1)
    near = np.zeros(vertices.x.size, np.bool_)
    near[triangles.corner[touched].reshape(-1)] = True
    return near
