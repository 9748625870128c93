"""Building a city: terrain, water, land use, buildings and trees, from its spec alone.

The same spec gives the same city in every process, so that images, LiDAR and truth can be made by
separate jobs.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from stereotruth.core.kernels import kernel

from .buildings import FLAT, choose_changed, place_buildings, place_vehicles
from .canopy import place_canopy, place_trees
from .cities import CitySpec
from .dated_worlds import dated_buildings, dated_trees
from .layout import draw_zones, extent
from .surfaces import (
    CELL_M,
    IN_IMAGES,
    IN_LIDAR,
    Surfaces,
    direction_of_sun,
    horizon,
    lidar_horizon,
    terrain_heights,
)
from .terrain import (
    BROAD_STEP_M,
    FINE_STEP_M,
    TERRAIN_STEP_M,
    TEXTURE_SIZE,
    make_terrain,
    spectral_noise,
)
from .twin_world import patch_tops, place_of

log = logging.getLogger("stereotruth")


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


class Objects(NamedTuple):
    """Boxes or crowns, the bits of their views, and their style, as in Surfaces."""

    shapes: np.ndarray
    view: np.ndarray
    style: np.ndarray


def build_surfaces(city: CitySpec) -> Surfaces:
    """Everything that stands in a city, ready for casting rays. Some seconds."""
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
        boxes = np.concatenate([boxes, vehicles.boxes])
        style = np.concatenate([style, vehicles.style])
        view = np.concatenate([view, vehicles.view])
    trees, tree_view, _ = dated_trees(city, trees)
    tree_style = np.tile([1.0, 0.0], (len(trees), 1))
    if city.character.canopy is not None:
        canopy = place_canopy(city, city.character.canopy, s, sites, boxes)
        trees = np.concatenate([trees, canopy.crowns])
        tree_view = np.concatenate([tree_view, canopy.view])
        tree_style = np.concatenate([tree_style, canopy.style])
    return _standing(city, s, Objects(boxes, view, style), Objects(trees, tree_view, tree_style))


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
