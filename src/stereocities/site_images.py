"""The images of a site, what each of their pixels shows, and control points of all of them."""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from stereotruth.core.products.files import write_table

from .built_city import surfaces_of
from .camera import Pass, aim, drift_of_attitude, jittering
from .control_points import GCP_COUNT, GCP_NOISE_PX, marks, spread_out, visible_in
from .dated_worlds import world_of
from .layout import coverage, frame_of
from .render import LEFT_COLLAR, SHOWN, Camera, biased_rpc, by_sun_of, horizon_of, relief_of, render
from .sites import ImageSpec, SiteSpec
from .truth import truth_between

log = logging.getLogger("stereotruth")

RPC_MARGIN_M = 30.0  # heights of small images should not range wider than their ground
FIELDS = ("id", "lon", "lat", "height", "image", "col", "row")
IN_IMAGE = ("lon", "lat", "height", "surface", "changed", "covered")  # truth of one image


@lru_cache(maxsize=64)
def camera_of(site: SiteSpec, image: ImageSpec) -> Camera:
    """The camera of an image of a site; kept for further calls of the same process."""
    city = site.city
    surfaces, frame = surfaces_of(city), frame_of(city)
    relief = relief_of(city, site.area, surfaces)
    rng = np.random.default_rng([image.pose_seed, 1])
    yaw = float(np.radians(rng.uniform(-0.7, 0.7)))
    flown = Pass(image.look_deg, image.aside_m, image.ascending, yaw, drift_of_attitude(rng))
    target = np.array([*image.centre_m, relief.middle])
    cam = aim(frame, target, flown, gsd=image.gsd_m, cols=image.cols, rows=image.rows)
    size = image.cols, image.rows
    drawn = image.pose_seed, "left"
    rpc = biased_rpc(cam, frame, relief, size, drawn, margin_m=RPC_MARGIN_M)
    if image.jitter:  # the RPCs know nothing of it
        cam = jittering(cam, image.jitter, np.random.default_rng([image.pose_seed, 6]))
    own = by_sun_of(world_of(city, surfaces, image.state), image.sun_deg)
    return Camera(
        image.name, cam, *size, rpc, horizon_of(cam, *size, surfaces), own,
        SHOWN[image.state], LEFT_COLLAR, image.radiometry, image.pose_seed,
    )  # fmt: skip


def simulate_site_image(
    site: SiteSpec, image: ImageSpec, out_tif: str | Path, *, seed: int
) -> dict[str, float]:
    """Render an image of a site, see :func:`.render.simulate_image`."""
    return render(camera_of(site, image), image.name, out_tif, seed=seed)


def pair_truth(
    site: SiteSpec, left: ImageSpec, right: ImageSpec, col: np.ndarray, row: np.ndarray
) -> dict[str, np.ndarray]:
    """The layers of :data:`.truth.LAYERS` at positions of the left of any two images, px."""
    cameras = camera_of(site, left), camera_of(site, right)
    cover = coverage(site.city, site.area)
    scanned = world_of(site.city, surfaces_of(site.city), "lidar")
    return truth_between(cameras, scanned, frame_of(site.city), cover, col, row)


def image_truth(
    site: SiteSpec, image: ImageSpec, col: np.ndarray, row: np.ndarray
) -> dict[str, np.ndarray]:
    """What an image shows at positions (col, row), px: the layers IN_IMAGE of the truth.

    ``lon``, ``lat`` (degrees) and ``height`` (ellipsoidal m) of the surface point, its kind, and
    whether the LiDAR has another surface there, or none. Outside the image NaN and 0.
    """
    found = pair_truth(site, image, image, col, row)
    return {name: found[name] for name in IN_IMAGE}


def site_points(site: SiteSpec, *, seed: int) -> tuple[list[dict], list[dict]]:
    """Control points of a site in the long form, as measured, and without their noise.

    Marks, as roof corners, that at least two images show, as evenly spread as the city has them.
    ``seed`` draws the noise of the image coordinates (0.25 px each); ground coordinates are exact.
    """
    xyz, _ = marks(surfaces_of(site.city))
    seen_in = [visible_in(camera_of(site, image), xyz) for image in site.images]
    often = np.sum([seen for _, seen in seen_in], axis=0)
    usable = np.flatnonzero(often >= 2)
    chosen = usable[spread_out(xyz[usable, :2], GCP_COUNT, np.zeros((1, 2)))]
    ground = frame_of(site.city).to_geodetic(xyz[chosen])
    rng = np.random.default_rng([seed, site.area.pose_seed])
    tables: tuple[list[dict], list[dict]] = ([], [])
    for k, n in enumerate(chosen):
        place = f"G{k + 1:02d}", *(f"{v:.{d}f}" for v, d in zip(ground[k], (10, 10, 4)))
        for image, (positions, seen) in zip(site.images, seen_in):
            noise = rng.normal(0, GCP_NOISE_PX, 2)
            if not seen[n]:
                continue
            for table, at in zip(tables, (positions[n] + noise, positions[n])):
                cells = *place, image.name, f"{at[0]:.4f}", f"{at[1]:.4f}"
                table.append(dict(zip(FIELDS, cells)))
    log.info("%s: %d ground control points", site.city.name, len(chosen))
    return tables


def simulate_site_points(
    site: SiteSpec, gcps_csv: str | Path, exact_csv: str | Path, *, seed: int
) -> None:
    """Write the measured and the exact control points of a site, in the long form."""
    for file, table in zip((gcps_csv, exact_csv), site_points(site, seed=seed)):
        write_table(file, table, FIELDS)
