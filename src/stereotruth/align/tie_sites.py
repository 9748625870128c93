"""Places of smooth, textured ground, all over a scene, where images and LiDAR compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..lidar.point_store import PointStore, query_points
from ..sensor.image_reader import Source
from ..sensor.rpc import SensorModel
from .tie_planes import GUARDS, HALF, MIN_POINTS, SIDE, Guard, SitePoints

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
Site = tuple[int, int, float, float]  # upper-left col, row px; lowest, highest point in m
Picture = NDArray[np.float32]


SITES = 120  # about; each is read by itself
SITE = 168  # px of the left image, side of a site
PER_SIDE = 3  # places per side of a site, at most
STEP = 4  # px between the candidates for a place
FLAT_PX = 0.3  # standard deviation of a place's points about their plane, as disparity
MARGIN = 24  # px around a site whose points are looked at
TRIED = 24  # windows of each part of a site that are looked at pixel by pixel
MIN_CLEAR = 90  # pixels of a window, a fifth
MIN_INFORMATION = 12.0  # smaller eigenvalue of a window, in pixels of the median slope
ENOUGH = 120  # places of a scene
NOT_FIRM = (3, 4, 5, 9)  # ASPRS classes: vegetation, and water, which moves
IS_FIRM = ~np.isin(np.arange(256), NOT_FIRM)  # by class


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


def _parallax(left: SensorModel, right: SensorModel, col: float, row: float, h: float) -> Floats:
    """[2] px/m: displacement of a point in the right image against a surface below it.

    Per metre that it lies above the surface, in px of the left image, where (col, row) is.
    """
    c, r = col + np.array([0.0, 0.0, 0.0, 1.0, 0.0]), row + np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    z = h + np.array([-5.0, 5.0, 0.0, 0.0, 0.0])
    at = np.stack(right.project(*left.localize(c, r, z), z), axis=-1)
    carry = np.stack([at[3] - at[2], at[4] - at[2]], axis=1)
    return np.linalg.solve(carry, at[1] - at[0]) / 10.0


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


def _places_of(points: SitePoints, picture: Picture) -> list[tuple[Integers, Floats, Bools]]:
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
