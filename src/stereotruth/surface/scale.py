"""What decides whether points lie on one surface: ground cells, spacing of points, tolerances.

The surface knows no image. What a pixel is on the ground and in height comes in as one
:class:`SurfaceScale` of plain values, so that one surface can serve several pairs of a site.

Plan positions are integers: parts of a ground cell (``PART`` of them along each axis), counted on
the global lattice (:mod:`stereotruth.lidar.lattice`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..lidar.lattice import LATTICE_M

PART_BITS = 5
PART = 1 << PART_BITS  # parts of a cell along each axis: 1 cm at pixels of 0.65 m

# Circumradius of the largest triangle that can be a facet, in spacings of points: of points strewn
# at random, a circle of 3 spacings is empty with a probability of 1e-12.
FACET_RADIUS = 3.0
# That of the largest undecided triangle whose prism is swept: three times as great, and at least so
# many cells (10 m at pixels of 0.65 m), for the ground in the LiDAR's own shadows beside walls.
SWEPT_RADIUS = 3.0
SWEPT_CELLS = 32
# Spacings of points along a breakline, to either side of a triangle, that determine it.
BREAKLINE_REACH = 12.0
# Spacings of points around a vertex of a rough surface that decide whether it is a top.
ROUGH_REACH = 2.2
# Even ground: one vertex for each square of so many cells (two pixels) along each axis.
SQUARE_CELLS = 4
EVEN_REACH = 3 * SQUARE_CELLS  # cells around a vertex that decide whether it stays

# Standard deviation of heights that airborne LiDAR has at least (m), and the one that is taken
# where points are too few to estimate it.
HEIGHT_NOISE_M = 0.02
PRIOR_NOISE_M = 0.05


@dataclass(frozen=True)
class SurfaceScale:
    """The scale of a surface; lengths and tolerances that all facets follow from.

    ``cell``: (lon, lat) size of a ground cell, lattice steps. ``spacing``: mean spacing of points,
    parts of a cell. Tolerances are metres of height:
    ``top_m``: points of a cell no farther below its highest one belong to its vertex;
    ``even_m``: residual of even ground, at most; ``residual_m``: residual of a vertex on the plane
    of a facet, at most; ``dome_m``: height of a triangle of a dome, at most; ``bulge_m``: least
    mean residual by which a facet bulges; ``passed_m``: a point that went through a rough surface
    lies lower than the points around by this; ``steep_m``: height of a triangle of a rough surface,
    at most.
    """

    cell: tuple[int, int]
    spacing: float
    top_m: float
    even_m: float
    residual_m: float
    dome_m: float
    bulge_m: float
    passed_m: float
    steep_m: float

    @property
    def facet_radius(self) -> float:
        """Greatest circumradius of a facet, parts of a cell."""
        return FACET_RADIUS * self.spacing

    @property
    def swept_radius(self) -> float:
        """Greatest circumradius of an undecided triangle, parts of a cell."""
        return max(SWEPT_RADIUS * self.facet_radius, float(SWEPT_CELLS * PART))

    @property
    def halo_cells(self) -> int:
        """Cells around a place whose points determine all facets there, so that these have the same
        bytes in every window.

        The vertices of a triangle lie within two radii of any place in its circumcircle. A label
        follows from its facet, its neighbours and theirs (noise), the neighbours of these
        (support), the triangles that share a vertex with them (planes), and again (slopes): six
        steps of two radii. A breakline follows from the points up to BREAKLINE_REACH around and
        their planes (two radii more); a rough surface from six steps, and its labels from
        ``rough_halo_cells`` around. Which vertices there are follows from the squares around
        (:mod:`.even_ground`).
        """
        facet, swept = self.facet_radius, self.swept_radius
        halo = max(12 * facet, 2 * swept) + BREAKLINE_REACH * self.spacing + 2 * facet
        halo = max(halo, 18 * facet + ROUGH_REACH * self.spacing)
        return int(np.ceil(halo / PART)) + EVEN_REACH + 2

    @property
    def rough_halo_cells(self) -> int:
        """Cells around a triangle of a rough surface whose points determine it: its vertices, those
        beside it and beside these (residuals), and what lies around these."""
        return int(np.ceil((6.0 * self.facet_radius + ROUGH_REACH * self.spacing) / PART))

    @property
    def height_reach(self) -> float:
        """Parts of a cell between a place of a triangle and any point that determines heights
        there."""
        breakline = BREAKLINE_REACH * self.spacing + 2.0 * self.facet_radius
        return max(breakline, 2.0 * self.swept_radius)


def spacing_parts(points_per_m2: float, cell_m: float) -> float:
    """Mean spacing of vertices in parts of a cell of ``cell_m``, for points of this density.

    Density counts in steps of a factor of 1.4, so that one more file leaves the rest of a scene as
    it is. Vertices are no denser than cells.
    """
    per_cell = 2.0 ** (round(2.0 * np.log2(points_per_m2 * cell_m**2)) / 2.0)
    return PART * max(1.0 / float(np.sqrt(per_cell)), 1.0)


def height_steps(height_m: float) -> float:
    """Metres of height in lattice steps."""
    return height_m / LATTICE_M
