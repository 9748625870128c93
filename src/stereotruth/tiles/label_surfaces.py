"""Which kind of surface a tile's labels lie on, as far as images can be held against them.

Open ground and roofs are where labels vary as a plane does, with nothing else in a square of
``GUARD_PX``: no pixel without label among labelled ones, no step of height. What SIFT says there is
of one surface. Crowns, with what lies in such a square beside them, are the LiDAR's vegetation;
where the LiDAR tells neither vegetation nor buildings, what is not smooth. The rest is near edges.
"""

from __future__ import annotations

from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from .tile_classes import BUILDING_CODE, CLASSED_CODES, off_plane

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]

VEGETATION_CODES = (3, 4, 5)  # ASPRS
GROUND_CODES = (0, 1, 2)  # never classified, unclassified, ground
SMOOTH_PX = 0.15  # standard deviation of labels from a plane: noise of points, and relief
GUARD_PX = 9  # side of the square in which nothing else may be
UNSURE_PX = 0.2  # of a label's uncertainty, above what all labels of the tile share: rough
SHARED = 0.2  # quantile of the uncertainties that tells what they share
DENSE = 0.95  # share of labelled pixels in the square, of what is usual in the tile


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
    disparity: Floats, sigma: Floats, surface_class: NDArray[np.uint8], buildings: Bools
) -> NDArray[np.uint8]:
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
