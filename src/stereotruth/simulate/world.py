"""Building a city: terrain, water, land use, buildings and trees, from its spec alone.

The same spec gives the same city in every process, so that images, LiDAR and truth can be made by
separate jobs.
"""

from __future__ import annotations

import logging
import math
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from .cities import LEFT_GSD_M, CitySpec, SceneSpec
from .geodesy import LocalFrame
from .kernels import kernel
from .surfaces import (
    CELL_M,
    IN_IMAGES,
    IN_LIDAR,
    Surfaces,
    horizon,
    lidar_horizon,
    terrain_heights,
)

log = logging.getLogger("stereotruth")

ZONE_KINDS = (
    "towers", "slabs", "lowrise", "village", "industry", "park", "fields", "forest", "bare",
)  # fmt: skip
BUILT = ZONE_KINDS[:5]
# block length, block width, half width of the street (m) of each kind of land use
BLOCKS = {
    "towers": (118, 98, 8.5), "slabs": (124, 92, 6.0), "lowrise": (86, 62, 4.0),
    "village": (64, 50, 2.2), "industry": (176, 122, 6.5), "park": (150, 110, 2.5),
    "fields": (96, 38, 1.2), "forest": (400, 400, 1.0), "bare": (400, 400, 1.0),
}  # fmt: skip
TERRAIN_STEP_M = 10.0
TEXTURE_SIZE = 1024
FINE_STEP_M = 0.25
BROAD_STEP_M = 2.0
FLAT, GRAVEL, TILES, SHEET = range(4)


def frame_of(city: CitySpec) -> LocalFrame:
    """The city's world frame."""
    return LocalFrame(city.lon, city.lat, city.base_height_m)


def image_axes(city: CitySpec, scene: SceneSpec) -> tuple[np.ndarray, np.ndarray]:
    """Nominal plan directions [2] in which the columns and rows of the left image run.

    From the orbit's inclination and the Earth's turning; the real image is within a degree.
    """
    latitude = math.radians(city.lat)
    azimuth = math.asin(math.cos(math.radians(97.4)) / math.cos(latitude))
    if not scene.ascending:
        azimuth = math.pi - azimuth
    run = 7040 * np.array([math.sin(azimuth), math.cos(azimuth)])
    run[0] -= 465 * math.cos(latitude)
    run /= np.hypot(*run)
    return np.array([-run[1], run[0]]), run


def scene_coordinates(city: CitySpec, scene: SceneSpec, xy: np.ndarray) -> np.ndarray:
    """Plan positions [n, 2] in metres from the scene's middle, along columns and rows."""
    across, along = image_axes(city, scene)
    local = np.atleast_2d(xy) - np.array(scene.centre_m)
    return np.column_stack([local @ across, local @ along])


def half_size(scene: SceneSpec) -> np.ndarray:
    """Half the ground size (m) of the left image, along columns and rows."""
    return np.array([scene.cols, scene.rows]) * LEFT_GSD_M / 2


def near_scenes(city: CitySpec, xy: np.ndarray, margin: float) -> np.ndarray:
    """Which plan positions [n, 2] lie in a scene or within ``margin`` metres of one."""
    near = np.zeros(len(xy), bool)
    for scene in city.scenes:
        inside = np.abs(scene_coordinates(city, scene, xy)) < half_size(scene) + margin
        near |= inside.all(axis=1)
    return near


def extent(city: CitySpec) -> tuple[float, float, float, float]:
    """(x_min, y_min, x_max, y_max) of the world, whole cells."""
    corners = []
    for scene in city.scenes:
        across, along = image_axes(city, scene)
        a, b = half_size(scene) + city.margin_m
        corners += [
            np.array(scene.centre_m) + i * a * across + j * b * along
            for i in (-1, 1)
            for j in (-1, 1)
        ]
    low = np.floor(np.min(corners, axis=0) / CELL_M) * CELL_M
    high = np.ceil(np.max(corners, axis=0) / CELL_M) * CELL_M
    return low[0], low[1], high[0], high[1]


