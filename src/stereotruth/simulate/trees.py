"""Trees of a city."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from .cities import CitySpec
from .layout import near_scenes
from .surfaces import CELL_M, Surfaces, terrain_heights
from .terrain import TEXTURE_SIZE


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
