"""What a pixel of a pair is on the ground and in height, and what follows for the surface.

Tolerances of the surface are px of disparity, so that what is wrong with a label stays below a
pixel. Nothing is tuned to a scene.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..epipolar.one_surface import SURFACE_PX
from ..surface.scale import PART, SurfaceScale, spacing_parts
from .rays import GROUND_CELL_PX, Rays

# Greatest residual of a vertex on the plane of a facet, of a vertex of even ground, and of a point
# on the top surface of its cell, px of disparity.
FACET_RESIDUAL_PX = 0.5
EVEN_RESIDUAL_PX = 0.15
TOP_RESIDUAL_PX = SURFACE_PX
# Trees and huts of fewer pixels are found by the images: where points are farther apart than this,
# a label between them needs a higher correlation.
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


@dataclass(frozen=True)
class PixelScale:
    """The scale of a pair's labels: ``px_per_m``, disparity of a metre of height; ``surface``."""

    px_per_m: float
    surface: SurfaceScale

    @classmethod
    def of(cls, points_per_m2: float, rays: Rays) -> PixelScale:
        """From the points over the ground that they cover, and the rays to both cameras."""
        spacing = spacing_parts(points_per_m2, rays.cell_m)
        metre = rays.px_per_m
        surface = SurfaceScale(
            cell=rays.cell,
            spacing=spacing,
            top_m=TOP_RESIDUAL_PX / metre,
            even_m=EVEN_RESIDUAL_PX / metre,
            residual_m=FACET_RESIDUAL_PX / metre,
            dome_m=_detection_weight(spacing_px(spacing)) * DOME_PX / metre,
            bulge_m=BULGE_PX / metre,
            passed_m=PASSED_PX / metre,
            steep_m=STEEP_PX / metre,
        )
        return cls(metre, surface)

    @property
    def spacing_px(self) -> float:
        """Mean spacing of points in pixels."""
        return spacing_px(self.surface.spacing)

    @property
    def points_per_px(self) -> float:
        """Points in a pixel on the average; more than four count as four."""
        return 1.0 / self.spacing_px**2

    @property
    def detection_weight(self) -> float:
        """Weight in [0, 1] that no object fits between the points: 1 for dense points, less where
        objects of NOTICED_PX fall between them."""
        return _detection_weight(self.spacing_px)


def spacing_px(spacing: float) -> float:
    """Parts of a ground cell in pixels."""
    return GROUND_CELL_PX * spacing / PART


def _detection_weight(spacing: float) -> float:
    return min(1.0, NOTICED_PX / spacing)