def spectral_noise(
    rng: np.random.Generator, shape: tuple[int, int], step: float, band: tuple[float, float],
    slope: float,
) -> np.ndarray:  # fmt: skip
    """Periodic Gaussian noise [ny, nx] of unit spread.

    Wavelengths within ``band`` (m); amplitude falls as frequency to the power ``-slope``.
    """
    fy = np.fft.fftfreq(shape[0], step)[:, None]
    fx = np.fft.rfftfreq(shape[1], step)[None, :]
    f = np.hypot(fx, fy)
    with np.errstate(divide="ignore"):
        amplitude = np.where((f >= 1 / band[1]) & (f <= 1 / band[0]), f**-slope, 0.0)
    amplitude[0, 0] = 0
    phase = np.exp(2j * np.pi * rng.random(amplitude.shape))
    noise = np.fft.irfft2(amplitude * phase * rng.normal(1, 0.3, amplitude.shape), s=shape)
    return noise / max(noise.std(), 1e-12)


def _terrain(
    city: CitySpec, rng: np.random.Generator, box: tuple[float, float, float, float]
) -> tuple[np.ndarray, float]:
    """Spline coefficients [ny, nx] of the terrain, and the water's level (−1e9: none)."""
    c = city.character
    nx = int((box[2] - box[0]) / TERRAIN_STEP_M) + 6
    ny = int((box[3] - box[1]) / TERRAIN_STEP_M) + 6
    size = 2 ** math.ceil(math.log2(max(nx, ny, 2.2 * c.wavelength_m / TERRAIN_STEP_M)))
    shape = (size, size)
    hills = spectral_noise(
        rng, shape, TERRAIN_STEP_M, (c.wavelength_m / 3.5, c.wavelength_m * 1.3), 3.0
    )
    rough = spectral_noise(rng, shape, TERRAIN_STEP_M, (120, 500), 2.2)
    micro = spectral_noise(rng, shape, TERRAIN_STEP_M, (40, 90), 1.0)
    hills, rough, micro = (a[:ny, :nx] for a in (hills, rough, micro))
    x = box[0] + TERRAIN_STEP_M * np.arange(nx)
    y = box[1] + TERRAIN_STEP_M * np.arange(ny)
    floor = np.quantile(hills, c.valley)
    rise = hills - floor
    rise = (rise + np.sqrt(rise**2 + 0.05)) / 2  # a plain that bends smoothly into hills
    z = rise * (1 + 0.07 * rough)
    z -= z.min()
    z *= c.relief_m / max(z.max(), 1e-9)
    for _ in range(8):  # relief gives way to the steepest slope allowed
        gy, gx = np.gradient(z, TERRAIN_STEP_M)
        steepest = math.degrees(math.atan(np.hypot(gx, gy).max()))
        if steepest <= c.max_slope_deg:
            break
        # soften where it is too steep rather than lower everything
        k = 2 if steepest < c.max_slope_deg * 1.3 else 4
        for _ in range(k):
            p = np.pad(z, 1, mode="edge")
            blurred = (p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:] + 4 * z) / 8
            steep = np.clip(np.hypot(gx, gy) / math.tan(math.radians(c.max_slope_deg)) - 0.7, 0, 1)
            z = z + np.minimum(1, 3 * steep) * (blurred - z)
    gy, gx = np.gradient(z, TERRAIN_STEP_M)
    z *= min(1.0, math.tan(math.radians(48)) / max(np.hypot(gx, gy).max(), 1e-9))
    z += 4 + 0.12 * micro
    water = -1e9
    if c.river_m:
        # a winding river: the ground falls to below the water along it
        water = 2.2
        phase = rng.uniform(0, 2 * np.pi, 2)
        angle = rng.uniform(0.15, 0.9)
        xx, yy = np.meshgrid(x, y)
        middle = np.mean([s.centre_m for s in city.scenes], axis=0)
        p = (xx - middle[0]) * math.cos(angle) + (yy - middle[1]) * math.sin(angle)
        q = (yy - middle[1]) * math.cos(angle) - (xx - middle[0]) * math.sin(angle)
        if c.relief_m > 150:  # follow the valley: the river lies where the hills are lowest
            weights = np.exp(-((z - z.min()) / 20))
            slope, level = np.polyfit(p.ravel(), q.ravel(), 1, w=weights.ravel())
            q = q - (slope * p + level)
        else:
            q = q - rng.uniform(-0.22, 0.22) * (box[3] - box[1])
        q = q - 110 * np.sin(p / 420 + phase[0]) - 40 * np.sin(p / 170 + phase[1])
        bank = 0.5 * c.river_m + 6 * rough
        depth = np.clip((bank - np.abs(q)) / 14, -1.5, 1)  # banks of about 20 degrees
        if c.relief_m > 150:  # slopes of 27 degrees at most from the river up
            cap = 5.0 + 0.5 * np.maximum(np.abs(q) - 0.6 * c.river_m, 0)
            z = -3.0 * np.logaddexp(-z / 3.0, -cap / 3.0)
        valley = 0.0 if c.relief_m > 150 else np.exp(-((np.abs(q) / (c.river_m * 2.5)) ** 2))
        z = z * (1 - valley) + np.minimum(z, 5.0 + 0.02 * z) * valley
        z = np.where(depth > -1.5, np.minimum(z, 2.2 - 4.0 * depth), z)
    if c.lakes:
        water = max(water, 2.2)
        dips = spectral_noise(rng, shape, TERRAIN_STEP_M, (250, 900), 1.5)[:ny, :nx]
        low = np.clip((dips - 1.75) / 0.25, 0, 1) * np.clip((14 - z) / 6, 0, 1)
        z = z * (1 - low) + (2.2 - c.lakes) * low
    if not c.river_m and not c.lakes:
        water = -1e9
    return z, water


