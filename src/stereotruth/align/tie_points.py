"""Places where LiDAR and both images show one smooth surface, and by how much they disagree.

Places are windows on a plane of the points at sites all over the scene, whose pixels take part if
nothing but the plane is seen there (:mod:`.tie_planes`). The plane maps the left window to the
right image, and least-squares matching (:mod:`.least_squares_matching`) finds the shift that is
left: with ``carry``, by which a right position depends on the left one, to first order (error of
the right image's model) − carry · (error of the left's). See docs/explanation/refinement.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..core.numerics.arrays import Bools, Floats, Ints, Singles
from ..core.numerics.interpolation import SIX_POINT_RADIUS
from ..core.numerics.statistics import median_and_nmad, robust_sigma
from ..epipolar.resampling import ANTIALIAS
from ..lidar.point_store import PointStore, query_points
from ..sensor.images import Source
from ..sensor.rpc import SensorModel
from .images import IS_FIRM, MARGIN, SITE, Site, query_box
from .least_squares_matching import least_squares_match, warp_patch
from .tie_planes import GUARDS, HALF, MIN_POINTS, SIDE, Guard, SitePoints

PER_SIDE = 3  # places per side of a site, at most
STEP = 4  # px between the candidates for a place
FLAT_PX = 0.3  # standard deviation of a place's points about their plane, as disparity
TRIED = 24  # windows of each part of a site that are looked at pixel by pixel
MIN_CLEAR = 90  # pixels of a window, a fifth
MIN_INFORMATION = 12.0  # smaller eigenvalue of a window, in pixels of the median slope
ENOUGH = 120  # places of a scene
STEEPEST = 3.0  # ratio of scales between the images along any direction
MIN_CORRELATION = 0.5
POOR_SIGMA = 0.25  # px: a match that is worse by its own residuals is none


@dataclass(frozen=True, eq=False)
class Places:
    """n places on smooth textured ground: ``site`` int[n], ``lon``, ``lat`` degrees, ``height`` m.

    ``slope`` [n, 2]: change of the plane's height along col and row of the left image, m/px;
    ``clear`` [n, SIDE, SIDE]: pixels of the window that show the plane alone, by ``guard``.
    """

    site: Ints
    lon: Floats
    lat: Floats
    height: Floats
    slope: Floats
    clear: Bools
    guard: Guard

    def __len__(self) -> int:
        return self.site.size


def _shift_information(picture: Singles) -> tuple[Floats, Floats, Floats]:
    """Information of each pixel [k, k] about a shift: products xx, xy, yy of its slopes, saturated.

    A pixel of the median slope of the picture counts a half, none more than one: texture is wanted,
    and an edge that stands out is not preferred. NaN where a slope is unknown.
    """
    gy, gx = np.gradient(picture.astype(np.float64))
    squared = gx * gx + gy * gy
    if not np.isfinite(squared).any():
        return squared, squared, squared
    median = float(np.nanmedian(squared))
    weight = 1.0 / np.maximum(median + squared, 1e-12)
    return weight * gx * gx, weight * gx * gy, weight * gy * gy


def _smaller_eigenvalue(xx: Floats, xy: Floats, yy: Floats) -> Floats:
    return (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)


def _candidates(
    information: tuple[Floats, Floats, Floats], share: Floats, at: Ints
) -> tuple[Ints, Ints]:
    """Part of the site [n] and index [n] of the most promising windows, TRIED at most of each of
    PER_SIDE² parts.

    By the information of their pixels, and by the share of the points that lie on the plane.
    ``share`` [k, k] of the candidates at px ``at`` [k] along both axes, 0 where there is no plane.
    """
    how = {"normalize": False, "borderType": cv2.BORDER_CONSTANT}
    sums = (cv2.boxFilter(np.nan_to_num(t), -1, (SIDE, SIDE), **how) for t in information)
    score = np.maximum(_smaller_eigenvalue(*sums), 0.0)[np.ix_(at, at)] * share**4
    parts, found = [], []
    edges = np.linspace(0, len(at), PER_SIDE + 1).astype(int)
    for top, bottom in pairwise(edges):
        for start, end in pairwise(edges):
            part = score[top:bottom, start:end]
            best = np.argsort(-part, axis=None, kind="stable")[:TRIED]
            best = best[part.ravel()[best] > 0.0]
            rows, cols = np.unravel_index(best, part.shape)
            parts.append(np.full(best.size, len(parts)))
            found.append((top + rows) * len(at) + start + cols)
    return np.concatenate(parts), np.concatenate(found)


def _parallax(left: SensorModel, right: SensorModel, col: float, row: float, h: float) -> Floats:
    """[2] px/m: displacement of a point in the right image against a surface below it.

    Per metre that it lies above the surface, in px of the left image, where (col, row) is.
    """
    c, r = col + np.array([0.0, 0.0, 0.0, 1.0, 0.0]), row + np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    z = h + np.array([-5.0, 5.0, 0.0, 0.0, 0.0])
    at = np.stack(right.project(*left.localize(c, r, z), z), axis=-1)
    carry = np.stack([at[3] - at[2], at[4] - at[2]], axis=1)
    return np.linalg.solve(carry, at[1] - at[0]) / 10.0


def _site_points(
    left: SensorModel, right: SensorModel, stores: Sequence[PointStore], site: Site
) -> SitePoints | None:
    """The points of a site and MARGIN around it; None where there are too few."""
    col0, row0 = site[:2]
    box = query_box(left, right, site)
    if box is None:
        return None
    points = query_points(stores, *box)
    if len(points) < MIN_POINTS:
        return None
    col, row = left.project(points.lon, points.lat, points.height)
    firm = IS_FIRM[points.classification]
    several = points.number_of_returns > 1
    if several.mean() < 0.5:  # else the pulses' returns tell nothing here
        firm &= ~several
    middle = float(np.median(points.height))
    parallax = _parallax(left, right, col0 + SITE / 2, row0 + SITE / 2, middle)
    wide = SITE + 2 * MARGIN
    return SitePoints.sorted(
        col - col0 + MARGIN, row - row0 + MARGIN, points.height, firm, (wide, wide), parallax
    )


def _places_of(points: SitePoints, picture: Singles) -> list[tuple[Ints, Floats, Bools]]:
    """The places of a site by each of GUARDS: (col, row) px [n, 2] in its ``picture`` [SITE, SITE],
    planes [n, 3], clear pixels [n, SIDE, SIDE]."""
    at = np.arange(HALF + 1, SITE - HALF - 1, STEP)
    centres = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    planes, share = points.fit_planes(centres + MARGIN)
    flat = planes[:, 3] * np.hypot(*points.parallax) <= FLAT_PX
    share = np.where(flat, share, 0.0)
    information = _shift_information(picture)
    part, tried = _candidates(information, share.reshape(len(at), len(at)), at)
    centres, planes = centres[tried], planes[tried]
    col, row = centres.T - HALF
    own = [sliding_window_view(values, (SIDE, SIDE))[row, col] for values in information]
    found = []
    for clear in points.clear_pixels(centres + MARGIN, planes):
        clear &= np.isfinite(own[0])
        sums = (np.where(clear, values, 0.0).sum(axis=(1, 2)) for values in own)
        score = np.where(clear.sum(axis=(1, 2)) >= MIN_CLEAR, _smaller_eigenvalue(*sums), 0.0)
        best_of: dict[int, int] = {}  # by part
        for k in np.flatnonzero(score >= MIN_INFORMATION).tolist():
            if score[k] > score[best_of.setdefault(int(part[k]), k)]:
                best_of[int(part[k])] = k
        best = list(best_of.values())
        found.append((centres[best], planes[best, :3], clear[best]))
    return found


def find_places(
    left: SensorModel,
    right: SensorModel,
    source: Source,
    stores: Sequence[PointStore],
    sites: Sequence[Site],
) -> Places:
    """The best places of every site, seen by the left image (``source``); memory for one site.

    With a wide guard around all that stands off their planes; where that leaves too few places
    (crowns in rows, dense woods), with the narrower ones.
    """
    of_guards: list[list] = [[] for _ in GUARDS]
    for number, site in enumerate(sites):
        points = _site_points(left, right, stores, site)
        if points is None:
            continue
        corner = site[:2]
        for found, there in zip(of_guards, _places_of(points, source.read(*corner, SITE, SITE))):
            at, planes, clear = there
            lon, lat = left.localize(*(at + np.array(corner)).T, planes[:, 0])
            number_of = np.full(len(at), number)
            found.append((number_of, lon, lat, planes[:, 0], planes[:, 1:], clear))
    enough = [sum(len(part[0]) for part in found) >= ENOUGH for found in of_guards]
    chosen = enough.index(True) if any(enough) else -1
    guard, found = GUARDS[chosen], of_guards[chosen]
    if not found:
        empty = np.empty(0)
        none = np.empty((0, SIDE, SIDE), bool)
        return Places(np.empty(0, np.int64), empty, empty, empty, np.empty((0, 2)), none, guard)
    return Places(*(np.concatenate(parts) for parts in zip(*found)), guard)


@dataclass(frozen=True, eq=False)
class TiePoints:
    """n tie points; coordinates are (col, row) px of the original images.

    ``site`` int[n]; ``height`` ellipsoidal m; ``left`` [n, 2] the place, ``right`` [n, 2] where
    plane and sensor models put it in the right image; ``carry`` [n, 2, 2]: d right / d left on the
    plane; ``shift`` [n, 2]: position found minus ``right``; ``sigma`` px of a left pixel, from the
    match's own residuals; ``correlation`` of the windows.
    """

    site: Ints
    height: Floats
    left: Floats
    right: Floats
    carry: Floats
    shift: Floats
    sigma: Floats
    correlation: Floats

    def __len__(self) -> int:
        return self.site.size


def _carry(
    left: SensorModel, right: SensorModel, where: Floats, height: Floats, slope: Floats
) -> tuple[Floats, Floats]:
    """Right position [n, 2] of left ones on their planes, and its change [n, 2, 2] with them."""
    u = np.array([0.0, HALF, -HALF, 0.0, 0.0])
    v = np.array([0.0, 0.0, 0.0, HALF, -HALF])
    heights = height[:, None] + slope[:, :1] * u + slope[:, 1:] * v
    lon, lat = left.localize(where[:, :1] + u, where[:, 1:] + v, heights)
    at = np.stack(right.project(lon, lat, heights), axis=-1)
    carry = np.stack([at[:, 1] - at[:, 2], at[:, 3] - at[:, 4]], axis=-1) / (2.0 * HALF)
    return at[:, 0], carry


def _window(source: Source, at: Floats, reach: float) -> tuple[Singles, Floats] | None:
    """The part of an image around positions [n, 2], and the position of its first pixel."""
    low = np.maximum(np.floor(at.min(axis=0) - reach).astype(int), 0)
    high = np.minimum(np.ceil(at.max(axis=0) + reach).astype(int) + 1, source.size)
    if (low >= high).any():
        return None
    return source.read(*low.tolist(), *(high - low).tolist()), low


@dataclass(frozen=True, eq=False)
class _Windows:
    """One place, ready for matching: see :func:`_prepared`."""

    index: int
    template: Singles
    clear: Floats
    pixels: Singles
    at: Floats
    carry: Floats
    scale: tuple[float, float]
    scores: Singles


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where the sensor models put places: ``left`` [n, 2] whole px, and as in TiePoints.

    ``along`` [n, 2]: direction in the left image in which a height above the plane displaces a
    point of the right image.
    """

    left: Floats
    height: Floats
    right: Floats
    carry: Floats
    along: Floats

    @classmethod
    def of(cls, places: Places, left: SensorModel, right: SensorModel) -> Geometry:
        """By the sensor models as they are; a place moves on its plane to the nearest pixel."""
        exact = np.stack(left.project(places.lon, places.lat, places.height), axis=1)
        where = np.rint(exact)
        height = places.height + np.sum((where - exact) * places.slope, axis=1)
        at, carry = _carry(left, right, where, height, places.slope)
        ends = [
            right.project(*left.localize(*where.T, height + z), height + z) for z in (-5.0, 5.0)
        ]
        moved = np.stack(ends[1], axis=-1) - np.stack(ends[0], axis=-1)
        known = np.isfinite(carry).all(axis=(1, 2)) & np.isfinite(moved).all(axis=1)
        along = np.zeros_like(moved)
        along[known] = np.linalg.solve(carry[known], moved[known, :, None])[:, :, 0]
        along /= np.maximum(np.hypot(*along.T), 1e-12)[:, None]
        return cls(where, height, at, carry, along)


