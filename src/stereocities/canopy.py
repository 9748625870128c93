"""Trees of a city: crowns with rough tops, single, in rows and in forest, with leaves or without.

A crown is the union of ellipsoids: a core, and lobes that stand out of its upper half. Rays meet it
exactly, as they meet each of its ellipsoids. Without leaves it is a few boughs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from .cities import Canopy, CitySpec
from .layout import near_scenes
from .surfaces import CELL_M, IN_IMAGES, IN_LEFT, IN_LIDAR, IN_RIGHT, Surfaces, terrain_heights
from .terrain import TEXTURE_SIZE, spectral_noise

ROW_STEP = 2.3  # distance of crowns in a row over their mean radius
DENSE = 3.0  # ground of a crown in a forest over the square of its mean radius
WOODS_M = (80.0, 600.0)  # wavelengths of where woods are
WOODS_STEP_M, WOODS_SIZE = 8.0, 512
CORE = 0.85  # of a crown's radius and half height
LOBE = (0.28, 0.42)  # radius of a lobe over the crown's
BOUGHS, BOUGH = 3, 0.16  # number, and radius over the crown's


class Placed(NamedTuple):
    """Ellipsoids, the bits of their views, and their style, as in :class:`.surfaces.Surfaces`."""

    crowns: np.ndarray
    view: np.ndarray
    style: np.ndarray


def place_canopy(
    city: CitySpec, canopy: Canopy, s: Surfaces, sites: cKDTree, boxes: np.ndarray
) -> Placed:
    """The crowns of a canopy on dry ground near the scenes, clear of walls."""
    rng = np.random.default_rng([city.world_seed, 4])
    xy = _ARRANGEMENTS[canopy.arrangement](canopy, s, sites, rng)
    radius = rng.uniform(*canopy.radius_m, len(xy))
    half = radius * rng.uniform(*canopy.slimness, len(xy))
    trunk = rng.uniform(*canopy.trunk_m, len(xy))
    ground = terrain_heights(s, xy)[:, 0]
    trees = np.column_stack([xy, ground + trunk + half, radius, half, (radius / half) ** 2])
    keep = near_scenes(city, xy, city.margin_m - 60) & (ground > s.water + 0.5)
    trees = trees[keep]
    trees = trees[clear_of_walls(trees, boxes)]
    leafy = _with_lobes(trees, canopy.lobes, rng)
    boughs = _boughs(trees, rng)
    bare = [bit for bit, view in ((IN_LEFT, city.left), (IN_RIGHT, city.right)) if view.bare]
    if not bare:
        seen_leaves, boughs = IN_IMAGES | IN_LIDAR, boughs[:0]
    else:
        seen_leaves = IN_LIDAR | ((IN_LEFT | IN_RIGHT) & ~sum(bare))
    return Placed(
        np.concatenate([leafy, boughs]),
        np.repeat(np.array([seen_leaves, sum(bare)], np.uint8), [len(leafy), len(boughs)]),
        np.repeat(
            [[canopy.brightness, canopy.porosity], [canopy.brightness, 0.0]],
            [len(leafy), len(boughs)],
            axis=0,
        ),
    )


def _area(s: Surfaces) -> tuple[float, float]:
    ny, nx = s.cell_top.shape
    return nx * CELL_M, ny * CELL_M


def _anywhere(ground_m2: float, s: Surfaces, rng: np.random.Generator) -> np.ndarray:
    width, height = _area(s)
    count = round(width * height / ground_m2)
    return rng.uniform(0, 1, (count, 2)) * [width, height] + [s.x0, s.y0]


def _single(canopy: Canopy, s: Surfaces, sites: cKDTree, rng: np.random.Generator) -> np.ndarray:
    """Places [n, 2] drawn one by one."""
    del sites
    return _anywhere(canopy.ground_m2, s, rng)


def _forest(canopy: Canopy, s: Surfaces, sites: cKDTree, rng: np.random.Generator) -> np.ndarray:
    """Places [n, 2] of woods with glades: dense where a smooth random field is high."""
    del sites
    dense_m2 = DENSE * np.mean(canopy.radius_m) ** 2
    share = min(dense_m2 / canopy.ground_m2, 1.0)
    field = spectral_noise(rng, (WOODS_SIZE, WOODS_SIZE), WOODS_STEP_M, WOODS_M, 2.0)
    xy = _anywhere(dense_m2, s, rng)
    i, j = ((xy - [s.x0, s.y0]) / WOODS_STEP_M).astype(int).T
    value = field[j % WOODS_SIZE, i % WOODS_SIZE]
    return xy[value >= np.quantile(value, 1.0 - share)]


def _rows(canopy: Canopy, s: Surfaces, sites: cKDTree, rng: np.random.Generator) -> np.ndarray:
    """Places [n, 2] in straight rows along the blocks of each zone."""
    step = ROW_STEP * float(np.mean(canopy.radius_m))
    apart = canopy.ground_m2 / step
    width, height = _area(s)
    reach = 2.0 * math.sqrt(width * height / max(len(s.zones), 1))
    found = []
    for n, zone in enumerate(s.zones):
        along, across = np.arange(-reach, reach, step), np.arange(-reach, reach, apart)
        p, q = (a.ravel() for a in np.meshgrid(along, across))
        p = p + rng.uniform(-0.2, 0.2, p.size) * step
        q = q + rng.uniform(-0.3, 0.3, q.size) + rng.uniform(0, apart)
        cos, sin = zone[2:4]
        xy = zone[:2] + np.column_stack([p * cos - q * sin, p * sin + q * cos])
        inside = ((xy > [s.x0, s.y0]) & (xy < [s.x0 + width, s.y0 + height])).all(axis=1)
        xy = xy[inside]
        found.append(xy[sites.query(xy)[1] == n] if len(xy) else xy)
    return np.concatenate(found)


_ARRANGEMENTS = {"single": _single, "rows": _rows, "forest": _forest}


def _ellipsoids(centre: np.ndarray, radius: np.ndarray, half: np.ndarray) -> np.ndarray:
    return np.column_stack([centre, radius, half, (radius / half) ** 2])


def _with_lobes(trees: np.ndarray, lobes: int, rng: np.random.Generator) -> np.ndarray:
    """The ellipsoids of crowns [n, 6], none wider than the crown; smooth without lobes."""
    if not lobes:
        return trees
    core = _ellipsoids(trees[:, :3], CORE * trees[:, 3], CORE * trees[:, 4])
    n = len(trees)
    turn = rng.uniform(0, 2 * math.pi, (n, 1)) + np.arange(lobes) * math.pi * (3 - math.sqrt(5))
    up = (np.arange(lobes) + rng.uniform(0.1, 0.9, (n, lobes))) / lobes  # sine of the elevation
    size = rng.uniform(*LOBE, (n, lobes))
    # so far out that a lobe ends where the crown's own ellipsoid does
    out, level = 1.0 - size, np.sqrt(1.0 - up * up)
    centre = np.stack(
        [
            trees[:, :1] + trees[:, 3:4] * out * level * np.cos(turn),
            trees[:, 1:2] + trees[:, 3:4] * out * level * np.sin(turn),
            trees[:, 2:3] + trees[:, 4:5] * out * up,
        ],
        axis=-1,
    )
    radius, half = trees[:, 3:4] * size, trees[:, 4:5] * size
    lobe = _ellipsoids(centre.reshape(-1, 3), radius.ravel(), half.ravel())
    return np.concatenate([core, lobe])


def _boughs(trees: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The ellipsoids of crowns [n, 6] without leaves: upright boughs about the middle."""
    n = len(trees)
    turn = rng.uniform(0, 2 * math.pi, (n, BOUGHS))
    away = rng.uniform(0.0, 0.5, (n, BOUGHS)) * trees[:, 3:4]
    centre = np.stack(
        [
            trees[:, :1] + away * np.cos(turn),
            trees[:, 1:2] + away * np.sin(turn),
            np.repeat(trees[:, 2:3], BOUGHS, axis=1),
        ],
        axis=-1,
    )
    radius = np.repeat(BOUGH * trees[:, 3:4], BOUGHS, axis=1)
    half = np.repeat(0.8 * trees[:, 4:5], BOUGHS, axis=1)
    return _ellipsoids(centre.reshape(-1, 3), radius.ravel(), half.ravel())


