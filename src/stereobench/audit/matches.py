"""Matches of images: of a pair to sub-pixel, knowing nothing of its labels, and of shared ground.

SIFT key points (:mod:`stereotruth.tiles.sift_matches`) are matched over some rows and a wide
range of disparities of either sign; least-squares matching (Gruen 1985) then finds, in a window
around the left pixel nearest the key point, the disparity there, its two slopes, and the vertical
parallax.
What keeps it free of bias:

- both images are smoothed alike before (``SMOOTHING_PX``) and the right one is interpolated by
  cubic B-splines, so that no sub-pixel phase is preferred to another;
- the slopes of the grey values are the mean of both windows', so that noise draws nothing;
- the disparity is that of the plane at the window's middle pixel, whatever the texture's centre.

Ground that two pairs share (duplicates, overlaps) is found in their left images alone, of which the
strongest SIFT features are kept: see :func:`find_shared`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter
from scipy.spatial import cKDTree

from stereotruth.align.least_squares_matching import (
    gain_and_correlation,
    mean_slopes,
    misfit,
    weighted_mean,
)
from stereotruth.core.kernels import inner, kernel
from stereotruth.core.numerics.arrays import Floats
from stereotruth.core.numerics.interpolation import cubic_slopes, cubic_weights
from stereotruth.tiles import sift_matches

Picture = NDArray[np.float32]

SMOOTHING_PX = 0.7  # standard deviation: what is left aliases by less than 0.01 px
HALF = 8  # px: windows of 17 x 17,
WEIGHT_PX = 4.5  # weighted by a Gaussian of this standard deviation
MIN_CORRELATION = 0.7
POOR_SIGMA = 0.25  # px, by the match's own residuals
ITERATIONS = 15
CONVERGED = 0.002  # px
MOVE_PX = 1.5  # that a match may move from where SIFT has it,
LABEL_MOVE_PX = 3.0  # and from there in the shape of labels: a window's middle may stand out
STEEPEST = 0.6  # px of disparity per px
LABELLED = 0.6  # of a window, by weight, where labels are held against a match
ROW_STEP_PX = 9.0  # of the search for rows that are far off: SIFT looks 5 px up and down
ROW_STEPS = 4
FEW = 30  # key points matched: fewer, and other rows are tried

# Shared ground.
FEATURES = 800  # of an image, the strongest
COMPONENTS = 14
QUERIES = 200  # of them, evenly chosen, are looked up
NEIGHBOURS = 6  # of a feature, in other images
AXES_FROM = 100_000  # features, evenly chosen, that the principal components are taken of
COMPARED = 60  # images: so few are all compared with each other; of more those with more neighbours
UNLIKELY = 4.0  # than by chance, by so many standard deviations
RATIO = 0.85
REPROJECTION_PX = 3.0
MIN_INLIERS = 8
SCALE = 1.3


class Matches(NamedTuple):
    """n matches; all in px. ``x``, ``y``: pixels of the left image (whole numbers).

    ``disparity`` x_left − x_right there, ``parallax`` y_right − y_left.
    """

    x: Floats
    y: Floats
    disparity: Floats
    parallax: Floats

    @property
    def x_right(self) -> Floats:
        """Columns in the right image."""
        return self.x - self.disparity


def grey(image: NDArray[Any]) -> Picture:
    """An image [h, w] or [h, w, 3] (RGB) as float32[h, w]."""
    if image.ndim == 3:
        return cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY)
    return image.astype(np.float32)


def smooth(image: Picture) -> Picture:
    """As both images are before they are compared."""
    return cv2.GaussianBlur(image, (0, 0), SMOOTHING_PX, borderType=cv2.BORDER_REFLECT)


@inner
def _sample(c: Picture, x: float, y: float, out: Floats, k: int) -> bool:
    """Fill ``out[k]`` by value and slopes of a spline; False next to its border and outside."""
    if not (x >= 2.0 and y >= 2.0 and x <= c.shape[1] - 4.0 and y <= c.shape[0] - 4.0):
        return False
    i, j = int(np.floor(x)), int(np.floor(y))
    across, across_slope = cubic_weights(x - i), cubic_slopes(x - i)
    weight, slope = cubic_weights(y - j), cubic_slopes(y - j)
    value, along, down = 0.0, 0.0, 0.0
    for b in range(4):
        v, s = 0.0, 0.0
        for a in range(4):
            p = c[j - 1 + b, i - 1 + a]
            v += across[a] * p
            s += across_slope[a] * p
        value += weight[b] * v
        along += weight[b] * s
        down += slope[b] * v
    out[k, 0], out[k, 1], out[k, 2] = value, along, down
    return True


@inner
def _solve(a: Floats, b: Floats) -> bool:
    """Solve a @ p = b, positive definite, in place: p in ``b``, the inverse in ``a``."""
    n = b.size
    for k in range(n):
        pivot = a[k, k]
        if not pivot > 1e-12:
            return False
        a[k, k] = 1.0
        for j in range(n):
            a[k, j] /= pivot
        b[k] /= pivot
        for i in range(n):
            if i != k:
                factor = a[i, k]
                a[i, k] = 0.0
                for j in range(n):
                    a[i, j] -= factor * a[k, j]
                b[i] -= factor * b[k]
    return True


@inner
def _match(
    images: tuple[Picture, Picture],
    shape: Picture,
    weight: Floats,
    start: Floats,
    unknowns: int,
    move: float,
    out: Floats,
) -> None:
    """Fill ``out`` [6] as :func:`_match_all` does, from one ``start`` [4]."""
    left, right = images
    side = len(weight)
    x0, y0, p, half = int(start[0]), int(start[1]), start[3], side // 2
    out[:] = np.nan
    rows, cols = left.shape
    if x0 - half < 2 or y0 - half < 2 or x0 + half > cols - 4 or y0 + half > rows - 4:
        return
    if np.isnan(shape[y0, x0]):
        return
    a, b, place = np.empty((side * side, 3)), np.empty((side * side, 3)), np.empty((side * side, 3))
    some = np.empty(side * side)
    n, total = 0, 0.0
    for k in range(side * side):
        u, v = k % side - half, k // side - half  # from the middle pixel
        if np.isnan(shape[y0 + v, x0 + u]):
            continue
        _sample(left, float(x0 + u), float(y0 + v), a, n)
        place[n, 0], place[n, 1], place[n, 2] = u, v, x0 + u - shape[y0 + v, x0 + u]
        some[n] = weight[k // side, k % side]
        total += some[n]
        n += 1
    if total < LABELLED * weight.sum():
        return
    weights = some[:n]
    mean_a = weighted_mean(a, weights)
    first = start[2] - shape[y0, x0]
    at, design, middle = np.array([first, p, 0.0, 0.0]), np.empty(4), np.empty(4)
    for _ in range(ITERATIONS):
        for k in range(n):
            x = place[k, 2] - (at[0] + at[2] * place[k, 0] + at[3] * place[k, 1])
            if not _sample(right, x, y0 + place[k, 1] + at[1], b, k):
                return
        mean_b = weighted_mean(b, weights)
        gain, correlation = gain_and_correlation(a, b, weights, mean_a, mean_b)
        if np.isnan(gain):
            return
        normal, rhs = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        middle[:] = 0.0
        squared = 0.0
        for k in range(n):
            w = weights[k]
            gx, gy = mean_slopes(a, b, gain, k)
            design[0], design[1] = -gx, gy
            design[2], design[3] = -gx * place[k, 0], -gx * place[k, 1]
            miss = misfit(a, b, mean_a, mean_b, gain, k)
            squared += w * miss * miss
            for m in range(unknowns):
                middle[m] += w * design[m]
                rhs[m] += w * design[m] * miss
                for q in range(unknowns):
                    normal[m, q] += w * design[m] * design[q]
        for m in range(unknowns):  # the windows' means are taken out: so are those of the design
            for q in range(unknowns):
                normal[m, q] -= middle[m] * middle[q] / total
        if not _solve(normal, rhs):
            return
        at[:unknowns] += rhs
        if abs(at[0] - first) > move or abs(at[1] - p) > MOVE_PX:
            return
        if max(abs(at[2]), abs(at[3])) > STEEPEST:
            return
        if max(abs(rhs[0]), abs(rhs[1])) < CONVERGED:
            out[:4] = at
            out[4] = np.sqrt(squared / (total - unknowns) * normal[0, 0])
            out[5] = correlation
            return


@kernel
def _match_all(
    images: tuple[Picture, Picture],
    shape: Picture,
    weight: Floats,
    start: Floats,
    unknowns: int,
    move: float,
    out: Floats,
) -> None:
    """Fill ``out`` [n, 6] by disparity, parallax, both slopes of the disparity, sigma of the
    disparity and correlation of the windows' match, or NaN.

    ``images``: splines of both; ``shape`` [h, w]: disparities to which those found are added, NaN
    for pixels that take no part; ``weight`` [odd, odd] of a window's pixels; ``start`` [n, 4]: x,
    y, disparity with the shape, parallax; ``unknowns``: 2, or 4 with the slopes; ``move``: px by
    which the disparity may differ from its start.
    """
    for k in range(len(start)):
        _match(images, shape, weight, start[k], unknowns, move, out[k])


def _matched(
    pair: tuple[Picture, Picture], shape: Picture, start: Floats, unknowns: int, move: float
) -> Floats:
    """What :func:`_match_all` finds [n, 6] in windows of both images of a ``pair`` [h, w]."""
    offset = np.arange(-HALF, HALF + 1) / WEIGHT_PX
    weight = np.exp(-0.5 * (offset[:, None] ** 2 + offset[None, :] ** 2))
    splines = (spline_filter(smooth(of).astype(np.float64), order=3, mode="mirror") for of in pair)
    left, right = (of.astype(np.float32) for of in splines)
    out = np.empty((len(start), 6))
    _match_all((left, right), shape, weight, start, unknowns, move, out)
    return out


def least_squares(left: Picture, right: Picture, start: Floats) -> Matches:
    """Least-squares matches of a pair [h, w] from ``start`` [n, 4]: x, y, disparity, parallax.

    Those that do not converge near their start, or fit poorly, are left out.
    """
    out = _matched((left, right), np.zeros_like(left), start, 4, MOVE_PX)
    with np.errstate(invalid="ignore"):
        good = (out[:, 5] >= MIN_CORRELATION) & (out[:, 4] <= POOR_SIGMA)
    return Matches(*start[good, :2].T, *out[good, :2].T)


def label_offsets(left: Picture, right: Picture, labels: NDArray[Any], matches: Matches) -> Floats:
    """Labels less disparity at each match, px; NaN without labels or where the images do not fit.

    A match is the mean of its window: on a crown or a ridge, where key points are, that is less
    than the label in its middle (0.5 px in a forest, with labels that are right to 0.03 px). So the
    window is matched once more, from where the match has it, in the shape that the labels give it.
    """
    start = np.column_stack(matches)
    shape = np.ascontiguousarray(labels, np.float32)
    out = _matched((left, right), shape, start, 2, LABEL_MOVE_PX)
    with np.errstate(invalid="ignore"):
        return np.where(out[:, 5] >= MIN_CORRELATION, -out[:, 0], np.nan)


def match_pair(
    left: NDArray[Any], right: NDArray[Any], reach_px: float, *, nodata: bool = True
) -> Matches:
    """Matches of a pair [h, w] or [h, w, 3] with disparities up to ``reach_px`` of either sign.

    Rows may be some 40 px off as a whole, and 5 px around that. ``nodata``: 0 is no grey value.
    """
    a, b = grey(left), grey(right)
    points = tuple(sift_matches.key_points(sift_matches.picture_of(image)) for image in (a, b))
    if not (points[0].x.size and points[1].x.size):
        return least_squares(a, b, np.empty((0, 4)))
    best: tuple[Any, Any] = sift_matches.match(*points, (-reach_px, reach_px))
    for step in range(1, ROW_STEPS + 1):
        if best[0].size >= FEW:
            break
        for shift in (-step * ROW_STEP_PX, step * ROW_STEP_PX):
            moved = points[1]._replace(y=points[1].y + shift)
            found = sift_matches.match(points[0], moved, (-reach_px, reach_px))
            best = found if found[0].size > best[0].size else best
    i, j = best
    x, y = points[0].x[i], points[0].y[i]
    start = np.column_stack(
        [np.floor(x + 0.5), np.floor(y + 0.5), x - points[1].x[j], points[1].y[j] - y]
    )
    _, first = np.unique(start[:, :2], axis=0, return_index=True)  # key points of one pixel
    start = start[np.sort(first)]
    if nodata:
        blank = cv2.dilate((a == 0).astype(np.uint8), np.ones((2 * HALF + 1,) * 2, np.uint8))
        cols, rows = start[:, :2].astype(int).T
        start = start[blank[np.clip(rows, 0, len(a) - 1), np.clip(cols, 0, a.shape[1] - 1)] == 0]
    return least_squares(a, b, start)


# ------------------------------------------------------------------------------- shared ground


@dataclass(frozen=True, eq=False)
class Features:
    """The strongest features of an image: ``place`` (x, y) px [n, 2], ``vector`` float16[n, 128].

    ``shape`` of the image, rows and columns.
    """

    place: Floats
    vector: NDArray[np.float16]
    shape: tuple[int, int]


@dataclass(frozen=True)
class Shared:
    """Two images, by number, that show common ground: matches, and its share of the first one."""

    first: int
    second: int
    matches: int
    share: float


def features(image: NDArray[Any]) -> Features:
    """Features of an image [h, w] or [h, w, 3]."""
    picture = sift_matches.picture_of(grey(image))
    found, vectors = cv2.SIFT_create(nfeatures=FEATURES).detectAndCompute(picture, None)
    if not found:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float16), picture.shape)
    root = np.sqrt(vectors / np.maximum(vectors.sum(axis=1, keepdims=True), 1e-9))
    order = np.lexsort([[k.pt[i] for k in found] for i in (0, 1)])
    return Features(
        np.array([k.pt for k in found])[order], root[order].astype(np.float16), picture.shape
    )


def find_shared(images: Sequence[Features]) -> list[Shared]:
    """All pairs of images that share ground, the first number the smaller.

    Two images with more features alike than chance gives are compared feature by feature, and one
    similarity transformation (RANSAC) must explain ``MIN_INLIERS`` matches. Crops, offsets, other
    grey values, rotations and scales up to ``SCALE`` do no harm.
    """
    found = []
    for first, second in _candidates(images):
        matches, share = compare(images[first], images[second])
        if matches >= MIN_INLIERS:
            found.append(Shared(first, second, matches, share))
    return found


def _candidates(images: Sequence[Features]) -> list[tuple[int, int]]:
    """Pairs of images of which more features look alike than by chance."""
    if len(images) <= COMPARED:
        return list(combinations(range(len(images)), 2))
    sizes = [len(image.vector) for image in images]
    ends = np.cumsum([0, *sizes])
    owner = np.repeat(np.arange(len(images)), sizes)
    every = max(1, -(-owner.size // AXES_FROM))
    some = np.concatenate([image.vector[::every] for image in images]).astype(np.float64)
    middle = some.mean(axis=0)
    _, axes = np.linalg.eigh((some - middle).T @ (some - middle))
    axes = axes[:, ::-1][:, :COMPONENTS]
    reduced = np.concatenate([(image.vector - middle) @ axes for image in images])
    tree = cKDTree(reduced)
    votes: Counter[tuple[int, int]] = Counter()
    for number, (begin, end) in enumerate(pairwise(ends)):
        asked = np.arange(begin, end, max(1, -(-(end - begin) // QUERIES)))
        _, near = tree.query(reduced[asked], k=min(NEIGHBOURS + 1, owner.size))
        for row in owner[near]:
            others = set(row.tolist()) - {number}
            votes.update((min(number, other), max(number, other)) for other in others)
    expected = 2 * votes.total() / (len(images) * (len(images) - 1))
    enough = expected + UNLIKELY * np.sqrt(expected)
    return sorted(pair for pair, count in votes.items() if count > enough)


def compare(a: Features, b: Features) -> tuple[int, float]:
    """Matches that one similarity explains, and the share of the first image that they show."""
    if min(len(a.vector), len(b.vector)) < 3:
        return 0, 0.0
    alike = a.vector.astype(np.float32) @ b.vector.astype(np.float32).T  # rows of unit length
    best = np.argmax(alike, axis=1)
    ordered = np.partition(alike, -2, axis=1)
    near, next_near = (np.sqrt(np.maximum(2 - 2 * ordered[:, k], 0)) for k in (-1, -2))
    mutual = np.argmax(alike, axis=0)[best] == np.arange(best.size)
    good = np.flatnonzero(mutual & (near < RATIO * next_near))
    if good.size < 3:
        return 0, 0.0
    cv2.setRNGSeed(0)
    transform, inlier = cv2.estimateAffinePartial2D(
        a.place[good], b.place[best[good]], ransacReprojThreshold=REPROJECTION_PX, maxIters=5000
    )
    if transform is None or not 1 / SCALE <= np.hypot(*transform[:, 0]) <= SCALE:
        return 0, 0.0
    # features of one place in several orientations are one match
    places = np.unique(np.rint(a.place[good][inlier.ravel() > 0]), axis=0)
    frame, there = (
        np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]], np.float32)
        for rows, cols in (b.shape, a.shape)
    )
    there = (there @ transform[:, :2].T + transform[:, 2]).astype(np.float32)
    area, _ = cv2.intersectConvexConvex(there, frame)
    return len(places), float(area / max(cv2.contourArea(there), 1e-9))
