"""The worlds of both images and of the LiDAR, each at its date: objects, ground and water.

Each thing that changes does so at a moment of its own, drawn between the first and the last date. A
world holds what stands at its date. Objects carry the bits of their worlds; ground, water, the
texture of streets and the roofs of twins are those of :func:`world_of`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .cities import CitySpec
from .patches import NOTHING
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


def dated_trees(
    city: CitySpec,
    trees: np.ndarray,
    group: np.ndarray | None = None,
    foot: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Crowns, the bits of their worlds, and which of ``trees`` [n, 6] each of them is.

    Those that have grown are there with young ones in their place. ``group`` [n]: the tree that a
    crown is part of, each is one without; ``foot`` [n]: z that a tree grows from, as far below its
    middle as it is high without.
    """
    view = np.full(len(trees), IN_IMAGES | IN_LIDAR, np.uint8)
    if city.dates is None:
        return trees, view, np.arange(len(trees))
    group = np.arange(len(trees)) if group is None else group
    above = 2.0 * trees[:, 4] if foot is None else trees[:, 2] - foot
    rng = np.random.default_rng([city.world_seed, 8])
    count = int(group.max(initial=-1)) + 1
    kind, moment = _drawn(rng, count, city.dates.felled, city.dates.grown)
    kind, moment = kind[group], moment[group]
    before, after = _moments(city, moment)
    view = np.select([kind == 0, kind == 1], [before, after], view)
    grown = np.flatnonzero(kind == 1)
    young = trees[grown].copy()
    young[:, 2] -= (1.0 - YOUNG) * above[grown]
    young[:, 3:5] *= YOUNG
    which = np.concatenate([np.arange(len(trees)), grown])
    view = np.concatenate([view, before[grown]]).astype(np.uint8)
    return np.concatenate([trees, young]), view, which


def dated_patches(city: CitySpec, s: Surfaces, passed: float) -> np.ndarray:
    """The patches of a twin where a share of the time has ``passed``, as Surfaces has them."""
    dates, rng = city.dates, np.random.default_rng([city.world_seed, 7])
    count = int(s.patch_building.max(initial=-1)) + 1
    kind, moment = _drawn(rng, count, dates.built, dates.demolished, dates.raised)
    rise = rng.uniform(*STOREYS_M, count)
    is_past = passed >= moment
    gone = np.append(np.where(kind == 0, ~is_past, (kind == 1) & is_past), False)
    higher = np.append(np.where((kind == 2) & is_past, rise, 0.0), 0.0)
    patches = s.patches.copy()
    patches[..., 0] = np.where(
        gone[s.patch_building], NOTHING, patches[..., 0] + higher[s.patch_building]
    )
    return patches


def world_of(city: CitySpec, s: Surfaces, world: str) -> Surfaces:
    """A city's surfaces at the date of a ``world``: left, right or lidar."""
    if city.dates is None:
        return s
    passed = city.dates.passed(world)
    terrain = s.terrain
    if city.dates.crops:
        terrain = terrain + _crops(city, s, passed)
    if s.patches.size:
        s = s._replace(patches=dated_patches(city, s, passed))
    water = s.water + city.dates.water_m * passed
    return s._replace(terrain=terrain, water=water, resurfaced=city.dates.resurfaced * passed)


def _crops(city: CitySpec, s: Surfaces, passed: float) -> np.ndarray:
    """By how much the terrain's coefficients [ny, nx] stand higher under crops, m."""
    from scipy.spatial import cKDTree  # slow to import, and most cities have one date

    from .layout import ZONE_KINDS

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
