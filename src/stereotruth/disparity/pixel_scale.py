"""What a pixel of a pair is on the ground and in height, beside the surface that it shows."""

from __future__ import annotations

from dataclasses import dataclass

from ..surface.scale import SurfaceScale, detection_weight
from .rays import Rays


@dataclass(frozen=True)
class PixelScale:
    """The scale of a pair's labels: ``px_per_m``, disparity of a metre of height; ``pixel_m``, side
    of a pixel on the ground; ``surface``."""

    px_per_m: float
    pixel_m: float
    surface: SurfaceScale

    @classmethod
    def of(cls, surface: SurfaceScale, rays: Rays) -> PixelScale:
        """From the surface, and the rays to both cameras."""
        return cls(rays.px_per_m, rays.pixel_m, surface)

    @property
    def spacing_px(self) -> float:
        """Mean spacing of points in pixels."""
        return self.surface.spacing_m / self.pixel_m

    @property
    def points_per_px(self) -> float:
        """Points in a pixel on the average; no more than one for each ground cell."""
        return 1.0 / self.spacing_px**2

    @property
    def detection_weight(self) -> float:
        """See :func:`stereotruth.surface.scale.detection_weight`."""
        return detection_weight(self.spacing_px)
