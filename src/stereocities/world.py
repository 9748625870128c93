"""A city with all that stands in it, at each date, built or read from a file.

The same spec gives the same city in every process, so that images, LiDAR and truth can be made by
separate jobs; a file of the surfaces saves them the building. Each thing that changes does so at a
moment of its own, drawn between the first and the last date: objects carry the bits of the worlds
(left, right image, LiDAR) that they stand in; ground, water, the texture of streets and the roofs
of twins are those of :func:`world_of`.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import numpy as np

from stereotruth.core.kernels import kernel
from stereotruth.core.products.files import atomic_file

from .cities import CitySpec
from .layout import (
    BROAD_STEP_M,
    FINE_STEP_M,
    TERRAIN_STEP_M,
    TEXTURE_SIZE,
    ZONE_KINDS,
    draw_zones,
    extent,
    frame_of,
    make_terrain,
    place_vehicles,
    spectral_noise,
)
from .surfaces import (
    CELL_M,
    IN_IMAGES,
    IN_LEFT,
    IN_LIDAR,
    IN_RIGHT,
    NOTHING,
    PATCHES_A_CELL,
    Objects,
    Surfaces,
    cast,
    direction_of_sun,
    greatest,
    horizon,
    join,
    lidar_horizon,
    terrain_heights,
)

PASSES = 2  # up is the ellipsoid's normal at the city's centre: the place follows from the height

log = logging.getLogger("stereotruth")

WORLDS = {"left": IN_LEFT, "right": IN_RIGHT, "lidar": IN_LIDAR}
STOREYS_M = (3.0, 15.0)  # least and greatest height by which a building is raised
CROP_M = (1.2, 3.0)  # by which a crop is higher than another
YOUNG = 0.45  # size of a crown before it has grown, over its size then
EDGE_M = 4.0  # of a field's block, where its crop ends


def write_surfaces(city: CitySpec, out_npz: str | Path) -> None:
    """Build a city and write its surfaces: one array per field of :class:`.surfaces.Surfaces`."""
    built = surfaces_of(city)
    with atomic_file(out_npz) as scratch, scratch.open("wb") as stream:
        np.savez(stream, **built._asdict())


def surfaces_of(city: CitySpec, built: str | Path | None = None) -> Surfaces:
    """Everything that stands in a city, ready for casting rays.

    ``built``: a file of :func:`write_surfaces`, which is read in a hundredth of the seconds that
    building takes; None builds the city. Kept for further calls of the same process.
    """
    return _surfaces_of(city, None if built is None else Path(built))


@lru_cache(maxsize=2)
def _surfaces_of(city: CitySpec, built: Path | None) -> Surfaces:
    if built is None:
        return build_surfaces(city)
    with np.load(built) as fields:
        return Surfaces(**{
            name: fields[name] if fields[name].ndim else fields[name].item() for name in fields
        })  # fmt: skip


@kernel
def _tops(s, xy, view, z, kind):
    for n in range(xy.shape[0]):
        z[n], kind[n], _, _, _, _, _ = cast(
            s, s.lidar_top, xy[n, 0], xy[n, 1], 0.0, 0.0, view, True, 0.0
        )


def top_surface(
    city: CitySpec, lon: np.ndarray, lat: np.ndarray, view: int = IN_IMAGES
) -> tuple[np.ndarray, np.ndarray]:
    """Ellipsoidal height (m) and kind of the top surface at longitudes and latitudes, degrees.

    Of any one shape. ``view``: the world that the images see, or that of the LiDAR (IN_LIDAR).
    Kinds are those of :mod:`.surfaces`; outside the city NONE, and heights NaN.
    """
    surfaces, frame = surfaces_of(city), frame_of(city)
    lon, lat = (np.asarray(v, dtype=np.float64) for v in (lon, lat))
    at = [lon.ravel(), lat.ravel()]
    height = np.full(lon.size, city.base_height_m)
    z, kind = np.empty(lon.size), np.empty(lon.size, np.uint8)
    for _ in range(PASSES):
        xyz = frame.from_geodetic(np.column_stack([*at, height]))
        _tops(surfaces, np.ascontiguousarray(xyz[:, :2]), view, z, kind)
        xyz[:, 2] = z
        height = frame.to_geodetic(xyz)[:, 2]
    height[kind == 0] = np.nan
    return height.reshape(lon.shape), kind.reshape(lon.shape)


def _cells(half: np.ndarray, xy: np.ndarray, s: Surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Objects by the cells that their bounding rectangles touch, as Surfaces has them.

    ``half`` [n, 2]: half sides of the rectangles; ``xy`` [n, 2]: their middles.
    """
    ny, nx = s.cell_top.shape
    low, high = ((xy + side * (half + 0.01) - [s.x0, s.y0]) / CELL_M for side in (-1, 1))
    start = np.maximum(low.astype(np.int64), 0)
    end = np.minimum(high.astype(np.int64), [nx - 1, ny - 1])
    wide, tall = np.maximum(end - start + 1, 0).T
    which = np.repeat(np.arange(len(xy)), wide * tall)
    number = np.arange(len(which)) - np.repeat(np.cumsum(wide * tall) - wide * tall, wide * tall)
    column, row = start[which, 0] + number % wide[which], start[which, 1] + number // wide[which]
    cell = row * nx + column
    first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=ny * nx))])
    return first, which[np.argsort(cell, kind="stable")].astype(np.int32)


