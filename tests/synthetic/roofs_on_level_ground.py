"""Two views of flat roofs on level ground, textured, with known cameras and points."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from stereotruth.sensor.rpc import SensorModel

from .cameras import HEIGHT, LAT, LON, METRES
from .textured_pair import SIZE

ROOF_M = 8.0  # above the ground
RIM_M = 0.6  # m: a bright rim of each roof, whose inner side is a line as its outer side is


def roofs(count: int = 5) -> np.ndarray:
    """[count², 5]: middle east, north (m), half sides, and turn (radians)."""
    rng = np.random.default_rng(3)
    axis = (np.arange(count) - (count - 1) / 2) * 58.0
    middle = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    middle += rng.uniform(-4, 4, middle.shape)
    return np.column_stack(
        [middle, rng.uniform(8, 15, middle.shape), rng.uniform(0, 3, len(middle))]
    )


def beyond(roof: np.ndarray, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """How far (m) places lie outside of a roof's sides; negative inside."""
    e, n = east - roof[0], north - roof[1]
    c, s = np.cos(roof[4]), np.sin(roof[4])
    return np.maximum(np.abs(e * c + n * s) - roof[2], np.abs(n * c - e * s) - roof[3])


def render(sensor: SensorModel, houses: np.ndarray) -> np.ndarray:
    """The image uint16 of an exact camera: roofs above walls above level ground."""
    rng = np.random.default_rng(1)
    noise = gaussian_filter(rng.normal(0, 1, (1000, 1000)), 1.8, mode="wrap")
    col, row = (c.ravel() for c in np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])))
    grey = np.full(col.size, np.nan)
    for above in np.arange(ROOF_M, -0.01, -1.0):
        open_ = np.flatnonzero(np.isnan(grey))
        lon, lat = sensor.localize(col[open_], row[open_], np.full(open_.size, HEIGHT + above))
        east, north = (lon - LON) * METRES[0], (lat - LAT) * METRES[1]
        outside = np.full(open_.size, np.inf)
        for roof in houses:
            outside = np.minimum(outside, beyond(roof, east, north))
        here = (outside < 0.0) | (above == 0.0)
        shown = np.full(open_.size, 500.0)  # a wall
        if above in (ROOF_M, 0.0):
            place = np.stack([north, east])[:, here] / 0.8
            texture = map_coordinates(noise, place, order=1, mode="grid-wrap")
            shown[here] = 800.0 + 1200.0 * texture
        if above == ROOF_M:
            shown[here] = np.where(outside[here] > -RIM_M, 1900.0, 500.0 + shown[here])
        grey[open_[here]] = shown[here]
    image = gaussian_filter(grey.reshape(SIZE[::-1]), 0.6)
    return np.clip(np.round(image + rng.normal(0, 5.0, image.shape)), 1, 60000).astype(np.uint16)


def points(houses: np.ndarray, spacing: float = 0.7) -> np.ndarray:
    """lon, lat, height [n, 3] of exact points, 0.03 m of noise in height."""
    rng = np.random.default_rng(0)
    east, north = np.mgrid[-250:250:spacing, -250:250:spacing].reshape(2, -1)
    east, north = np.stack([east, north]) + rng.uniform(-0.4, 0.4, (2, east.size)) * spacing
    height = HEIGHT + rng.normal(0, 0.03, east.size)
    for roof in houses:
        height[beyond(roof, east, north) < 0.0] += ROOF_M
    return np.column_stack([LON + east / METRES[0], LAT + north / METRES[1], height])
