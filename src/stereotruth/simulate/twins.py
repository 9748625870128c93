"""Twins of real places: a city whose surfaces follow from the points of a LAS or LAZ file.

What is made of the points (:mod:`.twin_world`) is the truth: images, LiDAR and truth of a twin look
at one and the same ground, roofs and crowns, and the points of the file are never seen again.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from .cities import LEFT_GSD_M, Character, CitySpec, SceneSpec, Twin
from .geodesy import LocalFrame
from .given_rpcs import read_rpc
from .layout import image_axes
from .twin_points import extent_of

MARGIN_PX = 30  # of the left image around the points
MOST_PX = 3200  # a side of 2 km: the patches of a twin take some 4 GB while it is built
SUN_DEG = (148.0, 54.0)
# Land use is what the ground looks like where the file tells nothing of it; all else is the file's.
CHARACTER = Character(
    relief_m=0.0, valley=0.0, wavelength_m=0.0, max_slope_deg=0.0, river_m=0.0, lakes=0.0,
    zones={"slabs": 2.0, "lowrise": 2.0, "village": 1.0, "park": 1.5}, towers_m=(0.0, 0.0),
    trees=0.0, zone_m=200.0,
)  # fmt: skip


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
    taken as ellipsoidal. Raises InputError of :func:`.twin_points.extent_of` and
    :func:`.given_rpcs.read_rpc`.
    """
    of = extent_of(file, crs)
    low, high = of.low, of.high
    middle = (low + high) / 2
    lon, lat, _ = of.to_geodetic(middle[None])[0]
    if not (abs(lon) <= 360 and abs(lat) <= 90):
        raise InputError(
            f"lies outside of what {of.crs.name} covers",
            file=file,
            remedy="give the coordinate system of the points, as --crs EPSG:2154",
        )
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
        twin=Twin(str(file), crs, half, math.atan2(right[1], right[0]), _read_once(rpcs)),
    )
    cols, rows = size_px or _all_of_it(city, scene, right, up)
    if max(cols, rows) > MOST_PX:
        raise InputError(
            f"would be {cols} x {rows} px of {LEFT_GSD_M} m, and {MOST_PX} are the most",
            file=file,
            remedy="give a part of it about its middle, as --size 2000 2000, or cut the file",
        )
    return replace(city, scenes=(replace(scene, cols=cols, rows=rows),))


def _read_once(rpcs: tuple[str | Path, str | Path] | None) -> tuple[str, str] | None:
    """The names of files of RPCs that can be read."""
    if rpcs is None:
        return None
    left, right = (str(read_rpc(file).file) for file in rpcs)
    return left, right


def _all_of_it(
    city: CitySpec, scene: SceneSpec, right: np.ndarray, up: np.ndarray
) -> tuple[int, int]:
    """Columns and rows of a left image that shows all points; half axes ``right``, ``up`` [2]."""
    sides = []
    for axis in image_axes(city, scene):
        reach = abs(float(axis @ right)) + abs(float(axis @ up))
        sides.append(math.ceil(2 * reach / LEFT_GSD_M) + 2 * MARGIN_PX)
    return sides[0], sides[1]
