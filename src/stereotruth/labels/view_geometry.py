"""What the labels of a view need to know of a pair's geometry."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class ViewGeometry(Protocol):
    """What is used of :class:`stereotruth.epipolar.model.EpipolarModel`."""

    shape: tuple[int, int]
    reference_height: float

    def ground_to_epipolar(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> Floats:
        """float64[4, n]: x_left, y_left, x_right, y_right in px."""

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where the left image's ray meets a height."""
