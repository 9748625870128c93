"""The right view as the reference, by mirroring.

A pair whose images are exchanged and mirrored along the rows is a pair like any other: with
x' = last - x, the new left image is the old right one, and d' = x'_left' - x'_right' =
x_left - x_right. So the right view's labels are those of the mirrored pair, mirrored back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..epipolar.model import EpipolarModel
from .image_patches import Array2D

Floats = NDArray[np.float64]


def mirrored(cols: slice, width: int) -> slice:
    """The columns of a window, as seen in the mirrored grid of ``width`` px."""
    return slice(width - cols.stop, width - cols.start)


@dataclass(frozen=True, eq=False)
class MirroredModel:
    """The epipolar model of the exchanged and mirrored pair."""

    model: EpipolarModel

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the grid."""
        return self.model.shape

    @property
    def reference_height(self) -> float:
        """Ellipsoidal m."""
        return self.model.reference_height

    def ground_to_epipolar(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> Floats:
        """float64[4, n]: x, y in the mirrored right image, then in the mirrored left one, px."""
        x_left, y_left, x_right, y_right = self.model.ground_to_epipolar(lon, lat, height)
        last = self.shape[1] - 1
        return np.stack([last - x_right, y_right, last - x_left, y_left])

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where a ray of the mirrored right image meets a height."""
        last = self.shape[1] - 1
        col, row = self.model.epipolar_to_right(last - np.asarray(x, dtype=np.float64), y)
        return self.model.right.localize(col, row, height)


@dataclass(frozen=True, eq=False)
class MirroredImage:
    """An image [y, x] read from right to left."""

    image: Array2D

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, cols)."""
        return self.image.shape

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]:
        rows, cols = key
        return self.image[rows, mirrored(cols, self.shape[1])][:, ::-1]
