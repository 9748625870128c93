"""What the labels of a tile lie on: kind of surface, class of the tile, height above the ground.

*Surfaces.* Open ground and roofs are where labels vary as a plane does, with nothing else in a
square of ``GUARD_PX``: no pixel without label among labelled ones, no step of height. What SIFT
says there is of one surface. Crowns, with what lies in such a square beside them, are the LiDAR's
vegetation; where the LiDAR tells neither vegetation nor buildings, what is not smooth. The rest is
near edges.

*Classes* (table 4 of the paper). A tile is of the class building if at least ``building_share`` of
its classified pixels are. The class of a pixel is that of the LiDAR where the tile holds any
building or vegetation in the LiDAR's classes. Else buildings are found by their shape: pixels that
stand ``RAISED_M`` above the ground (the opening of the heights by a square of ``GROUND_PX``, with
an allowance for its slope), on or next to a plane, which trees are not (``ROUGH_M`` in squares of
``PLANE_PX``). On synthetic cities that finds 70–90 % of the roof pixels in towns (99 % of what is
found is roof) and a third of small houses in forests on slopes; of tiles without houses, 0.4 % pass
for buildings.

*Heights above the ground.* The ground is what the LiDAR's class says (2, ground), or else what a
morphological filter leaves (Pingel et al. 2013, ISPRS J. 77, "SMRF": openings by windows that grow,
of which a cell stands off if it is higher than the window's reach on a slope), both in plan, on
cells of about two pixels. Between ground cells the heights are linear.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import map_coordinates

from ..core.numerics.arrays import Bools, Floats
from ..core.numerics.geometry import DEGREE_M

Codes = NDArray[np.uint8]  # LAS classes (ASPRS)

GROUND_CODE, BUILDING_CODE, VEGETATION_CODES = 2, 6, (3, 4, 5)
CLASSED_CODES = (*VEGETATION_CODES, BUILDING_CODE)
GROUND_CODES = (0, 1, GROUND_CODE)  # never classified, unclassified, ground

SMOOTH_PX = 0.15  # standard deviation of labels from a plane: noise of points, and relief
GUARD_PX = 9  # side of the square in which nothing else may be
UNSURE_PX = 0.2  # of a label's uncertainty, above what all labels of the tile share: rough
SHARED = 0.2  # quantile of the uncertainties that tells what they share
DENSE = 0.95  # share of labelled pixels in the square, of what is usual in the tile

BUILDING, VEGETATION = "building", "vegetation"  # classes of tiles
GROUND_PX = 91  # about 60 m in images of GF-7
PLANE_PX = 9
RAISED_M = 2.5
ROUGH_M = 0.25
FAR = 1e6  # m

REACH_M = 24.0  # half of the widest opening: no roof is wider than twice that each way
SLOPE = 0.2  # steepest ground that the filter keeps beside what stands on it
RISE_M = 0.5  # of a cell over the opening that counts as ground


class LabelSurface(IntEnum):
    """What labels lie on."""

    NEAR_EDGES = 0
    OPEN_GROUND = 1
    ROOFS = 2
    CROWNS = 3

    @property
    def words(self) -> str:
        """As people say it."""
        return self.name.lower().replace("_", " ")


def label_surfaces(
    disparity: Floats, sigma: Floats, surface_class: Codes, buildings: Bools
) -> Codes:
    """:class:`LabelSurface` of each pixel of a tile; 0 where there is no label.

    ``disparity`` [h, w], px, NaN where there is no label; ``sigma``: its uncertainty, px, 0 where
    that is not known; ``surface_class``: the LiDAR's class, 0 where it is not known;
    ``buildings``: pixels of buildings.
    """
    known = np.isfinite(disparity)
    found = np.zeros(disparity.shape, np.uint8)
    if not known.any():
        return found
    classed = bool(np.isin(surface_class, CLASSED_CODES).any())
    vegetation = np.isin(surface_class, VEGETATION_CODES)
    unsure = known & (sigma > np.hypot(np.quantile(sigma[known], SHARED), UNSURE_PX))
    other = unsure | known & (vegetation | ~np.isin(surface_class, (*GROUND_CODES, BUILDING_CODE)))
    guard = (GUARD_PX, GUARD_PX)
    share = cv2.boxFilter(known.astype(np.float32), -1, guard, borderType=cv2.BORDER_REFLECT)
    dense = share >= DENSE * np.median(share[known])
    values = np.where(known, disparity - np.median(disparity[known]), 0.0)
    smooth = known & dense & ~unsure & (off_plane(values, known) < SMOOTH_PX)
    pure, built = smooth & ~_near(other), _near(buildings)
    found[known & (_near(vegetation) if classed else ~smooth & ~built)] = LabelSurface.CROWNS
    found[pure & ~built] = LabelSurface.OPEN_GROUND
    found[pure & ~_near(known & ~buildings)] = LabelSurface.ROOFS
    return found


def _near(where: Bools) -> Bools:
    """Pixels in whose guard's square there is one of those."""
    return cv2.dilate(where.astype(np.uint8), np.ones((GUARD_PX, GUARD_PX), np.uint8)) > 0


