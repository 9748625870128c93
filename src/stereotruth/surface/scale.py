"""What decides whether points lie on one surface: ground cells, spacing of points, tolerances.

The surface knows no image, so that one surface serves all pairs of a site. The size of a ground
cell comes in as plain numbers, and all tolerances are heights that follow from it: those that are
so many pixels of disparity in a pair of BASE_OVER_HEIGHT. In a pair of a narrower angle the same
heights are fewer pixels.

Plan positions are integers: parts of a ground cell (``PART`` of them along each axis), counted on
the global lattice (:mod:`stereotruth.lidar.lattice`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..core.numerics.geometry import DEGREE_M
from ..lidar.lattice import LATTICE_DEG, LATTICE_M

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
# Spacings of points along the side of a square, whose triangles share breaklines.
SHARED_SPACINGS = 2.0
# Spacings of points around a vertex of a rough surface that decide whether it is a top.
ROUGH_REACH = 2.2
# Even ground: one vertex for each square of so many cells (two pixels) along each axis.
SQUARE_CELLS = 4
EVEN_REACH = 3 * SQUARE_CELLS  # cells around a vertex that decide whether it stays

GROUND_CELL_PX = 0.5  # cells are finer than pixels, so that walls stand where they are
BASE_OVER_HEIGHT = 0.6  # of the pair in which tolerances are px of disparity: GF-7's and the like
# Greatest residual of a vertex on the plane of a facet, of a vertex of even ground, and of a point
# on the top surface of its cell, px of disparity.
FACET_RESIDUAL_PX = 0.5
EVEN_RESIDUAL_PX = 0.15
TOP_RESIDUAL_PX = 1.0
# Objects of fewer pixels are seen by the images alone, where points are farther apart than this.
NOTICED_PX = 1.5
# Crowns bulge: all around lies below their planes, however steeply it falls, while at the foot of a
# step it rises. A triangle of a dome is no higher than this, less where points are sparse
# (``detection_weight``).
DOME_PX = 3.0
# A facet bulges if its vertices lie below each other's planes by this or more on the average (noise
# of points stays below).
BULGE_PX = 0.1
# Rough surfaces: how much lower a point lies that went through, and the height of a triangle that
# is the side of something.
PASSED_PX = 1.0
STEEP_PX = 6.0

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

    @classmethod
    def of(cls, points_per_m2: float, cell: tuple[int, int]) -> SurfaceScale:
        """From the points over the ground that they cover, and the ground cell: GROUND_CELL_PX of
        the pixel of the finest image that the surface is for."""
        cell_m = cell[1] * LATTICE_DEG * DEGREE_M
        spacing = _spacing_parts(points_per_m2, cell_m)
        px_m = cell_m / (GROUND_CELL_PX * BASE_OVER_HEIGHT)  # height of a px of disparity
        return cls(
            cell=cell,
            spacing=spacing,
            top_m=TOP_RESIDUAL_PX * px_m,
            even_m=EVEN_RESIDUAL_PX * px_m,
            residual_m=FACET_RESIDUAL_PX * px_m,
            dome_m=detection_weight(GROUND_CELL_PX * spacing / PART) * DOME_PX * px_m,
            bulge_m=BULGE_PX * px_m,
            passed_m=PASSED_PX * px_m,
            steep_m=STEEP_PX * px_m,
        )

    @property
    def cell_m(self) -> float:
        """Side of a cell on the ground, m."""
        return self.cell[1] * LATTICE_DEG * DEGREE_M

    @property
    def spacing_m(self) -> float:
        """Mean spacing of points on the ground, m."""
        return self.spacing / PART * self.cell_m

    @property
    def facet_radius(self) -> float:
        """Greatest circumradius of a facet, parts of a cell."""
        return FACET_RADIUS * self.spacing

    @property
    def swept_radius(self) -> float:
        """Greatest circumradius of an undecided triangle, parts of a cell."""
        return max(SWEPT_RADIUS * self.facet_radius, float(SWEPT_CELLS * PART))

    @property
    def shared_cells(self) -> int:
        """Side of the squares whose triangles share breaklines."""
        return int(np.ceil(SHARED_SPACINGS * self.spacing / PART))

    @property
    def halo_cells(self) -> int:
        """Cells around a place whose points determine all facets there, so that these have the same
        bytes in every window.

        The vertices of a triangle lie within two radii of any place in its circumcircle. A label
        follows from its facet, its neighbours and theirs (noise), the neighbours of these
        (support), the triangles that share a vertex with them (planes), and again (slopes): six
        steps of two radii. A breakline follows from the points up to BREAKLINE_REACH around any
        triangle of a square and their planes (two radii more); a rough surface from six steps, and
        its labels from ``rough_halo_cells`` around. Which vertices there are follows from the
        squares around (:func:`.vertices.even_ground`).
        """
        facet, swept = self.facet_radius, self.swept_radius
        halo = max(12 * facet, 2 * swept) + BREAKLINE_REACH * self.spacing + 2 * facet
        halo = max(halo, 18 * facet + ROUGH_REACH * self.spacing)
        return int(np.ceil(halo / PART)) + self.shared_cells + EVEN_REACH + 2

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
        breakline += np.sqrt(2.0) * PART * self.shared_cells
        return max(breakline, 2.0 * self.swept_radius)


class SquareGrid(NamedTuple):
    """The squares of a window: ``shape`` (rows, cols); ``before`` (cols, rows): cells of the first
    square that lie before the window's first cell."""

    shape: tuple[int, int]
    before: tuple[int, int]

    @classmethod
    def around(cls, first: tuple[int, int], shape: tuple[int, int]) -> SquareGrid:
        """Of a window of ``shape`` (rows, cols) cells from the ``first`` cell (col, row) on."""
        before = first[0] % SQUARE_CELLS, first[1] % SQUARE_CELLS
        rows, cols = (
            (size - 1 + cells) // SQUARE_CELLS + 1 for size, cells in zip(shape, before[::-1])
        )
        return cls((rows, cols), before)


def ground_cell(pixel_deg: tuple[float, float]) -> tuple[int, int]:
    """(lon, lat) size of a ground cell, lattice steps, for a pixel on the ground."""
    lon, lat = (max(round(GROUND_CELL_PX * side / LATTICE_DEG), 1) for side in pixel_deg)
    return lon, lat


def detection_weight(spacing_px: float) -> float:
    """Weight in [0, 1] that no object fits between points so many pixels apart: 1 for dense points,
    less where objects of NOTICED_PX fall between them."""
    return min(1.0, NOTICED_PX / spacing_px)


def _spacing_parts(points_per_m2: float, cell_m: float) -> float:
    """Mean spacing of vertices in parts of a cell of ``cell_m``, for points of this density.

    Density counts in steps of a factor of 1.4, so that one more file leaves the rest of a scene as
    it is. Vertices are no denser than cells.
    """
    per_cell = 2.0 ** (round(2.0 * np.log2(points_per_m2 * cell_m**2)) / 2.0)
    return PART * max(1.0 / float(np.sqrt(per_cell)), 1.0)


def height_steps(height_m: float) -> float:
    """Metres of height in lattice steps."""
    return height_m / LATTICE_M
