"""The ground of a twin: a smooth surface through the points that lie lowest."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from .twin_points import Points

GROUND_CLASSES = (2, 9)
STEP_M = 2.0  # between the coefficients of the spline
FILTER_M = 1.0  # cells in which the lowest points are sought
WIDEST_M = 30.0  # half the width of the widest building, where no class tells the ground
STEEP = 0.15  # rise over run of ground that the search for objects lets pass
LOW_M = 3.0  # a cell so far below those around has a false point
NEAR_M = 0.5  # of the lowest surface: ground
BEYOND = 64  # squares of ground that tell how high it lies where the file ends
MAX_SLOPE = 1.0  # less steep than any ray, so that each meets the ground once


def is_ground(points: Points) -> np.ndarray:
    """Which points lie on the ground, bool[n]: by their class, or else the lowest ones.

    Without classes by a progressive morphological filter (Zhang et al. 2003, doi
    10.1109/TGRS.2003.810682): objects are what openings of growing width cut off.
    """
    if points.has_class(*GROUND_CLASSES):
        return np.isin(points.label, GROUND_CLASSES)
    low = points.xyz[:, :2].min(axis=0)
    i, j = ((points.xyz[:, :2] - low) / FILTER_M).astype(int).T
    lowest = np.full((j.max() + 1, i.max() + 1), np.inf)
    np.minimum.at(lowest, (j, i), points.xyz[:, 2])
    lowest = _filled(lowest)
    around = ndimage.median_filter(lowest, 5, mode="nearest")
    lowest = np.where(lowest < around - LOW_M, around, lowest)
    surface, is_object = lowest, np.zeros(lowest.shape, bool)
    for half in _windows():
        opened = ndimage.grey_opening(surface, size=2 * half + 1, mode="nearest")
        is_object |= surface - opened > STEEP * half * FILTER_M
        surface = opened
    ground = _filled(np.where(is_object, np.inf, lowest))
    return np.abs(points.xyz[:, 2] - ground[j, i]) < NEAR_M


def _windows() -> list[int]:
    """Half widths of the openings, cells: each some half wider than the one before."""
    halves = [1]
    while halves[-1] * FILTER_M < WIDEST_M:
        halves.append(math.ceil(1.5 * halves[-1]))
    return halves


def _filled(heights: np.ndarray) -> np.ndarray:
    """Heights with those of the nearest cell in place of infinite ones."""
    holes = ~np.isfinite(heights)
    if not holes.any():
        return heights
    at = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    return heights[tuple(at)]


def terrain_of(xyz: np.ndarray, x0: float, y0: float, shape: tuple[int, int]) -> np.ndarray:
    """Spline coefficients [ny, nx] of the terrain from (x0, y0) on, STEP_M apart.

    ``xyz`` [n, 3]: points on the ground. Linear between them, as under buildings; beyond them the
    median height of the nearest ones. No slope is above MAX_SLOPE.
    """
    i, j = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / STEP_M).astype(np.int64).T
    square = j * (i.max() + 1) + i
    count = np.bincount(square)
    mean = np.column_stack([np.bincount(square, weights=xyz[:, k]) for k in range(3)])
    mean = mean[count > 0] / count[count > 0, None]
    x, y = np.meshgrid(x0 + STEP_M * np.arange(shape[1]), y0 + STEP_M * np.arange(shape[0]))
    z = np.full(shape, np.nan)
    if len(mean) > 3:
        z = LinearNDInterpolator(mean[:, :2], mean[:, 2])(x, y)
    beyond = ~np.isfinite(z)
    at = np.column_stack([x[beyond], y[beyond]])
    _, near = cKDTree(mean[:, :2]).query(at, min(BEYOND, len(mean)))
    z[beyond] = np.median(mean[near, 2].reshape(len(at), -1), axis=1)
    return _less_steep(z)


def _less_steep(z: np.ndarray) -> np.ndarray:
    """Heights that no slope along x or y exceeds MAX_SLOPE / √2: what is steeper gives way."""
    rise = MAX_SLOPE / math.sqrt(2) * STEP_M
    while True:
        lower = z.copy()
        for axis in (0, 1):
            ahead, behind = np.roll(lower, -1, axis), np.roll(lower, 1, axis)
            last = [slice(None)] * 2
            last[axis] = -1
            ahead[tuple(last)] = np.inf
            last[axis] = 0
            behind[tuple(last)] = np.inf
            lower = np.minimum(lower, np.minimum(ahead, behind) + rise)
        if np.array_equal(lower, z):
            return z
        z = lower
