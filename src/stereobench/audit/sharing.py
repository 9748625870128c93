"""Ground that two pairs share: duplicates and overlaps, found in the left images alone.

Of each left image the strongest SIFT features are kept. For each, its nearest ones in other images
are looked up (in the first principal components, exactly); two images with more of them in common
than chance gives are compared feature by feature, and one similarity transformation (RANSAC) must
explain ``MIN_INLIERS`` matches. Crops, offsets, other grey values, rotations and scales up to
``SCALE`` do no harm. How many matches unrelated images have by chance is said by
:func:`chance_inliers`, one image against the mirror images of others: no ground is its own mirror.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereotruth.pages.pictures import stretch

from .matches import grey

Floats = NDArray[np.float64]


FEATURES = 800  # of an image, the strongest
COMPONENTS = 14
QUERIES = 200  # of them, evenly chosen, are looked up
NEIGHBOURS = 6  # of a feature, in other images
AXES_FROM = 100_000  # features, evenly chosen, that the principal components are taken of
ALL = 60  # images: so few are all compared with each other; of more those with more neighbours
UNLIKELY = 4.0  # than by chance, by so many standard deviations
RATIO = 0.85
REPROJECTION_PX = 3.0
MIN_INLIERS = 8
SCALE = 1.3


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
    picture = stretch(grey(image), percent=(0.1, 99.9))
    found, vectors = cv2.SIFT_create(nfeatures=FEATURES).detectAndCompute(picture, None)
    if not found:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float16), picture.shape)
    root = np.sqrt(vectors / np.maximum(vectors.sum(axis=1, keepdims=True), 1e-9))
    order = np.lexsort([[k.pt[i] for k in found] for i in (0, 1)])
    return Features(
        np.array([k.pt for k in found])[order], root[order].astype(np.float16), picture.shape
    )


def find_shared(images: list[Features]) -> list[Shared]:
    """All pairs of images that share ground, the first number the smaller."""
    found = []
    for first, second in _candidates(images):
        if result := _compare(images[first], images[second]):
            found.append(Shared(first, second, *result))
    return found


def _candidates(images: list[Features]) -> list[tuple[int, int]]:
    """Pairs of images of which more features look alike than by chance."""
    if len(images) <= ALL:
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


def _compare(a: Features, b: Features) -> tuple[int, float] | None:
    """Matches that one similarity explains, and the share of the first image they show; or None."""
    inliers, transform = _align(a, b)
    if inliers < MIN_INLIERS or transform is None:
        return None
    rows, cols = a.shape
    corners = np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]], np.float32)
    there = (corners @ transform[:, :2].T + transform[:, 2]).astype(np.float32)
    height, width = b.shape
    frame = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    area, _ = cv2.intersectConvexConvex(there, frame)
    return inliers, float(area / max(cv2.contourArea(there), 1e-9))


def _align(a: Features, b: Features) -> tuple[int, Floats | None]:
    if min(len(a.vector), len(b.vector)) < 3:
        return 0, None
    alike = a.vector.astype(np.float32) @ b.vector.astype(np.float32).T  # rows of unit length
    best = np.argmax(alike, axis=1)
    ordered = np.partition(alike, -2, axis=1)
    near, next_near = (np.sqrt(np.maximum(2 - 2 * ordered[:, k], 0)) for k in (-1, -2))
    mutual = np.argmax(alike, axis=0)[best] == np.arange(best.size)
    good = np.flatnonzero(mutual & (near < RATIO * next_near))
    if good.size < 3:
        return 0, None
    cv2.setRNGSeed(0)
    transform, inlier = cv2.estimateAffinePartial2D(
        a.place[good], b.place[best[good]], ransacReprojThreshold=REPROJECTION_PX, maxIters=5000
    )
    if transform is None:
        return 0, None
    scale = float(np.hypot(transform[0, 0], transform[1, 0]))
    if not 1 / SCALE <= scale <= SCALE:
        return 0, None
    # Features of one place in several orientations are one match.
    places = np.unique(np.rint(a.place[good][inlier.ravel() > 0]), axis=0)
    return len(places), transform


def chance_inliers(images: list[NDArray[Any]]) -> list[int]:
    """Matches that a transformation explains between each image and the mirrored next ones."""
    plain = [features(image) for image in images]
    mirrored = [features(np.ascontiguousarray(image[:, ::-1])) for image in images]
    return [_align(a, b)[0] for i, a in enumerate(plain) for b in mirrored[i + 1 :]]
