"""Where things are in a city: its frame, scenes, extent."""

from __future__ import annotations

import math

import numpy as np

from .cities import LEFT_GSD_M, CitySpec, SceneSpec
from .geodesy import LocalFrame
from .surfaces import CELL_M


def frame_of(city: CitySpec) -> LocalFrame:
    """The city's world frame."""
    return LocalFrame(city.lon, city.lat, city.base_height_m)


def image_axes(city: CitySpec, scene: SceneSpec) -> tuple[np.ndarray, np.ndarray]:
    """Nominal plan directions [2] in which the columns and rows of the left image run.

    From the orbit's inclination and the Earth's turning; the real image is within a degree.
    """
    latitude = math.radians(city.lat)
    azimuth = math.asin(math.cos(math.radians(97.4)) / math.cos(latitude))
    if not scene.ascending:
        azimuth = math.pi - azimuth
    run = 7040 * np.array([math.sin(azimuth), math.cos(azimuth)])
    run[0] -= 465 * math.cos(latitude)
    run /= np.hypot(*run)
    return np.array([-run[1], run[0]]), run


def scene_coordinates(city: CitySpec, scene: SceneSpec, xy: np.ndarray) -> np.ndarray:
    """Plan positions [n, 2] in metres from the scene's middle, along columns and rows."""
    across, along = image_axes(city, scene)
    local = np.atleast_2d(xy) - np.array(scene.centre_m)
    return np.column_stack([local @ across, local @ along])


def half_size(scene: SceneSpec) -> np.ndarray:
    """Half the ground size (m) of the left image, along columns and rows."""
    return np.array([scene.cols, scene.rows]) * LEFT_GSD_M / 2


def near_scenes(city: CitySpec, xy: np.ndarray, margin: float) -> np.ndarray:
    """Which plan positions [n, 2] lie in a scene or within ``margin`` metres of one."""
    near = np.zeros(len(xy), bool)
    for scene in city.scenes:
        inside = np.abs(scene_coordinates(city, scene, xy)) < half_size(scene) + margin
        near |= inside.all(axis=1)
    return near


def extent(city: CitySpec) -> tuple[float, float, float, float]:
    """(x_min, y_min, x_max, y_max) of the world, whole cells."""
    corners = []
    for scene in city.scenes:
        across, along = image_axes(city, scene)
        a, b = half_size(scene) + city.margin_m
        corners += [
            np.array(scene.centre_m) + i * a * across + j * b * along
            for i in (-1, 1)
            for j in (-1, 1)
        ]
    low = np.floor(np.min(corners, axis=0) / CELL_M) * CELL_M
    high = np.ceil(np.max(corners, axis=0) / CELL_M) * CELL_M
    return low[0], low[1], high[0], high[1]
