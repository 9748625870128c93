"""The layers of a tile that a user may ask for beside its labels, on the grid of the left image.

============  =======  =========================================================================
layer         type     what it holds
============  =======  =========================================================================
height        float32  height above the WGS 84 ellipsoid of what the label shows, m
class         uint8    LAS class (ASPRS) of the highest point that the label rests on; 0: none
agl           float32  its height above the ground, m (:mod:`.ground_heights`)
uncertainty   float32  standard uncertainty of the disparity, px
lidar_date    uint16   when the LiDAR measured what the label shows, days since 1970-01-01; 0: not
                       known
============  =======  =========================================================================

Where a pixel has no label they hold nodata: NODATA, or 0 of whole numbers.
"""

from __future__ import annotations

from typing import NamedTuple

NODATA = -9999.0


class LayerKind(NamedTuple):
    """``dtype`` of the file, its nodata, and what it says of itself."""

    dtype: str
    nodata: float
    description: str


KINDS = {
    "height": LayerKind("float32", NODATA, "height above the WGS 84 ellipsoid in m"),
    "class": LayerKind("uint8", 0, "LAS class (ASPRS)"),
    "agl": LayerKind("float32", NODATA, "height above the ground in m"),
    "uncertainty": LayerKind("float32", NODATA, "standard uncertainty of the disparity in px"),
    "lidar_date": LayerKind("uint16", 0, "days since 1970-01-01 of the LiDAR"),
}


def column(name: str) -> str:
    """The manifest's column of a layer's file; ``class`` alone is that of the tile."""
    return f"layer_{name}"
