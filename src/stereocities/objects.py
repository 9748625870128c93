"""Buildings and trees of a drawn city.

Buildings stand block by block of the land use; a few of them change between images and LiDAR.
Crowns have rough tops, single, in rows and in forest, with leaves or without: a crown is the union
of ellipsoids, a core and lobes that stand out of its upper half; without leaves it is a few boughs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .cities import Canopy, CitySpec
from .layout import (
    BUILT,
    TEXTURE_SIZE,
    ZONE_KINDS,
    half_size,
    near_scenes,
    scene_coordinates,
    spectral_noise,
)
from .surfaces import (
    CELL_M,
    IN_IMAGES,
    IN_LEFT,
    IN_LIDAR,
    IN_RIGHT,
    Objects,
    Surfaces,
    terrain_heights,
)

FLAT, GRAVEL, TILES, SHEET = range(4)

ROW_STEP = 2.3  # distance of crowns in a row over their mean radius
DENSE = 3.0  # ground of a crown in a forest over the square of its mean radius
WOODS_M = (80.0, 600.0)  # wavelengths of where woods are
WOODS_STEP_M, WOODS_SIZE = 8.0, 512
CORE = 0.85  # of a crown's radius and half height
LOBE = (0.28, 0.42)  # radius of a lobe over the crown's
BOUGHS, BOUGH = 3, 0.16  # number, and radius over the crown's


@dataclass(frozen=True)
class House:
    """A building to be: a box, perhaps with a wing that makes an L, and with small ones on top.

    Metres: its middle (``cx``, ``cy``) in plan, ``length`` along ``angle`` (radians), ``height`` of
    the eaves over the highest ground below, ``rise`` of a gabled roof over them, ``wing`` (length,
    width), ``steepest`` difference of the ground that it bears. ``top``: whether there may be small
    boxes on a flat roof; ``cover``: of the roof, None for one that goes with its form.
    """

    cx: float
    cy: float
    angle: float
    length: float
    width: float
    height: float
    rise: float = 0.0
    wing: tuple[float, float] | None = None
    steepest: float = 4.0
    top: bool = True
    cover: int | None = None


class _Builder:
    """Collects buildings; refuses those that do not fit the ground."""

    def __init__(self, city: CitySpec, s: Surfaces, sites: cKDTree, rng: np.random.Generator):
        self.city, self.s, self.sites, self.rng = city, s, sites, rng
        self.zone_cells = s.zone_cells.tolist()
        self.boxes: list[tuple[float, ...]] = []
        self.style: list[tuple[float, ...]] = []
        self.group: list[int] = []
        self.groups = 0
        self.chance = np.random.default_rng([city.world_seed, 3])  # of what is not built

    def add(self, zone: int, house: House) -> bool:
        """Build a house of a zone (-1: of any) if it fits; whether it does."""
        cx, cy, wing, rise = house.cx, house.cy, house.wing, house.rise
        ux, uy = math.cos(house.angle), math.sin(house.angle)
        a, b = house.length / 2, house.width / 2
        corner = np.array([[cx - a * ux + b * uy, cy - a * uy - b * ux]])
        if not near_scenes(self.city, corner, self.city.margin_m - 40)[0]:
            return False
        here = self.zone_cells[int((cy - self.s.y0) / CELL_M)][int((cx - self.s.x0) / CELL_M)]
        if zone >= 0 and here >= 0 and here != zone:
            return False
        parts = [(cx, cy, ux, uy, a, b)]
        if wing is not None:
            # at the end of the body, reaching out to +v
            wa, wb = wing[1] / 2, wing[0] / 2
            du, dv = a - wa, b + wb - 2.0
            parts.append((cx + du * ux - dv * uy, cy + du * uy + dv * ux, ux, uy, wa, wb + 0.0))
        corners = np.array([
            (px + i * pa * ux - j * pb * uy, py + i * pa * uy + j * pb * ux)
            for px, py, _, _, pa, pb in parts
            for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0))
        ])  # fmt: skip
        if zone >= 0 and (self.sites.query(corners)[1] != zone).any():
            return False
        if self.chance.random() >= self.city.character.buildings:
            return False
        if self.city.character.flat_roofs:
            rise = 0.0
        z = terrain_heights(self.s, corners)[:, 0]
        if z.min() < self.s.water + 0.6 or z.max() - z.min() > house.steepest:
            return False
        rng = self.rng
        eaves = z.max() + house.height
        roof = min(max(rng.lognormal(math.log(0.33), 0.42), 0.12), 0.85)
        walls = rng.uniform(0.22, 0.55)
        cover = house.cover
        if cover is None:
            cover = TILES if rise > 1.2 else (FLAT, GRAVEL, FLAT, SHEET)[rng.integers(4)]
        for part in parts:
            self._put((*part, eaves, rise if wing is None else 0.0), (roof, walls, cover))
        broad = min(house.length, house.width) > 9.5
        if house.top and rise == 0 and broad and house.height > 9:
            for _ in range(int(rng.integers(1, 3 if house.length < 35 else 4))):
                ta, tb = rng.uniform(1.6, 3.4), rng.uniform(1.4, 2.6)
                du = rng.uniform(-1, 1) * (a - ta - 2.2)
                dv = rng.uniform(-1, 1) * (b - tb - 1.8)
                part = (cx + du * ux - dv * uy, cy + du * uy + dv * ux, ux, uy, ta, tb)
                self._put((*part, eaves + rng.uniform(2.0, 3.6), 0.0), (roof * 0.9, walls, FLAT))
        self.groups += 1
        return True

    def _put(self, box: tuple[float, ...], style: tuple[float, ...]) -> None:
        self.boxes.append(box)
        self.style.append((*style, self.rng.uniform(0, 1000)))
        self.group.append(self.groups)


def _plots(
    size: tuple[float, float], pitch: tuple[float, float], empty: float, rng: np.random.Generator
) -> Iterator[tuple[float, float, float, float]]:
    """Middles and sides of the plots of about a ``pitch`` of a block, but for a share of them."""
    columns, lanes = (max(1, int(side // step)) for side, step in zip(size, pitch))
    width, height = size[0] / columns, size[1] / lanes
    for i in range(columns):
        for j in range(lanes):
            if rng.random() >= empty:
                yield (i + 0.5) * width, (j + 0.5) * height, width, height


def _fill_block(build: _Builder, zone: int, kind: str, at, size, angle, towers) -> None:
    """Buildings of one block. ``at(p, q)``: block coordinates (m) to plan; ``size``: inside."""
    rng = build.rng
    w, h = size
    if kind == "towers":
        columns = 3 if rng.random() < 0.5 else 2
        pitch_w, pitch_h = w / columns, h / 2
        podium = rng.random() < 0.35
        for i in range(columns):
            for j in range(2):
                if rng.random() < 0.12:
                    continue
                length, width = rng.uniform(15, min(31, pitch_w - 9)), rng.uniform(15, 23)
                x, y = at((i + 0.5) * pitch_w + rng.uniform(-2, 2), (j + 0.5) * pitch_h)
                tall = rng.uniform(*towers)
                if build.add(zone, House(x, y, angle, length, width, tall)) and podium:
                    build.groups -= 1  # the podium goes with its tower
                    length = min(length + 12, pitch_w - 4)
                    low = rng.uniform(7, 11)
                    build.add(zone, House(x, y, angle, length, width + 12, low, top=False))
    elif kind == "slabs":
        lanes = 3
        for j in range(lanes):
            p = 2.0
            storeys = int(rng.integers(6, 12))
            while p < w - 26:
                length = min(rng.uniform(32, 58), w - 2 - p)
                x, y = at(p + length / 2, (j + 0.5) * h / lanes)
                width = rng.uniform(11, 13.5)
                build.add(zone, House(x, y, angle, length, width, 3.0 * storeys + 1))
                p += length + rng.uniform(7, 12)
    elif kind == "lowrise":
        for p, q, pitch_w, pitch_h in _plots(size, (21, 18), 0.1, rng):
            length, width = rng.uniform(11, pitch_w - 2.5), rng.uniform(9, pitch_h - 3)
            x, y = at(p, q)
            rise = rng.uniform(1.5, 3) if rng.random() < 0.25 else 0.0
            turned = angle + rng.normal(0, 0.015)
            height = 3.1 * int(rng.integers(2, 7))
            build.add(zone, House(x, y, turned, length, width, height, rise))
    elif kind == "village":
        for p, q, _, _ in _plots(size, (17, 16), 0.28, rng):
            length, width = rng.uniform(9.5, 13), rng.uniform(7.5, 10)
            x, y = at(p, q)
            gabled = rng.random() < 0.5
            wing = None
            if not gabled and rng.random() < 0.25:
                length, width, wing = 12.0, 6.5, (6.0, 5.0)
            turned = angle + rng.normal(0, 0.05)
            height = 3.0 * int(rng.integers(1, 4)) + 0.5
            rise = rng.uniform(1.8, 3.0) if gabled else 0.0
            build.add(zone, House(x, y, turned, length, width, height, rise, wing))
    elif kind == "industry":
        lanes = 2 if rng.random() < 0.6 else 3
        for j in range(lanes):
            p = 3.0
            while p < w - 40:
                length = min(rng.uniform(45, 90), w - 3 - p)
                x, y = at(p + length / 2, (j + 0.5) * h / lanes)
                wide = rng.uniform(0.62, 0.8) * h / lanes
                if rng.random() < 0.25 and lanes == 2:
                    height, wing = rng.uniform(8, 14), (wide * 0.3, 18.0)
                    hall = House(x, y, angle, length, wide * 0.5, height, wing=wing, cover=GRAVEL)
                else:
                    height = rng.uniform(8, 13)
                    rise = rng.uniform(1.5, 3.0) if rng.random() < 0.6 else 0.0
                    hall = House(x, y, angle, length, wide, height, rise, cover=SHEET)
                build.add(zone, hall)
                p += length + rng.uniform(9, 16)


def place_buildings(
    city: CitySpec, rng: np.random.Generator, s: Surfaces, sites: cKDTree
) -> _Builder:
    """All buildings of a city, block by block of its land use."""
    build = _Builder(city, s, sites, rng)
    ny, nx = s.cell_top.shape
    x1, y1 = s.x0 + nx * CELL_M, s.y0 + ny * CELL_M
    for n, zone in enumerate(s.zones):
        kind = ZONE_KINDS[int(zone[7])]
        if kind not in BUILT:
            continue
        cos, sin, length, width, street = zone[2:7]
        reach = 1.1 * city.character.zone_m
        p0, q0 = zone[0] * cos + zone[1] * sin, zone[1] * cos - zone[0] * sin
        for i in range(math.floor((p0 - reach) / length), math.ceil((p0 + reach) / length)):
            for j in range(math.floor((q0 - reach) / width), math.ceil((q0 + reach) / width)):
                edge = street + (3.0 if kind in ("towers", "slabs", "industry") else 1.2)
                pa, qa = i * length + edge, j * width + edge

                def at(p, q, pa=pa, qa=qa, cos=cos, sin=sin):
                    p, q = pa + p, qa + q
                    return p * cos - q * sin, p * sin + q * cos

                middle = at((length - 2 * edge) / 2, (width - 2 * edge) / 2)
                if not (s.x0 < middle[0] < x1 and s.y0 < middle[1] < y1):
                    continue
                if sites.query(middle)[1] != n and kind != "village":
                    continue
                _fill_block(build, n, kind, at, (length - 2 * edge, width - 2 * edge),
                            math.atan2(sin, cos), city.character.towers_m)  # fmt: skip
    # single houses all over the country, where a slope can carry them
    pitch = 105.0
    for y in np.arange(s.y0 + pitch, y1 - pitch / 2, pitch):
        for x in np.arange(s.x0 + pitch, x1 - pitch / 2, pitch):
            px, py = x + rng.uniform(-35, 35), y + rng.uniform(-35, 35)
            zone = int(sites.query((px, py))[1])
            if ZONE_KINDS[int(s.zones[zone, 7])] in BUILT or rng.random() < 0.25:
                continue
            turned, length = rng.uniform(-0.6, 0.6), rng.uniform(11, 17)
            width, height = rng.uniform(8.5, 11), rng.uniform(5, 10)
            rise = rng.uniform(1.5, 2.6) if rng.random() < 0.2 else 0.0
            build.add(zone, House(px, py, turned, length, width, height, rise, steepest=7.0))
    return build


def choose_changed(
    city: CitySpec, rng: np.random.Generator, build: _Builder, boxes: np.ndarray
) -> np.ndarray:
    """Which views each box is in: a few buildings of every scene in the LiDAR or images only."""
    view = np.full(len(boxes), IN_IMAGES | IN_LIDAR, np.uint8)
    group = np.array(build.group)
    for scene in city.scenes:
        local = scene_coordinates(city, scene, boxes[:, :2])
        inside = (np.abs(local) < half_size(scene) - np.array(scene.ragged_m) - 60).all(axis=1)
        inside &= (local[:, 0] < half_size(scene)[0] - scene.gap_m[0] - 60) | (
            local[:, 1] > scene.gap_m[1] + 60 - half_size(scene)[1]
        )
        solid = inside & (boxes[:, 4] * boxes[:, 5] > 22) & (view == 3)
        candidates = np.unique(group[solid])
        count = min(max(4, len(candidates) // 90), 12, len(candidates) // 6)
        chosen = rng.permutation(candidates)[: 2 * count]
        view[np.isin(group, chosen[:count])] = IN_IMAGES
        view[np.isin(group, chosen[count:])] = IN_LIDAR
    return view


def place_canopy(
    city: CitySpec, canopy: Canopy, s: Surfaces, sites: cKDTree, boxes: np.ndarray
) -> Objects:
    """The crowns of a canopy on dry ground near the scenes, clear of walls."""
    rng = np.random.default_rng([city.world_seed, 4])
    if canopy.arrangement == "forest":
        xy = _forest(canopy, s, rng)
    elif canopy.arrangement == "rows":
        xy = _rows(canopy, s, sites, rng)
    else:
        xy = _anywhere(canopy.ground_m2, s, rng)
    radius = rng.uniform(*canopy.radius_m, len(xy))
    half = radius * rng.uniform(*canopy.slimness, len(xy))
    trunk = rng.uniform(*canopy.trunk_m, len(xy))
    ground = terrain_heights(s, xy)[:, 0]
    trees = _ellipsoids(np.column_stack([xy, ground + trunk + half]), radius, half)
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
    return Objects(
        np.concatenate([leafy, boughs]),
        np.repeat(np.array([seen_leaves, sum(bare)], np.uint8), [len(leafy), len(boughs)]),
        np.repeat(
            [[canopy.brightness, canopy.porosity], [canopy.brightness, 0.0]],
            [len(leafy), len(boughs)],
            axis=0,
        ),
    )


def _anywhere(ground_m2: float, s: Surfaces, rng: np.random.Generator) -> np.ndarray:
    """Places [n, 2] drawn one by one."""
    size = CELL_M * np.array(s.cell_top.shape[::-1])
    count = round(size.prod() / ground_m2)
    return rng.uniform(0, 1, (count, 2)) * size + [s.x0, s.y0]


def _forest(canopy: Canopy, s: Surfaces, rng: np.random.Generator) -> np.ndarray:
    """Places [n, 2] of woods with glades: dense where a smooth random field is high."""
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
    width, height = CELL_M * s.cell_top.shape[1], CELL_M * s.cell_top.shape[0]
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


def _ellipsoids(centre: np.ndarray, radius: np.ndarray, half: np.ndarray) -> np.ndarray:
    """[n, 6] as in :class:`.surfaces.Surfaces`."""
    return np.column_stack([centre, radius, half, (radius / half) ** 2])


def _beside(
    trees: np.ndarray,
    away: np.ndarray,
    turn: np.ndarray,
    z: np.ndarray,
    radius: np.ndarray,
    half: np.ndarray,
) -> np.ndarray:
    """Ellipsoids that stand ``away`` from the axes of crowns [n, 6]; all values [n, k]."""
    x, y = trees[:, :1] + away * np.cos(turn), trees[:, 1:2] + away * np.sin(turn)
    centre = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return _ellipsoids(centre, radius.ravel(), half.ravel())


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
    z = trees[:, 2:3] + trees[:, 4:5] * out * up
    away = trees[:, 3:4] * out * level
    lobe = _beside(trees, away, turn, z, trees[:, 3:4] * size, trees[:, 4:5] * size)
    return np.concatenate([core, lobe])


def _boughs(trees: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The ellipsoids of crowns [n, 6] without leaves: upright boughs about the middle."""
    turn = rng.uniform(0, 2 * math.pi, (len(trees), BOUGHS))
    away = rng.uniform(0.0, 0.5, (len(trees), BOUGHS)) * trees[:, 3:4]
    z, radius, half = (
        np.repeat(of, BOUGHS, axis=1)
        for of in (trees[:, 2:3], BOUGH * trees[:, 3:4], 0.8 * trees[:, 4:5])
    )
    return _beside(trees, away, turn, z, radius, half)


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
    half = np.hypot(boxes[:, 4], boxes[:, 5])
    order = np.argsort(-half)
    for part in (order[half[order] > 25], order[half[order] <= 25]):  # few large ones reach far
        if not (len(part) and len(trees)):
            continue
        # Known: where all boxes are of one part, those that are near are looked up in another
        # order, and some crowns stand in walls. To mend it would move the data of such cities.
        searched = boxes if len(part) == len(boxes) else boxes[part]
        reach = float(half[part].max()) + 4.5
        near = cKDTree(trees[:, :2]).query_ball_tree(cKDTree(searched[:, :2]), reach)
        which = np.repeat(np.arange(len(trees)), [len(of) for of in near])
        b = boxes[part[np.array([box for of in near for box in of], int)]]
        dx, dy = trees[which, 0] - b[:, 0], trees[which, 1] - b[:, 1]
        u = np.abs(dx * b[:, 2] + dy * b[:, 3]) - b[:, 4]
        v = np.abs(dy * b[:, 2] - dx * b[:, 3]) - b[:, 5]
        gap = np.hypot(np.maximum(u, 0), np.maximum(v, 0))
        free[which[gap < trees[which, 3] * 0.95 + 0.3]] = False
    return free
