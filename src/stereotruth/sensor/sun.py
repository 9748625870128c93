"""Where the sun stands over a place: the Astronomical Almanac's low-precision formulas (page C5).

Good to 0.01 degrees between 1950 and 2050; refraction, 0.02 degrees at most while shadows are short
enough to match images, is left out.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
DAY = timedelta(days=1)


def sun_over(time: datetime, lon: float, lat: float) -> tuple[float, float]:
    """Azimuth (from north over east) and elevation of the sun, degrees; ``time`` has a zone."""
    days = (time - J2000) / DAY
    mean_longitude = 280.460 + 0.9856474 * days
    anomaly = math.radians(357.528 + 0.9856003 * days)
    longitude = math.radians(
        mean_longitude + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly)
    )
    obliquity = math.radians(23.439 - 4e-7 * days)
    right_ascension = math.degrees(
        math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    )
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    sidereal = 15.0 * (6.697375 + 0.0657098242 * days + (days + 0.5) % 1.0 * 24.0)
    hour_angle = math.radians(sidereal + lon - right_ascension)
    phi = math.radians(lat)
    elevation = math.asin(
        math.sin(declination) * math.sin(phi)
        + math.cos(declination) * math.cos(phi) * math.cos(hour_angle)
    )
    azimuth = math.atan2(
        -math.cos(declination) * math.sin(hour_angle),
        math.sin(declination) * math.cos(phi)
        - math.cos(declination) * math.sin(phi) * math.cos(hour_angle),
    )
    return math.degrees(azimuth) % 360.0, math.degrees(elevation)


def toward_sun(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    """Unit vector [3] (east, north, up) toward the sun."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)])


def shadow_shift(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Way of a shadow's end between two suns (azimuth, elevation), in heights of what casts it."""
    ends = [-direction[:2] / direction[2] for direction in (toward_sun(*one), toward_sun(*other))]
    return float(np.linalg.norm(ends[0] - ends[1]))


def between_suns(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Angle between the directions to two suns, degrees."""
    cosine = float(toward_sun(*one) @ toward_sun(*other))
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
