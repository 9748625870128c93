"""Twins of real places: a city whose surfaces follow from the points of a LAS or LAZ file.

What is made of the points is the truth: images, LiDAR and truth of a twin look at one and the same
ground, roofs and crowns, and the points of the file are never seen again.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pyproj

from stereotruth.core.errors import InputError

from .appearance import PAINT
from .camera import LocalFrame
from .cities import LEFT_GSD_M, Character, CitySpec, SceneSpec, Twin
from .layout import draw_zones, extent, frame_of, image_axes
from .rpcs import read_rpc
from .surfaces import CELL_M, PATCHES_A_CELL, Surfaces, terrain_heights
from .twin_surfaces import (
    OBJECT_M,
    STEP_M,
    Crowns,
    Points,
    buildings_of,
    crowns_of,
    is_ground,
    is_leaf,
    planes_of,
    rasterised,
    terrain_of,
    thinned,
)

log = logging.getLogger("stereotruth")

NOISE = (7, 18)  # classes of LAS
POINTS_A_CHUNK = 2_000_000
TONE = 2.2  # exponent of the tone curve of colours
MIDDLE = 0.25  # reflectance of a point of median intensity
DARKEST, BRIGHTEST = 0.04, 0.75  # reflectance
ROOF_LIGHT = 0.1, 0.5  # reflectance of roofs where the points tell none
GROUND_M = 0.7  # one point of the ground at most in a square of this side paints it
GIVE_CRS = "give the coordinate system of the points, as --crs EPSG:2154"

MARGIN_PX = 30  # of the left image around the points
MOST_PX = 3200  # a side of 2 km: the patches of a twin take some 4 GB while it is built
SUN_DEG = (148.0, 54.0)
# Land use is what the ground looks like where the file tells nothing of it; all else is the file's.
CHARACTER = Character(
    relief_m=0.0, valley=0.0, wavelength_m=0.0, max_slope_deg=0.0, river_m=0.0, lakes=0.0,
    zones={"slabs": 2.0, "lowrise": 2.0, "village": 1.0, "park": 1.5}, towers_m=(0.0, 0.0),
    trees=0.0, zone_m=200.0,
)  # fmt: skip


class Extent(NamedTuple):
    """Where the points of a file lie: ``crs`` of their plan positions, ``low`` and ``high`` [3] in
    the units of the file, ``unit_m``: metres of a unit of height."""

    crs: pyproj.CRS
    low: np.ndarray
    high: np.ndarray
    unit_m: float

    def to_geodetic(self, xyz: np.ndarray) -> np.ndarray:
        """Longitude, latitude (degrees), height (m) [n, 3] of points [n, 3] of the file."""
        transformer = pyproj.Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)
        lon, lat = transformer.transform(xyz[:, 0], xyz[:, 1])
        return np.column_stack([lon, lat, self.unit_m * xyz[:, 2]])


def extent_of(file: str | Path, crs: str = "") -> Extent:
    """Extent of a LAS or LAZ file by its header. ``crs``: of a file that declares none.

    Raises InputError: no file of points, none in it, or no coordinate system.
    """
    file = Path(file)
    points = "name a LAS or LAZ file of a place's points"
    if not file.is_file():
        raise InputError("there is no such file", file=file, remedy=points)
    try:
        with laspy.open(file) as source:
            header = source.header
            declared = None if crs else header.parse_crs()
    except (laspy.LaspyException, pyproj.exceptions.CRSError, ValueError) as error:
        raise InputError(
            f"cannot be read as LAS or LAZ: {error}", file=file, remedy=points
        ) from None
    if not header.point_count:
        raise InputError("has no points", file=file, remedy=points)
    if not crs and declared is None:
        what = "declares no coordinate system that an EPSG code or WKT names"
        raise InputError(what, file=file, remedy=GIVE_CRS)
    try:
        full = pyproj.CRS.from_user_input(crs) if crs else declared
    except pyproj.exceptions.CRSError:
        what = f"{crs!r} is no coordinate system"
        raise InputError(what, file=file, remedy=GIVE_CRS) from None
    plan = full.sub_crs_list[0] if full.is_compound else full
    if not (plan.is_projected or plan.is_geographic):
        what = f"the coordinate system {plan.name} has no positions in plan"
        raise InputError(what, file=file, remedy=GIVE_CRS)
    axes = full.axis_info
    upward = axes[2] if len(axes) > 2 else axes[0]
    unit = upward.unit_conversion_factor if plan.is_projected or len(axes) > 2 else 1.0
    return Extent(plan.to_2d(), np.array(header.mins), np.array(header.maxs), float(unit))


def read_points(twin: Twin, frame: LocalFrame) -> Points:
    """All points of a place but noise and withheld ones."""
    extent = extent_of(twin.file, twin.crs)
    parts = []
    with laspy.open(twin.file) as source:
        names = set(source.header.point_format.dimension_names)
        for cloud in source.chunk_iterator(POINTS_A_CHUNK):
            label = np.asarray(cloud.classification, np.uint8)
            use = ~np.isin(label, NOISE) & (np.asarray(cloud.withheld) == 0)
            xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[use]
            parts.append((
                frame.from_geodetic(extent.to_geodetic(xyz)),
                label[use],
                np.asarray(cloud.number_of_returns)[use] <= 1,
                np.asarray(cloud.return_number)[use] <= 1,
                np.asarray(cloud.intensity)[use],
                _grey(cloud, names, use),
            ))  # fmt: skip
    xyz, label, single, first, echo, grey = (np.concatenate(of) for of in zip(*parts))
    log.info("%s: %.2f million points", Path(twin.file).name, len(xyz) / 1e6)
    return Points(xyz, label, single, first, _tint(echo, grey))


def _grey(cloud: laspy.ScaleAwarePointRecord, names: set[str], use: np.ndarray) -> np.ndarray:
    """Mean of the colours of points; 0 where a file has none."""
    if not {"red", "green", "blue"} <= names:
        return np.zeros(int(use.sum()), np.float32)
    colours = (np.asarray(cloud[c])[use] for c in ("red", "green", "blue"))
    return (sum(c.astype(np.float32) for c in colours) / 3).astype(np.float32)


def _tint(echo: np.ndarray, grey: np.ndarray) -> np.ndarray | None:
    """Reflectance of points by their colours, else by their intensity, else None."""
    if len(grey) and np.ptp(grey) > 0:
        full = 65535.0 if grey.max() > 255 else 255.0
        return np.clip((grey / full) ** TONE, DARKEST, BRIGHTEST).astype(np.float32)
    if len(echo) and np.ptp(echo) > 0:
        scaled = MIDDLE * echo.astype(np.float64) / max(float(np.median(echo)), 1.0)
        return np.clip(scaled, DARKEST, BRIGHTEST).astype(np.float32)
    return None


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
    if points.tint is not None:
        tint = points.tint[roofs], points.tint[low]
    else:  # drawn for each roof, and the ground (0) has no paint
        drawn = np.append(rng.uniform(*ROOF_LIGHT, len(found.plane)), 0.0)
        tint = drawn[found.number], np.zeros(len(low))
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


def twin_city(
    name: str,
    file: str | Path,
    *,
    crs: str = "",
    size_px: tuple[int, int] | None = None,
    sun_deg: tuple[float, float] = SUN_DEG,
    rpcs: tuple[str | Path, str | Path] | None = None,
    pose_seed: int = 1,
) -> CitySpec:
    """The twin of the place whose points a LAS or LAZ file has, with its one scene ``name``-1.

    ``crs``: of a file that declares none. ``size_px``: columns and rows of the left image, about
    the middle of the place; None: all of it. ``sun_deg``: azimuth and elevation. ``rpcs``: of
    the left and the right image, instead of GaoFen-7's camera; images have the size that the place
    has in them then. ``pose_seed`` draws orbit, attitude and the bias of the RPCs. Heights are
    taken as ellipsoidal. Raises InputError of :func:`extent_of` and
    :func:`.rpcs.read_rpc`.
    """
    of = extent_of(file, crs)
    low, high = of.low, of.high
    middle = (low + high) / 2
    lon, lat, _ = of.to_geodetic(middle[None])[0]
    if not (abs(lon) <= 360 and abs(lat) <= 90):
        what = f"lies outside of what {of.crs.name} covers"
        raise InputError(what, file=file, remedy=GIVE_CRS)
    base = math.floor(of.unit_m * low[2])
    frame = LocalFrame(float(lon), float(lat), float(base))
    ends = np.array([[high[0], middle[1], low[2]], [middle[0], high[1], low[2]]])
    right, up = frame.from_geodetic(of.to_geodetic(ends))[:, :2]
    half = float(np.hypot(*right)), float(np.hypot(*up))
    if not min(half) > 0:
        raise InputError("covers no ground", file=file, remedy="name a file of a place's points")
    scene = SceneSpec(
        f"{name}-1", (0.0, 0.0), 0, 0, pose_seed, lidar_grid=(1, 1), ragged_m=(0.0, 0.0)
    )
    city = CitySpec(
        name,
        lon=float(lon),
        lat=float(lat),
        epsg=(32601 if lat >= 0 else 32701) + int((lon + 180.0) // 6.0),
        base_height_m=float(base),
        world_seed=pose_seed,
        character=CHARACTER,
        scenes=(scene,),
        sun_azimuth_deg=sun_deg[0],
        sun_elevation_deg=sun_deg[1],
        twin=Twin(
            str(file),
            crs,
            half,
            math.atan2(right[1], right[0]),
            None if rpcs is None else tuple(str(read_rpc(file).file) for file in rpcs),
        ),
    )
    cols, rows = size_px or (
        math.ceil(2 * (abs(float(axis @ right)) + abs(float(axis @ up))) / LEFT_GSD_M)
        + 2 * MARGIN_PX
        for axis in image_axes(city, scene)
    )
    if max(cols, rows) > MOST_PX:
        raise InputError(
            f"would be {cols} x {rows} px of {LEFT_GSD_M} m, and {MOST_PX} are the most",
            file=file,
            remedy="give a part of it about its middle, as --size 2000 2000, or cut the file",
        )
    return replace(city, scenes=(replace(scene, cols=cols, rows=rows),))
