"""A tile whose right image is warped to the left by the tile's disparities."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.products.rasters import read_tile
from ..epipolar.warping import CorrelationSum, agreement, warp_rows

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WarpedTile:
    """An exported tile: left, warped right (NaN unlabelled) and disparity, float64[h, w]."""

    name: str
    left: Floats
    warped: Floats
    disparity: Floats

    @property
    def sums(self) -> CorrelationSum:
        """Of left and warped right image over the labelled pixels."""
        return agreement(self.left, self.warped)

    @property
    def correlation(self) -> float:
        """Coefficient of left and warped right image over the labelled pixels."""
        return self.sums.coefficient


def warp_tile(tiles: str | Path, row: Mapping[str, str]) -> WarpedTile:
    """Warp an exported tile by its own disparity; ``row`` is its line of the manifest."""
    folder = Path(tiles)
    left, right, disparity = (read_tile(folder / row[kind]) for kind in ("left", "right", "disp"))
    x = np.arange(left.shape[1])[None, :] - disparity
    warped = warp_rows(np.nan_to_num(right), x)
    return WarpedTile(row["tile"], np.nan_to_num(left), warped, disparity)