def place_trees(
    city: CitySpec, rng: np.random.Generator, s: Surfaces, sites: cKDTree, boxes: np.ndarray
) -> np.ndarray:
    """Crowns float64[n, 6] on a jittered grid, as dense as the land use has them."""
    ny, nx = s.cell_top.shape
    pitch = 6.4
    columns, rows = int(nx * CELL_M / pitch), int(ny * CELL_M / pitch)
    jj, ii = np.mgrid[0:rows, 0:columns]
    xy = np.column_stack([ii.ravel(), jj.ravel()]) + rng.uniform(0.12, 0.88, (rows * columns, 2))
    xy = xy * pitch + [s.x0, s.y0]
    xy = xy[near_scenes(city, xy, city.margin_m - 60)]
    zone = sites.query(xy)[1]
    z = s.zones[zone]
    kind = z[:, 7].astype(int)
    share = np.array([0.10, 0.16, 0.05, 0.16, 0.05, 0.42, 0.012, 0.93, 0.10])[kind]
    p = xy[:, 0] * z[:, 2] + xy[:, 1] * z[:, 3]
    q = xy[:, 1] * z[:, 2] - xy[:, 0] * z[:, 3]
    edge = np.minimum.reduce(
        [p % z[:, 4], z[:, 4] - p % z[:, 4], q % z[:, 5], z[:, 5] - q % z[:, 5]]
    )
    built = kind < 5
    avenue = built & (edge > z[:, 6]) & (edge < z[:, 6] + 3.2)
    share = np.where(avenue, 0.5, share)
    share = np.where(built & (edge < z[:, 6] + 0.5), 0.0, share)
    hedge = (kind == 6) & (edge < 2.5) & (np.floor(p / z[:, 4]) % 4 == 0)
    share = np.where(hedge, 0.4, share)
    t = terrain_heights(s, xy)
    slope = np.hypot(t[:, 1], t[:, 2])
    share = np.where((slope > 0.2) & (kind != 8), np.maximum(share, 0.7), share)
    share = np.clip(share * city.character.trees, 0, 0.97)
    # woods have clearings
    clump = s.broad[
        (xy[:, 1] / 4).astype(int) % TEXTURE_SIZE, (xy[:, 0] / 4).astype(int) % TEXTURE_SIZE
    ]
    share = share * np.clip(1.15 + 0.5 * clump, 0.15, 1.2)
    keep = (rng.random(len(xy)) < share) & (t[:, 0] > s.water + 0.5)
    wood = (share > 0.45)[keep]
    xy, ground = xy[keep], t[keep, 0]
    radius = np.where(wood, rng.uniform(2.6, 4.4, len(xy)), rng.uniform(1.5, 3.1, len(xy)))
    half = radius * rng.uniform(0.75, 1.1, len(xy))
    trunk = rng.uniform(0.2, 2.2, len(xy)) + np.where(wood, 2.0, 0.0)
    trees = np.column_stack(
        [xy, ground + trunk + half, radius, half, radius * radius / (half * half)]
    )
    return trees[clear_of_walls(trees, boxes)]