def _zones(
    city: CitySpec, rng: np.random.Generator, s: Surfaces
) -> tuple[np.ndarray, np.ndarray, cKDTree]:
    """Land use: zones float64[n, 9] (x, y, cos, sin, block length, width, half street, kind,
    tone), the zone of each cell (−1 where several meet), and the sites as a tree."""
    c = city.character
    ny, nx = s.cell_top.shape
    width, height = nx * CELL_M, ny * CELL_M
    columns, rows = max(2, round(width / c.zone_m)), max(2, round(height / c.zone_m))
    jj, ii = np.mgrid[0:rows, 0:columns]
    xy = np.column_stack([(ii.ravel() + 0.5) * width / columns, (jj.ravel() + 0.5) * height / rows])
    xy += rng.uniform(-0.36, 0.36, xy.shape) * [width / columns, height / rows]
    xy += [s.x0, s.y0]
    around = np.concatenate([xy + d for d in ((0, 0), (70, 0), (-70, 0), (0, 70), (0, -70))])
    t = terrain_heights(s, around)
    slope = np.hypot(t[:, 1], t[:, 2]).reshape(5, -1).mean(axis=0)
    kinds = list(c.zones)
    zones = np.zeros((len(xy), 9))
    zones[:, :2] = xy
    city_angle = rng.uniform(-0.3, 0.3)
    centre = np.mean([q.centre_m for q in city.scenes], axis=0)
    for n in range(len(xy)):
        weights = np.array([c.zones[k] for k in kinds], dtype=float)
        urban = math.exp(-np.hypot(*(xy[n] - centre)) / 1100)
        for m, kind in enumerate(kinds):
            if kind in ("towers", "slabs", "lowrise", "industry"):
                weights[m] *= 0.35 + 1.6 * urban
                if slope[n] > 0.12:
                    weights[m] = 0
            elif kind in ("village", "fields", "park"):
                weights[m] *= 1 if slope[n] < 0.22 else 0.02
            else:
                weights[m] *= 0.35 if slope[n] < 0.1 else 3
        kind = kinds[rng.choice(len(kinds), p=weights / weights.sum())]
        length, block, street = BLOCKS[kind]
        loose = 0.5 if kind in ("village", "fields", "park") else 0.08
        angle = city_angle + rng.uniform(-loose, loose)
        grow = rng.uniform(0.9, 1.12)
        zones[n, 2:] = (
            math.cos(angle), math.sin(angle), length * grow, block * grow, street,
            ZONE_KINDS.index(kind), rng.random(),
        )  # fmt: skip
    sites = cKDTree(xy)
    corner_x = s.x0 + CELL_M * np.arange(nx + 1)
    corner_y = s.y0 + CELL_M * np.arange(ny + 1)
    nearest = sites.query(
        np.stack(np.meshgrid(corner_x, corner_y), axis=-1).reshape(-1, 2)
    )[1].reshape(ny + 1, nx + 1)  # fmt: skip
    same = (
        (nearest[:-1, :-1] == nearest[1:, 1:])
        & (nearest[1:, :-1] == nearest[:-1, 1:])
        & (nearest[:-1, :-1] == nearest[:-1, 1:])
    )
    return zones, np.where(same, nearest[:-1, :-1], -1).astype(np.int32), sites


