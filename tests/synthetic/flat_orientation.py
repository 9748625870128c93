"""The orientation record of a tile on flat ground, of known geometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereotruth.core.numerics.geometry import DEGREE_M
from stereotruth.tiles.orientation import GROUND_TOLERANCE, fit

GSD, RATIO, LAT = 0.7, 0.62, 30.0  # m, base to height, degrees


def orientation(gsd: float = GSD) -> dict[str, Any]:
    """A tile of 100 px on flat ground: columns to the north-east, a height as its disparity."""
    side, depth = np.linspace(0, 100, 6), np.linspace(-5, 20, 6)
    x, y, d = (v.ravel() for v in np.meshgrid(side, side, depth))
    height = 40 + d * gsd / RATIO
    east, north = (gsd * (x * c + y * s) for c, s in ((0.8, 0.6), (0.6, -0.8)))
    lon = 114 + east / (DEGREE_M * np.cos(np.radians(LAT)))
    ground = {"lon": lon, "lat": LAT + north / DEGREE_M, "height": height}
    inputs = {"x": x, "y": y, "d": d}
    record = fit(inputs, ground, tuple(inputs.values()), tuple(ground.values()), GROUND_TOLERANCE)
    return {"window": {"size": 100}, "ground": record | {"disparity_range_px": [-5.0, 20.0]}}
