"""Vehicles on the streets of a city: each image and the LiDAR have them elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from .appearance import VEHICLE
from .cities import CitySpec
from .surfaces import CELL_M, IN_IMAGES, IN_LEFT, IN_LIDAR, IN_RIGHT, Surfaces, terrain_heights
from .zones import BUILT

CAR_M = (4.4, 1.8, 1.5)  # length, width, height
VAN_M = (7.5, 2.3, 2.8)
VANS = 0.12  # share of the vehicles
NARROWEST_M = 3.5  # half width of a street that vehicles use
LANE = 0.35  # distance from the middle over half the width
SLOW_M = (0.5, 6.0)  # way of a vehicle in slow traffic between the views
APART_M = 15.0  # more than two bodies and the ways of both
PARKED, SLOW, LEAVING, COMING = 0.25, 0.35, 0.15, 0.15  # shares; the others are in the LiDAR only


class Placed(NamedTuple):
    """Boxes, the bits of their views, and their style, as in :class:`.surfaces.Surfaces`."""

    boxes: np.ndarray
    view: np.ndarray
    style: np.ndarray


def place_vehicles(city: CitySpec, s: Surfaces, sites: cKDTree) -> Placed:
    """Vehicles of a city: parked ones, some that creep between the views, some in one of them."""
    rng = np.random.default_rng([city.world_seed, 5])
    ny, nx = s.cell_top.shape
    size = np.array([nx, ny]) * CELL_M
    count = round(city.character.vehicles * size.prod() / 1e4)
    if not count:
        return Placed(np.zeros((0, 8)), np.zeros(0, np.uint8), np.zeros((0, 4)))
    xy = rng.uniform(0, 1, (count, 2)) * size + [s.x0, s.y0]
    zone = s.zones[sites.query(xy)[1]]
    cos, sin = zone[:, 2], zone[:, 3]
    p, q = xy[:, 0] * cos + xy[:, 1] * sin, xy[:, 1] * cos - xy[:, 0] * sin
    lane = rng.choice([-1.0, 1.0], count) * LANE * zone[:, 6]
    along_q = rng.random(count) < 0.5
    p = np.where(along_q, np.rint(p / zone[:, 4]) * zone[:, 4] + lane, p)
    q = np.where(along_q, q, np.rint(q / zone[:, 5]) * zone[:, 5] + lane)
    heading = np.column_stack([np.where(along_q, -sin, cos), np.where(along_q, cos, sin)])
    xy = np.column_stack([p * cos - q * sin, p * sin + q * cos])
    body = np.where((rng.random(count) < VANS)[:, None], VAN_M, CAR_M)
    paint = rng.choice([0.06, 0.12, 0.25, 0.55, 0.75], count) * rng.uniform(0.9, 1.1, count)
    way = rng.choice([-1.0, 1.0], count) * rng.uniform(*SLOW_M, count)
    state = np.searchsorted(np.cumsum([PARKED, SLOW, LEAVING, COMING]), rng.random(count))
    views = np.array([IN_IMAGES, IN_LEFT, IN_LEFT, IN_RIGHT, IN_LIDAR], np.uint8)[state]
    if city.dates is not None and city.dates.left != city.dates.right:
        # no vehicle waits from one image to the other
        views = np.where(views == IN_IMAGES, IN_LEFT << (np.arange(count) % 2), views)
    slow = np.flatnonzero(state == 1)
    street = (zone[:, 7] < len(BUILT)) & (zone[:, 6] > NARROWEST_M)
    street[cKDTree(xy).query_pairs(APART_M, output_type="ndarray").max(axis=1, initial=-1)] = False

    order = np.concatenate([np.arange(count), slow])
    at = np.concatenate([xy, xy[slow] + way[slow, None] * heading[slow]])
    view = np.concatenate([views, np.full(len(slow), IN_RIGHT, np.uint8)])
    a, b = body[order, 0] / 2, body[order, 1] / 2
    corners = np.stack([
        at + i * a[:, None] * heading[order] + j * b[:, None] * heading[order][:, ::-1] * [-1, 1]
        for i in (-1, 1) for j in (-1, 1)
    ])  # fmt: skip
    z = terrain_heights(s, corners.reshape(-1, 2))[:, 0].reshape(4, -1)
    boxes = np.column_stack(
        [at, heading[order], a, b, z.max(axis=0) + body[order, 2], np.zeros(len(at))]
    )
    style = np.column_stack(
        [paint[order], 0.7 * paint[order], np.full(len(at), float(VEHICLE)), 97.0 * order]
    )
    middle = np.array([s.x0, s.y0]) + size / 2
    inside = (np.abs(corners - middle) < size / 2 - 1.0).all((0, 2))
    keep = street[order] & inside & (z.min(axis=0) > s.water + 0.5)
    return Placed(boxes[keep], view[keep], style[keep])
