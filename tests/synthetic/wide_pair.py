"""A pair of cameras of known epipolar geometry, and ground points before them."""

from __future__ import annotations

import numpy as np

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.sensor.rpc import SensorModel

from .cameras import HEIGHT, LAT, LON, METRES

SIZE = (6000, 5000)


def ground(n: int = 400, seed: int = 0) -> np.ndarray:
    """Random ground points [3, n] in the middle of the scene, over its height range."""
    t = np.random.default_rng(seed).uniform(-1, 1, (3, n))
    east_north = t[:2] * 1200.0
    return np.vstack(
        [LON + east_north[0] / METRES[0], LAT + east_north[1] / METRES[1], HEIGHT + 400 * t[2]]
    )


def fit(left: SensorModel, right: SensorModel, **options) -> EpipolarModel:
    sizes = {"left_size": SIZE, "right_size": SIZE} | options.pop("sizes", {})
    return fit_epipolar(left, right, **sizes, reference_height=options.pop("h", HEIGHT), **options)
