"""All files of a scene; sites: one city and many images of it, their truth and control points.

The images of a site are taken on passes, at dates and under suns of their own.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path

import numpy as np

from stereotruth.core.products.files import write_table

from .camera import ALTITUDE_M, Pass, aim, drift_of_attitude, jittering
from .cities import Canopy, CitySpec, Jitter, SceneSpec, ViewSpec, lidar_files, training_city
from .control_points import (
    GCP_COUNT,
    GCP_NOISE_PX,
    marks,
    simulate_points,
    spread_out,
    visible_in,
)
from .layout import coverage, frame_of
from .lidar import simulate_lidar_tile
from .render import (
    LEFT_COLLAR,
    SHOWN,
    Camera,
    biased_rpc,
    by_sun_of,
    horizon_of,
    relief_of,
    render,
    simulate_image,
)
from .truth import simulate_truth, truth_between
from .world import surfaces_of, world_of

FIRST_DAY = datetime(2023, 2, 1, tzinfo=UTC)
DAYS = 700  # that the passes of a drawn site are spread over
LOCAL_HOURS = (9.6, 11.6)  # mean local solar time of a pass
LOOK_DEG = 24.0  # greatest along the track
ASIDE_M = 190e3  # greatest distance of the target from the track
SHARED_PASS = 0.5  # share of the images that are taken on the pass of the image before
BASE_GSD_M = 0.55  # straight down
LOWEST_SUN_DEG = 28.0  # shadows reach no farther than rays are followed
STEEPEST = 0.15  # relief over the side of an image
TURNED = 1.24  # side of the area over that of the image: passes cross at an angle

log = logging.getLogger("stereotruth")

RPC_MARGIN_M = 30.0  # heights of small images should not range wider than their ground
FIELDS = ("id", "lon", "lat", "height", "image", "col", "row")
IN_IMAGE = ("lon", "lat", "height", "surface", "changed", "covered")  # truth of one image


def make_scene(
    city: CitySpec, scene: SceneSpec, folder: Path, *, spacing_m: float, seed: int
) -> None:
    """All files of a scene under ``folder``, as the workflow makes them, and gcps.csv."""
    exact, checks = folder / "gcps_exact.csv", folder / "checkpoints.csv"
    simulate_points(city, scene, folder / "gcps.csv", exact, checks, seed=seed)
    for view in SHOWN:
        simulate_image(city, scene, view, folder / f"{view}.tif", seed=seed)
    for name in lidar_files(city, scene):
        file = folder / "lidar" / name
        simulate_lidar_tile(city, scene, name, file, spacing_m=spacing_m, seed=seed)
    simulate_truth(city, scene, folder / "truth.zarr")


@dataclass(frozen=True)
class ImageSpec:
    """One image of a site.

    ``acquired``: date and time, UTC. ``look_deg``, ``aside_m``, ``ascending``: see
    :class:`.camera.Pass`. ``centre_m``: ground position of the image's middle, east and north of
    the city's centre. ``sun_deg``: azimuth and elevation. ``state``: which of the city's two
    states (``left``, ``right``; see :class:`.cities.ViewSpec`) the image shows. ``radiometry``:
    dark value and digital numbers per reflectance. ``pose_seed`` draws yaw, drift of the attitude
    and the bias of the RPCs; ``jitter`` of the attitude.
    """

    name: str
    acquired: datetime
    look_deg: float
    aside_m: float
    ascending: bool
    gsd_m: float
    cols: int
    rows: int
    sun_deg: tuple[float, float]
    pose_seed: int
    centre_m: tuple[float, float] = (0.0, 0.0)
    state: str = "left"
    radiometry: tuple[float, float] = (60.0, 1420.0)
    jitter: Jitter | None = None


@dataclass(frozen=True)
class SiteSpec:
    """A city whose one scene is the area that its LiDAR covers, and images of it."""

    city: CitySpec
    images: tuple[ImageSpec, ...]

    @property
    def area(self) -> SceneSpec:
        """What the LiDAR covers."""
        (area,) = self.city.scenes
        return area

    def image(self, name: str) -> ImageSpec:
        """The image of that name; KeyError if there is none."""
        for image in self.images:
            if image.name == name:
                return image
        raise KeyError(f"{self.city.name} has no image {name}")


def sun_at(acquired: datetime, lon: float, lat: float) -> tuple[float, float]:
    """Azimuth and elevation of the sun, degrees, at a time (UTC) over a place.

    From the sun's mean motion and the equation of the centre (Meeus 1998, chapter 25, low
    accuracy); without refraction, 0.02 degrees.
    """
    since = (acquired - datetime(2000, 1, 1, 12, tzinfo=UTC)) / timedelta(days=36525)
    mean_longitude = 280.46646 + 36000.76983 * since
    anomaly = math.radians(357.52911 + 35999.05029 * since)
    centre = (1.914602 - 0.004817 * since) * math.sin(anomaly)
    centre += 0.019993 * math.sin(2 * anomaly) + 0.000289 * math.sin(3 * anomaly)
    longitude = math.radians(mean_longitude + centre - 0.00569)
    tilt = math.radians(23.439291 - 0.0130042 * since)
    declination = math.asin(math.sin(tilt) * math.sin(longitude))
    ascension = math.atan2(math.cos(tilt) * math.sin(longitude), math.cos(longitude))
    sidereal = 280.46061837 + 13185000.77005374225 * since + lon
    hour = math.radians(sidereal) - ascension
    phi = math.radians(lat)
    up = math.sin(phi) * math.sin(declination)
    up += math.cos(phi) * math.cos(declination) * math.cos(hour)
    east = -math.cos(declination) * math.sin(hour)
    north = math.cos(phi) * math.sin(declination)
    north -= math.sin(phi) * math.cos(declination) * math.cos(hour)
    return math.degrees(math.atan2(east, north)) % 360.0, math.degrees(math.asin(up))


def drawn_site(
    number: int, seed: int, *, images: int, side_px: int, seasons: bool = True
) -> SiteSpec:
    """Site ``number`` of ``seed``: so many images of about ``side_px`` squared of a drawn city.

    Half of the images share the pass of the one before, which makes pairs of one day. ``seasons``:
    the city has crowns that are bare in winter, and vehicles that stand elsewhere then. The same
    numbers give the same site everywhere; more images include fewer.
    """
    area_px = math.ceil(TURNED * side_px)
    city = training_city(2 * number + 1, seed, area_px)
    name = f"Site-{number}"
    # a river or a lake could be all that so small an area has
    relief = min(city.character.relief_m, STEEPEST * side_px * BASE_GSD_M)
    character = replace(city.character, river_m=0.0, lakes=0.0, relief_m=relief)
    if seasons:
        character = replace(character, canopy=Canopy(), vehicles=6.0)
    city = replace(
        city,
        name=name,
        character=character,
        scenes=(replace(city.scenes[0], name=name),),
        right=ViewSpec(bare=seasons),
    )
    return SiteSpec(city, images_drawn(name, city, images, side_px, seed=seed, number=number))


def images_drawn(
    name: str, city: CitySpec, count: int, side_px: int, *, seed: int, number: int = 0
) -> tuple[ImageSpec, ...]:
    """So many images of a city, of about ``side_px`` squared, named ``name``-A, -B …"""
    rng = np.random.default_rng([seed, number, 0x73697465])
    found: list[ImageSpec] = []
    for k in range(count):
        before = found[-1] if found and rng.random() < SHARED_PASS else None
        found.append(_drawn_image(f"{name}-{chr(ord('A') + k)}", city, before, side_px, rng))
    return tuple(found)


def _drawn_image(
    name: str, city: CitySpec, before: ImageSpec | None, side_px: int, rng: np.random.Generator
) -> ImageSpec:
    """An image on a pass of its own, or on that of the image ``before``, some seconds later."""
    look = float(rng.uniform(-LOOK_DEG, LOOK_DEG))
    if before is not None:
        seconds = (look - before.look_deg) * math.radians(1) * ALTITUDE_M / 7000.0
        acquired = before.acquired + timedelta(seconds=-round(seconds))
        aside, ascending, state = before.aside_m, before.ascending, before.state
        radiometry = before.radiometry
    else:
        acquired = _drawn_time(city, rng)
        aside, ascending = float(rng.uniform(-ASIDE_M, ASIDE_M)), bool(rng.random() < 0.15)
        state = "right" if acquired.month in (11, 12, 1, 2, 3) else "left"
        radiometry = float(rng.uniform(50, 80)), float(rng.uniform(1300, 1550))
    off_nadir = math.hypot(math.tan(math.radians(look)), aside / ALTITUDE_M)
    gsd = BASE_GSD_M * math.hypot(1.0, off_nadir)
    cols = rows = math.ceil(side_px * BASE_GSD_M / gsd)
    return ImageSpec(
        name, acquired, look, aside, ascending, gsd, cols, rows,
        sun_at(acquired, city.lon, city.lat), int(rng.integers(1 << 20, 2**31)),
        state=state, radiometry=radiometry,
    )  # fmt: skip


def _drawn_time(city: CitySpec, rng: np.random.Generator) -> datetime:
    """A time at which the sun is high enough, in a day's hours of passes."""
    while True:
        day = FIRST_DAY + timedelta(days=int(rng.integers(DAYS)))
        hours = float(rng.uniform(*LOCAL_HOURS)) - city.lon / 15.0
        acquired = day + timedelta(seconds=round(3600 * hours))
        if sun_at(acquired, city.lon, city.lat)[1] > LOWEST_SUN_DEG:
            return acquired


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