def _even(picture: Singles) -> Singles:
    """A picture without the brightness of its surroundings, and no pixel above the usual contrast.

    So that an edge that stands out has no more say than the texture around it; 0 where the picture
    has no value.
    """
    known = np.isfinite(picture)
    level = float(picture[known].mean())
    filled = np.where(known, picture - level, np.float32(0))
    detail = filled - cv2.GaussianBlur(filled, (0, 0), 3.0)
    usual = float(robust_sigma(detail[known], 0.0)) + 1e-6
    return np.where(known, np.clip(detail / usual, -1.5, 1.5), 0.0).astype(np.float32)


def _prepared(
    places: Places, geometry: Geometry, sources: tuple[Source, Source], radius: int
) -> Iterator[_Windows]:
    """Windows and correlations at whole shifts [row, col] of the places that both images show.

    Read site by site.
    """
    scales = np.linalg.svd(np.nan_to_num(geometry.carry), compute_uv=False)
    usable = (scales[:, 0] < STEEPEST) & (scales[:, 1] > 1.0 / STEEPEST)
    big = np.empty((2 * (HALF + radius) + 1,) * 2, np.float32)
    for site in np.unique(places.site[usable]):
        members = np.flatnonzero(usable & (places.site == site))
        right = geometry.right[members]
        members = members[np.abs(right - np.median(right, axis=0)).max(axis=1) < 4 * SITE]
        left_window = _window(sources[0], geometry.left[members], HALF + 2.0)
        reach = 1.5 * (HALF + radius + 3) * scales[members, 0].max() + 2 * SIX_POINT_RADIUS
        right_window = _window(sources[1], geometry.right[members], reach)
        if left_window is None or right_window is None:
            continue
        picture, first = left_window
        pixels, origin = right_window
        for k in members:
            i, j = (geometry.left[k] - first).astype(int)
            template = picture[
                max(j - HALF - 1, 0) : j + HALF + 2, max(i - HALF - 1, 0) : i + HALF + 2
            ]
            if template.shape != (2 * HALF + 3,) * 2:
                continue
            holes = cv2.dilate((~np.isfinite(template)).astype(np.uint8), np.ones((3, 3), np.uint8))
            clear = (places.clear[k] & (holes[1:-1, 1:-1] == 0)).astype(np.float32)
            if clear.sum() < MIN_CLEAR:
                continue
            carry, at = geometry.carry[k], geometry.right[k] - origin
            # of the kernel along (col, row), where the right image is the finer one
            spans = np.hypot(carry[:, 0], carry[:, 1]).tolist()
            scale = tuple(span if span > ANTIALIAS else 1.0 for span in spans)
            warp_patch(pixels, *at, carry, scale, big)
            if np.isfinite(big).mean() < 0.5:
                continue
            inner, searched = _even(template)[1:-1, 1:-1], _even(big)
            mean = float((inner * clear).sum() / clear.sum())
            scores = cv2.matchTemplate(searched, (inner - mean) * clear, cv2.TM_CCORR)
            energy = cv2.matchTemplate(searched**2, clear, cv2.TM_CCORR)
            energy = energy * float((((inner - mean) * clear) ** 2).sum())
            scores = scores / np.sqrt(np.maximum(energy, 1e-6))
            yield _Windows(
                k, template, clear.ravel().astype(np.float64), pixels, at, carry, scale, scores
            )


