"""The exact truth of a scene: what each pixel shows, where the other image has it, what changed.

A ray goes through a pixel of one image and meets the surface of each world: those of both images
and of the LiDAR. What is highest on the ray and is not in all worlds is the reason of the change.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import zarr
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec

from stereotruth.core.job import progress
from stereotruth.core.kernels import inlined, kernel
from stereotruth.core.products.grids import PlainStore, atomic_store

from .appearance import VEHICLE, resurfaced_at
from .camera import LocalFrame, pose, project_point, world_to_geodetic_point
from .cities import CitySpec, SceneSpec
from .layout import coverage, covered
from .render import Camera, has_data, in_collar, prepare, ray
from .surfaces import (
    GROUND,
    IN_LIDAR,
    NONE,
    ROOF,
    TREE,
    WALL,
    WATER,
    Surfaces,
    cast,
    stands_in,
    terrain_at,
)
from .world import world_of

if TYPE_CHECKING:
    import xarray as xr

log = logging.getLogger("stereotruth")

CHUNK = 512
SEEN_TOLERANCE_M = 0.02
SAME_M = 0.01  # on one ray: the same surface
SURFACES = "none ground roof wall tree water"
CHANGES = "unchanged in_lidar_only in_images_only"
LAYERS = {
    "lon": ("float64", "degrees_east", "WGS 84 longitude of the surface point"),
    "lat": ("float64", "degrees_north", "WGS 84 latitude of the surface point"),
    "height": ("float64", "m", "WGS 84 ellipsoidal height of the surface point"),
    "right_col": ("float64", "px", "column of the surface point in the right image"),
    "right_row": ("float64", "px", "row of the surface point in the right image"),
    "visible_right": ("uint8", "1", "1 where the right image shows the surface point"),
    "hidden_right": (
        "uint8",
        "1",
        "1 where the surface point lies in the right frame, behind something",
    ),
    "surface": ("uint8", "1", "kind of surface that the pixel shows"),
    "changed": ("uint8", "1", "whether the pixel would show another surface in the LiDAR's world"),
    "changed_right": (
        "uint8",
        "1",
        "1 where the LiDAR's world is unchanged, but hides the point from the right view and that "
        "of the images does not, or the other way round",
    ),
    "covered": ("uint8", "1", "1 inside the LiDAR coverage"),
}
FLAGS = {"surface": SURFACES, "changed": CHANGES}
REALS = [name for name, (dtype, _, _) in LAYERS.items() if dtype == "float64"]

UNCHANGED, BUILT, DEMOLISHED, GROWN_OR_FELLED, MOVED, WATER_LEVEL, GROUND_LEVEL, TEXTURE = range(8)
CHANGE_LAYERS = {
    "height": "m above the frame's height: what the pixel's ray meets in the image's world",
    "height_other": "m: what it meets in the world of the other image",
    "height_lidar": "m: what it meets in the world of the LiDAR",
    "reason": "what changed there: one of REASONS",
}
REASONS = "none built demolished grown_or_felled moved water ground texture"


@inlined
def seen_from(s, above, x, y, z, line, view, tolerance):
    """Whether nothing hides a world point from the position in ``line``, a camera's pose."""
    depth = line[2] - z
    bx, by = (line[0] - x) / depth, (line[1] - y) / depth
    hit, kind, _, _, _, _, _ = cast(s, above, x - bx * z, y - by * z, bx, by, view, True, z)
    return kind != NONE and hit <= z + tolerance


@inlined
def _lies_lower(s, kind, x, y, z):
    """Whether ground or water of a world lies lower than a point of another world's."""
    if kind != GROUND and kind != WATER:
        return False
    ground, _, _ = terrain_at(s, x, y)
    return max(ground, s.water) < z - SEEN_TOLERANCE_M


