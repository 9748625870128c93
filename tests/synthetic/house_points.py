"""A LAZ of a place whose surface is known: a gabled house, a flat one, two trees, level ground."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pyproj

ORIGIN = np.array([500_000.0, 4_800_000.0])  # of EPSG:32631, in France
HALF_M = 62.0  # half the side of the place
GROUND_Z, EAVES_Z, RISE = 120.0, 128.0, 4.0
HOUSE = 24.0, 12.0  # half length (east), half width (north) of the gabled one, in the middle
FLAT = (38.0, -40.0), 12.0, 134.0  # middle, half side, height of the flat one
TREES = ((-42.0, 36.0), 6.0, 131.0), ((-38.0, -38.0), 5.0, 129.0)  # middle, radius, top
DENSITY = 6.0  # points per m²
ROOF_GREY, GROUND_GREY = 200, 120  # of 255


def top_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height of ground and roofs at plan positions from the middle, m."""
    z = np.full(x.shape, GROUND_Z)
    inside = (np.abs(x) < HOUSE[0]) & (np.abs(y) < HOUSE[1])
    z[inside] = (EAVES_Z + RISE * (1 - np.abs(y) / HOUSE[1]))[inside]
    (fx, fy), half, height = FLAT
    z[(np.abs(x - fx) < half) & (np.abs(y - fy) < half)] = height
    return z


def write_place(file: Path, *, crs: bool = True, colours: bool = True) -> Path:
    """Write the place's points, without classes: tree tops return twice, the rest once."""
    rng = np.random.default_rng(5)
    count = round(DENSITY * (2 * HALF_M) ** 2)
    xy = rng.uniform(-HALF_M, HALF_M, (count, 2))
    ground = top_of(*xy.T)
    z, is_leaf = ground.copy(), np.zeros(count, bool)
    for middle, radius, top in TREES:
        away = np.hypot(*(xy - middle).T)
        inside = away < radius
        z[inside] = top - 5.0 * (away[inside] / radius) ** 2 + rng.uniform(-1.2, 0, inside.sum())
        is_leaf |= inside
    below = np.flatnonzero(is_leaf)[::2]  # every other pulse reaches the ground
    header = laspy.LasHeader(version="1.4", point_format=7 if colours else 6)
    header.offsets, header.scales = [*ORIGIN, 0.0], np.full(3, 0.001)
    if crs:
        header.add_crs(pyproj.CRS.from_epsg(32631))
    points = laspy.LasData(header)
    order = np.concatenate([np.arange(count), below])
    points.x, points.y = ORIGIN[0] + xy[order, 0], ORIGIN[1] + xy[order, 1]
    points.z = np.concatenate([z, ground[below]]) + rng.normal(0, 0.02, len(order))
    points.classification = np.ones(len(order), np.uint8)
    points.number_of_returns = np.where(is_leaf[order], 2, 1)
    points.return_number = np.append(np.ones(count, int), np.full(len(below), 2))
    if colours:
        grey = np.where(points.z > GROUND_Z + 2, ROOF_GREY, GROUND_GREY) * 256
        points.red = points.green = points.blue = grey.astype(np.uint16)
    points.write(file)
    return file
