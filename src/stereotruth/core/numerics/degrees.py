"""Degrees of longitude and latitude in metres."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

DEGREE_M = 111_320.0
"""A degree of longitude at the equator; of latitude, to 0.7 % anywhere. For distances that are
judged, not measured."""
SEMI_MAJOR_M = 6_378_137.0  # WGS 84
ECCENTRICITY_SQUARED = 6.69437999014e-3

SEAM_DEG = -177.6
"""Where longitudes jump by 360: the meridian near that of 180° with least land, so that places on
both sides of the line of 180° have longitudes that are near to each other."""


def turn(degrees: ArrayLike) -> NDArray[np.float64]:
    """Differences of longitudes, the shorter way around: in [−180, 180)."""
    return (np.asarray(degrees, np.float64) + 180.0) % 360.0 - 180.0


def continuous(lon: ArrayLike) -> NDArray[np.float64]:
    """Longitudes in [SEAM_DEG, SEAM_DEG + 360), to the bit those that lie there already."""
    lon = np.asarray(lon, np.float64)
    turns = np.floor((np.where(np.isfinite(lon), lon, 0.0) - SEAM_DEG) / 360.0)
    return lon - 360.0 * turns if turns.any() else lon


def for_readers(lon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Longitudes of one outline as other programs have them, up to 180; those of an outline across
    the line of 180° go on beyond it, so that it stays in one piece."""
    return lon - 360.0 if lon.min() >= 180.0 else lon


def metres_per_degree(lat: ArrayLike) -> NDArray[np.float64]:
    """Metres [2, ...] of a degree to the east and to the north at latitudes ``lat``; to 0.7 %."""
    return DEGREE_M * np.stack([np.cos(np.radians(lat)), np.ones(np.shape(lat))])


def exact_metres_per_degree(lat: float, height_m: float) -> NDArray[np.float64]:
    """Metres [2] of a degree to the east and to the north at a height over WGS 84, exactly."""
    phi = np.radians(lat)
    w = 1.0 - ECCENTRICITY_SQUARED * np.sin(phi) ** 2
    prime_vertical = SEMI_MAJOR_M / np.sqrt(w) + height_m
    meridian = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / w**1.5 + height_m
    return np.radians([np.cos(phi) * prime_vertical, meridian])