@kernel
def _truth_points(first, second, scanned_s, frame, cover, image_col, image_row, real, flags):
    """The truth at positions [n] of the ``first`` of two images; neighbours follow each other.

    ``scanned_s``: the LiDAR's world. real[5, n] and flags[6, n]: values of LAYERS in their order.
    Positions outside the first frame, in its collar, or NaN get NaN and 0.
    """
    line, other = np.empty(12), np.empty(12)
    guess = 0.0
    right_row = 0.5 * second.rows
    posed = np.nan
    for k in range(image_col.size):
        c, row = image_col[k], image_row[k]
        if not has_data(first, c, row):
            real[:, k] = np.nan
            flags[:, k] = 0
            continue
        if row != posed:
            pose(first.cam, row, line)
            posed = row
        ax, ay, bx, by = ray(first.cam, line, c)
        z, kind, index, _, ground, _, _ = cast(
            first.surfaces, first.above, ax, ay, bx, by, first.shown, True, guess
        )
        guess = ground
        x, y = ax + bx * z, ay + by * z
        lon, lat, height = world_to_geodetic_point(frame, x, y, z)
        col, right_row = project_point(second.cam, x, y, z, right_row, other)
        free = seen_from(
            second.surfaces, second.above, x, y, z, other, second.shown, SEEN_TOLERANCE_M
        )
        inside = (
            col >= 0
            and right_row >= 0
            and col <= second.cols - 1
            and right_row <= second.rows - 1
            and not in_collar(second.collar, col, right_row, second.cols, second.rows)
        )
        there = inside and stands_in(second.surfaces, kind, index, second.shown, z)
        there = there and not _lies_lower(second.surfaces, kind, x, y, z)
        scanned, _, _, _, _, _, _ = cast(
            scanned_s, first.above, ax, ay, bx, by, IN_LIDAR, True, ground
        )
        changed = 1 if scanned > z + SAME_M else (2 if scanned < z - SAME_M else 0)
        real[0, k], real[1, k], real[2, k] = lon, lat, height
        real[3, k], real[4, k] = col, right_row
        flags[0, k] = free and there
        flags[1, k] = there and not free
        flags[2, k] = kind
        flags[3, k] = changed
        flags[4, k] = (
            changed == 0
            and inside
            and seen_from(scanned_s, second.above, x, y, z, other, IN_LIDAR, SEEN_TOLERANCE_M)
            != free
        )
        flags[5, k] = covered(cover, x, y)


def truth_at(
    city: CitySpec, scene: SceneSpec, col: np.ndarray, row: np.ndarray, view: str = "left"
) -> dict[str, np.ndarray]:
    """The layers of LAYERS at positions (col, row) of the left image, px, of any one shape.

    Rays go through the very positions given, by the rigorous camera. Where the left image shows
    nothing (outside its frame, in its collar, NaN) the layers hold NaN and 0. With the ``view``
    "right", positions are of the right image, and the layers named right tell of the left one.
    """
    ready = prepare(city, scene)
    cameras = (ready.left, ready.right) if view == "left" else (ready.right, ready.left)
    scanned = world_of(city, ready.surfaces, "lidar")
    return truth_between(cameras, scanned, ready.frame, coverage(city, scene), col, row)


def truth_between(
    cameras: tuple[Camera, Camera],
    scanned: Surfaces,
    frame: LocalFrame,
    cover: np.ndarray,
    col: np.ndarray,
    row: np.ndarray,
) -> dict[str, np.ndarray]:
    """The layers of LAYERS at positions (col, row) of the first of two images of one city.

    What is called right is the second image. ``scanned``: the LiDAR's world. ``cover``: of
    :func:`.layout.coverage`.
    """
    first, second = (camera.sight for camera in cameras)
    at = [np.ascontiguousarray(a, dtype=np.float64).ravel() for a in (col, row)]
    real = np.empty((len(REALS), at[0].size))
    flags = np.empty((len(LAYERS) - len(REALS), at[0].size), np.uint8)
    _truth_points(first, second, scanned, frame.packed(), cover, *at, real, flags)
    return dict(zip(LAYERS, (values.reshape(np.shape(col)) for values in (*real, *flags))))


def simulate_truth(city: CitySpec, scene: SceneSpec, out_zarr: str | Path) -> dict[str, float]:
    """Write the truth on the raw left image's grid [row, col], one array per layer of LAYERS.

    Pixels of the collar hold NaN and 0. Longitudes and latitudes are rounded to 2^-33 degrees
    (13 µm), heights and image coordinates to 2^-20: far below any use, and they pack well. Returns
    the shares of pixels that are visible, hidden and changed.
    """
    left = prepare(city, scene).left
    totals = np.zeros(3)
    with atomic_store(out_zarr) as scratch:
        group = zarr.open_group(PlainStore(scratch), mode="w", zarr_format=3)
        group.attrs.update({
            "conventions": "arrays are [row, col] of the left image; pixel (0, 0) is the centre "
            "of the upper-left pixel",
            "scene": scene.name,
        })  # fmt: skip
        arrays = {}
        for name, (dtype, units, long_name) in LAYERS.items():
            attributes = {"units": units, "long_name": long_name}
            if name in FLAGS:
                values = list(range(len(FLAGS[name].split())))
                attributes |= {"flag_values": values, "flag_meanings": FLAGS[name]}
            arrays[name] = group.create_array(
                name, shape=(left.rows, left.cols), dtype=dtype, chunks=(CHUNK, CHUNK),
                fill_value=np.nan if dtype == "float64" else 0,
                compressors=(
                    BloscCodec(cname="zstd", clevel=1, shuffle=BloscShuffle.shuffle),
                    Crc32cCodec(),
                ),
                dimension_names=("row", "col"), attributes=attributes,
            )  # fmt: skip
        strips = range(0, left.rows, CHUNK)
        steps = {"lon": 2.0**33, "lat": 2.0**33}
        for first in progress(strips, len(strips), f"{scene.name} truth"):
            rows = slice(first, min(first + CHUNK, left.rows))
            row, col = np.mgrid[rows, 0 : left.cols].astype(np.float64)
            found = truth_at(city, scene, col, row)
            for name in REALS:
                step = steps.get(name, 2.0**20)
                found[name] = np.rint(found[name] * step) / step
            for name, values in found.items():
                arrays[name][rows] = values
            shown = found["surface"] > 0
            seen = found["visible_right"] > 0
            totals += [(seen & shown).sum(), (shown & ~seen).sum(), (found["changed"] > 0).sum()]
    shares = totals / (left.cols * left.rows)
    log.info(
        "%s: the right image shows %.1f %% of the left's pixels, not %.1f %%; %.2f %% changed",
        scene.name, *(100 * shares),
    )  # fmt: skip
    return dict(zip(("visible", "hidden", "changed"), map(float, shares)))


