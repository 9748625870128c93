"""Building a twin: ground, roofs and crowns of a real place from its points."""

from __future__ import annotations

import logging

import numpy as np

from ..errors import InputError
from .appearance import PAINT
from .cities import CitySpec
from .dated_worlds import dated_patches
from .layout import extent, frame_of
from .patches import PATCHES_A_CELL, greatest
from .surfaces import CELL_M, Surfaces, terrain_heights
from .twin_crowns import OBJECT_M, Crowns, crowns_of, is_leaf
from .twin_ground import STEP_M, is_ground, terrain_of
from .twin_points import Points, read_points
from .twin_roofs import Planes, buildings_of, planes_of, rasterised, thinned
from .zones import draw_zones

log = logging.getLogger("stereotruth")

ROOF_LIGHT = 0.1, 0.5  # reflectance of roofs where the points tell none
GROUND_M = 0.7  # one point of the ground at most in a square of this side paints it


def place_of(city: CitySpec, empty: Surfaces) -> tuple[Surfaces, Crowns]:
    """The surfaces of a twin but for its crowns, and these.

    ``empty``: surfaces of the city's extent where nothing stands. Raises InputError if the file
    has no ground, or no points in the scenes.
    """
    frame, box = frame_of(city), extent(city)
    points = read_points(city.twin, frame)
    inside = (points.xyz[:, :2] > box[:2]) & (points.xyz[:, :2] < box[2:])
    points = points.which(inside.all(axis=1))
    if not len(points.xyz):
        raise InputError(
            "has no points in the scene", file=city.twin.file, remedy="make the scene larger"
        )
    low = is_ground(points)
    if not low.any():
        raise InputError(
            "has no points on the ground", file=city.twin.file, remedy="name a place's points"
        )
    shape = tuple(int((box[k + 2] - box[k]) / STEP_M) + 6 for k in (1, 0))
    terrain = terrain_of(points.xyz[low], box[0], box[1], shape)
    rng = np.random.default_rng([city.world_seed, 10])
    s = empty._replace(step=STEP_M, terrain=terrain)
    zones, zone_cells, zone_near, _ = draw_zones(city, rng, s)
    s = s._replace(zones=zones, zone_cells=zone_cells, zone_near=zone_near)
    ground = terrain_heights(s, points.xyz[:, :2])[:, 0]
    high = ~low & (points.xyz[:, 2] > ground + OBJECT_M)
    leaf = is_leaf(points.which(high))
    leaves, roofs = np.flatnonzero(high)[leaf], np.flatnonzero(high)[~leaf]
    roofs = roofs[thinned(points.xyz[roofs])]
    low = np.flatnonzero(low)
    low = low[thinned(points.xyz[low], GROUND_M)]
    found = planes_of(points.xyz[roofs])
    tint = _tints(points, found, roofs, low, rng)
    first = np.floor((points.xyz[:, :2].min(axis=0) - box[:2]) / CELL_M).astype(int)
    last = np.floor((points.xyz[:, :2].max(axis=0) - box[:2]) / CELL_M).astype(int) + 1
    raster = rasterised(
        found, points.xyz[roofs], points.xyz[low], tint, tuple(box[:2] + CELL_M * first),
        tuple(PATCHES_A_CELL * (last - first)[::-1]),
    )  # fmt: skip
    crowns = crowns_of(points.which(leaves), ground[leaves], rng)
    log.info(
        "%s: %d roof planes over %.0f m², %d crown tops",
        city.name, len(found.plane), (raster.roof >= 0).sum() * (CELL_M / PATCHES_A_CELL) ** 2,
        len(crowns.ellipsoids),
    )  # fmt: skip
    s = s._replace(
        patches=raster.patches, patch_side=raster.side,
        patch_building=buildings_of(raster.roof, rng), patch_i=int(first[0]),
        patch_j=int(first[1]), paint=np.rint(raster.paint * PAINT).astype(np.uint16),
    )  # fmt: skip
    return s, crowns


def _tints(
    points: Points, found: Planes, roofs: np.ndarray, low: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance of the points on roofs and on the ground.

    Where the file tells none, it is drawn for each roof, and the ground (0) has no paint.
    """
    if points.tint is not None:
        return points.tint[roofs], points.tint[low]
    drawn = np.append(rng.uniform(*ROOF_LIGHT, len(found.plane)), 0.0)
    return drawn[found.number], np.zeros(len(low))


def patch_tops(city: CitySpec, s: Surfaces) -> np.ndarray:
    """Greatest z of the patches in each cell of a city at any date, as its ``cell_top``."""
    top = np.full(s.cell_top.shape, -1e9)
    if not s.patches.size:
        return top
    rows, cols = (n // PATCHES_A_CELL for n in s.patches.shape[:2])
    highest = greatest(s.patches.astype(np.float64))
    if city.dates is not None:
        for passed in (0.0, 1.0):
            of = dated_patches(city, s, passed)
            highest = np.maximum(highest, greatest(of.astype(np.float64)))
    cells = highest.reshape(rows, PATCHES_A_CELL, cols, PATCHES_A_CELL)
    # rays are not followed where a cell ends: what is left over for rounding
    top[s.patch_j : s.patch_j + rows, s.patch_i : s.patch_i + cols] = cells.max(axis=(1, 3)) + 1e-3
    return top