def clear_of_walls(trees: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Which crowns [n, 6] stand in no wall, bool[n]."""
    free = np.ones(len(trees), bool)
    if len(boxes) and len(trees):
        near = cKDTree(boxes[:, :2])
        biggest = np.hypot(boxes[:, 4], boxes[:, 5])
        order = np.argsort(-biggest)
        split = [order[biggest[order] > 25], order[biggest[order] <= 25]]
        for part in split:
            if not len(part):
                continue
            tree = cKDTree(boxes[part, :2]) if len(part) < len(boxes) else near
            pairs = cKDTree(trees[:, :2]).query_ball_tree(tree, float(biggest[part].max()) + 4.5)
            count = np.array([len(m) for m in pairs])
            which = np.repeat(np.arange(len(trees)), count)
            if not len(which):
                continue
            against = part[np.concatenate([np.array(m, int) for m in pairs if m])]
            b = boxes[against]
            dx, dy = trees[which, 0] - b[:, 0], trees[which, 1] - b[:, 1]
            u = np.abs(dx * b[:, 2] + dy * b[:, 3]) - b[:, 4]
            v = np.abs(dy * b[:, 2] - dx * b[:, 3]) - b[:, 5]
            gap = np.hypot(np.maximum(u, 0), np.maximum(v, 0))
            free[which[gap < trees[which, 3] * 0.95 + 0.3]] = False
    return free
