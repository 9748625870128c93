"""Virtual ground points that carry the fit of an epipolar model, in both images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .rpc import SensorModel

Floats = NDArray[np.float64]


MAX_DOMAIN = 300_000.0  # px; the largest scenes have some 50 000


@dataclass(frozen=True)
class Points:
    """Virtual points in both images: ground (lon, lat, height) [3, n] and (col, row) [2, n]."""

    ground: Floats
    left: Floats
    right: Floats

    @classmethod
    def at(
        cls, left: SensorModel, right: SensorModel, lon: Floats, lat: Floats, h: Floats
    ) -> Points:
        """Of ground positions that broadcast; those that no image can have are left out."""
        ground = np.stack([np.ravel(c) for c in np.broadcast_arrays(lon, lat, h)])
        in_left, in_right = np.array(left.project(*ground)), np.array(right.project(*ground))
        good = (
            np.isfinite(ground).all(0) & np.isfinite(in_left).all(0) & np.isfinite(in_right).all(0)
        )
        return cls(ground[:, good], in_left[:, good], in_right[:, good])

    def __add__(self, other: Points) -> Points:
        return Points(
            np.hstack([self.ground, other.ground]),
            np.hstack([self.left, other.left]),
            np.hstack([self.right, other.right]),
        )


def steps(low: float, high: float, n: int, inset: float) -> Floats:
    """n equal steps from low to high, drawn in by a share of the range at both ends."""
    return low + (high - low) * np.linspace(inset, 1 - inset, n)


def frame(size: tuple[int, int], n: int) -> tuple[Floats, Floats]:
    """(col, row) of an n × n grid over an image of (cols, rows) px, edges included."""
    col, row = np.meshgrid(np.linspace(0, size[0] - 1, n), np.linspace(0, size[1] - 1, n))
    return col.ravel(), row.ravel()


def inside(image: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which image points [2, n] lie in the frame of an image of (cols, rows) px."""
    limit = np.array(size)[:, None] - 0.5
    return ((image >= -0.5) & (image <= limit)).all(axis=0)


def of_frames(
    left: SensorModel,
    right: SensorModel,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    heights: Floats,
    n: int,
) -> Points:
    """Ground points over both images' frames at the given heights."""
    found = []
    for sensor, size in zip((left, right), sizes):
        col, row = frame(size, n)
        lon, lat = sensor.localize(col[:, None], row[:, None], heights[None, :])
        found.append(Points.at(left, right, lon, lat, heights[None, :]))
    return found[0] + found[1]


def of_box(
    left: SensorModel,
    right: SensorModel,
    box: tuple[float, float, float, float],
    heights: Floats,
    n: int,
    inset: float,
) -> Points:
    """Ground points on a regular grid over a ground box at the given heights."""
    lon, lat, h = np.meshgrid(
        steps(box[0], box[2], n, inset), steps(box[1], box[3], n, inset), heights
    )
    return Points.at(left, right, lon, lat, h)


def common_box(
    left: SensorModel, right: SensorModel
) -> tuple[tuple[float, float, float, float], tuple[float, float]]:
    """Intersection of both RPCs' ground boxes: (lon, lat bounds) and height range."""
    a, b = np.array(left.rpc.ground_box), np.array(right.rpc.ground_box)
    b[[0, 2]] += 360.0 * np.round((a[0] + a[2] - b[0] - b[2]) / 720.0)
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:4], b[2:4])
    heights = (max(a[4], b[4]), min(a[5], b[5]))
    if heights[0] >= heights[1]:
        heights = (min(a[4], b[4]), max(a[5], b[5]))
    return (
        (float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        (float(heights[0]), float(heights[1])),
    )


def box_defect(
    left: SensorModel,
    right: SensorModel,
    box: tuple[float, float, float, float],
    points: Points,
    n: int,
) -> str:
    """Why a ground box cannot carry the fit, or an empty string."""
    if box[0] >= box[2] or box[1] >= box[3]:
        return "the RPCs' ground boxes do not overlap"
    if points.ground.shape[1] < n:
        return "the RPCs give no finite image coordinates in parts of their ground box"
    for sensor in (left, right):
        for values in sensor.rpc.denominators(*points.ground):
            if values.min() <= 0.0 <= values.max():
                return "an RPC's denominator vanishes in its ground box"
    for image in (points.left, points.right):
        if np.ptp(image, axis=1).max() > MAX_DOMAIN:
            return f"the RPCs' ground box spans more than {MAX_DOMAIN:.0f} px"
    return ""
