"""Young trees, by the classes of the LiDAR: what is beside these changes most.

Young trees grow most. That is known before any image is compared.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.windows import box_max, summed_area
from ..lidar.point_store import VEGETATION_CLASSES

Bools = NDArray[np.bool_]

# A crown of the LiDAR is a young one if so few pixels up to YOUNG_REACH_PX around show vegetation:
# 2.4 m wide in pixels of 0.65 m. One that doubles covers 2 px around, and the optics blur it by
# one.
YOUNG_REACH_PX, YOUNG_PIXELS = 3, 14


def beside_young_crowns(surface_class: NDArray[np.uint8]) -> Bools:
    """Pixels [h, w] no more than YOUNG_REACH_PX from a crown of the LiDAR that is small, by the
    ``surface_class`` [h, w] (ASPRS)."""
    is_young = np.isin(surface_class, VEGETATION_CLASSES)
    row, col = np.nonzero(is_young)
    margin = 2 * YOUNG_REACH_PX
    table = summed_area(np.pad(is_young, margin))

    def count(px: int) -> NDArray[np.int64]:
        """Of vegetation up to ``px`` around each of its pixels."""
        top, side = row + margin - px, col + margin - px
        end, far = top + 2 * px + 1, side + 2 * px + 1
        return table[end, far] - table[top, far] - table[end, side] + table[top, side]

    around = count(YOUNG_REACH_PX)
    is_small = (around <= YOUNG_PIXELS) & (count(margin) <= 2 * YOUNG_PIXELS)
    is_young[row, col] = is_small & (2 * count(1) >= around)  # compact, no branches of a canopy
    return box_max(is_young, YOUNG_REACH_PX)
