"""Degrees of longitude and latitude in metres, the convex hull, and triangles over an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels import inner
from .arrays import Floats

DEGREE_M = 111_320.0
"""A degree of longitude at the equator; of latitude, to 0.7 % anywhere. For distances that are
judged, not measured."""
SEMI_MAJOR_M = 6_378_137.0  # WGS 84
ECCENTRICITY_SQUARED = 6.69437999014e-3

SEAM_DEG = -177.6
"""Where longitudes jump by 360: the meridian near that of 180° with least land, so that places on
both sides of the line of 180° have longitudes that are near to each other."""

Three = tuple[float, float, float]


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


def corners_of_hull(x: Floats, y: Floats) -> list[int]:
    """Which points are corners of the convex hull of all, counterclockwise.

    Andrew's monotone chain. SciPy's hull takes a quarter of a job's start-up to import.
    """
    order = np.lexsort((y, x)).tolist()
    xs, ys = x.tolist(), y.tolist()
    corners: list[int] = []
    for points in (order, order[::-1]):  # the lower side, then the upper
        side: list[int] = []
        for k in points:
            while len(side) > 1:
                i, j = side[-2:]
                if (xs[j] - xs[i]) * (ys[k] - ys[i]) > (ys[j] - ys[i]) * (xs[k] - xs[i]):
                    break
                side.pop()
            side.append(k)
        corners += side[:-1]
    return corners


@inner
def edge_crossing(xa: float, ya: float, xb: float, yb: float, y: float) -> float:
    """Column where an edge between (xa, ya) and (xb, yb) meets the row ``y``.

    The same bits for both triangles beside the edge, so that no pixel is lost between them.
    """
    if yb < ya or (yb == ya and xb < xa):
        xa, ya, xb, yb = xb, yb, xa, ya
    return xa + (y - ya) * ((xb - xa) / (yb - ya))


@inner
def row_span(x: Three, y: Three, row: float) -> tuple[float, float]:
    """Lowest and highest column of a triangle in a row, both included; (inf, -inf) for none."""
    low, high = np.inf, -np.inf
    for i in range(3):
        k = (i + 1) % 3
        if y[i] == y[k]:
            if y[i] == row:
                low, high = min(low, x[i], x[k]), max(high, x[i], x[k])
        elif min(y[i], y[k]) <= row <= max(y[i], y[k]):
            at = edge_crossing(x[i], y[i], x[k], y[k], row)
            low, high = min(low, at), max(high, at)
    return low, high


@inner
def plane_slopes(x: Three, y: Three, value: Three) -> tuple[float, float]:
    """Slopes along x and y of a value at the corners; not finite if these lie in a line."""
    u, v, s, t = x[1] - x[0], y[1] - y[0], x[2] - x[0], y[2] - y[0]
    p, q = value[1] - value[0], value[2] - value[0]
    area = u * t - v * s
    return (p * t - q * v) / area, (q * u - p * s) / area


@inner
def corner_shares(x: Three, y: Three, across: float, down: float) -> tuple[float, float]:
    """Shares of the second and the third corner at a position that lies so far from the first one:
    barycentric coordinates, that of the first being what is left to 1.

    Of a position outside of the triangle by roundings, those of its border.
    """
    bx, by = plane_slopes(x, y, (0.0, 1.0, 0.0))
    cx, cy = plane_slopes(x, y, (0.0, 0.0, 1.0))
    b = min(max(bx * across + by * down, 0.0), 1.0)
    return b, min(max(cx * across + cy * down, 0.0), 1.0 - b)
