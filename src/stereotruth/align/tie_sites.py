"""Places of smooth, textured ground, all over a scene, where images and LiDAR compare.

A tie point compares the two images over a window on a plane. Anything that stands beside the plane
moves between the images by its parallax, and a dark crown over a bright lawn outweighs all of the
lawn's texture. So the plane is fitted robustly to the heights that the pixels of a window show, and
a pixel takes part only if both images show the plane there and all around, within a guard distance.
What a pixel shows is what the rasterised surface says (:mod:`stereotruth.surface.raster`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..core.kernels import inner, kernel
from ..core.numerics.degrees import DEGREE_M
from ..core.numerics.robust import TUKEY, biweight, robust_sigma
from ..lidar.point_store import PointStore
from ..sensor.image_reader import Source
from ..sensor.rpc import SensorModel
from ..sensor.shown_ground import GroundOfImages
from ..surface.image_surface import ImageProjection
from ..surface.raster import VISIBLE
from ..surface.surface_store import SurfaceStore

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
Site = tuple[int, int, float, float]  # upper-left col, row px; lowest, highest point in m
Picture = NDArray[np.float32]


HALF = 10  # px: windows of 21 x 21
SIDE = 2 * HALF + 1
SITES = 120  # about; each is read by itself
SITE = 168  # px of the left image, side of a site
PER_SIDE = 3  # places per side of a site, at most
STEP = 4  # px between the candidates for a place
FLAT_PX = 0.3  # standard deviation of a place's heights about their plane, as disparity
MARGIN = 24  # px around a site whose points are looked at
TRIED = 24  # windows of each part of a site that are looked at pixel by pixel
MIN_CLEAR = 90  # pixels of a window, a fifth
MIN_INFORMATION = 12.0  # smaller eigenvalue of a window, in pixels of the median slope
ENOUGH = 120  # places of a scene
NOT_FIRM = (3, 4, 5, 9)  # ASPRS classes: vegetation, and water, which moves
IS_FIRM = ~np.isin(np.arange(256), NOT_FIRM)  # by class
EVERY = 2  # px between those that a plane is fitted to
MIN_ON_PLANE = 24  # of the pixels that a plane is fitted to
SPREAD = 0.35  # of an even distribution's variance: less, and the pixels do not fix the plane
OFF_SIGMAS = 4.0  # of the heights about the plane: farther, and a pixel lies off it
OFF_M = 0.1  # m, at least
ROUNDS = 5  # of each of the two robust fits of a plane
NEAREST_M = 0.03  # m: heights nearer to a plane do not count for more


class Guard(NamedTuple):
    """How far, in px, pixels stay from what stands off a plane: the optics' blur and the
    interpolation reach that far.

    ``common_px``: what matches behind such a guard have in common, rms over simulated scenes.
    """

    px: float
    common_px: float


GUARDS = (Guard(2.5, 0.005), Guard(1.8, 0.012), Guard(1.2, 0.05))  # the widest first
AROUND = int(GUARDS[0].px) + 1  # px around a site that are rasterised


@dataclass(frozen=True, eq=False)
class Places:
    """n places on smooth textured ground: ``site`` int[n], ``lon``, ``lat`` degrees, ``height`` m.

    ``slope`` [n, 2]: change of the plane's height along col and row of the left image, m/px;
    ``clear`` [n, SIDE, SIDE]: pixels of the window that show the plane alone, by ``guard``.
    """

    site: Integers
    lon: Floats
    lat: Floats
    height: Floats
    slope: Floats
    clear: Bools
    guard: Guard

    def __len__(self) -> int:
        return self.site.size


def _heights(
    stores: Sequence[PointStore], lon: float, lat: float, reach: float
) -> tuple[float, float] | None:
    """Lowest and highest point (m) of the cells around a place; None where there are none."""
    box = lon - reach, lat - reach, lon + reach, lat + reach
    found = [
        store.height_range(*box)
        for store in stores
        if store.bounds[0] <= box[2]
        and store.bounds[2] >= box[0]
        and store.bounds[1] <= box[3]
        and store.bounds[3] >= box[1]
    ]
    found = [pair for pair in found if pair is not None]
    return (min(p[0] for p in found), max(p[1] for p in found)) if found else None


def _covered(
    left: SensorModel,
    right: SensorModel,
    right_size: tuple[int, int],
    stores: Sequence[PointStore],
    height: float,
    col: float,
    row: float,
) -> tuple[float, float] | None:
    """Range of heights (m) at a left position that LiDAR and right image cover, else None.

    ``height``: about that of the ground.
    """
    low = high = height
    for _ in range(3):
        lon, lat = (float(v) for v in left.localize(col, row, (low + high) / 2))
        if not np.isfinite(lon):
            return None
        there = _heights(stores, lon, lat, 1e-5)
        if there is None:
            return None
        low, high = there
    c, r = right.project(lon, lat, (low + high) / 2)
    return (low, high) if 0 <= c < right_size[0] and 0 <= r < right_size[1] else None


def choose_sites(
    left: SensorModel,
    right: SensorModel,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    stores: Sequence[PointStore],
    height: float,
) -> list[Site]:
    """(col, row, lowest, highest height in m) of sites: upper-left px in the left image.

    Some SITES squares on a regular grid, apart from each other, over what both images and the
    LiDAR cover. ``height``: about that of the ground, ellipsoidal m; points that lie elsewhere have
    no say.
    """
    cols, rows = sizes[0]
    if min(cols, rows) < SITE:
        return []

    def grid(spacing: float) -> list[Site]:
        found = []
        for row in np.arange(spacing / 2, rows, spacing):
            for col in np.arange(spacing / 2, cols, spacing):
                heights = _covered(left, right, sizes[1], stores, height, col, row)
                if heights is not None:
                    corner = (
                        min(max(int(at) - SITE // 2, 0), n - SITE)
                        for at, n in zip((col, row), (cols, rows))
                    )
                    found.append((*corner, *heights))
        return found

    coarse = max(np.sqrt(cols * rows / (2.0 * SITES)), SITE)
    return grid(max(coarse * np.sqrt(max(len(grid(coarse)), 1) / SITES), SITE))


def _shift_information(picture: Picture) -> tuple[Floats, Floats, Floats]:
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


def _window_sums(values: Floats) -> Floats:
    return cv2.boxFilter(values, -1, (SIDE, SIDE), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _candidates(
    information: tuple[Floats, Floats, Floats], share: Floats, at: Integers
) -> tuple[Integers, Integers]:
    """Part of the site [n] and index [n] of the most promising windows, TRIED at most of each of
    PER_SIDE² parts.

    By the information of their pixels, and by the share of the points that lie on the plane.
    ``share`` [k, k] of the candidates at px ``at`` [k] along both axes, 0 where there is no plane.
    """
    score = np.maximum(
        _smaller_eigenvalue(*(_window_sums(np.nan_to_num(t)) for t in information)), 0.0
    )
    score = score[np.ix_(at, at)] * share**4
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


def query_box(left: SensorModel, right: SensorModel, site: Site) -> Floats | None:
    """(west, south, east, north) of all points that either image may show in a site, degrees."""
    col0, row0, low, high = site
    corner_cols, corner_rows = (
        c.ravel() for c in np.meshgrid([-MARGIN, SITE + MARGIN], [-MARGIN, SITE + MARGIN])
    )
    middle = (low + high) / 2
    ground = [left.localize(col0 + corner_cols, row0 + corner_rows, z) for z in (low, high)]
    at_right = right.project(*left.localize(col0 + corner_cols, row0 + corner_rows, middle), middle)
    ground += [right.localize(*at_right, z) for z in (low, high)]
    ground = np.hstack([np.stack(g) for g in ground])
    if not np.isfinite(ground).all():
        return None
    return np.concatenate([ground.min(axis=1), ground.max(axis=1)])


class SiteSurface(NamedTuple):
    """What both images show of a site and AROUND px around it: heights m, NaN where that is not
    sure or not firm.

    ``left`` [h, w]; ``right`` [h', w'] of another window; ``to_right`` [2, 4]: (col, row) px of the
    right window by (col, row) px of the left one, height in m and 1.
    """

    left: Floats
    right: Floats
    to_right: Floats

    @property
    def px_per_m(self) -> float:
        """By how many px of the left image a metre of height displaces a point in the right one."""
        return float(np.hypot(*np.linalg.solve(self.to_right[:, :2], self.to_right[:, 2])))

    @classmethod
    def of(
        cls, left: ImageProjection, right: ImageProjection, surface: SurfaceStore, site: Site
    ) -> SiteSurface | None:
        """By sensor models as they are; None where there is no surface."""
        box = query_box(left.sensor, right.sensor, site)
        if box is None:
            return None
        first, wide = np.array(site[:2]) - AROUND, SITE + 2 * AROUND
        shown = _heights_shown(left, surface, box, first, (wide, wide))
        if not np.isfinite(shown).any():
            return None
        # over the ground and the heights of a site the sensor models are affine, to 0.1 px
        corner, height = np.array([0.0, wide - 1.0]), [np.nanmin(shown) - 1, np.nanmax(shown) + 1]
        col, row, z = (axis.ravel() for axis in np.meshgrid(corner, corner, height))
        there = right.sensor.project(*left.sensor.localize(col + first[0], row + first[1], z), z)
        there = np.stack(there, axis=1)
        if not np.isfinite(there).all():
            return None
        origin = np.floor(there.min(axis=0)).astype(int) - AROUND
        size = np.ceil(there.max(axis=0)).astype(int) + AROUND + 1 - origin
        design = np.column_stack([col, row, z, np.ones(z.size)])
        to_right = np.linalg.lstsq(design, there - origin, rcond=None)[0].T
        return cls(shown, _heights_shown(right, surface, box, origin, size), to_right.copy())

    def fit_planes(self, centres: Integers) -> tuple[Floats, Floats]:
        """Planes [k, 4] of windows around centres int[k, 2], and shares [k]: see the kernel."""
        planes, share = np.empty((len(centres), 4)), np.empty(len(centres))
        _fit_planes(self.left, centres, planes, share)
        return planes, share

    def clear_pixels(self, centres: Integers, planes: Floats) -> Bools:
        """Pixels [guards, k, SIDE, SIDE] of windows around ``centres`` int[k, 2] that show their
        ``planes`` [k, 4] alone, by each of GUARDS: see the kernel."""
        guards = np.array([guard.px for guard in GUARDS])
        clear = np.empty((len(guards), len(centres), SIDE, SIDE), bool)
        _clear_pixels(self, guards, centres, planes, clear)
        return clear


def _heights_shown(
    image: ImageProjection,
    surface: SurfaceStore,
    box: Floats,
    first: Integers,
    size: tuple[int, int],
) -> Floats:
    """Heights m [h, w] that the pixels of a window show, NaN where that is not sure or not firm.

    Of ``size`` (cols, rows), from the (col, row) ``first`` on.
    """
    cols, rows = (slice(int(at), int(at + n)) for at, n in zip(first, size))
    seen = image.seen(surface, tuple(box.tolist()), rows, cols)
    if seen is None:
        return np.full((size[1], size[0]), np.nan)
    sure = (seen.visibility == VISIBLE) & IS_FIRM[seen.surface_class]
    return np.where(sure, seen.height, np.nan)


@inner
def _solve_plane(u: Floats, v: Floats, h: Floats, weight: Floats, plane: Floats) -> bool:
    """Fill ``plane`` [3] (level at (0, 0), slopes) by weighted least squares; False if that fails.

    ``u``, ``v`` in [-1, 1] over the window.
    """
    s, su, sv, suu, suv, svv, sh, suh, svh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(h.size):
        w = weight[k]
        s += w
        su += w * u[k]
        sv += w * v[k]
        suu += w * u[k] * u[k]
        suv += w * u[k] * v[k]
        svv += w * v[k] * v[k]
        sh += w * h[k]
        suh += w * u[k] * h[k]
        svh += w * v[k] * h[k]
    if not s > 0.0:
        return False
    mu, mv, mh = su / s, sv / s, sh / s
    cuu, cuv, cvv = suu / s - mu * mu, suv / s - mu * mv, svv / s - mv * mv
    cuh, cvh = suh / s - mu * mh, svh / s - mv * mh
    even = 1.0 / 3.0  # variance of an even distribution over [-1, 1]
    det = cuu * cvv - cuv * cuv
    if not (cuu > SPREAD * even and cvv > SPREAD * even and det > (SPREAD * even) ** 2):
        return False
    plane[1] = (cvv * cuh - cuv * cvh) / det
    plane[2] = (cuu * cvh - cuv * cuh) / det
    plane[0] = mh - plane[1] * mu - plane[2] * mv
    return True


@inner
def _robust_plane(u: Floats, v: Floats, h: Floats, plane: Floats) -> float:
    """Fill ``plane`` by what most heights lie on; their robust standard deviation m, or NaN.

    First the sum of the distances is made least, which a third of them cannot mislead, then Tukey's
    biweight leaves out what lies off the plane.
    """
    weight = np.ones(h.size)
    distance = np.empty(h.size)
    if not _solve_plane(u, v, h, weight, plane):
        return np.nan
    sigma = np.nan
    for step in range(2 * ROUNDS):
        for k in range(h.size):
            distance[k] = abs(h[k] - plane[0] - plane[1] * u[k] - plane[2] * v[k])
        if step >= ROUNDS:
            sigma = robust_sigma(distance, 0.01)
        for k in range(h.size):
            if step < ROUNDS:
                weight[k] = 1.0 / max(distance[k], NEAREST_M)
            else:
                weight[k] = biweight(distance[k] / (TUKEY * sigma))
        if not _solve_plane(u, v, h, weight, plane):
            return np.nan
    return sigma


@kernel
def _fit_planes(height: Floats, centres: Integers, planes: Floats, share: Floats) -> None:
    """Robust planes through the heights of windows around ``centres`` int[k, 2] (col, row) px.

    Fills ``planes`` [k, 4]: height at the centre (m), slopes along columns and rows (m/px), robust
    standard deviation of the heights (m), NaN where none is determined; ``share`` [k]: of the
    window's pixels, those on the plane.
    """
    size = (SIDE // EVERY + 1) ** 2
    u, v, h = np.empty(size), np.empty(size), np.empty(size)
    plane = np.empty(3)
    for c in range(len(centres)):
        planes[c] = np.nan
        share[c] = 0.0
        i, j = centres[c]
        n = 0
        for y in range(-HALF, HALF + 1, EVERY):
            for x in range(-HALF, HALF + 1, EVERY):
                if not np.isnan(height[j + y, i + x]):
                    u[n], v[n], h[n] = x / HALF, y / HALF, height[j + y, i + x]
                    n += 1
        if n < MIN_ON_PLANE:
            continue
        middle = h[0]
        sigma = _robust_plane(u[:n], v[:n], h[:n] - middle, plane)
        if np.isnan(sigma):
            continue
        limit, on = max(OFF_SIGMAS * sigma, OFF_M), 0
        for k in range(n):
            on += abs(h[k] - middle - plane[0] - plane[1] * u[k] - plane[2] * v[k]) <= limit
        if on < MIN_ON_PLANE:
            continue
        planes[c, 0], planes[c, 3] = plane[0] + middle, sigma
        planes[c, 1], planes[c, 2] = plane[1] / HALF, plane[2] / HALF
        share[c] = on / size


@inner
def _near(marked: Bools, j: int, i: int, radius: float) -> bool:
    """Whether a marked pixel lies within ``radius`` px of one."""
    reach = int(radius)
    for y in range(j - reach, j + reach + 1):
        for x in range(i - reach, i + reach + 1):
            if marked[y, x] and (y - j) ** 2 + (x - i) ** 2 <= radius * radius:
                return True
    return False


@kernel
def _clear_pixels(
    site: SiteSurface, guards: Floats, centres: Integers, planes: Floats, clear: Bools
) -> None:
    """Fill ``clear`` [guards, k, SIDE, SIDE]: the pixels of windows that show their plane and
    nothing else, in either image, up to a guard around them.

    ``planes`` [k, 4] as :func:`_fit_planes` gives them for ``centres``; ``guards`` px, the widest
    first.
    """
    wide = SIDE + 2 * AROUND
    off = np.empty((wide, wide), np.bool_)
    to_right = site.to_right
    for c in range(len(centres)):
        limit = max(OFF_SIGMAS * planes[c, 3], OFF_M)
        for y in range(wide):
            for x in range(wide):
                u, v = x - HALF - AROUND, y - HALF - AROUND
                i, j = centres[c, 0] + u, centres[c, 1] + v
                z = planes[c, 0] + planes[c, 1] * u + planes[c, 2] * v
                col, row = (
                    to_right[0, 0] * i + to_right[0, 1] * j + to_right[0, 2] * z + to_right[0, 3],
                    to_right[1, 0] * i + to_right[1, 1] * j + to_right[1, 2] * z + to_right[1, 3],
                )
                k, m = int(np.rint(col)), int(np.rint(row))
                off[y, x] = True
                if 0 <= k < site.right.shape[1] and 0 <= m < site.right.shape[0]:
                    in_left = abs(site.left[j, i] - z) <= limit  # not of NaN
                    off[y, x] = not (in_left and abs(site.right[m, k] - z) <= limit)
        for y in range(SIDE):
            for x in range(SIDE):
                clear[:, c, y, x] = True
                for g in range(len(guards)):
                    if not _near(off, y + AROUND, x + AROUND, guards[g]):
                        break  # narrower guards leave what a wider one leaves
                    clear[g, c, y, x] = False


def _places_of(site: SiteSurface, picture: Picture) -> list[tuple[Integers, Floats, Bools]]:
    """The places of a site by each of GUARDS: (col, row) px [n, 2] in its ``picture`` [SITE, SITE],
    planes [n, 3], clear pixels [n, SIDE, SIDE]."""
    at = np.arange(HALF + 1, SITE - HALF - 1, STEP)
    centres = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    planes, share = site.fit_planes(centres + AROUND)
    share = np.where(planes[:, 3] * site.px_per_m <= FLAT_PX, share, 0.0)
    information = _shift_information(picture)
    part, tried = _candidates(information, share.reshape(len(at), len(at)), at)
    centres, planes = centres[tried], planes[tried]
    col, row = centres.T - HALF
    own = [sliding_window_view(values, (SIDE, SIDE))[row, col] for values in information]
    found = []
    for clear in site.clear_pixels(centres + AROUND, planes):
        clear &= np.isfinite(own[0])
        score = np.where(clear.sum(axis=(1, 2)) >= MIN_CLEAR, _information_of(own, clear), 0.0)
        best = _best_of_parts(part, score)
        found.append((centres[best], planes[best, :3], clear[best]))
    return found


def _information_of(own: Sequence[Floats], pixels: Bools) -> Floats:
    """Smaller eigenvalue [k] of the information xx, xy, yy [k, SIDE, SIDE] of some ``pixels`` of
    windows."""
    return _smaller_eigenvalue(*(np.where(pixels, values, 0.0).sum(axis=(1, 2)) for values in own))


def _best_of_parts(part: Integers, score: Floats) -> list[int]:
    """The candidate of each ``part`` [k] that has the greatest ``score`` [k], if that is enough."""
    best: dict[int, int] = {}
    for k in np.flatnonzero(score >= MIN_INFORMATION).tolist():
        if score[k] > score[best.setdefault(int(part[k]), k)]:
            best[int(part[k])] = k
    return list(best.values())


def find_places(
    left: SensorModel,
    right: SensorModel,
    sources: tuple[Source, Source],
    surface: SurfaceStore,
    sites: Sequence[Site],
) -> Places:
    """The best places of every site, seen by the left image; memory for one site.

    With a wide guard around all that stands off their planes; where that leaves too few places
    (crowns in rows, dense woods), with the narrower ones.
    """
    projections = [
        ImageProjection(sensor, GroundOfImages([sensor], [source.size]).pixel_deg[1] * DEGREE_M)
        for sensor, source in zip((left, right), sources)
    ]
    of_guards: list[list] = [[] for _ in GUARDS]
    for number, site in enumerate(sites):
        shown = SiteSurface.of(*projections, surface, site)
        if shown is None:
            continue
        corner = site[:2]
        for found, there in zip(of_guards, _places_of(shown, sources[0].read(*corner, SITE, SITE))):
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
