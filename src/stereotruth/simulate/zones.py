"""Land use of a city: zones, each with its grid of blocks and streets."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import cKDTree

from .cities import CitySpec
from .surfaces import CELL_M, Surfaces, terrain_heights

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
