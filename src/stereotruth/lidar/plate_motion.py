"""Motion of the rigid plates in ITRF2020, for coordinates that are of another epoch.

Rotation rates and origin rate bias: Altamimi, Métivier, Rebischung, Collilieux, Chanard, Barnéoud
(2023), ITRF2020 Plate Motion Model, Geophysical Research Letters 50, e2023GL106373,
doi 10.1029/2023GL106373, tables 1 and 2 (also the file ITRF2020 of PROJ 9.5). As the paper advises,
the bias is added to the horizontal velocities, and what it makes of vertical ones is left out.

The outlines of the plates are coarse: straight lines between places that lie some tens of km beside
the boundaries of Bird (2003, doi 10.1029/2001GC000252). Zones that belong to no rigid plate of the
model (Japan, Taiwan, Indonesia, Anatolia, Iceland, the Andes' coast) lie in none of them. Within
200 km of a boundary the ground moves by up to some cm a year otherwise than the plate.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pyproj
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MAS = np.radians(1 / 3.6e6)  # a milliarcsecond
ORIGIN_RATE_BIAS = (0.37e-3, 0.35e-3, 0.74e-3)  # m a year, X, Y, Z
ROTATION = {  # mas a year about X, Y, Z
    "AMUR": (-0.131, -0.551, 0.837),
    "ANTA": (-0.269, -0.312, 0.678),
    "ARAB": (1.129, -0.146, 1.438),
    "AUST": (1.487, 1.175, 1.223),
    "CARB": (0.207, -1.422, 0.726),
    "EURA": (-0.085, -0.519, 0.753),
    "INDI": (1.137, 0.013, 1.444),
    "NAZC": (-0.327, -1.561, 1.605),
    "NOAM": (0.045, -0.666, -0.098),
    "NUBI": (0.090, -0.585, 0.717),
    "PCFC": (-0.404, 1.021, -2.154),
    "SOAM": (-0.261, -0.282, -0.157),
    "SOMA": (-0.081, -0.719, 0.864),
}

# From Fiordland along the Alpine and the Hope Fault to the Hikurangi Trough.
_NEW_ZEALAND = (
    "165.6 -46.8, 167.0 -45.2, 167.9 -44.55, 168.7 -44.1, 169.4 -43.8, 170.2 -43.4, 171.45 -42.75, "
    "172.9 -42.5, 173.9 -42.4, 175.3 -42.0, 177 -41, 178.5 -39.5, 179.4 -37.5"
)
# The San Andreas Fault from Cape Mendocino to the Gulf of California.
_CALIFORNIA = (
    "-124.4 40.3, -123.7 38.9, -122.5 37.7, -121.2 36.6, -119.9 35.1, -118.5 34.7, -117.4 34.2, "
    "-116.2 33.6, -115.5 32.6, -114.5 31, -109 23.5"
)


def _reversed(line: str) -> str:
    return ", ".join(reversed(line.split(", ")))


# Longitude and latitude of the corners; the first outline that a place lies in counts.
OUTLINES = (
    ("AUST", f"110 -11, 120 -11, 128 -11, 142 -9.6, 146 -11, 156 -13, 165 -21.5, 171 -23, 179 -35, "
     f"{_reversed(_NEW_ZEALAND)}, 160 -50, 135 -48, 108 -42"),
    ("PCFC", f"{_NEW_ZEALAND}, 184 -37, 184 -53, 166 -53"),
    ("PCFC", f"-160 5, -160 45, -135 45, {_CALIFORNIA}, -120 10"),
    ("AMUR", "112 50, 118 42.5, 122 39, 125.5 33, 130 34.5, 131.5 42, 139 48, 139 53.5, 120 55.5"),
    ("EURA", "-24 37.5, -10 36.4, -5.5 36, 0 37.6, 8 38.8, 12.4 37.4, 15.4 37.6, 19 39.6, 20.5 42, "
     "28.5 41.8, 41 43.5, 50 42, 58 39, 68 38.5, 74 36.5, 80 35.5, 92 28.5, 99 25, 102 21.5, "
     "107 20.5, 112 17.5, 119.5 24, 123 29, 124 37, 122 39, 118 42.5, 112 50, 120 55.5, 131 62, "
     "138 68, 140 82, 0 84, 5 74, -8 70, -12 66.5, -13 63, -28 55, -28 40"),
    ("NOAM", f"-168 71, -166 64, -157 60.5, -145 61.5, -135 57.8, -131.5 53.5, -125 48.4, "
     f"-124.2 43, {_CALIFORNIA}, -105.3 20.3, -98 17, -93.5 16, -88.5 17.5, -86 21.3, -75 21.2, "
     "-66 21, -55 22, -46 25, -34 45, -33 57, -40 60, -28 67.5, -18 70.5, -8 82, -60 86, -168 80"),
    ("CARB", "-81 12.5, -75.5 17.3, -68 17.5, -64.5 17.6, -62 18.2, -60.2 15, -60.7 11.8, "
     "-66 12.2, -72 13.2, -79 10.5"),
    ("SOAM", "-76 -14.5, -79 -5, -77.5 -2, -76 1, -73.5 5, -71 8, -63 10.2, -59 12.5, -45 9, "
     "-32 0, -20 -15, -18 -45, -55 -53, -66 -54, -73 -50, -72.5 -40, -70.5 -33, -69 -20, -71 -16"),
    ("ARAB", "35.7 29, 36.3 33, 38 36.3, 42 36.8, 45.5 34, 48.5 30.2, 52 27, 56 26, 58 24.8, "
     "60 22.5, 58 17, 52 14.8, 45 13, 43 13.8, 40.5 19.5, 37 24.5"),
    ("SOMA", "43 10.8, 52 12.8, 60 2, 62 -22, 54 -32, 37 -33, 36 -20, 37 -6, 39.5 3, 41.5 8"),
    ("NUBI", "-28 37, -6 35.4, -1.5 35, 9 37, 12 33.5, 20 33.2, 31 32.2, 33.5 28.2, 36.5 22, "
     "39 16, 39.5 13.5, 38 8.5, 36 4.5, 31 3.5, 29 -2, 29 -7, 32 -11, 33.5 -19, 32 -27, 33 -36, "
     "20 -46, -8 -40, -12 0, -25 15, -28 30"),
    ("INDI", "67.5 24, 70.5 29.5, 74.5 32.2, 80 28.8, 88 26.6, 91.5 25.8, 91 21.5, 90 10, 86 2, "
     "72 2, 66 16"),
    ("ANTA", "-180 -90, -180 -64, 180 -64, 180 -90"),
)  # fmt: skip


def _corners(outline: str) -> Floats:
    return np.array([corner.split() for corner in outline.split(", ")], float)


_CORNERS = tuple((plate, _corners(outline)) for plate, outline in OUTLINES)


def plate_at(lon: float, lat: float) -> str | None:
    """The plate (ITRF2020's abbreviation) of a place in degrees; None where none of them is."""
    for plate, corners in _CORNERS:
        turns = np.round((corners[:, 0].mean() - lon) / 360.0) * 360.0
        x, y = corners[:, 0] - (lon + turns), corners[:, 1] - lat
        following = np.roll(x, -1), np.roll(y, -1)
        crosses = (y > 0) != (following[1] > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = x - y * (following[0] - x) / (following[1] - y)
        if np.count_nonzero(crosses & (at > 0)) % 2:
            return plate
    return None


@cache
def _to_geocentric() -> pyproj.Transformer:
    return pyproj.Transformer.from_pipeline("+proj=pipeline +step +proj=cart +ellps=GRS80")


def _velocity(lon: Floats, lat: Floats, xyz: Floats, plate: str) -> Floats:
    """Geocentric velocity [3, n], m a year: the rotation's, and the bias' horizontal part."""
    spin = np.array(ROTATION[plate])[:, None] * MAS
    bias = np.array(ORIGIN_RATE_BIAS)[:, None]
    lon, lat = np.radians(lon), np.radians(lat)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.cross(spin, xyz, axis=0) + bias - (bias * up).sum(axis=0) * up


def speed(lon: float, lat: float, plate: str) -> float:
    """Of a place on a plate, m a year."""
    place = np.array([[lon], [lat], [0.0]])
    xyz = np.stack(_to_geocentric().transform(*place))
    return float(np.linalg.norm(_velocity(place[0], place[1], xyz, plate)))


def moved(
    lon: Floats, lat: Floats, height: Floats, plate: str, years: float
) -> tuple[Floats, Floats, Floats]:
    """Longitude, latitude (degrees) and ellipsoidal height (m) after some years, each float64[n].

    In ITRF2020, GRS 80. Places that are not finite stay so.
    """
    xyz = np.stack(_to_geocentric().transform(lon, lat, height))
    there = xyz + years * _velocity(lon, lat, xyz, plate)
    east, north, up = _to_geocentric().transform(*there, direction="INVERSE")
    return east, north, up
