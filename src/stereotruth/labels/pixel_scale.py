"""What a pixel of a pair is on the ground and in height, beside the surface that it shows."""

from __future__ import annotations

from dataclasses import dataclass

from ..surface.scale import SurfaceScale
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