def off_plane(height: Floats, known: Bools) -> Floats:
    """Standard deviation of heights from the plane in the square around each pixel, in their unit.

    0 where they are not known; infinite where less than 70 % of the square are.
    """
    size = (PLANE_PX, PLANE_PX)

    def mean(values: Floats) -> Floats:
        return cv2.boxFilter(values, -1, size, borderType=cv2.BORDER_REFLECT)

    share = mean(known.astype(np.float64))
    values = np.where(known, height, mean(height) / np.maximum(share, 1e-9))
    step = np.tile(np.arange(PLANE_PX) - PLANE_PX // 2.0, (PLANE_PX, 1))
    across, down = (
        cv2.filter2D(values, -1, kernel / (step**2).sum(), borderType=cv2.BORDER_REFLECT)
        for kernel in (step, step.T.copy())
    )
    slopes = (across**2 + down**2) * (step[0] ** 2).mean()
    variance = mean(values**2) - mean(values) ** 2 - slopes
    return np.where(share > 0.7, np.sqrt(np.maximum(variance, 0.0)), np.inf)


def buildings_by_shape(height: Floats) -> Bools:
    """Pixels of a height grid (m, NaN where there is none) that look like buildings."""
    known = np.isfinite(height)
    if not known.any():
        return known
    z = np.where(known, height - np.nanmedian(height), 0.0)
    square = np.ones((GROUND_PX, GROUND_PX), np.uint8)
    low = cv2.erode(np.where(known, z, FAR), square)
    ground = cv2.dilate(np.where(low < FAR, low, -FAR), square)
    ground = np.where(ground > -FAR, ground, 0.0)
    raised = known & (z - ground > RAISED_M)
    if not raised.any():
        return raised
    smooth = cv2.GaussianBlur(ground, (0, 0), GROUND_PX / 4)
    slope = cv2.dilate(np.hypot(*np.gradient(smooth)), square)  # as the opening, from all around
    raised &= z - ground > RAISED_M + slope * GROUND_PX / 2
    flat = raised & (off_plane(z, known) < ROUGH_M)
    square = np.ones((PLANE_PX, PLANE_PX), np.uint8)
    return raised & (cv2.dilate(flat.astype(np.uint8), square) > 0)


class Buildings(NamedTuple):
    """Pixels of a tile that are building, and those that could be: bool[h, w]."""

    found: Bools
    of: Bools

    @classmethod
    def of_tile(cls, surface_class: Codes, height: Any, here: tuple[slice, slice]) -> Buildings:
        """By the LiDAR's classes in the tile (0: unknown), or from heights.

        ``height``: of the whole scene, m, NaN where there is none (may be a Zarr array); ``here``:
        the tile's rows and columns in it. Heights are read with ``GROUND_PX`` of their
        surroundings.
        """
        if np.isin(surface_class, CLASSED_CODES).any():
            return cls(surface_class == BUILDING_CODE, surface_class != 0)
        wide = tuple(slice(max(s.start - GROUND_PX, 0), s.stop + GROUND_PX) for s in here)
        tile = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(here, wide))
        values = np.asarray(height[wide], dtype=np.float64)
        return cls(buildings_by_shape(values)[tile], np.isfinite(values[tile]))

    def tile_class(self, building_share: float) -> str:
        """Class of a tile of which so large a share must be building."""
        share = self.found.sum() / max(self.of.sum(), 1)
        return BUILDING if share >= building_share else VEGETATION


def heights_above_ground(ground: Floats, surface_class: Codes) -> Floats:
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
    of_class = surface_class[known] == GROUND_CODE
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
        rim = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
        rim[[0, -1]] = rim[:, [0, -1]] = True
        rim &= known
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
