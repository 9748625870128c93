"""WGS 84 and the local Cartesian frame in which a synthetic city is built.

World coordinates are metres in the tangent frame at the city's centre: x east, y north, z along
the ellipsoid's normal there, the origin at the city's base height. The frame is Cartesian, so that
rays are straight lines in it and the way to ECEF is one rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereotruth.core.kernels import inlined, kernel

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
EARTH_RATE = 7.292115e-5  # rad/s
GRAVITY = 3.986004418e14  # m³/s²


def geodetic_to_ecef(lon: np.ndarray, lat: np.ndarray, height: np.ndarray) -> np.ndarray:
    """ECEF metres [..., 3] of WGS 84 degrees and ellipsoidal metres."""
    lam, phi = np.radians(lon), np.radians(lat)
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(phi) ** 2)
    return np.stack(
        [
            (normal + height) * np.cos(phi) * np.cos(lam),
            (normal + height) * np.cos(phi) * np.sin(lam),
            (normal * (1 - ECCENTRICITY2) + height) * np.sin(phi),
        ],
        axis=-1,
    )


@inlined
def ecef_to_geodetic_point(x, y, z):
    """Longitude, latitude (degrees) and ellipsoidal height (m) of one ECEF point.

    Bowring's formula, iterated: below 1e-12 degrees within 100 km of the ellipsoid.
    """
    semi_minor = SEMI_MAJOR_M * (1 - FLATTENING)
    second = ECCENTRICITY2 / (1 - ECCENTRICITY2)
    p = math.sqrt(x * x + y * y)
    tan_u = z * SEMI_MAJOR_M / (p * semi_minor)
    tan_phi = 0.0
    for _ in range(2):
        cos_u = 1 / math.sqrt(1 + tan_u * tan_u)
        sin_u = tan_u * cos_u
        tan_phi = (z + second * semi_minor * sin_u**3) / (
            p - ECCENTRICITY2 * SEMI_MAJOR_M * cos_u**3
        )
        tan_u = (1 - FLATTENING) * tan_phi
    cos_phi = 1 / math.sqrt(1 + tan_phi * tan_phi)
    sin_phi = tan_phi * cos_phi
    height = (
        p * cos_phi + z * sin_phi - SEMI_MAJOR_M * math.sqrt(1 - ECCENTRICITY2 * sin_phi * sin_phi)
    )
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan(tan_phi)), height


@kernel
def _ecef_to_geodetic(xyz, out):
    for i in range(xyz.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = ecef_to_geodetic_point(xyz[i, 0], xyz[i, 1], xyz[i, 2])


def ecef_to_geodetic(xyz: np.ndarray) -> np.ndarray:
    """WGS 84 longitude, latitude (degrees), ellipsoidal height (m), [n, 3], of ECEF [n, 3]."""
    xyz = np.ascontiguousarray(np.atleast_2d(xyz), dtype=np.float64)
    out = np.empty_like(xyz)
    _ecef_to_geodetic(xyz, out)
    return out


@dataclass(frozen=True)
class LocalFrame:
    """The city's tangent frame: centre in degrees, ellipsoidal height of z = 0 in metres."""

    lon: float
    lat: float
    height: float

    @property
    def origin(self) -> np.ndarray:
        """ECEF position [3] of the frame's origin."""
        return geodetic_to_ecef(*(np.float64(v) for v in (self.lon, self.lat, self.height)))

    @property
    def axes(self) -> np.ndarray:
        """ECEF unit vectors [3, 3], rows east, north, up."""
        lam, phi = math.radians(self.lon), math.radians(self.lat)
        sl, cl, sp, cp = math.sin(lam), math.cos(lam), math.sin(phi), math.cos(phi)
        return np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])

    def to_ecef(self, xyz: np.ndarray) -> np.ndarray:
        """ECEF [n, 3] of world points [n, 3]."""
        return self.origin + np.atleast_2d(xyz) @ self.axes

    def to_geodetic(self, xyz: np.ndarray) -> np.ndarray:
        """Longitude, latitude, ellipsoidal height [n, 3] of world points [n, 3]."""
        return ecef_to_geodetic(self.to_ecef(xyz))

    def from_geodetic(self, lonlath: np.ndarray) -> np.ndarray:
        """World points [n, 3] of longitude, latitude, ellipsoidal height [n, 3]."""
        ecef = geodetic_to_ecef(*np.atleast_2d(lonlath).T)
        return (ecef - self.origin) @ self.axes.T

    def packed(self) -> np.ndarray:
        """float64[12] for kernels: origin, then the axes row by row."""
        return np.concatenate([self.origin, self.axes.ravel()])


@inlined
def world_to_geodetic_point(frame, x, y, z):
    """Longitude, latitude (degrees), ellipsoidal height (m) of one world point."""
    return ecef_to_geodetic_point(
        frame[0] + frame[3] * x + frame[6] * y + frame[9] * z,
        frame[1] + frame[4] * x + frame[7] * y + frame[10] * z,
        frame[2] + frame[5] * x + frame[8] * y + frame[11] * z,
    )
