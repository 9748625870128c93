"""Ground, roofs and crowns of the twin of a real place, from its points.

The ground is a smooth surface through the points that lie lowest. Roofs are planes that are grown
from point to point by the points' neighbours (Rabbani et al. 2006, Segmentation of point clouds
using smoothness constraint), and become a raster of planar patches. Crowns are ellipsoids whose
tops are the points of leaves that were hit first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from stereotruth.core.kernels import inlined, kernel

from .surfaces import NOTHING, PATCH_M

CLASSED_SHARE = 0.01  # of the points: less of a class, and its class was not looked for
NEIGHBOURS = 10  # by which the plane of a point is told
THIN_M = 0.4  # one point at most in a square of this side
SEED_ROUGH_M = 0.12  # rms of the neighbours off the plane of a point that one begins with
OFF_M = 0.18  # of a plane: a point so near belongs to it
JOIN_M = 0.45  # what no plane took up joins the one beside it, so near
TURN = math.cos(math.radians(28))  # of the normals within a plane
STEEPEST = 2.0  # rise over run; what is steeper is a wall
FEWEST = 10  # points of a plane
VOTES = 14  # points that say what stands at a patch
VOTE_M = 0.55  # how near they count
REACH_M = 1.3
PAINTED_M = 8.0  # from the nearest point: what is farther has no paint
STRAIGHT_M = 0.6  # over which outlines are smoothed
SMALLEST_M2 = 10.0  # of a building
BUILDING_M2 = 400.0  # of one among others that it touches
SEAM_M = 0.35  # planes that come so near each other meet in a ridge or a valley
SEAM = 3  # patches to each side, among which such a plane is sought
SIDE_M = 1.0  # over which the directions of sides are smoothed

GROUND_CLASSES = (2, 9)
STEP_M = 2.0  # between the coefficients of the spline
FILTER_M = 1.0  # cells in which the lowest points are sought
WIDEST_M = 30.0  # half the width of the widest building, where no class tells the ground
STEEP = 0.15  # rise over run of ground that the search for objects lets pass
LOW_M = 3.0  # a cell so far below those around has a false point
NEAR_M = 0.5  # of the lowest surface: ground
BEYOND = 64  # squares of ground that tell how high it lies where the file ends
MAX_SLOPE = 1.0  # less steep than any ray, so that each meets the ground once

CLASSES = (3, 4, 5)
ROOFS = (6, 17)  # 17: bridge decks
OBJECT_M = 1.5  # above the ground: less is none
ROUGH_M = 0.2  # rms of neighbours off their plane: more is no roof
SEVERAL = 0.6  # share of the neighbours whose pulses had more returns: more is no roof
SPACING_M = 1.2  # between tops
TREE_M = 6.0  # between trees
RADIUS_M = (1.0, 1.35)
DEPTH_M = 5.0  # of a crown below its top at most
BOTTOM = 0.3  # of a top's height above the ground
LEAF = 0.15  # reflectance of a leaf of style 1
POROSITY = 0.3  # share of the pulses that the top of a crown lets pass


class Points(NamedTuple):
    """Points of a place: ``xyz`` float64[n, 3] in the world frame; ``label`` uint8[n]: class of
    LAS; ``single``, ``first`` bool[n]: the only, the first return of its pulse; ``tint``
    float32[n]: reflectance, None where the file tells none."""

    xyz: np.ndarray
    label: np.ndarray
    single: np.ndarray
    first: np.ndarray
    tint: np.ndarray | None

    def which(self, use: np.ndarray) -> Points:
        """The points of a mask or of indices."""
        return Points(*(None if values is None else values[use] for values in self))

    def has_class(self, *labels: int) -> bool:
        """Whether the file tells which points are of these classes."""
        return bool(np.isin(self.label, labels).mean() > CLASSED_SHARE)


class Planes(NamedTuple):
    """Of points: ``number`` int32[n], −1 for none. ``plane`` float64[m, 5]: middle x, y, z there,
    slopes along x and y."""

    number: np.ndarray
    plane: np.ndarray


class Raster(NamedTuple):
    """What stands in each patch, [rows, cols], as in :class:`.surfaces.Surfaces`, and ``roof``
    int32: the number of the plane, −1 for none."""

    patches: np.ndarray
    side: np.ndarray
    paint: np.ndarray
    roof: np.ndarray


def thinned(xyz: np.ndarray, side_m: float = THIN_M) -> np.ndarray:
    """Indices of the highest point in each square of a side, in order."""
    if not len(xyz):
        return np.zeros(0, np.int64)
    i, j = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / side_m).astype(np.int64).T
    cell = j * (i.max() + 1) + i
    order = np.lexsort((-xyz[:, 2], cell))
    return np.sort(order[np.diff(cell[order], prepend=-1) != 0])


def local_planes(xyz: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Upward normal [n, 3] and rms (m) off the plane of the neighbours ``near`` [n, k]."""
    normal, rough = np.empty((len(xyz), 3)), np.empty(len(xyz))
    for first in range(0, len(xyz), 100_000):
        part = slice(first, first + 100_000)
        around = xyz[near[part]]
        around = around - around.mean(axis=1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        up = vectors[:, :, 0]
        normal[part] = up * np.where(up[:, 2:] < 0, -1.0, 1.0)
        rough[part] = np.sqrt(np.maximum(values[:, 0], 0.0) / near.shape[1])
    return normal, rough


@inlined
def _fit(sums, plane):
    """Plane z = plane[2] + gx (x − plane[0]) + gy (y − plane[1]) of sums about an origin."""
    n = sums[0]
    mx, my, mz = sums[1] / n, sums[2] / n, sums[3] / n
    xx, xy, yy = sums[4] / n - mx * mx, sums[5] / n - mx * my, sums[6] / n - my * my
    xz, yz = sums[7] / n - mx * mz, sums[8] / n - my * mz
    det = xx * yy - xy * xy
    plane[0], plane[1], plane[2] = mx, my, mz
    if det > 1e-3 * xx * yy and det > 1e-9:
        plane[3], plane[4] = (xz * yy - yz * xy) / det, (yz * xx - xz * xy) / det


@kernel
def _grow(xyz, near, normal, rough, order, number, planes):
    """Grow planes from the points in ``order``; returns how many there are."""
    count = 0
    queue = np.empty(len(xyz), np.int64)
    sums, plane = np.zeros(9), np.zeros(5)
    for seed in order:
        if number[seed] >= 0 or rough[seed] > SEED_ROUGH_M or normal[seed, 2] < 0.4:
            continue
        ox, oy, oz = xyz[seed, 0], xyz[seed, 1], xyz[seed, 2]
        plane[:3] = 0.0
        plane[3] = -normal[seed, 0] / normal[seed, 2]
        plane[4] = -normal[seed, 1] / normal[seed, 2]
        sums[:] = 0.0
        queue[0], size, at, refit = seed, 1, 0, 2 * FEWEST
        number[seed] = count
        while at < size:
            p = queue[at]
            at += 1
            x, y, z = xyz[p, 0] - ox, xyz[p, 1] - oy, xyz[p, 2] - oz
            sums[0] += 1
            sums[1] += x
            sums[2] += y
            sums[3] += z
            sums[4] += x * x
            sums[5] += x * y
            sums[6] += y * y
            sums[7] += x * z
            sums[8] += y * z
            if at >= refit:
                _fit(sums, plane)
                refit = at + at // 2
            scale = 1 / math.sqrt(1 + plane[3] ** 2 + plane[4] ** 2)
            for k in range(near.shape[1]):
                q = near[p, k]
                if number[q] >= 0:
                    continue
                dx, dy = xyz[q, 0] - ox - plane[0], xyz[q, 1] - oy - plane[1]
                off = xyz[q, 2] - oz - plane[2] - plane[3] * dx - plane[4] * dy
                turn = normal[q, 2] - plane[3] * normal[q, 0] - plane[4] * normal[q, 1]
                if abs(off) * scale < OFF_M and (turn * scale > TURN or rough[q] > SEED_ROUGH_M):
                    number[q] = count
                    queue[size] = q
                    size += 1
        _fit(sums, plane)
        if size < FEWEST or plane[3] ** 2 + plane[4] ** 2 > STEEPEST**2:
            for k in range(size):
                number[queue[k]] = -1
            continue
        planes[count, 0], planes[count, 1] = plane[0] + ox, plane[1] + oy
        planes[count, 2], planes[count, 3:] = plane[2] + oz, plane[3:]
        count += 1
    return count


@kernel
def _join(xyz, near, number, planes, out):
    """Give points without a plane the nearest one of their neighbours'; returns how many."""
    joined = 0
    for p in range(len(xyz)):
        out[p] = number[p]
        best = JOIN_M
        if number[p] >= 0:
            continue
        for k in range(near.shape[1]):
            m = number[near[p, k]]
            if m < 0:
                continue
            off = abs(_height(planes[m], xyz[p, 0], xyz[p, 1]) - xyz[p, 2])
            if off < best:
                best = off
                out[p] = m
        joined += out[p] >= 0
    return joined


@inlined
def _height(plane, x, y):
    return plane[2] + plane[3] * (x - plane[0]) + plane[4] * (y - plane[1])


def planes_of(xyz: np.ndarray) -> Planes:
    """The planes that points [n, 3] of roofs lie in."""
    if len(xyz) <= NEIGHBOURS:
        return Planes(np.full(len(xyz), -1, np.int32), np.zeros((0, 5)))
    near = cKDTree(xyz).query(xyz, NEIGHBOURS)[1]
    normal, rough = local_planes(xyz, near)
    number = np.full(len(xyz), -1, np.int32)
    planes = np.zeros((len(xyz), 5))
    order = np.argsort(rough, kind="stable")
    count = _grow(xyz, near, normal, rough, order, number, planes)
    while True:
        joined = np.empty_like(number)
        if not _join(xyz, near, number, planes, joined):
            return Planes(number, planes[:count].copy())
        number = joined


@kernel
def _vote(number, tint, near, away, roof, paint):
    """The plane that stands in each patch, −1 for none, and its paint.

    By the votes, falling with distance, of the ``near`` [rows, cols, k] points, ``away`` m from it,
    that are of a plane or of the ground. The paint is that of the points that have won.
    """
    for j in range(roof.shape[0]):
        for i in range(roof.shape[1]):
            best, most = -1, 0.0
            for k in range(near.shape[2]):
                if away[j, i, k] > REACH_M:
                    break
                m, votes = number[near[j, i, k]], 0.0
                for n in range(near.shape[2]):
                    if number[near[j, i, n]] == m and away[j, i, n] <= REACH_M:
                        votes += math.exp(-((away[j, i, n] / VOTE_M) ** 2))
                if votes > most + 1e-12:
                    best, most = m, votes
            light = weight = 0.0
            for k in range(near.shape[2]):
                if number[near[j, i, k]] == best or away[j, i, 0] > REACH_M:
                    w = 1 / (0.04 + away[j, i, k] ** 2)
                    light += w * tint[near[j, i, k]]
                    weight += w
            paint[j, i] = light / weight if away[j, i, 0] < PAINTED_M else 0.0
            roof[j, i] = best


@kernel
def _raise(roof, planes, x0, y0, patches):
    """The planes of patches: of two that meet, the lower at a ridge, the higher in a valley."""
    rows, cols = roof.shape
    for j in range(rows):
        for i in range(cols):
            own = roof[j, i]
            if own < 0:
                continue
            x, y = x0 + PATCH_M * (i + 0.5), y0 + PATCH_M * (j + 0.5)
            chosen, z = own, _height(planes[own], x, y)
            for n in range(max(j - SEAM, 0), min(j + SEAM + 1, rows)):
                for k in range(max(i - SEAM, 0), min(i + SEAM + 1, cols)):
                    m = roof[n, k]
                    if m < 0 or m in (own, chosen):
                        continue
                    other = _height(planes[m], x, y)
                    if other == z or abs(other - z) > SEAM_M:
                        continue
                    is_ridge = _height(planes[m], planes[own, 0], planes[own, 1]) > planes[own, 2]
                    if (other < z) == is_ridge:
                        chosen, z = m, other
            patches[j, i, 0] = z
            patches[j, i, 1], patches[j, i, 2] = planes[chosen, 3], planes[chosen, 4]


def _straightened(roof: np.ndarray) -> np.ndarray:
    """The planes of patches where outlines are smooth and nothing small stands alone."""
    solid = ndimage.gaussian_filter((roof >= 0).astype(np.float32), STRAIGHT_M / PATCH_M) > 0.5
    part, _ = ndimage.label(solid)
    solid &= np.bincount(part.ravel())[part] * PATCH_M**2 >= SMALLEST_M2
    if not solid.any():
        return np.full_like(roof, -1)
    at = ndimage.distance_transform_edt(roof < 0, return_distances=False, return_indices=True)
    return np.where(solid, roof[tuple(at)], -1).astype(np.int32)


def rasterised(
    found: Planes,
    roofs: np.ndarray,
    ground: np.ndarray,
    tint: tuple[np.ndarray, np.ndarray],
    origin: tuple[float, float],
    shape: tuple[int, int],
) -> Raster:
    """The raster of roofs and paint from an ``origin`` (x, y) on.

    ``roofs``, ``ground`` [n, 3]: points; ``tint``: reflectance of both. ``found``: the planes of
    the roofs' points.
    """
    use = found.number >= 0
    xyz = np.concatenate([roofs[use], ground])
    number = np.concatenate([found.number[use], np.full(len(ground), -1, np.int32)])
    light = np.concatenate([tint[0][use], tint[1]]).astype(np.float32)
    tree = cKDTree(xyz[:, :2])
    patches = np.zeros((*shape, 3), np.float32)
    patches[..., 0] = NOTHING
    roof, paint = np.full(shape, -1, np.int32), np.zeros(shape, np.float32)
    x = origin[0] + PATCH_M * (np.arange(shape[1]) + 0.5)
    k = min(VOTES, len(xyz))
    for first in range(0, shape[0], 64):
        rows = slice(first, min(first + 64, shape[0]))
        y = origin[1] + PATCH_M * (np.arange(rows.start, rows.stop) + 0.5)
        at = np.stack(np.meshgrid(x, y), axis=-1)
        away, near = (v.reshape(*at.shape[:2], k) for v in tree.query(at, k))
        _vote(number, light, near, away, roof[rows], paint[rows])
    roof = _straightened(roof)
    _raise(roof, found.plane, *origin, patches)
    return Raster(patches, _sides(patches[..., 0]), paint, roof)


def buildings_of(roof: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The building that each patch of a raster of planes is part of, −1 for none.

    Roofs that touch each other are one, or several of about BUILDING_M2, parted halfway between
    places that are drawn.
    """
    part, count = ndimage.label(roof >= 0)
    j, i = np.nonzero(part)
    of = part[j, i]
    size = np.bincount(of, minlength=count + 1)
    several = np.maximum(np.rint(size * PATCH_M**2 / BUILDING_M2), 1).astype(int)
    order = np.argsort(of, kind="stable")
    ends = np.cumsum(size)
    building, first = np.full(roof.shape, -1, np.int32), 0
    for k in range(1, count + 1):
        inside = order[ends[k - 1] : ends[k]]
        at = np.column_stack([i[inside], j[inside]])
        seeds = at[rng.integers(len(at), size=several[k])]
        building[j[inside], i[inside]] = first + cKDTree(seeds).query(at)[1]
        first += several[k]
    return building


def _sides(z: np.ndarray) -> np.ndarray:
    """Direction in which the side of each patch looks, uint8 in 256 parts of a turn: downhill."""
    standing = z > NOTHING
    level = np.where(standing, z, z[standing].min() - 3.0 if standing.any() else 0.0)
    smooth = ndimage.gaussian_filter(level.astype(np.float64), SIDE_M / PATCH_M, mode="nearest")
    down_y, down_x = (-d for d in np.gradient(smooth))
    return np.rint(np.arctan2(down_y, down_x) * (128 / math.pi)).astype(np.int64).astype(np.uint8)


def is_ground(points: Points) -> np.ndarray:
    """Which points lie on the ground, bool[n]: by their class, or else the lowest ones.

    Without classes by a progressive morphological filter (Zhang et al. 2003, doi
    10.1109/TGRS.2003.810682): objects are what openings of growing width cut off.
    """
    if points.has_class(*GROUND_CLASSES):
        return np.isin(points.label, GROUND_CLASSES)
    low = points.xyz[:, :2].min(axis=0)
    i, j = ((points.xyz[:, :2] - low) / FILTER_M).astype(int).T
    lowest = np.full((j.max() + 1, i.max() + 1), np.inf)
    np.minimum.at(lowest, (j, i), points.xyz[:, 2])
    lowest = _filled(lowest)
    around = ndimage.median_filter(lowest, 5, mode="nearest")
    lowest = np.where(lowest < around - LOW_M, around, lowest)
    surface, is_object = lowest, np.zeros(lowest.shape, bool)
    half = 1
    while True:  # half widths of the openings, cells
        opened = ndimage.grey_opening(surface, size=2 * half + 1, mode="nearest")
        is_object |= surface - opened > STEEP * half * FILTER_M
        surface = opened
        if half * FILTER_M >= WIDEST_M:
            break
        half = math.ceil(1.5 * half)
    ground = _filled(np.where(is_object, np.inf, lowest))
    return np.abs(points.xyz[:, 2] - ground[j, i]) < NEAR_M


def _filled(heights: np.ndarray) -> np.ndarray:
    """Heights with those of the nearest cell in place of infinite ones."""
    holes = ~np.isfinite(heights)
    if not holes.any():
        return heights
    at = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    return heights[tuple(at)]


def terrain_of(xyz: np.ndarray, x0: float, y0: float, shape: tuple[int, int]) -> np.ndarray:
    """Spline coefficients [ny, nx] of the terrain from (x0, y0) on, STEP_M apart.

    ``xyz`` [n, 3]: points on the ground. Linear between them, as under buildings; beyond them the
    median height of the nearest ones. No slope is above MAX_SLOPE.
    """
    i, j = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / STEP_M).astype(np.int64).T
    square = j * (i.max() + 1) + i
    count = np.bincount(square)
    mean = np.column_stack([np.bincount(square, weights=xyz[:, k]) for k in range(3)])
    mean = mean[count > 0] / count[count > 0, None]
    x, y = np.meshgrid(x0 + STEP_M * np.arange(shape[1]), y0 + STEP_M * np.arange(shape[0]))
    z = np.full(shape, np.nan)
    if len(mean) > 3:
        z = LinearNDInterpolator(mean[:, :2], mean[:, 2])(x, y)
    beyond = ~np.isfinite(z)
    at = np.column_stack([x[beyond], y[beyond]])
    _, near = cKDTree(mean[:, :2]).query(at, min(BEYOND, len(mean)))
    z[beyond] = np.median(mean[near, 2].reshape(len(at), -1), axis=1)
    return _less_steep(z)


def _less_steep(z: np.ndarray) -> np.ndarray:
    """Heights that no slope along x or y exceeds MAX_SLOPE / √2: what is steeper gives way."""
    rise = MAX_SLOPE / math.sqrt(2) * STEP_M
    while True:
        lower = z.copy()
        for axis in (0, 1):
            ahead, behind = np.roll(lower, -1, axis), np.roll(lower, 1, axis)
            last = [slice(None)] * 2
            last[axis] = -1
            ahead[tuple(last)] = np.inf
            last[axis] = 0
            behind[tuple(last)] = np.inf
            lower = np.minimum(lower, np.minimum(ahead, behind) + rise)
        if np.array_equal(lower, z):
            return z
        z = lower


def is_leaf(points: Points) -> np.ndarray:
    """Which points above the ground are leaves, bool[n]; the others are roofs.

    By their class; where the file has no classes of roofs or of plants, by how rough the surface is
    around them and how many pulses went through it, as most of their neighbours say.
    """
    if points.has_class(*CLASSES) and points.has_class(*ROOFS):
        return np.isin(points.label, CLASSES)
    if len(points.xyz) <= NEIGHBOURS:
        return np.zeros(len(points.xyz), bool)
    near = cKDTree(points.xyz).query(points.xyz, NEIGHBOURS)[1]
    _, rough = local_planes(points.xyz, near)
    several = np.mean(~points.single[near], axis=1)
    leaf = (rough > ROUGH_M) | (several > SEVERAL)
    for _ in range(3):
        leaf = np.mean(leaf[near], axis=1) > 0.5
    return leaf


class Crowns(NamedTuple):
    """``ellipsoids`` float64[n, 6] and their ``style`` [n, 2], as in :class:`.surfaces.Surfaces`;
    ``tree`` [n]: number of the tree that one is part of; ``foot`` [n]: z of the ground below."""

    ellipsoids: np.ndarray
    style: np.ndarray
    tree: np.ndarray
    foot: np.ndarray


def crowns_of(points: Points, ground: np.ndarray, rng: np.random.Generator) -> Crowns:
    """The crowns whose leaves are ``points``; ``ground`` [n]: z of the ground below each of them.

    A tree is what lies nearest to the highest top of TREE_M².
    """
    first = np.flatnonzero(points.first)
    top = first[thinned(points.xyz[first], SPACING_M)]
    xyz, foot = points.xyz[top], ground[top]
    tall = xyz[:, 2] - foot
    bottom = np.maximum(foot + BOTTOM * tall, xyz[:, 2] - DEPTH_M)
    half = np.maximum((xyz[:, 2] - bottom) / 2, 0.4)
    radius = rng.uniform(*RADIUS_M, len(top))
    crowns = np.column_stack([xyz[:, :2], xyz[:, 2] - half, radius, half, (radius / half) ** 2])
    light = np.full(len(top), 1.0) if points.tint is None else points.tint[top] / LEAF
    style = np.column_stack([np.clip(light, 0.4, 1.6), np.full(len(top), POROSITY)])
    tree = np.zeros(len(top), np.int64)
    if len(top):
        tree = cKDTree(xyz[thinned(xyz, TREE_M), :2]).query(xyz[:, :2])[1]
    return Crowns(crowns, style, tree, foot)
