"""Pairs of images: what they share, under which light, how they rank, which images they link.

All follows from RPCs and times alone, before anything is matched. The angles are those by which
pairs are chosen in the field (Jeong and Kim 2014, ISPRS J. 92; Ames Stereo Pipeline, asp_plot; Qin
2019, ISPRS J. 147); what counts as diachronic: docs/explanation/real_sensors.md.

Pairs rank by the information about heights that a pixel is expected to give: the share of pixels
that can be matched, times ½ log₂(1 + (RELIEF_M / height_sigma_m)²) bits (Shannon 1949). The log
odds of a match fall with the base, the way of the shadows and the roughness of the site, by
coefficients that ``bench/pairs.py`` fits and tests (docs/stack.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import DEGREE_M
from .deliveries import Acquisition, between_suns, shadow_shift
from .pair_geometry import frame, inside, pixel_deg, ray_upwards, view_order
from .rpc import SensorModel

Names = tuple[str, str]  # of a pair's images

SAMPLES = 65  # along each side of an image, of the ground that it shares
DIACHRONIC_DAYS = 30.0  # more than these, as in DiachronicStereo (2026)
BUILDING_M = 10.0  # height of three storeys
SHADOW_PX = 0.5  # way of the end of its shadow; also what a label may be off and its images agree
# log odds of a wrong match: of a usual site at no base and no way of the shadows; then by each
WRONG_AT_NOTHING = -2.8
BY_BASE = 2.2  # per base over height
BY_SHADOW = 1.3  # per height of what casts the shadow
BY_ROUGHNESS = 1.6  # per logarithm of the roughness over the usual one
USUAL_ROUGHNESS_M = 1.3  # the median of the simulated sites
SMOOTHEST_M = 0.1  # steps of bare ground and noise
UNKNOWN_SHADOW = 0.4  # of a pair of unknown dates: the median of the simulated ones
MATCH_SIGMA_PX = 0.3  # of a right match of semi-global matching
RELIEF_M = 10.0  # what heights are to be told apart: a building of three storeys
COARSE_SIGMA_M = 1.0  # heights to less than a third of a storey
WORTH_SAYING = 0.1  # loss of matched


# ------------------------------------------------------------------ geometry


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

    @property
    def is_diachronic(self) -> bool:
        """Whether days or suns tell of two lights, as :func:`pair_light` has it of labels."""
        moved_px = 0.0 if self.shadow is None else self.shadow * BUILDING_M / self.pixel_m
        return (self.days or 0.0) > DIACHRONIC_DAYS or moved_px > SHADOW_PX


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
    col, row = frame(one.size, SAMPLES)
    lon, lat = one.sensor.localize(col, row, height)
    seen = inside(np.array(other.sensor.project(lon, lat, height)), other.size)
    if not seen.any():
        return None
    overlap = np.stack([col[seen], row[seen]])
    col, row = overlap.mean(axis=1)
    lon, lat = one.sensor.localize(col, row, height)
    there = tuple(map(float, other.sensor.project(lon, lat, height)))
    places = (one.sensor, col, row), (other.sensor, *there)
    rays = tuple(ray_upwards(*place, height) for place in places)
    left, right = order(one, other, overlap, rays, height)
    pixels = [pixel_deg(*place, height)[1] * DEGREE_M for place in places]
    areas = [image.size[0] * image.size[1] * pixel**2 for image, pixel in zip((one, other), pixels)]
    ground = float(seen.mean()) * areas[0]
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
        days=_days(one.time, other.time),
    )


def _days(one: datetime | None, other: datetime | None) -> float | None:
    """Between two times; None if one is not known."""
    return None if one is None or other is None else abs((one - other) / timedelta(days=1))


def order(
    one: SiteImage, other: SiteImage, overlap: Floats, rays: tuple[Floats, Floats], height: float
) -> tuple[SiteImage, SiteImage]:
    """Left and right of a pair: the backward view is left; across the track, the steeper one.

    The steeper view hides less of the ground, and what is left has the labels.
    """
    seen = view_order(one.sensor, other.sensor, overlap, height)
    if seen == "left looks backward":
        return one, other
    if seen == "left looks forward":
        return other, one
    return (one, other) if rays[0][2] >= rays[1][2] else (other, one)


def pairs_of_site(images: Sequence[SiteImage]) -> list[SitePair]:
    """All pairs of images that share ground, whatever the order of the images."""
    images = sorted(images, key=lambda image: image.name)
    heights = {image.name: image.sensor.rpc.height_off for image in images}
    found = [
        pair_of(one, other, (heights[one.name] + heights[other.name]) / 2)
        for k, one in enumerate(images)
        for other in images[k + 1 :]
    ]
    return [pair for pair in found if pair is not None]


# ------------------------------------------------------------------ light


@dataclass(frozen=True)
class PairLight:
    """Whether a pair is ``diachronic``, and by what: ``decided_by`` is the scenes sheet, the
    suns, the days between the images, or the configuration.

    ``sun_angle_deg`` between the directions to both suns, ``shadow_px``: way of the end of the
    shadow of a building of BUILDING_M, in pixels; ``days`` between the images; None: not known.
    """

    diachronic: bool
    decided_by: str
    sun_angle_deg: float | None = None
    shadow_px: float | None = None
    days: float | None = None


def pair_light(
    left: Acquisition,
    right: Acquisition,
    pixel_m: float,
    told: bool | None = None,
    default: bool = False,
) -> PairLight:
    """The light of a pair, by the first that is known: what the scenes sheet has ``told``, more
    than DIACHRONIC_DAYS between the images, both suns, the ``default`` of the configuration.

    ``pixel_m``: side of a pixel on the ground, m.
    """
    angle = shadow = None
    if left.sun is not None and right.sun is not None:
        angle = round(between_suns(left.sun, right.sun), 2)
        shadow = round(shadow_shift(left.sun, right.sun) * BUILDING_M / pixel_m, 2)
    days = _days(left.time, right.time)
    days = None if days is None else round(days, 3)
    known = angle, shadow, days
    if told is not None:
        return PairLight(told, "scenes sheet", *known)
    if days is not None and days > DIACHRONIC_DAYS:
        return PairLight(True, "days", *known)
    if shadow is not None:
        return PairLight(shadow > SHADOW_PX, "suns", *known)
    return PairLight(default, "configuration", *known)


# ------------------------------------------------------------------ rank


@dataclass(frozen=True)
class Quality:
    """What a pair is expected to give.

    ``matched``: share of right matches; ``height_sigma_m``: standard uncertainty of a height from
    one match; ``bits``: information about the height that a pixel gives; ``reason``: what lowers
    it most.
    """

    matched: float
    height_sigma_m: float
    bits: float
    reason: str


def quality_of(pair: SitePair, roughness_m: float | None = None) -> Quality:
    """The predicted quality of a pair, from what is known before it is matched.

    ``roughness_m`` of its site; None: not known, taken as the usual one.
    """
    roughness = USUAL_ROUGHNESS_M if roughness_m is None else max(roughness_m, SMOOTHEST_M)
    of_site = BY_ROUGHNESS * math.log(roughness / USUAL_ROUGHNESS_M)
    shadow = UNKNOWN_SHADOW if pair.shadow is None else pair.shadow
    hidden, moved = BY_BASE * pair.base, BY_SHADOW * shadow
    matched = _matched(of_site + hidden + moved)
    losses = {
        f"{pair.convergence:.0f}° apart: much is hidden or seen askew": hidden,
        f"shadows move by {shadow:.1f} of what casts them": moved,
    }
    reason, worst = max(losses.items(), key=lambda item: item[1])
    if _matched(of_site + hidden + moved - worst) - matched < WORTH_SAYING:
        reason = "alike in angle and light"
    if pair.shadow is None:
        reason = "no date of one image: its sun is not known"
    sigma = pair.metres_per_px * MATCH_SIGMA_PX
    if sigma > COARSE_SIGMA_M:
        reason = f"heights follow badly: 1 px is {pair.metres_per_px:.1f} m"
    bits = matched * math.log2(1.0 + (RELIEF_M / sigma) ** 2) / 2
    return Quality(matched, sigma, bits, reason)


def _matched(log_odds: float) -> float:
    return 1.0 - 1.0 / (1.0 + math.exp(-WRONG_AT_NOTHING - log_odds))


@dataclass(frozen=True)
class RatedPair:
    """A pair and its predicted quality."""

    pair: SitePair
    quality: Quality

    @property
    def names(self) -> Names:
        """Of the left and the right image."""
        return self.pair.left, self.pair.right


def rate(images: Sequence[SiteImage], roughness_m: float | None = None) -> list[RatedPair]:
    """All pairs of a site that share ground, best first, whatever the order of its images.

    ``roughness_m``: see :func:`quality_of`.
    """
    rated = [RatedPair(pair, quality_of(pair, roughness_m)) for pair in pairs_of_site(images)]
    return sorted(rated, key=lambda r: (-r.quality.bits, r.pair.left, r.pair.right))


# ------------------------------------------------------------------ links


def new_links(pairs: Iterable[Names], links: Iterable[Names] = ()) -> list[Names]:
    """The first of the ``pairs`` that link images which neither ``links`` nor those before them
    have linked (a spanning forest, Kruskal 1956)."""
    group: dict[str, str] = {}

    def link(pair: Names) -> bool:
        one, other = (group.setdefault(name, name) for name in pair)
        if one == other:
            return False
        for name, of in group.items():
            if of == other:
                group[name] = one
        return True

    for pair in links:
        link(pair)
    return [pair for pair in pairs if link(pair)]


@dataclass(frozen=True)
class Links:
    """``groups`` of images that no pair links, by size; images that are ``unused``, in no pair.

    Groups are adjusted apart, each to the LiDAR alone, so that between them labels may differ by
    more than within them.
    """

    groups: tuple[tuple[str, ...], ...]
    unused: tuple[str, ...]

    @classmethod
    def of(cls, images: Iterable[str], pairs: Sequence[Names]) -> Links:
        """Of all ``images`` of a site, and those that its pairs name."""
        used = {name for pair in pairs for name in pair}
        groups = {name: {name} for name in used}
        for one, other in new_links(pairs):
            both = groups[one] | groups[other]
            groups.update(dict.fromkeys(both, both))
        apart = {tuple(sorted(group)) for group in groups.values()}
        by_size = sorted(apart, key=lambda group: (-len(group), group))
        return cls(tuple(by_size), tuple(sorted(set(images) - used)))

    @property
    def sentences(self) -> list[str]:
        """What is not linked, in words; nothing where all images are."""
        said = [self.of_unused] if self.unused else []
        return [*said, self.of_groups] if len(self.groups) > 1 else said

    @property
    def of_unused(self) -> str:
        """Which images are in no pair."""
        word = "image" if len(self.unused) == 1 else "images"
        return f"{len(self.unused)} {word} in no pair: {', '.join(self.unused)}"

    @property
    def of_groups(self) -> str:
        """Which groups no pair links."""
        named = "; ".join(", ".join(group) for group in self.groups)
        return (
            f"{len(self.groups)} groups of images without a pair between them, each adjusted by "
            f"itself: {named}"
        )