def common_shift(
    places: Places,
    geometry: Geometry,
    sources: tuple[Source, Source],
    radius: int,
) -> tuple[Floats, float]:
    """The shift [2] in px of the left image at which most places agree, and how clearly.

    For sensor models that are many px off: the places' correlations are added up. The second
    figure is the peak's height in standard deviations of the sum over all shifts.
    """
    total = np.zeros((2 * radius + 1,) * 2)
    for place in _prepared(places, geometry, sources, radius):
        total += place.scores
    # Models may be tilted, so that the places' own shifts lie some px apart.
    total = cv2.GaussianBlur(total, (0, 0), 2.0, borderType=cv2.BORDER_REFLECT)
    y, x = np.unravel_index(int(np.argmax(total)), total.shape)
    spread = median_and_nmad(total)[1]
    height = float(total.max() - np.median(total)) / max(spread, 1e-12)
    return np.array([x - radius, y - radius], dtype=float), height


def match(
    places: Places,
    geometry: Geometry,
    sources: tuple[Source, Source],
    radius: int,
) -> TiePoints:
    """Match every place within ``radius`` px (of the left image); places that fail are left out."""
    results = np.full((len(places), 5), np.nan)
    for w in _prepared(places, geometry, sources, radius):
        y, x = np.unravel_index(int(np.argmax(w.scores)), w.scores.shape)
        if 0 < x < 2 * radius and 0 < y < 2 * radius:
            start = np.array([x - radius, y - radius], dtype=np.float64)
            along = geometry.along[w.index]
            least_squares_match(
                w.template, w.clear, w.pixels, *w.at, w.carry, w.scale, along, start,
                results[w.index],
            )  # fmt: skip
    good = (
        np.isfinite(results).all(axis=1)
        & (results[:, 3] >= MIN_CORRELATION)
        & (results[:, 2] <= POOR_SIGMA)
    )
    shift = np.einsum("nab,nb->na", geometry.carry, results[:, :2])
    return TiePoints(
        site=places.site[good],
        height=geometry.height[good],
        left=geometry.left[good],
        right=geometry.right[good],
        carry=geometry.carry[good],
        shift=shift[good],
        sigma=np.hypot(results[good, 2], results[good, 4]),
        correlation=results[good, 3],
    )
