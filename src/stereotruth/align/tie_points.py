"""Places where LiDAR and both images show one smooth surface, and by how much they disagree.

The scene is sampled at a fixed number of sites, spread evenly over the ground that both images and
the LiDAR cover, whatever its size. In a site, places are windows on a plane of the points, whose
pixels take part if nothing but the plane is seen there (:mod:`.tie_planes`). The plane maps the
left window to the right image, and robust least-squares matching finds by how much the right image
shows the same elsewhere (:mod:`.least_squares_matching`): the tie point's shift.

On a plane a right image position depends on the left one by ``carry``, so that the shift is, to
first order, (error of the right image's model) − carry · (error of the left's): what both have in
common is seen on slopes only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.numerics.cubic_convolution import SIX_POINT_RADIUS
from ..core.numerics.robust import median_and_nmad, robust_sigma
from ..epipolar.resampling import ANTIALIAS
from ..sensor.image_reader import Source
from ..sensor.rpc import SensorModel
from .least_squares_matching import least_squares_match, warp_patch
from .tie_planes import HALF
from .tie_sites import MIN_CLEAR, SITE, Places

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]


STEEPEST = 3.0  # ratio of scales between the images along any direction
MIN_CORRELATION = 0.5
POOR_SIGMA = 0.25  # px: a match that is worse by its own residuals is none


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
    clear: Floats
    pixels: Picture
    at: Floats
    carry: Floats
    scale: tuple[float, float]
    scores: Picture


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


def _even(picture: Picture) -> Picture:
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
            carry, scale = geometry.carry[k], _widening(geometry.carry[k])
            at = geometry.right[k] - origin
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
