"""Places of smooth, textured ground, all over a scene, where images and LiDAR compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ..epipolar.image_reader import Source
from ..epipolar.rpc import SensorModel
from ..lidar.point_store import PointStore, query_points
from .least_squares_matching import HALF

Floats = NDArray[np.float64]
Site = tuple[int, int, float, float]  # upper-left col, row px; lowest, highest point in m
Picture = NDArray[np.float32]


SITES = 120  # about; each is read by itself
SITE = 168  # px of the left image, side of a site
PER_SIDE = 3  # places per side of a site, at most
STEP = 3  # px between the candidates for a place
FLAT_PX = 0.3  # rms distance of a place's points from their plane, as disparity
MIN_POINTS = 24  # of a place
CENTRED = 0.15  # of the window: how far the points' centroid may be off
SPREAD = 0.7  # of an even distribution's variance: less, and the points leave part of it empty


@dataclass(frozen=True, eq=False)
class Places:
    """n places on smooth textured ground: ``site`` int[n], ``lon``, ``lat`` degrees, ``height`` m.

    ``slope`` [n, 2]: change of the plane's height along col and row of the left image, m/px.
    """

    site: NDArray[np.int64]
    lon: Floats
    lat: Floats
    height: Floats
    slope: Floats

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
    heights: tuple[float, float],
    col: float,
    row: float,
) -> tuple[float, float] | None:
    """Range of heights (m) at a left position that LiDAR and right image cover, else None.

    ``heights``: that of all points.
    """
    low, high = heights
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
) -> list[Site]:
    """(col, row, lowest, highest height in m) of sites: upper-left px in the left image.

    Some SITES squares on a regular grid, apart from each other, over what both images and the
    LiDAR cover.
    """
    cols, rows = sizes[0]
    if min(cols, rows) < SITE:
        return []
    every = min(s.bounds[4] for s in stores), max(s.bounds[5] for s in stores)

    def grid(spacing: float) -> list[Site]:
        found = []
        for row in np.arange(spacing / 2, rows, spacing):
            for col in np.arange(spacing / 2, cols, spacing):
                heights = _covered(left, right, sizes[1], stores, every, col, row)
                if heights is not None:
                    corner = (
                        min(max(int(at) - SITE // 2, 0), n - SITE)
                        for at, n in zip((col, row), (cols, rows))
                    )
                    found.append((*corner, *heights))
        return found

    coarse = max(np.sqrt(cols * rows / (2.0 * SITES)), SITE)
    return grid(max(coarse * np.sqrt(max(len(grid(coarse)), 1) / SITES), SITE))


def _planes(
    col: Floats, row: Floats, height: Floats, size: int
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Planes through the points of the windows around the candidates of a site.

    ``col``, ``row`` px from the site's upper-left pixel. Returns the planes [k, k, 3] (height at
    the candidate, slopes along col and row in m/px), the rms distance [k, k] m, and whether the
    points fill the window; candidates are every STEP px from HALF on.
    """
    middle = float(np.median(height))
    u, v, h = (col - size / 2) / HALF, (row - size / 2) / HALF, height - middle
    index = np.rint(row).astype(int) * size + np.rint(col).astype(int)
    sums = []
    for value in (np.ones_like(h), u, v, u * u, u * v, v * v, h, u * h, v * h, h * h):
        cell = np.bincount(index, value, minlength=size * size).reshape(size, size)
        box = cv2.boxFilter(
            cell, -1, (2 * HALF + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT
        )
        sums.append(box[HALF:-HALF:STEP, HALF:-HALF:STEP])
    n, su, sv, suu, suv, svv, sh, suh, svh, shh = sums
    enough = n >= MIN_POINTS
    n = np.where(enough, n, 1.0)
    at = np.arange(HALF, size - HALF, STEP, dtype=float)
    here_v, here_u = np.meshgrid((at - size / 2) / HALF, (at - size / 2) / HALF, indexing="ij")
    mu, mv, mh = su / n, sv / n, sh / n
    cuu, cuv, cvv = suu / n - mu * mu, suv / n - mu * mv, svv / n - mv * mv
    cuh, cvh, chh = suh / n - mu * mh, svh / n - mv * mh, shh / n - mh * mh
    det = cuu * cvv - cuv * cuv
    even = 1.0 / 3.0  # variance of an even distribution over [-1, 1]
    filled = (
        enough
        & (np.abs(mu - here_u) < CENTRED)
        & (np.abs(mv - here_v) < CENTRED)
        & (cuu > SPREAD * even)
        & (cvv > SPREAD * even)
        & (det > 0.25 * even * even)
    )
    det = np.where(filled, det, 1.0)
    a, b = (cvv * cuh - cuv * cvh) / det, (cuu * cvh - cuv * cuh) / det
    rms = np.sqrt(np.maximum(chh - a * cuh - b * cvh, 0.0))
    level = middle + mh + a * (here_u - mu) + b * (here_v - mv)
    return np.stack([level, a / HALF, b / HALF], axis=-1), rms, filled


def _texture(picture: Picture) -> Floats:
    """Smaller eigenvalue [k, k] of the summed squares of the slopes around the candidates.

    NaN where a window of the picture [size, size] has no value.
    """
    gy, gx = np.gradient(picture.astype(np.float64))
    sums = []
    for value in (gx * gx, gx * gy, gy * gy):
        box = cv2.boxFilter(
            np.nan_to_num(value), -1, (2 * HALF + 1,) * 2, borderType=cv2.BORDER_CONSTANT
        )
        sums.append(box[HALF:-HALF:STEP, HALF:-HALF:STEP])
    holes = cv2.dilate(np.isnan(gx + gy).astype(np.uint8), np.ones((2 * HALF + 3,) * 2, np.uint8))[
        HALF:-HALF:STEP, HALF:-HALF:STEP
    ]
    xx, xy, yy = sums
    smaller = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return np.where(holes > 0, np.nan, smaller)


def _best(score: Floats) -> NDArray[np.int64]:
    """(row, col) [n, 2] of the best finite score in each of PER_SIDE² parts of a grid."""
    found = []
    edges = np.linspace(0, len(score), PER_SIDE + 1).astype(int)
    for top, bottom in pairwise(edges):
        for start, end in pairwise(edges):
            part = score[top:bottom, start:end]
            if np.isfinite(part).any():
                j, i = np.unravel_index(np.nanargmax(part), part.shape)
                found.append((top + j, start + i))
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def _px_per_m(left: SensorModel, right: SensorModel, col: float, row: float, h: float) -> float:
    """How far a right image position moves per metre of height at a left position, px."""
    ends = [np.array(right.project(*left.localize(col, row, z), z)) for z in (h - 5.0, h + 5.0)]
    return float(np.hypot(*(ends[1] - ends[0])) / 10.0)


def _places_of(
    left: SensorModel,
    right: SensorModel,
    source: Source,
    stores: Sequence[PointStore],
    site: Site,
) -> tuple[Floats, Floats] | None:
    """The places of a site: (col, row) px of the left image [n, 2] and planes [n, 3]."""
    col0, row0, low, high = site
    corner_cols, corner_rows = np.meshgrid([-1.0, SITE], [-1.0, SITE])
    ground = np.hstack(
        [
            np.stack(left.localize(col0 + corner_cols.ravel(), row0 + corner_rows.ravel(), h))
            for h in (low, high)
        ]
    )
    if not np.isfinite(ground).all():
        return None
    (west, south), (east, north) = ground.min(axis=1), ground.max(axis=1)
    points = query_points(stores, west, south, east, north)
    col, row = left.project(points.lon, points.lat, points.height)
    col, row = col - col0, row - row0
    inside = (col > -0.5) & (col < SITE - 0.5) & (row > -0.5) & (row < SITE - 0.5)
    if inside.sum() < MIN_POINTS:
        return None
    height = points.height[inside]
    planes, rms, good = _planes(col[inside], row[inside], height, SITE)
    middle = float(np.median(height))
    good &= rms * _px_per_m(left, right, col0 + SITE / 2, row0 + SITE / 2, middle) <= FLAT_PX
    if not good.any():
        return None
    best = _best(np.where(good, _texture(source.read(col0, row0, SITE, SITE)), np.nan))
    return best[:, ::-1] * STEP + HALF + np.array([col0, row0]), planes[best[:, 0], best[:, 1]]


def find_places(
    left: SensorModel,
    right: SensorModel,
    source: Source,
    stores: Sequence[PointStore],
    sites: Sequence[Site],
) -> Places:
    """The best places of every site, seen by the left image (``source``); memory for one site."""
    found = []
    for number, site in enumerate(sites):
        pair = _places_of(left, right, source, stores, site)
        if pair is not None and len(pair[0]):
            where, planes = pair
            lon, lat = left.localize(where[:, 0], where[:, 1], planes[:, 0])
            found.append((np.full(len(where), number), lon, lat, planes[:, 0], planes[:, 1:]))
    if not found:
        empty = np.empty(0)
        return Places(np.empty(0, np.int64), empty, empty, empty, np.empty((0, 2)))
    return Places(*(np.concatenate(parts) for parts in zip(*found)))
