"""Image warping over whole scenes: correlation of the left with the warped right image."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.errors import InputError
from ..core.products.grids import blocks, open_grid
from ..epipolar.warping import CorrelationSum, agreement, warp_window

BLOCK = 1024  # px


@dataclass
class SceneWarping:
    """Sums of left and warped right image, and counts of pixels: labelled, in the left image."""

    sums: CorrelationSum = field(default_factory=CorrelationSum)
    labelled: int = 0
    imaged: int = 0

    def merge(self, other: SceneWarping) -> None:
        """Add those of other pixels."""
        self.sums.merge(other.sums)
        self.labelled += other.labelled
        self.imaged += other.imaged


def warp_scene(left: str | Path, right: str | Path, disparity: str | Path) -> SceneWarping:
    """Warp a scene, given as left.zarr, right.zarr and disparity.zarr, block by block.

    Raises InputError for unfinished stores.
    """
    left_image, right_image = (open_grid(path)["image"] for path in (left, right))
    labels = open_grid(disparity)["disparity"]
    if not left_image.shape == right_image.shape == labels.shape:
        raise InputError(
            "images and disparity differ in size", file=disparity, remedy="run project again"
        )
    total = SceneWarping()
    for rows, cols in blocks(labels.shape, BLOCK):
        values = labels[rows, cols].values.astype(np.float64)
        warped = warp_window(right_image, values, rows, cols)
        reference = left_image[rows, cols].values.astype(np.float64)
        labelled = int(np.isfinite(values).sum())
        total.merge(
            SceneWarping(agreement(reference, warped), labelled, int((reference != 0).sum()))
        )
    return total
