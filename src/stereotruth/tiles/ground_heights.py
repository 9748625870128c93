"""Heights of the bare ground below a window of an epipolar grid.

The ground is what the LiDAR's class says (2, ground), or else what a morphological filter leaves
(Pingel et al. 2013, ISPRS J. 77, "SMRF": openings by windows that grow, of which a cell stands off
if it is higher than the window's reach on a slope), both in plan, on cells of about two pixels.
Between ground cells the heights are linear.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import map_coordinates

from ..core.numerics.geometry import DEGREE_M

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

GROUND_CLASS = 2  # ASPRS
REACH_M = 24.0  # half of the widest opening: no roof is wider than twice that each way
SLOPE = 0.2  # steepest ground that the filter keeps beside what stands on it
RISE_M = 0.5  # of a cell over the opening that counts as ground


def heights_above_ground(ground: Floats, surface_class: NDArray[np.uint8]) -> Floats:
    """Heights above the ground, m [h, w], NaN where there is no height.

    ``ground`` float64[3, h, w]: longitude, latitude (degrees), ellipsoidal height (m) of what each
    pixel shows; ``surface_class``: LAS classes, 0 where it is not known.
    """
    lon, lat, height = ground
    known = np.isfinite(height)
    above = np.full(height.shape, np.nan)
    if not known.any():
        return above
    middle = float(np.median(lat[known]))
    scale = DEGREE_M * np.cos(np.radians(middle)), DEGREE_M
    x = (lon[known] - lon[known].min()) * scale[0]
    y = (lat[known] - lat[known].min()) * scale[1]
    z = height[known]
    cell = 2.0 * float(np.sqrt(max(np.ptp(x), 1.0) * max(np.ptp(y), 1.0) / known.sum()))
    of_class = surface_class[known] == GROUND_CLASS
    column, row = (x / cell).astype(int), (y / cell).astype(int)
    low = np.full((row.max() + 1, column.max() + 1), np.inf)
    use = of_class if of_class.any() else np.ones(len(z), bool)
    np.minimum.at(low, (row[use], column[use]), z[use])
    if not of_class.any():
        low[~ground_cells(low, cell)] = np.inf
    if not np.isfinite(low).any():
        return above
    above[known] = z - _between(low, x / cell - 0.5, y / cell - 0.5)
    return above


def ground_cells(low: Floats, cell_m: float) -> Bools:
    """Cells [h, w] of lowest heights (m, infinite where there is none) that are ground."""
    known = np.isfinite(low)
    widest = max(int(REACH_M / cell_m), 1)
    filled = np.where(known, low, low[known].max() if known.any() else 0.0)
    # slopes go on beyond the rim, where openings would cut them off
    margin = [(min(widest, n - 1),) * 2 for n in low.shape]
    surface = np.pad(filled, margin, mode="reflect", reflect_type="odd").astype(np.float32)
    is_ground, before = np.ones(surface.shape, bool), 0
    for radius in range(1, widest + 1):
        square = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
        opened = cv2.morphologyEx(surface, cv2.MORPH_OPEN, square)
        limit = SLOPE * (radius - before) * cell_m + RISE_M
        is_ground &= surface - opened <= limit
        surface, before = np.minimum(surface, opened + np.float32(limit)), radius
    (top, _), (left, _) = margin
    return known & is_ground[top : top + low.shape[0], left : left + low.shape[1]]


def _between(low: Floats, column: Floats, row: Floats) -> Floats:
    """Heights at places (columns and rows of cells), linear between the cells that have one."""
    known = np.isfinite(low)
    filled = np.where(known, low, 0.0)
    if not known.all():
        # of the cells that have a height, those beside a hole say what is in it
        rim = known & (cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
        rim |= known & ~_inner(known)
        at = np.argwhere(rim if rim.sum() >= 4 else known).astype(float)
        values = low[tuple(at.astype(int).T)]
        holes = np.argwhere(~known).astype(float)
        found = np.full(len(holes), np.nan)
        if len(at) >= 4 and np.ptp(at[:, 0]) > 0 and np.ptp(at[:, 1]) > 0:
            found = LinearNDInterpolator(at, values)(holes)
        outside = np.isnan(found)
        if outside.any():
            found[outside] = NearestNDInterpolator(at, values)(holes[outside])
        filled[~known] = found
    return map_coordinates(filled, [row, column], order=1, mode="nearest")


def _inner(known: Bools) -> Bools:
    """All but the outermost rows and columns."""
    inner = np.zeros_like(known)
    inner[1:-1, 1:-1] = True
    return inner
