"""How two images of a site look at the ground that they share, from RPCs and times alone.

The angles are those by which pairs are chosen in the field: convergence, elevation of the bisector
and asymmetry of both rays (Jeong and Kim 2014, ISPRS J. 92; Ames Stereo Pipeline, asp_plot), and
the difference of the sun's direction, which decides most for pairs of two dates (Qin 2019, ISPRS
J. 147).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import DEGREE_M
from .pair_geometry import ray_upwards, view_order
from .rpc import SensorModel
from .sun import between_suns, shadow_shift
from .virtual_points import frame, inside

Floats = NDArray[np.float64]

SAMPLES = 65  # along each side of an image, of the ground that it shares


@dataclass(frozen=True, eq=False)
class SiteImage:
    """An image of a site: sensor model, size (cols, rows) px, time (UTC), sun's angles (degrees).

    ``time`` and ``sun`` (azimuth, elevation) are None where nothing tells them.
    """

    name: str
    sensor: SensorModel
    size: tuple[int, int]
    time: datetime | None = None
    sun: tuple[float, float] | None = None


@dataclass(frozen=True)
class SitePair:
    """What is known of a pair before it is matched.

    ``left``, ``right``: names of the images, see :func:`order`. ``shared_km2``: ground in both;
    ``shared``: its share of the smaller image's ground. Angles in degrees: ``convergence`` of both
    rays, ``bisector`` (elevation of their bisector), ``asymmetry`` (between the bisector and the
    vertical within the plane of both rays), ``sun`` (between both directions to the sun; None:
    unknown). ``shadow``: how far the end of a shadow moves from one image to the other, in heights
    of what casts it (None: unknown). ``days`` between both images (None: unknown).
    ``off_nadir``: greatest angle of a ray from the vertical. ``pixel_m``: side of the larger ground
    pixel; ``pixel_ratio``: over that of the smaller one.
    """

    left: str
    right: str
    shared_km2: float
    shared: float
    convergence: float
    bisector: float
    asymmetry: float
    off_nadir: float
    pixel_ratio: float
    pixel_m: float
    sun: float | None = None
    shadow: float | None = None
    days: float | None = None

    @property
    def base(self) -> float:
        """Base over height: of rays by so many degrees about their bisector."""
        return 2 * math.tan(math.radians(self.convergence) / 2)

    @property
    def metres_per_px(self) -> float:
        """Height that moves a point by one of the larger pixels."""
        return self.pixel_m / max(self.base, 1e-9)


def angles_of(rays: tuple[Floats, Floats]) -> tuple[float, float, float]:
    """Convergence, elevation of the bisector, asymmetry of two unit vectors upwards, degrees."""
    one, other = rays
    normal = np.cross(one, other)
    convergence = math.atan2(float(np.linalg.norm(normal)), float(one @ other))
    bisector = (one + other) / np.linalg.norm(one + other)
    elevation = math.asin(float(np.clip(bisector[2], -1, 1)))
    if convergence < 1e-9:
        return 0.0, math.degrees(elevation), 0.0
    normal /= np.linalg.norm(normal)
    vertical = np.array([0.0, 0.0, 1.0])
    within = vertical - (vertical @ normal) * normal
    cosine = float(bisector @ within / np.linalg.norm(within))
    asymmetry = math.acos(min(max(cosine, -1.0), 1.0))
    return tuple(map(math.degrees, (convergence, elevation, asymmetry)))


def pair_of(one: SiteImage, other: SiteImage, height: float) -> SitePair | None:
    """The pair of two images at an ellipsoidal height of the ground, m.

    None without shared ground. The order in which the images are given plays no part.
    """
    one, other = sorted((one, other), key=lambda image: image.name)
    shared = _shared(one, other, height)
    if shared is None:
        return None
    col, row = shared[0].mean(axis=1)
    lon, lat = one.sensor.localize(col, row, height)
    there = tuple(map(float, other.sensor.project(lon, lat, height)))
    rays = (
        ray_upwards(one.sensor, col, row, height),
        ray_upwards(other.sensor, *there, height),
    )
    left, right = order(one, other, shared[0], rays, height)
    pixels = [
        _pixel_m(image.sensor, *at, height) for image, at in ((one, (col, row)), (other, there))
    ]
    areas = [image.size[0] * image.size[1] * pixel**2 for image, pixel in zip((one, other), pixels)]
    ground = shared[1] * areas[0]
    convergence, bisector, asymmetry = angles_of(rays)
    suns = None if one.sun is None or other.sun is None else (one.sun, other.sun)
    return SitePair(
        left.name,
        right.name,
        shared_km2=ground / 1e6,
        shared=min(ground / min(areas), 1.0),
        convergence=convergence,
        bisector=bisector,
        asymmetry=asymmetry,
        off_nadir=max(math.degrees(math.acos(min(ray[2], 1.0))) for ray in rays),
        pixel_ratio=max(pixels) / min(pixels),
        pixel_m=max(pixels),
        sun=None if suns is None else between_suns(*suns),
        shadow=None if suns is None else shadow_shift(*suns),
        days=_days(one, other),
    )


def _days(one: SiteImage, other: SiteImage) -> float | None:
    if one.time is None or other.time is None:
        return None
    return abs((one.time - other.time) / timedelta(days=1))


def _shared(one: SiteImage, other: SiteImage, height: float) -> tuple[Floats, float] | None:
    """(col, row) [2, n] of pixels of the first image that the second shows, and their share."""
    col, row = frame(one.size, SAMPLES)
    lon, lat = one.sensor.localize(col, row, height)
    seen = inside(np.array(other.sensor.project(lon, lat, height)), other.size)
    if not seen.any():
        return None
    return np.stack([col[seen], row[seen]]), float(seen.mean())


def _pixel_m(sensor: SensorModel, col: float, row: float, height: float) -> float:
    """Side of the square that has the area of a pixel on level ground, m."""
    lon, lat = sensor.localize([col - 5, col + 5, col, col], [row, row, row - 5, row + 5], height)
    east = DEGREE_M * math.cos(math.radians(lat[0]))
    across = (lon[1] - lon[0]) * east, (lat[1] - lat[0]) * DEGREE_M
    along = (lon[3] - lon[2]) * east, (lat[3] - lat[2]) * DEGREE_M
    return math.sqrt(abs(across[0] * along[1] - across[1] * along[0])) / 10.0


def order(
    one: SiteImage,
    other: SiteImage,
    overlap: Floats,
    rays: tuple[Floats, Floats],
    height: float,
) -> tuple[SiteImage, SiteImage]:
    """Left and right of a pair: the backward view is left; across the track, the steeper one.

    The steeper view hides less of the ground, and what is left has the labels.
    """
    seen = view_order(one.sensor, other.sensor, overlap, height)
    if seen == "left looks backward":
        return one, other
    if seen == "left looks forward":
        return other, one
    steeper = rays[0][2] >= rays[1][2]
    return (one, other) if steeper else (other, one)


def pairs_of_site(images: Sequence[SiteImage]) -> list[SitePair]:
    """All pairs of images that share ground, whatever the order of the images."""
    images = sorted(images, key=lambda image: image.name)
    heights: Mapping[str, float] = {image.name: image.sensor.rpc.height_off for image in images}
    found = [
        pair_of(one, other, (heights[one.name] + heights[other.name]) / 2)
        for k, one in enumerate(images)
        for other in images[k + 1 :]
    ]
    return [pair for pair in found if pair is not None]
