"""How two images look at the ground: what both see, at which angle, along which direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.numerics.geometry import exact_metres_per_degree
from .rpc import SensorModel
from .virtual_points import frame, inside, steps

Floats = NDArray[np.float64]


MIN_CONVERGENCE = 1.0  # degrees
LEAST_BASE = 1e-5  # difference of two unit rays; with less, both images look from one place


def find_overlap(
    left: SensorModel,
    right: SensorModel,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    reference: float,
    height_range: tuple[float, float],
    names: tuple[str, str],
) -> Floats:
    """(col, row) [2, n] of left pixels whose ground at the reference height the right image sees.

    If there are none at that height, those of the nearest height in the range that has some.
    """
    col, row = frame(sizes[0], 41)
    heights = sorted({reference, *steps(*height_range, 21, 0.0)}, key=lambda h: abs(h - reference))
    for height in heights:
        lon, lat = left.localize(col, row, height)
        if height == reference and not np.isfinite(lon).any():
            raise InputError(
                "no pixel can be located on the ground by the RPC",
                file=names[0],
                remedy="check that the RPC belongs to this image",
            )
        seen = inside(np.array(right.project(lon, lat, height)), sizes[1])
        if seen.any():
            return np.stack([col[seen], row[seen]])
    raise InputError(
        f"left and right image do not overlap between {height_range[0]:.0f} and "
        f"{height_range[1]:.0f} m (other image: {names[1]})",
        file=names[0],
        remedy="check that both images are of one pair and that each RPC belongs to its image",
    )


def ray_upwards(sensor: SensorModel, col: float, row: float, height: float) -> Floats:
    """Unit vector (east, north, up) of a pixel's ray, upwards, near an ellipsoidal height in m."""
    lon, lat = sensor.localize([col, col], [row, row], [height, height + 200.0])
    east, north = exact_metres_per_degree(lat[0], height)
    ray = np.array([(lon[1] - lon[0]) * east, (lat[1] - lat[0]) * north, 200.0])
    return ray / np.linalg.norm(ray)


def convergence_angle(
    left: SensorModel, right: SensorModel, overlap: Floats, height: float, names: tuple[str, str]
) -> float:
    """Angle in degrees between both rays in the middle of the overlap."""
    col, row = overlap.mean(axis=1)
    there = right.project(*left.localize(col, row, height), height)
    rays = ray_upwards(left, col, row, height), ray_upwards(right, *map(float, there), height)
    angle = float(np.degrees(np.arccos(np.clip(rays[0] @ rays[1], -1.0, 1.0))))
    if not angle >= MIN_CONVERGENCE:
        raise InputError(
            f"left and right image see the ground from one direction (convergence {angle:.2f} "
            f"degrees; other image: {names[1]})",
            file=names[0],
            remedy="check that the two images are not the same view, and that each RPC belongs "
            "to its image",
        )
    return angle


def find_rotation(
    left: SensorModel, right: SensorModel, overlap: Floats, height: float
) -> tuple[Floats, float]:
    """Rotation float64[2, 3] of the left image to (x, y), and its angle in degrees.

    +x is the way that a point on a right ray goes in the left image when it rises: x_right stays,
    x_left and with it the disparity grow.
    """
    ground = left.localize(*overlap, height)
    there = right.project(*ground, height)
    ends = [left.project(*right.localize(*there, h), h) for h in (height - 50.0, height + 50.0)]
    way = np.array(ends[1]) - np.array(ends[0])
    east, south = np.nanmean(way / np.hypot(*way), axis=1)
    angle = round(float(np.degrees(np.arctan2(south, east))), 6)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return np.array([[c, s, 0.0], [-s, c, 0.0]]), angle


def view_order(left: SensorModel, right: SensorModel, overlap: Floats, height: float) -> str:
    """Which image looks backward, if image rows run in flight direction."""
    col, row = overlap.mean(axis=1)
    there = right.project(*left.localize(col, row, height), height)
    base = (ray_upwards(left, col, row, height) - ray_upwards(right, *map(float, there), height))[
        :2
    ]
    lon, lat = left.localize([col, col], [row - 50.0, row + 50.0], height)
    flight = np.array([(lon[1] - lon[0]) * np.cos(np.radians(lat[0])), lat[1] - lat[0]])
    length = float(np.linalg.norm(base))
    along = float(base @ flight / np.linalg.norm(flight)) / max(length, LEAST_BASE)
    if abs(along) < 0.7:
        return "across track"
    return "left looks backward" if along > 0 else "left looks forward"
