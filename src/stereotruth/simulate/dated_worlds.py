"""The worlds of both images and of the LiDAR, each at its date: objects, ground and water.

Each thing that changes does so at a moment of its own, drawn between the first and the last date. A
world holds what stands at its date. Objects carry the bits of their worlds; ground, water and the
texture of streets are those of :func:`world_of`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .cities import CitySpec
from .surfaces import IN_IMAGES, IN_LEFT, IN_LIDAR, IN_RIGHT, Surfaces

WORLDS = {"left": IN_LEFT, "right": IN_RIGHT, "lidar": IN_LIDAR}
STOREYS_M = (3.0, 15.0)  # least and greatest height by which a building is raised
CROP_M = (1.2, 3.0)  # by which a crop is higher than another
YOUNG = 0.45  # size of a crown before it has grown, over its size then
EDGE_M = 4.0  # of a field's block, where its crop ends


class Moments(NamedTuple):
    """Bits of the worlds ``before`` and ``after`` the moments [n] at which things change."""

    before: np.ndarray
    after: np.ndarray


def _moments(city: CitySpec, moment: np.ndarray) -> Moments:
    """``moment``: in (0, 1], of the time from the first date to the last."""
    before = np.zeros(moment.shape, np.uint8)
    for world, bit in WORLDS.items():
        before |= np.where(city.dates.passed(world) < moment, bit, 0).astype(np.uint8)
    after = np.uint8(IN_LEFT | IN_RIGHT | IN_LIDAR) & ~before
    return Moments(_both_images(before), _both_images(after))


def _both_images(view: np.ndarray) -> np.ndarray:
    """Bits with IN_IMAGES in place of IN_LEFT and IN_RIGHT together."""
    both = view & (IN_LEFT | IN_RIGHT) == IN_LEFT | IN_RIGHT
    return np.where(both, view & IN_LIDAR | IN_IMAGES, view).astype(np.uint8)


def _drawn(rng: np.random.Generator, count: int, *shares: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``shares`` each of so many things belongs to (their number: none), and moments."""
    kind = np.searchsorted(np.cumsum(shares), rng.random(count), side="right")
    return kind, 1.0 - rng.random(count)


def dated_buildings(
    city: CitySpec, group: np.ndarray, boxes: np.ndarray, style: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes [n, 8], their style and the bits of their worlds, with those that raised buildings
    have. ``group`` [n]: the building that a box is part of."""
    dates, rng = city.dates, np.random.default_rng([city.world_seed, 7])
    count = int(group.max(initial=-1)) + 1
    kind, moment = _drawn(rng, count, dates.built, dates.demolished, dates.raised)
    rise = rng.uniform(*STOREYS_M, count)
    kind, moment, rise = kind[group], moment[group], rise[group]
    before, after = _moments(city, moment)
    view = np.full(len(boxes), IN_IMAGES | IN_LIDAR, np.uint8)
    view = np.select([kind == 0, kind == 1, kind == 2], [after, before, before], view)
    raised = np.flatnonzero(kind == 2)
    higher = boxes[raised].copy()
    higher[:, 6] += rise[raised]
    boxes = np.concatenate([boxes, higher])
    view = np.concatenate([view, after[raised]]).astype(np.uint8)
    return boxes, np.concatenate([style, style[raised]]), view


def dated_trees(city: CitySpec, trees: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Crowns [n, 6] and the bits of their worlds, with the young ones of those that have grown."""
    view = np.full(len(trees), IN_IMAGES | IN_LIDAR, np.uint8)
    if city.dates is None:
        return trees, view
    rng = np.random.default_rng([city.world_seed, 8])
    kind, moment = _drawn(rng, len(trees), city.dates.felled, city.dates.grown)
    before, after = _moments(city, moment)
    view = np.select([kind == 0, kind == 1], [before, after], view)
    grown = np.flatnonzero(kind == 1)
    young = trees[grown].copy()
    young[:, 2] -= (1.0 - YOUNG) * 2.0 * young[:, 4]
    young[:, 3:5] *= YOUNG
    return np.concatenate([trees, young]), np.concatenate([view, before[grown]]).astype(np.uint8)


def world_of(city: CitySpec, s: Surfaces, world: str) -> Surfaces:
    """A city's surfaces at the date of a ``world``: left, right or lidar."""
    if city.dates is None:
        return s
    passed = city.dates.passed(world)
    terrain = s.terrain
    if city.dates.crops:
        terrain = terrain + _crops(city, s, passed)
    water = s.water + city.dates.water_m * passed
    return s._replace(terrain=terrain, water=water, resurfaced=city.dates.resurfaced * passed)


def _crops(city: CitySpec, s: Surfaces, passed: float) -> np.ndarray:
    """By how much the terrain's coefficients [ny, nx] stand higher under crops, m."""
    from scipy.spatial import cKDTree  # slow to import, and most cities have one date

    from .zones import ZONE_KINDS

    ny, nx = s.terrain.shape
    x, y = np.meshgrid(s.x0 + s.step * np.arange(nx), s.y0 + s.step * np.arange(ny))
    number = cKDTree(s.zones[:, :2]).query(np.column_stack([x.ravel(), y.ravel()]))[1]
    zone = s.zones[number.reshape(ny, nx)]
    cos, sin, length, width = np.moveaxis(zone[..., 2:6], -1, 0)
    p, q = x * cos + y * sin, y * cos - x * sin
    edge = np.minimum(
        np.minimum(p % length, length - p % length), np.minimum(q % width, width - q % width)
    )
    field = (zone[..., 7] == ZONE_KINDS.index("fields")) & (edge > EDGE_M)
    block = np.column_stack([
        number.reshape(ny, nx)[field], p[field] // length[field], q[field] // width[field]
    ])  # fmt: skip
    distinct, which = np.unique(block, axis=0, return_inverse=True)
    rng = np.random.default_rng([city.world_seed, 9])
    kind, moment = _drawn(rng, len(distinct), city.dates.crops)
    height = rng.uniform(*CROP_M, len(distinct))
    is_tall = (passed < moment) == (rng.random(len(distinct)) < 0.5)
    rise = np.zeros((ny, nx))
    rise[field] = np.where((kind == 0) & is_tall, height, 0.0)[which.reshape(-1)]
    return rise
