"""Where things are in a city: its frame, scenes, extent, terrain, land use, vehicles, LiDAR.

Each zone has its grid of blocks and streets. A scene's LiDAR reaches beyond its image on two sides,
and ends inside it on the others. Each image and the LiDAR have the vehicles elsewhere.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from stereotruth.core.kernels import inlined

from .appearance import VEHICLE
from .camera import LocalFrame
from .cities import LEFT_GSD_M, CitySpec, SceneSpec
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

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

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

CAR_M = (4.4, 1.8, 1.5)  # length, width, height
VAN_M = (7.5, 2.3, 2.8)
VANS = 0.12  # share of the vehicles
NARROWEST_M = 3.5  # half width of a street that vehicles use
LANE = 0.35  # distance from the middle over half the width
SLOW_M = (0.5, 6.0)  # way of a vehicle in slow traffic between the views
APART_M = 15.0  # more than two bodies and the ways of both
PARKED, SLOW, LEAVING, COMING = 0.25, 0.35, 0.15, 0.15  # shares; the others are in the LiDAR only


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


def draw_zones(
    city: CitySpec, rng: np.random.Generator, s: Surfaces
) -> tuple[np.ndarray, np.ndarray, np.ndarray, cKDTree]:
    """Land use: zones, the zone of each cell, those that meet in a cell, and the sites as a tree.

    Zones are float64[n, 9]: x, y, cos, sin, block length, width, half street, kind, tone. A place
    is of the zone with the nearest site. Cells where several meet have −1 − k in place of a zone,
    and row k of what is third holds those that a place in the cell can be of, then −1.
    """
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
    from scipy.spatial import cKDTree  # slow to import, and most jobs draw no zones

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
    border_y, border_x = np.nonzero(~same)
    middles = np.column_stack([
        s.x0 + CELL_M * (border_x + 0.5), s.y0 + CELL_M * (border_y + 0.5)
    ])  # fmt: skip
    # no place is farther than half a diagonal from its cell's middle; 1 mm for rounding
    reach = sites.query(middles)[0] + CELL_M * math.sqrt(2) + 1e-3
    meeting = sites.query_ball_point(middles, reach, return_sorted=True)
    near = np.full((len(middles), max(map(len, meeting), default=0)), -1, np.int32)
    for row, found in zip(near, meeting):
        row[: len(found)] = found
    cells = nearest[:-1, :-1].astype(np.int32)
    cells[~same] = -1 - np.arange(len(middles))
    return zones, cells, near, sites


def coverage(city: CitySpec, scene: SceneSpec) -> np.ndarray:
    """Packed outline float64[21] of a scene's LiDAR coverage, see :func:`covered`.

    It reaches beyond the image at the first columns and last rows, and ends inside it, raggedly,
    at the last columns and first rows, with a block missing in the corner between them. That of a
    twin is a rectangle.
    """
    if city.twin is not None:  # what the file covers, and not the image's margin around it
        cos, sin = math.cos(city.twin.turned_rad), math.sin(city.twin.turned_rad)
        outline = [0.0, 0.0, cos, sin, -sin, cos, *city.twin.half_m]
        return np.array([*outline, *np.zeros(13)])
    across, along = image_axes(city, scene)
    rng = np.random.default_rng([scene.pose_seed, 6])
    beyond = 35.0 + 0.12 * city.character.relief_m
    return np.array([
        *scene.centre_m, *across, *along, *half_size(scene), beyond, *scene.ragged_m,
        *rng.uniform(0, 2 * np.pi, 6), *scene.gap_m, *rng.uniform(0, 2 * np.pi, 2),
    ])  # fmt: skip


@inlined
def covered(c, x, y):
    """Whether a plan position lies in the LiDAR coverage."""
    dx, dy = x - c[0], y - c[1]
    a, b = dx * c[2] + dy * c[3], dx * c[4] + dy * c[5]
    if a < -c[6] - c[8] or b > c[7] + c[8]:
        return False
    # the waves below stay within these factors: most points need no sine
    if a < c[6] - 1.95 * c[9] and b > -c[7] + 1.95 * c[10]:
        inside = True
    else:
        edge_a = 1 + 0.5 * math.sin(b / 150 + c[11]) + 0.3 * math.sin(b / 61 + c[12])
        edge_a += 0.15 * math.sin(b / 19 + c[13])
        edge_b = 1 + 0.5 * math.sin(a / 170 + c[14]) + 0.3 * math.sin(a / 53 + c[15])
        edge_b += 0.15 * math.sin(a / 17 + c[16])
        inside = a <= c[6] - c[9] * edge_a and b >= -c[7] + c[10] * edge_b
    if not inside or a < c[6] - 1.07 * c[17] or b > -c[7] + 1.07 * c[18]:
        return inside
    gap_a = c[17] * (1 + 0.05 * math.sin(b / 90 + c[19]) + 0.02 * math.sin(b / 23))
    gap_b = c[18] * (1 + 0.05 * math.sin(a / 80 + c[20]) + 0.02 * math.sin(a / 21))
    return a < c[6] - gap_a or b > -c[7] + gap_b


def spectral_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    step: float,
    band: tuple[float, float],
    slope: float,
) -> np.ndarray:
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


def make_terrain(
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


def place_vehicles(city: CitySpec, s: Surfaces, sites: cKDTree) -> Objects:
    """Vehicles of a city: parked ones, some that creep between the views, some in one of them."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng([city.world_seed, 5])
    ny, nx = s.cell_top.shape
    size = np.array([nx, ny]) * CELL_M
    count = round(city.character.vehicles * size.prod() / 1e4)
    if not count:
        return Objects(np.zeros((0, 8)), np.zeros(0, np.uint8), np.zeros((0, 4)))
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
    return Objects(boxes[keep], view[keep], style[keep])