def build_surfaces(city: CitySpec) -> Surfaces:
    """Everything that stands in a city, ready for casting rays. Some seconds."""
    from .objects import (  # their imports take longer than reading a built city
        FLAT,
        choose_changed,
        place_buildings,
        place_canopy,
        place_trees,
    )
    from .twin_world import place_of

    if city.twin is not None:
        s, crowns = place_of(city, _nothing(city))
        trees, view, which = dated_trees(city, crowns.ellipsoids, crowns.tree, crowns.foot)
        boxes = Objects(s.boxes, s.box_view, s.box_style)
        return _standing(city, s, boxes, Objects(trees, view, crowns.style[which]))
    rng = np.random.default_rng([city.world_seed, 0])
    s = _nothing(city)
    terrain, water = make_terrain(city, rng, extent(city))
    s = s._replace(terrain=terrain, water=water)
    zones, zone_cells, zone_near, sites = draw_zones(city, rng, s)
    s = s._replace(zones=zones, zone_cells=zone_cells, zone_near=zone_near)
    if city.single_box is not None:
        x, y, length, width, height = city.single_box
        z = terrain_heights(s, np.array([[x, y]]))[0, 0] + height
        boxes = np.array([[x, y, 1.0, 0.0, length / 2, width / 2, z, 0.0]])
        view = np.array([IN_IMAGES | IN_LIDAR], np.uint8)
        style = np.array([[0.4, 0.35, FLAT, 1.0]])
        trees = np.zeros((0, 6))
    else:
        build = place_buildings(city, rng, s, sites)
        boxes = np.array(build.boxes, dtype=np.float64).reshape(-1, 8)
        style = np.array(build.style, dtype=np.float64).reshape(-1, 4)
        if city.dates is None:
            view = choose_changed(city, rng, build, boxes)
        else:
            boxes, style, view = dated_buildings(city, np.array(build.group), boxes, style)
        trees = place_trees(city, rng, s, sites, boxes)
        vehicles = place_vehicles(city, s, sites)
        boxes, view, style = join(Objects(boxes, view, style), vehicles)
    trees, tree_view, _ = dated_trees(city, trees)
    crowns = Objects(trees, tree_view, np.tile([1.0, 0.0], (len(trees), 1)))
    if city.character.canopy is not None:
        crowns = join(crowns, place_canopy(city, city.character.canopy, s, sites, boxes))
    return _standing(city, s, Objects(boxes, view, style), crowns)


def _nothing(city: CitySpec) -> Surfaces:
    """A city's extent, textures and sun, where nothing stands."""
    box = extent(city)
    nx, ny = round((box[2] - box[0]) / CELL_M), round((box[3] - box[1]) / CELL_M)
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    textures = np.random.default_rng([city.world_seed, 1])
    fine = spectral_noise(textures, size, FINE_STEP_M, (0.7, 40), 0.75)
    broad = spectral_noise(textures, size, BROAD_STEP_M, (6, 500), 1.0)
    none = np.zeros(1, np.int64), np.zeros(0, np.int32)
    return Surfaces(
        x0=box[0], y0=box[1], step=TERRAIN_STEP_M, terrain=np.zeros((0, 0)), water=-1e9,
        boxes=np.zeros((0, 8)), box_view=np.zeros(0, np.uint8), box_style=np.zeros((0, 4)),
        trees=np.zeros((0, 6)), tree_view=np.zeros(0, np.uint8), tree_style=np.zeros((0, 2)),
        ground_look=np.array(city.character.ground_look),
        box_first=none[0], box_list=none[1], tree_first=none[0],
        tree_list=none[1], cell_top=np.full((ny, nx), -1e9, np.float32),
        sun_top=np.zeros((ny, nx), np.float32), lidar_top=np.zeros((ny, nx), np.float32),
        zones=np.zeros((0, 9)),
        zone_cells=np.zeros((0, 0), np.int32),
        zone_near=np.zeros((0, 0), np.int32), fine=fine.astype(np.float32),
        broad=broad.astype(np.float32),
        sun=direction_of_sun(city.sun_azimuth_deg, city.sun_elevation_deg), resurfaced=0.0,
        patches=np.zeros((0, 0, 3), np.float32), patch_side=np.zeros((0, 0), np.uint8),
        patch_building=np.zeros((0, 0), np.int32), patch_i=0, patch_j=0,
        paint=np.zeros((0, 0), np.uint16),
    )  # fmt: skip