class _Builder:
    """Collects buildings; refuses those that do not fit the ground."""

    def __init__(self, city: CitySpec, s: Surfaces, sites: cKDTree, rng: np.random.Generator):
        self.city, self.s, self.sites, self.rng = city, s, sites, rng
        self.zone_cells = s.zone_cells.tolist()
        self.around = [
            (*scene.centre_m, *np.concatenate(image_axes(city, scene)), *half_size(scene))
            for scene in city.scenes
        ]
        self.boxes: list[tuple[float, ...]] = []
        self.style: list[tuple[float, ...]] = []
        self.group: list[int] = []
        self.groups = 0

    def _near(self, x: float, y: float) -> bool:
        """:func:`near_scenes` of one position, without arrays: most buildings end here."""
        margin = self.city.margin_m - 40
        return any(
            abs((x - cx) * ax + (y - cy) * ay) < width + margin
            and abs((x - cx) * bx + (y - cy) * by) < height + margin
            for cx, cy, ax, ay, bx, by, width, height in self.around
        )

    def add(
        self, zone: int, cx: float, cy: float, angle: float, length: float, width: float,
        height: float, rise: float = 0.0, wing: tuple[float, float] | None = None,
        steepest: float = 4.0, top: bool = True, cover: int | None = None,
    ) -> bool:  # fmt: skip
        """One building: a box, perhaps with a wing (length, width) that makes an L, and on top."""
        ux, uy = math.cos(angle), math.sin(angle)
        a, b = length / 2, width / 2
        if not self._near(cx - a * ux + b * uy, cy - a * uy - b * ux):
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
        z = terrain_heights(self.s, corners)[:, 0]
        if z.min() < self.s.water + 0.6 or z.max() - z.min() > steepest:
            return False
        rng = self.rng
        eaves = z.max() + height
        roof = float(np.clip(rng.lognormal(math.log(0.33), 0.42), 0.12, 0.85))
        walls = float(rng.uniform(0.22, 0.55))
        if cover is None:
            cover = TILES if rise > 1.2 else int(rng.choice([FLAT, GRAVEL, FLAT, SHEET]))
        for part in parts:
            self._put(part, eaves, rise if wing is None else 0.0, roof, walls, cover)
        if top and rise == 0 and min(length, width) > 9.5 and height > 9:
            for _ in range(int(rng.integers(1, 3 if length < 35 else 4))):
                ta, tb = rng.uniform(1.6, 3.4), rng.uniform(1.4, 2.6)
                du = rng.uniform(-1, 1) * (a - ta - 2.2)
                dv = rng.uniform(-1, 1) * (b - tb - 1.8)
                part = (cx + du * ux - dv * uy, cy + du * uy + dv * ux, ux, uy, ta, tb)
                self._put(part, eaves + rng.uniform(2.0, 3.6), 0.0, roof * 0.9, walls, FLAT)
        self.groups += 1
        return True

    def _put(self, part, eaves, rise, roof, walls, cover) -> None:
        self.boxes.append((*part, eaves, rise))
        self.style.append((roof, walls, cover, self.rng.uniform(0, 1000)))
        self.group.append(self.groups)


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
                if build.add(zone, x, y, angle, length, width, tall) and podium:
                    build.groups -= 1  # the podium goes with its tower
                    build.add(zone, x, y, angle, min(length + 12, pitch_w - 4), width + 12,
                              rng.uniform(7, 11), top=False)  # fmt: skip
    elif kind == "slabs":
        lanes = 3
        for j in range(lanes):
            p = 2.0
            storeys = int(rng.integers(6, 12))
            while p < w - 26:
                length = min(rng.uniform(32, 58), w - 2 - p)
                x, y = at(p + length / 2, (j + 0.5) * h / lanes)
                build.add(zone, x, y, angle, length, rng.uniform(11, 13.5), 3.0 * storeys + 1)
                p += length + rng.uniform(7, 12)
    elif kind == "lowrise":
        columns, lanes = max(1, int(w // 21)), max(1, int(h // 18))
        pitch_w, pitch_h = w / columns, h / lanes
        for i in range(columns):
            for j in range(lanes):
                if rng.random() < 0.1:
                    continue
                length, width = rng.uniform(11, pitch_w - 2.5), rng.uniform(9, pitch_h - 3)
                x, y = at((i + 0.5) * pitch_w, (j + 0.5) * pitch_h)
                rise = rng.uniform(1.5, 3) if rng.random() < 0.25 else 0.0
                build.add(zone, x, y, angle + rng.normal(0, 0.015), length, width,
                          3.1 * int(rng.integers(2, 7)), rise)  # fmt: skip
    elif kind == "village":
        columns, lanes = max(1, int(w // 17)), max(1, int(h // 16))
        pitch_w, pitch_h = w / columns, h / lanes
        for i in range(columns):
            for j in range(lanes):
                if rng.random() < 0.28:
                    continue
                length, width = rng.uniform(9.5, 13), rng.uniform(7.5, 10)
                x, y = at((i + 0.5) * pitch_w, (j + 0.5) * pitch_h)
                gabled = rng.random() < 0.5
                wing = None
                if not gabled and rng.random() < 0.25:
                    length, width, wing = 12.0, 6.5, (6.0, 5.0)
                build.add(zone, x, y, angle + rng.normal(0, 0.05), length, width,
                          3.0 * int(rng.integers(1, 4)) + 0.5,
                          rng.uniform(1.8, 3.0) if gabled else 0.0, wing)  # fmt: skip
    elif kind == "industry":
        lanes = 2 if rng.random() < 0.6 else 3
        for j in range(lanes):
            p = 3.0
            while p < w - 40:
                length = min(rng.uniform(45, 90), w - 3 - p)
                x, y = at(p + length / 2, (j + 0.5) * h / lanes)
                wide = rng.uniform(0.62, 0.8) * h / lanes
                if rng.random() < 0.25 and lanes == 2:
                    build.add(zone, x, y - 0.0, angle, length, wide * 0.5, rng.uniform(8, 14),
                              wing=(wide * 0.3, 18.0), cover=GRAVEL)  # fmt: skip
                else:
                    build.add(
                        zone,
                        x,
                        y,
                        angle,
                        length,
                        wide,
                        rng.uniform(8, 13),
                        rng.uniform(1.5, 3.0) if rng.random() < 0.6 else 0.0,
                        cover=SHEET,
                    )
                p += length + rng.uniform(9, 16)


def _buildings(city: CitySpec, rng: np.random.Generator, s: Surfaces, sites: cKDTree) -> _Builder:
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
            build.add(zone, px, py, rng.uniform(-0.6, 0.6), rng.uniform(11, 17),
                      rng.uniform(8.5, 11), rng.uniform(5, 10),
                      rng.uniform(1.5, 2.6) if rng.random() < 0.2 else 0.0,
                      steepest=7.0)  # fmt: skip
    return build


def _choose_changed(
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


def _trees(
    city: CitySpec, rng: np.random.Generator, s: Surfaces, sites: cKDTree, boxes: np.ndarray
) -> np.ndarray:
    """Crowns float64[n, 5] on a jittered grid, as dense as the land use has them."""
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
    trees = np.column_stack([xy, ground + trunk + half, radius, half])
    if len(boxes) and len(trees):  # no crown through a wall
        near = cKDTree(boxes[:, :2])
        biggest = np.hypot(boxes[:, 4], boxes[:, 5])
        free = np.ones(len(trees), bool)
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
        trees = trees[free]
    return trees


@kernel
def _list_cells(half_x, half_y, xy, x0, y0, ny, nx, first, out, fill):
    """Count (fill False) or list the cells that objects' bounding rectangles touch."""
    for n in range(xy.shape[0]):
        i0 = max(int((xy[n, 0] - half_x[n] - x0) / CELL_M), 0)
        i1 = min(int((xy[n, 0] + half_x[n] - x0) / CELL_M), nx - 1)
        j0 = max(int((xy[n, 1] - half_y[n] - y0) / CELL_M), 0)
        j1 = min(int((xy[n, 1] + half_y[n] - y0) / CELL_M), ny - 1)
        for j in range(j0, j1 + 1):
            for i in range(i0, i1 + 1):
                cell = j * nx + i
                if fill:
                    out[first[cell]] = n
                    first[cell] += 1
                else:
                    first[cell + 1] += 1


def _cells(half: np.ndarray, xy: np.ndarray, s: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    ny, nx = s.cell_top.shape
    first = np.zeros(ny * nx + 1, np.int64)
    half = np.ascontiguousarray(half + 0.01)
    xy = np.ascontiguousarray(xy)
    args = (half[:, 0].copy(), half[:, 1].copy(), xy, s.x0, s.y0, ny, nx)
    _list_cells(*args, first, np.empty(0, np.int32), False)
    first = np.cumsum(first)
    listed = np.empty(first[-1], np.int32)
    _list_cells(*args, first.copy(), listed, True)
    return first, listed


def build_surfaces(city: CitySpec) -> Surfaces:
    """Everything that stands in a city, ready for casting rays. About a second."""
    return _build(city)


@lru_cache(maxsize=2)
def _build(city: CitySpec) -> Surfaces:
    rng = np.random.default_rng([city.world_seed, 0])
    box = extent(city)
    nx, ny = round((box[2] - box[0]) / CELL_M), round((box[3] - box[1]) / CELL_M)
    terrain, water = _terrain(city, rng, box)
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    textures = np.random.default_rng([city.world_seed, 1])
    fine = spectral_noise(textures, size, FINE_STEP_M, (0.7, 40), 0.75)
    broad = spectral_noise(textures, size, BROAD_STEP_M, (6, 500), 1.0)
    azimuth, elevation = math.radians(city.sun_azimuth_deg), math.radians(city.sun_elevation_deg)
    sun = np.array([
        math.cos(elevation) * math.sin(azimuth), math.cos(elevation) * math.cos(azimuth),
        math.sin(elevation),
    ])  # fmt: skip
    none = np.zeros(1, np.int64), np.zeros(0, np.int32)
    s = Surfaces(
        x0=box[0], y0=box[1], step=TERRAIN_STEP_M, terrain=terrain, water=water,
        boxes=np.zeros((0, 8)), box_view=np.zeros(0, np.uint8), box_style=np.zeros((0, 4)),
        trees=np.zeros((0, 5)), box_first=none[0], box_list=none[1], tree_first=none[0],
        tree_list=none[1], cell_top=np.full((ny, nx), -1e9, np.float32),
        sun_top=np.zeros((ny, nx), np.float32), lidar_top=np.zeros((ny, nx), np.float32),
        zones=np.zeros((0, 9)),
        zone_cells=np.zeros((0, 0), np.int32), fine=fine.astype(np.float32),
        broad=broad.astype(np.float32), sun=sun,
    )  # fmt: skip
    zones, zone_cells, sites = _zones(city, rng, s)
    s = s._replace(zones=zones, zone_cells=zone_cells)
    if city.single_box is not None:
        x, y, length, width, height = city.single_box
        z = terrain_heights(s, np.array([[x, y]]))[0, 0] + height
        boxes = np.array([[x, y, 1.0, 0.0, length / 2, width / 2, z, 0.0]])
        view = np.array([IN_IMAGES | IN_LIDAR], np.uint8)
        style = np.array([[0.4, 0.35, FLAT, 1.0]])
        trees = np.zeros((0, 5))
    else:
        build = _buildings(city, rng, s, sites)
        boxes = np.array(build.boxes, dtype=np.float64).reshape(-1, 8)
        style = np.array(build.style, dtype=np.float64).reshape(-1, 4)
        view = _choose_changed(city, rng, build, boxes)
        trees = _trees(city, rng, s, sites, boxes)
    half = np.column_stack([
        np.abs(boxes[:, 2]) * boxes[:, 4] + np.abs(boxes[:, 3]) * boxes[:, 5],
        np.abs(boxes[:, 3]) * boxes[:, 4] + np.abs(boxes[:, 2]) * boxes[:, 5],
    ])  # fmt: skip
    box_first, box_list = _cells(half, boxes[:, :2], s)
    tree_first, tree_list = _cells(np.repeat(trees[:, 3:4], 2, axis=1), trees[:, :2], s)
    top = np.full(ny * nx, -1e9)
    cells = np.arange(ny * nx)
    for first, listed, height in (
        (box_first, box_list, boxes[:, 6] + boxes[:, 7]),
        (tree_first, tree_list, trees[:, 2] + trees[:, 4]),
    ):
        np.maximum.at(top, np.repeat(cells, np.diff(first)), height[listed])
    top = top.reshape(ny, nx)
    top = np.nextafter(top.astype(np.float32), np.float32(np.inf))
    s = s._replace(
        boxes=boxes, box_view=view, box_style=style, trees=trees, box_first=box_first,
        box_list=box_list, tree_first=tree_first, tree_list=tree_list,
        cell_top=top, sun_top=horizon(top, sun[0] / sun[2], sun[1] / sun[2]),
        lidar_top=lidar_horizon(top),
    )  # fmt: skip
    log.info(
        "%s: %d building parts (%d in the images only, %d in the LiDAR only), %d trees, "
        "terrain %.0f to %.0f m",
        city.name, len(boxes), (view == IN_IMAGES).sum(), (view == IN_LIDAR).sum(), len(trees),
        terrain.min() + city.base_height_m, terrain.max() + city.base_height_m,
    )  # fmt: skip
    return s
