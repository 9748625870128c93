"""Places where LiDAR and both images show one smooth surface, and by how much they disagree.

The scene is sampled at a fixed number of sites, spread evenly over the ground that both images and
the LiDAR cover, whatever its size. In a site, places are taken where the points lie on one plane
(no roof edge, no crown, nothing hidden behind it) and the left image has texture. The plane maps
the left window to the right image, and least-squares matching (Gruen 1985) finds by how much the
right image shows the same elsewhere: the tie point's shift.

On a plane a right image position depends on the left one by ``carry``, so that the shift is, to
first order, (error of the right image's model) − carry · (error of the left's): what both have in
common is seen on slopes only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from .points import PointStore, query_points
from .rectification import Source
from .resampling import ANTIALIAS, RADIUS, sample, tap_weights
from .rpc import SensorModel

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]
Site = tuple[int, int, float, float]  # upper-left col, row px; lowest, highest point in m

SITES = 120  # about; each is read by itself
SITE = 168  # px of the left image, side of a site
PER_SIDE = 3  # places per side of a site, at most
HALF = 10  # px: windows of 21 x 21
STEP = 3  # px between the candidates for a place
FLAT_PX = 0.3  # rms distance of a place's points from their plane, as disparity
MIN_POINTS = 24  # of a place
CENTRED = 0.15  # of the window: how far the points' centroid may be off
SPREAD = 0.7  # of an even distribution's variance: less, and the points leave part of it empty
STEEPEST = 3.0  # ratio of scales between the images along any direction
MIN_CORRELATION = 0.6
POOR_SIGMA = 0.2  # px: a match that is worse by its own residuals is none
ITERATIONS = 12
CONVERGED = 0.003  # px


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


@dataclass(frozen=True, eq=False)
class TiePoints:
    """n tie points; coordinates are (col, row) px of the original images.

    ``site`` int[n]; ``height`` ellipsoidal m; ``left`` [n, 2] the place, ``right`` [n, 2] where
    plane and sensor models put it in the right image; ``carry`` [n, 2, 2]: d right / d left on the
    plane; ``shift`` [n, 2]: position found minus ``right``; ``sigma`` px of a left pixel, from the
    match's own residuals; ``correlation`` of the windows.
    """

    site: NDArray[np.int64]
    height: Floats
    left: Floats
    right: Floats
    carry: Floats
    shift: Floats
    sigma: Floats
    correlation: Floats

    def __len__(self) -> int:
        return self.site.size


# --------------------------------------------------------------------------------------- kernels


@njit(cache=True, nogil=True, error_model="numpy")
def _warp(
    source: Picture, col: float, row: float, carry: Floats, scale: tuple[float, float], out: Picture
) -> None:
    """Fill ``out`` [odd, odd] by the source at (col, row) + carry · (offset from the middle)."""
    across = np.empty(2 * int(np.ceil(RADIUS * scale[0])))
    down = np.empty(2 * int(np.ceil(RADIUS * scale[1])))
    half_rows, half_cols = out.shape[0] // 2, out.shape[1] // 2
    for j in range(out.shape[0]):
        v = j - half_rows
        for i in range(out.shape[1]):
            u = i - half_cols
            c = col + carry[0, 0] * u + carry[0, 1] * v
            r = row + carry[1, 0] * u + carry[1, 1] * v
            first_col = int(np.floor(c)) + 1 - across.size // 2
            first_row = int(np.floor(r)) + 1 - down.size // 2
            tap_weights(c, first_col, scale[0], across)
            tap_weights(r, first_row, scale[1], down)
            out[j, i] = sample(source, first_row, first_col, down, across)


@njit(cache=True, nogil=True, error_model="numpy")
def _least_squares_match(
    template: Picture,
    source: Picture,
    col: float,
    row: float,
    carry: Floats,
    scale: tuple[float, float],
    start: Floats,
    result: Floats,
) -> None:
    """Fill ``result`` with the shift (x, y) in template px, its sigma, and the correlation.

    ``template`` has a margin of one px for the slopes. Unknowns are the shift, gain and offset;
    the slopes are the mean of both windows', so that noise does not draw the shift. NaN where the
    match leaves the picture or does not converge.
    """
    n = template.shape[0] - 2
    x, y = start[0], start[1]
    window = np.empty(template.shape, np.float32)
    result[:] = np.nan
    count = n * n
    mean_left = 0.0
    for j in range(1, n + 1):
        for i in range(1, n + 1):
            mean_left += template[j, i]
    mean_left /= count
    for _ in range(ITERATIONS):
        c = col + carry[0, 0] * x + carry[0, 1] * y
        r = row + carry[1, 0] * x + carry[1, 1] * y
        _warp(source, c, r, carry, scale, window)
        mean_right = 0.0
        for j in range(1, n + 1):
            for i in range(1, n + 1):
                mean_right += window[j, i]
        mean_right /= count
        if np.isnan(mean_right):
            return
        ll, lr, rr = 0.0, 0.0, 0.0
        for j in range(1, n + 1):
            for i in range(1, n + 1):
                a, b = template[j, i] - mean_left, window[j, i] - mean_right
                ll += a * a
                lr += a * b
                rr += b * b
        if ll <= 0.0 or rr <= 0.0 or lr <= 0.0:
            return
        gain = np.sqrt(ll / rr)
        xx, xy, yy, bx, by, misfit = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(1, n + 1):
            for i in range(1, n + 1):
                miss = template[j, i] - mean_left - gain * (window[j, i] - mean_right)
                gx = 0.25 * (
                    template[j, i + 1]
                    - template[j, i - 1]
                    + gain * (window[j, i + 1] - window[j, i - 1])
                )
                gy = 0.25 * (
                    template[j + 1, i]
                    - template[j - 1, i]
                    + gain * (window[j + 1, i] - window[j - 1, i])
                )
                xx += gx * gx
                xy += gx * gy
                yy += gy * gy
                bx += gx * miss
                by += gy * miss
                misfit += miss * miss
        det = xx * yy - xy * xy
        if not det > 0.0:
            return
        dx, dy = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
        x += dx
        y += dy
        if abs(x - start[0]) > 2.0 or abs(y - start[1]) > 2.0:
            return
        if max(abs(dx), abs(dy)) < CONVERGED:
            result[0], result[1] = x, y
            result[2] = np.sqrt(misfit / (count - 4) * max(xx, yy) / det)
            result[3] = lr / np.sqrt(ll * rr)
            return


# ----------------------------------------------------------------------------------------- sites


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


# ---------------------------------------------------------------------------------------- places


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


# -------------------------------------------------------------------------------------- matching


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


def _window(source: Source, at: Floats, reach: float) -> tuple[Picture, Floats] | None:
    """The part of an image around positions [n, 2], and the position of its first pixel."""
    low = np.maximum(np.floor(at.min(axis=0) - reach).astype(int), 0)
    high = np.minimum(np.ceil(at.max(axis=0) + reach).astype(int) + 1, source.size)
    if (low >= high).any():
        return None
    return source.read(*low.tolist(), *(high - low).tolist()), low


def _widening(carry: Floats) -> tuple[float, float]:
    """Widening of the kernel along (col, row) where the right image is the finer one."""
    spans = np.hypot(carry[:, 0], carry[:, 1])
    return tuple(float(span) if span > ANTIALIAS else 1.0 for span in spans)


@dataclass(frozen=True, eq=False)
class _Windows:
    """One place, ready for matching: see :func:`_prepared`."""

    index: int
    template: Picture
    pixels: Picture
    at: Floats
    carry: Floats
    scale: tuple[float, float]
    scores: Picture


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where the sensor models put places: ``left`` [n, 2] whole px, and as in TiePoints."""

    left: Floats
    height: Floats
    right: Floats
    carry: Floats

    @classmethod
    def of(cls, places: Places, left: SensorModel, right: SensorModel) -> Geometry:
        """By the sensor models as they are; a place moves on its plane to the nearest pixel."""
        exact = np.stack(left.project(places.lon, places.lat, places.height), axis=1)
        where = np.rint(exact)
        height = places.height + np.sum((where - exact) * places.slope, axis=1)
        return cls(where, height, *_carry(left, right, where, height, places.slope))


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
        reach = 1.5 * (HALF + radius + 3) * scales[members, 0].max() + 2 * RADIUS
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
            if template.shape != (2 * HALF + 3,) * 2 or not np.isfinite(template).all():
                continue
            carry, scale = geometry.carry[k], _widening(geometry.carry[k])
            at = geometry.right[k] - origin
            _warp(pixels, *at, carry, scale, big)
            known = np.isfinite(big)
            if known.mean() < 0.5:
                continue
            inner = template[1:-1, 1:-1]
            scores = cv2.matchTemplate(
                np.where(known, big - big[known].mean(), np.float32(0)),
                inner - inner.mean(),
                cv2.TM_CCOEFF_NORMED,
            )
            scores = np.where(np.abs(scores) <= 1.0, scores, np.float32(0))  # of flat windows: inf
            yield _Windows(k, template, pixels, at, carry, scale, scores)


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
    spread = 1.4826 * float(np.median(np.abs(total - np.median(total))))
    height = float(total.max() - np.median(total)) / max(spread, 1e-12)
    return np.array([x - radius, y - radius], dtype=float), height


def match(
    places: Places,
    geometry: Geometry,
    sources: tuple[Source, Source],
    radius: int,
) -> TiePoints:
    """Match every place within ``radius`` px (of the left image); places that fail are left out."""
    results = np.full((len(places), 4), np.nan)
    for w in _prepared(places, geometry, sources, radius):
        y, x = np.unravel_index(int(np.argmax(w.scores)), w.scores.shape)
        if 0 < x < 2 * radius and 0 < y < 2 * radius:
            start = np.array([x - radius, y - radius], dtype=np.float64)
            _least_squares_match(
                w.template, w.pixels, *w.at, w.carry, w.scale, start, results[w.index]
            )
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
        sigma=results[good, 2],
        correlation=results[good, 3],
    )