def patch_tops(city: CitySpec, s: Surfaces) -> np.ndarray:
    """Greatest z of the patches in each cell of a city at any date, as its ``cell_top``."""
    top = np.full(s.cell_top.shape, -1e9)
    if not s.patches.size:
        return top
    rows, cols = (n // PATCHES_A_CELL for n in s.patches.shape[:2])
    highest = greatest(s.patches.astype(np.float64))
    if city.dates is not None:
        for passed in (0.0, 1.0):
            of = dated_patches(city, s, passed)
            highest = np.maximum(highest, greatest(of.astype(np.float64)))
    cells = highest.reshape(rows, PATCHES_A_CELL, cols, PATCHES_A_CELL)
    # rays are not followed where a cell ends: what is left over for rounding
    top[s.patch_j : s.patch_j + rows, s.patch_i : s.patch_i + cols] = cells.max(axis=(1, 3)) + 1e-3
    return top


def _standing(city: CitySpec, s: Surfaces, boxes: Objects, trees: Objects) -> Surfaces:
    """A city's surfaces with these objects, listed by the cells that they stand in."""
    ny, nx = s.cell_top.shape
    shapes = boxes.shapes
    half = np.column_stack([
        np.abs(shapes[:, 2]) * shapes[:, 4] + np.abs(shapes[:, 3]) * shapes[:, 5],
        np.abs(shapes[:, 3]) * shapes[:, 4] + np.abs(shapes[:, 2]) * shapes[:, 5],
    ])  # fmt: skip
    box_first, box_list = _cells(half, shapes[:, :2], s)
    radius = np.repeat(trees.shapes[:, 3:4], 2, axis=1)
    tree_first, tree_list = _cells(radius, trees.shapes[:, :2], s)
    top = patch_tops(city, s).ravel()
    cells = np.arange(ny * nx)
    for first, listed, height in (
        (box_first, box_list, shapes[:, 6] + shapes[:, 7]),
        (tree_first, tree_list, trees.shapes[:, 2] + trees.shapes[:, 4]),
    ):
        np.maximum.at(top, np.repeat(cells, np.diff(first)), height[listed])
    top = top.reshape(ny, nx)
    top = np.nextafter(top.astype(np.float32), np.float32(np.inf))
    s = s._replace(
        boxes=shapes, box_view=boxes.view, box_style=boxes.style, trees=trees.shapes,
        tree_view=trees.view, tree_style=trees.style, box_first=box_first,
        box_list=box_list, tree_first=tree_first, tree_list=tree_list,
        cell_top=top, sun_top=horizon(top, s.sun[0] / s.sun[2], s.sun[1] / s.sun[2]),
        lidar_top=lidar_horizon(top),
    )  # fmt: skip
    log.info(
        "%s: %d building parts (%d in the images only, %d in the LiDAR only), %d trees, "
        "terrain %.0f to %.0f m",
        city.name, len(shapes), (boxes.view == IN_IMAGES).sum(), (boxes.view == IN_LIDAR).sum(),
        len(trees.shapes), s.terrain.min() + city.base_height_m,
        s.terrain.max() + city.base_height_m,
    )  # fmt: skip
    return s


def _moments(city: CitySpec, moment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bits of the worlds before and after the moments [n] at which things change.

    ``moment``: in (0, 1], of the time from the first date to the last.
    """
    before = np.zeros(moment.shape, np.uint8)
    for world, bit in WORLDS.items():
        before |= np.where(city.dates.passed(world) < moment, bit, 0).astype(np.uint8)
    after = np.uint8(IN_LEFT | IN_RIGHT | IN_LIDAR) & ~before
    return _both_images(before), _both_images(after)


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