def open_truth(path: str | Path) -> xr.Dataset:
    """The truth of a scene as a lazy xarray Dataset on dimensions (row, col)."""
    import xarray as xr  # a quarter of a job's start-up, and the job that makes it needs none

    return xr.open_zarr(path, consolidated=True, chunks=None)


@inlined
def _reason(s, kind, index, z, scanned):
    """Of a surface at height ``z`` that is not in all worlds; ``scanned``: the LiDAR's height."""
    if kind == TREE:
        return GROWN_OR_FELLED
    if kind in (ROOF, WALL):
        if index >= 0 and s.box_style[index, 2] == VEHICLE:
            return MOVED
        return DEMOLISHED if scanned > z - SAME_M else BUILT
    return WATER_LEVEL if kind == WATER else GROUND_LEVEL


@kernel
def _changes(here, other, scanned_s, image_col, image_row, heights, reason):
    """Of the image ``here``, the ``other`` one, and the LiDAR's world."""
    line = np.empty(12)
    s0, s1 = here.surfaces, other.surfaces
    z, kind, index = np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(image_col.size):
        col, row = image_col[n], image_row[n]
        heights[:, n] = np.nan
        reason[n] = UNCHANGED
        if not has_data(here, col, row):
            continue
        pose(here.cam, row, line)
        ax, ay, bx, by = ray(here.cam, line, col)
        above = here.above
        z[0], kind[0], index[0], _, _, _, _ = cast(s0, above, ax, ay, bx, by, here.shown, True, 0.0)
        z[1], kind[1], index[1], _, _, _, _ = cast(
            s1, above, ax, ay, bx, by, other.shown, True, 0.0
        )
        z[2], kind[2], index[2], _, _, _, _ = cast(
            scanned_s, above, ax, ay, bx, by, IN_LIDAR, True, 0.0
        )
        if kind.min() == NONE:
            continue
        heights[:, n] = z
        top = z.argmax()
        if z.max() - z.min() > SAME_M:
            of = kind[top]
            if of == GROUND and (kind == WATER).any():
                of = WATER  # the water has fallen below a ground that it does not show
            reason[n] = _reason(s0, of, index[top], z[top], z[2])
        elif kind[0] == GROUND:
            x, y = ax + bx * z[0], ay + by * z[0]
            if resurfaced_at(s0, x, y) != resurfaced_at(s1, x, y):
                reason[n] = TEXTURE


def changes_at(
    city: CitySpec, scene: SceneSpec, col: np.ndarray, row: np.ndarray, view: str = "left"
) -> dict[str, np.ndarray]:
    """The layers of CHANGE_LAYERS at positions (col, row) of an image of a scene, of any one shape.

    ``view``: left or right. Outside the image and in its collar heights are NaN, reasons none.
    """
    ready = prepare(city, scene)
    images = (ready.left.sight, ready.right.sight)[:: 1 if view == "left" else -1]
    at = [np.ascontiguousarray(a, dtype=np.float64).ravel() for a in (col, row)]
    heights, reason = np.empty((3, at[0].size)), np.empty(at[0].size, np.uint8)
    _changes(*images, world_of(city, ready.surfaces, "lidar"), *at, heights, reason)
    layers = (values.reshape(np.shape(col)) for values in (*heights, reason))
    return dict(zip(CHANGE_LAYERS, layers))
