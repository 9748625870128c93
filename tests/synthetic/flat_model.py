"""Disparities of a slanted plane."""

from __future__ import annotations

import numpy as np
import pyproj

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel

from .cameras import HEIGHT, LAT, LON, camera

SIZE = (420, 380)
EPSG = 32650
UTM = pyproj.Transformer.from_crs(4326, EPSG, always_xy=True)


def make_model() -> EpipolarModel:
    left, right = (
        camera(tilt, size=SIZE, angle=angle, gsd=gsd_m)
        for tilt, angle, gsd_m in (((0.03, -0.1), 12.0, 0.65), ((-0.05, 0.5), 10.0, 0.8))
    )
    return fit_epipolar(left, right, SIZE, SIZE, HEIGHT)


def disparity_of(model: EpipolarModel, surface) -> np.ndarray:
    """The grid's disparities of a surface, height (m) of (lon, lat), along the rays."""
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(float)
    h = np.full(x.shape, HEIGHT)
    for _ in range(30):
        lon, lat = model.epipolar_to_ground(x, y, h)
        h = surface(lon, lat)
    x_right = model.ground_to_epipolar(lon, lat, h)[2].reshape(x.shape)
    return (x - x_right).astype(np.float32)


def metres(lon, lat):
    """East and north of the middle of the scene, m."""
    east, north = UTM.transform(np.ravel(lon), np.ravel(lat))
    middle = UTM.transform(LON, LAT)
    return (np.reshape(v - m, np.shape(lon)) for v, m in zip((east, north), middle))


def plane(lon, lat):
    east, north = metres(lon, lat)
    return HEIGHT + 0.3 * east - 0.15 * north
