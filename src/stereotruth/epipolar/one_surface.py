"""When two points or pixels belong to one surface."""

from __future__ import annotations

# Points that differ by no more than this in disparity (px) belong to one surface: a slope of 45°
# spans 0.6 px over a pixel of GF-7, a storey 3 px.
SURFACE_PX = 1.0

# Pixels belong to one surface if a disparity is off the plane through the other by no more than
# SURFACE_PX, and BEND px for each pixel between them.
BEND = 0.1
