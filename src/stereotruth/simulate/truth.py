"""The exact truth of a scene: what each left pixel shows, and where the right image has it."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec, BloscShuffle

from ..grid_store import building
from ..runlog import progress
from .camera import SIZE, direction, pose, project_point
from .cities import CitySpec, SceneSpec
from .geodesy import world_to_geodetic_point
from .kernels import inlined, kernel
from .lidar import coverage, covered
from .render import in_collar, prepare
from .surfaces import IN_IMAGES, IN_LIDAR, NONE, cast

log = logging.getLogger("stereotruth")

CHUNK = 512
SEEN_TOLERANCE_M = 0.02
SURFACES = "none ground roof wall tree water"
LAYERS = {
    "lon": ("float64", "degrees_east", "WGS 84 longitude of the surface point"),
    "lat": ("float64", "degrees_north", "WGS 84 latitude of the surface point"),
    "height": ("float64", "m", "WGS 84 ellipsoidal height of the surface point"),
    "right_col": ("float64", "px", "column of the surface point in the right image"),
    "right_row": ("float64", "px", "row of the surface point in the right image"),
    "visible_right": ("uint8", "1", "1 where the right image shows the surface point"),
    "surface": ("uint8", "1", "kind of surface that the pixel shows"),
    "changed": ("uint8", "1", "1 where LiDAR and images differ by design"),
    "covered": ("uint8", "1", "1 inside the LiDAR coverage"),
}


@inlined
def seen_from(s, above, cam, x, y, z, row, line, tolerance):
    """(col, row, whether nothing hides it) of a world point in a camera; ``row`` a first guess."""
    col, row = project_point(cam, x, y, z, row, line)
    depth = line[2] - z
    bx, by = (line[0] - x) / depth, (line[1] - y) / depth
    hit, kind, _, _, _, _, _ = cast(s, above, x - bx * z, y - by * z, bx, by, IN_IMAGES, True, z)
    return col, row, kind != NONE and hit <= z + tolerance


@kernel
def _truth_rows(s, above_left, above_right, left, right, frame, cover, size, first, real, flags):
    """Rows of the truth from left image row ``first``.

    ``size``: left cols, rows, right cols, rows. real[5, r, c]: lon, lat, height, right col, row;
    flags[4, r, c]: visible, surface, changed, covered.
    """
    line, other = np.empty(12), np.empty(12)
    guess = 0.0
    right_row = 0.5 * size[3]
    for r in range(real.shape[1]):
        row = float(first + r)
        pose(left, row, line)
        for c in range(real.shape[2]):
            if in_collar(True, float(c), row, size[0], size[1]):
                real[:, r, c] = np.nan
                flags[:, r, c] = 0
                continue
            dx, dy, dz = direction(left, line, float(c))
            bx, by = dx / dz, dy / dz
            ax, ay = line[0] - bx * line[2], line[1] - by * line[2]
            z, kind, _, _, ground, _, _ = cast(
                s, above_left, ax, ay, bx, by, IN_IMAGES, True, guess
            )
            guess = ground
            x, y = ax + bx * z, ay + by * z
            lon, lat, height = world_to_geodetic_point(frame, x, y, z)
            col, right_row, free = seen_from(
                s, above_right, right, x, y, z, right_row, other, SEEN_TOLERANCE_M
            )
            inside = (
                col >= 0
                and right_row >= 0
                and col <= size[2] - 1
                and right_row <= size[3] - 1
                and not in_collar(False, col, right_row, size[2], size[3])
            )
            scanned, _, _, _, _, _, _ = cast(s, above_left, ax, ay, bx, by, IN_LIDAR, True, guess)
            real[0, r, c], real[1, r, c], real[2, r, c] = lon, lat, height
            real[3, r, c], real[4, r, c] = col, right_row
            flags[0, r, c] = free and inside
            flags[1, r, c] = kind
            flags[2, r, c] = abs(scanned - z) > 0.01
            flags[3, r, c] = covered(cover, x, y)


def simulate_truth(city: CitySpec, scene: SceneSpec, out_zarr: str | Path) -> dict[str, float]:
    """Write the truth on the raw left image's grid [row, col], one array per layer of LAYERS.

    Pixels of the collar hold NaN and 0. Longitudes and latitudes are rounded to 2^-33 degrees
    (13 µm), heights and image coordinates to 2^-20: far below any use, and they pack well. Returns
    the shares of pixels that are visible, hidden and changed.
    """
    ready = prepare(city, scene)
    left, right = ready.left, ready.right
    kernel = (ready.surfaces, left.horizon, right.horizon, left.cam, right.cam)
    size = np.array([left.cols, left.rows, right.cols, right.rows], dtype=np.float64)
    cover = coverage(city, scene)
    frame = ready.frame.packed()
    totals = np.zeros(3)
    assert left.cam.size == SIZE
    with building(out_zarr) as scratch:
        group = zarr.open_group(scratch, mode="w", zarr_format=3)
        group.attrs.update({
            "conventions": "arrays are [row, col] of the left image; pixel (0, 0) is the centre "
            "of the upper-left pixel",
            "scene": scene.name,
        })  # fmt: skip
        arrays = {}
        for name, (dtype, units, long_name) in LAYERS.items():
            attributes = {"units": units, "long_name": long_name}
            if name == "surface":
                attributes |= {"flag_values": list(range(6)), "flag_meanings": SURFACES}
            arrays[name] = group.create_array(
                name, shape=(left.rows, left.cols), dtype=dtype, chunks=(CHUNK, CHUNK),
                fill_value=np.nan if dtype == "float64" else 0,
                compressors=BloscCodec(cname="zstd", clevel=1, shuffle=BloscShuffle.shuffle),
                dimension_names=("row", "col"), attributes=attributes,
            )  # fmt: skip
        strips = range(0, left.rows, CHUNK)
        steps = np.array([2.0**33, 2.0**33, 2.0**20, 2.0**20, 2.0**20])[:, None, None]
        for first in progress(strips, len(strips), f"{scene.name} truth"):
            count = min(CHUNK, left.rows - first)
            real = np.empty((5, count, left.cols))
            flags = np.empty((4, count, left.cols), np.uint8)
            _truth_rows(*kernel, frame, cover, size, first, real, flags)
            real *= steps
            np.rint(real, out=real)
            real /= steps
            for name, values in zip(LAYERS, [*real, *flags]):
                arrays[name][first : first + count] = values
            shown = flags[1] > 0
            totals += [(flags[0] & shown).sum(), (shown & (flags[0] == 0)).sum(), flags[2].sum()]
    shares = totals / (left.cols * left.rows)
    log.info(
        "%s: the right image shows %.1f %% of the left's pixels, not %.1f %%; %.2f %% changed",
        scene.name, *(100 * shares),
    )  # fmt: skip
    return dict(zip(("visible", "hidden", "changed"), map(float, shares)))


def open_truth(path: str | Path) -> xr.Dataset:
    """The truth of a scene as a lazy xarray Dataset on dimensions (row, col)."""
    return xr.open_zarr(path, consolidated=True, chunks=None)
