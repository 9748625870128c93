"""Edges of roofs, from the points: where a roof ends and the surface beside it lies lower.

Such an edge stands in a fixed place over the ground, and an image shows it as a line. Level ground
tells nothing of its own place; its roofs do. An edge is a straight line between a smooth roof and
points that lie lower by STEP_M at least, along LENGTH_M. Crowns are no roofs: their points lie on
no plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ..core.numerics.geometry import metres_per_degree

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


STEP_M = 2.5  # m that a roof lies above what is beside it: more than cars, hedges and fences
LENGTH_M, LENGTH_SPACINGS = 10.0, 10.0  # of an edge, at most: a wall of a house
SHORTEST = 0.6  # of this length, that a wall has to have
COVERED = 0.8  # of an edge's length along which there is a step
SIDE_M = 4.0  # m to both sides that are looked at
ONE_ROOF_M = 0.75  # m between the heights of the steps of one edge
SMOOTH_M, SMOOTH = 0.3, 0.8  # m from a roof's plane within which this share of its points lies
STEEPEST = 0.6  # m per m, of a roof
LOW = 0.9  # share of the points beside a roof that lie lower
MISPLACED = 0.08  # share of the points on the wrong side of an edge, at most
BESIDE = 4.5  # cells around a step where no other line is looked for
FEWEST = 6  # steps, and points of each side
TURNS = np.radians(np.arange(-6.0, 6.5, 1.0))  # of a line, that are tried
EMPTY_CELLS = 3.0  # cells from the nearest point on: nothing is known there


@dataclass(frozen=True, eq=False)
class RoofEdges:
    """n edges over the ground, degrees and ellipsoidal m.

    ``start``, ``end``, ``outward`` [n, 2]: (lon, lat) of both ends, and of a place 1 m beside the
    middle on the lower side; ``height`` [n] of the roof there; ``site`` int[n] of the scene.
    """

    start: Floats
    end: Floats
    outward: Floats
    height: Floats
    site: Integers

    def __len__(self) -> int:
        return self.site.size

    @property
    def middle(self) -> Floats:
        """[n, 2] (lon, lat)."""
        return (self.start + self.end) / 2.0

    @classmethod
    def concatenate(cls, parts: list[RoofEdges]) -> RoofEdges:
        """Those of all sites."""
        none = cls(*(np.zeros((0, 2)),) * 3, np.zeros(0), np.zeros(0, np.int64))
        return cls(
            *(np.concatenate([vars(p)[name] for p in (none, *parts)]) for name in vars(none))
        )


def find_roof_edges(lon: Floats, lat: Floats, height: Floats, site: int, most: int) -> RoofEdges:
    """Edges of the roofs among points [n] of a ``site``, ``most`` of them at most.

    Points that may be crowns or water are left out before.
    """
    metres = metres_per_degree(float(lat.mean()))
    origin = np.array([lon.min(), lat.min()])
    at = (np.column_stack([lon, lat]) - origin) * metres
    lines = _lines(at, height, most)
    start, end, out = lines[:, 0:2], lines[:, 2:4], lines[:, 4:6]
    outward = (start + end) / 2.0 + out
    ground = [origin + place / metres for place in (start, end, outward)]
    return RoofEdges(*ground, lines[:, 6], np.full(len(lines), site))


def _steps(at: Floats, height: Floats, cell: float) -> Floats:
    """Steps [k, 6] between neighbouring cells: place, direction to the lower side, height m of
    both sides, the upper one first.

    A cell has the height of its highest point; empty ones that of the nearest cell.
    """
    col, row = np.floor(at / cell).astype(np.int64).T
    top = np.full((row.max() + 1, col.max() + 1), -np.inf)
    np.maximum.at(top, (row, col), height)
    distance, nearest = distance_transform_edt(np.isinf(top), return_indices=True)
    top = top[tuple(nearest)]
    top[distance > EMPTY_CELLS] = np.nan
    found = []
    for axis in (0, 1):
        change = np.diff(top, axis=axis)
        j, i = np.nonzero(np.abs(change) >= STEP_M)
        one, other = top[j, i], (top[j + 1, i] if axis == 0 else top[j, i + 1])
        along, across = (np.array([i + 0.5, j + 1.0]), 1) if axis == 0 else ((i + 1.0, j + 0.5), 0)
        way = np.zeros((i.size, 2))
        way[:, across] = np.sign(one - other)
        sides = np.maximum(one, other), np.minimum(one, other)
        found.append(np.column_stack([np.array(along).T * cell, way, *sides]))
    return np.concatenate(found)


def _lines(at: Floats, height: Floats, most: int) -> Floats:
    """Edges [k, 7] among points ``at`` [n, 2] m: both ends, unit direction outward, height m."""
    cell = float(np.sqrt(np.prod(np.ptp(at, axis=0)) / len(at)))
    length = max(LENGTH_M, LENGTH_SPACINGS * cell)
    if not cell > 0.0 or np.ptp(at, axis=0).min() < length:
        return np.zeros((0, 7))
    steps = _steps(at, height, cell)
    if len(steps) < FEWEST:
        return np.zeros((0, 7))
    from scipy.spatial import cKDTree  # most pairs look for no edges

    tree, points = cKDTree(steps[:, :2]), cKDTree(at)
    free, tried = np.ones(len(steps), bool), np.zeros(len(steps), bool)
    lines = []
    # in any order but that of the place: of a site with many edges all sides have their share
    for k in np.random.default_rng(len(steps)).permutation(len(steps)):
        if tried[k] or not free[k]:
            continue
        near = np.array(tree.query_ball_point(steps[k, :2], length / 2, return_sorted=True))
        near = near[free[near] & (np.abs(steps[near, 4] - steps[k, 4]) < ONE_ROOF_M)]
        beside = np.abs(steps[near, :2] - steps[k, :2]).max(axis=1) < BESIDE * cell
        tried[near[beside]] = True
        enough = max(FEWEST, COVERED * SHORTEST * length / cell)
        line = _line_of(steps[near], length, cell) if near.size >= enough else None
        if line is None:
            continue
        chosen, middle, along, half = line
        free[near[chosen]] = False
        roof = float(np.median(steps[near[chosen], 4]))
        reach = points.query_ball_point(middle, float(np.hypot(half, SIDE_M)), return_sorted=True)
        edge = _edge_of(at[reach], height[reach], middle, along, half, roof, cell)
        if edge is not None:
            lines.append(edge)
            if len(lines) == most:
                break
    return np.array(lines).reshape(-1, 7)


def _line_of(
    steps: Floats, length: float, cell: float
) -> tuple[Bools, Floats, Floats, float] | None:
    """Which of some ``steps`` [k, 6] lie on a line, its middle [2], its direction [2] with the
    lower side to the left, and half of its length m; None where there is none."""
    place, way = steps[:, :2], steps[:, 2:4]
    chosen = np.ones(len(steps), bool)
    for width in (2.4, 2.4, 1.2, 1.2):
        centre = place[chosen].mean(axis=0)
        offset = place - centre
        xx, xy, yy = (float((offset[chosen, a] * offset[chosen, b]).sum()) for a, b in
                      ((0, 0), (0, 1), (1, 1)))  # fmt: skip
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
        along = np.array([np.cos(angle), np.sin(angle)])
        out = np.array([-along[1], along[0]])
        if way[chosen].mean(axis=0) @ out < 0.0:
            along, out = -along, -out
        chosen = (np.abs(offset @ out) < width * cell) & (way @ out > -0.1)
        if chosen.sum() < FEWEST:
            return None
    t = (place[chosen] - centre) @ along
    span = float(np.ptp(t))
    full = np.unique(np.floor(t / cell)).size * cell
    if span < SHORTEST * length or full < COVERED * span:
        return None
    middle = centre + along * (t.min() + t.max()) / 2.0
    return chosen, middle, along, span / 2.0 - cell / 2.0


def _edge_of(
    at: Floats,
    height: Floats,
    middle: Floats,
    along: Floats,
    half: float,
    roof: float,
    cell: float,
) -> Floats | None:
    """The edge [7] between the points of a roof and those beside it, from a line near it; or None.

    It parts both with the fewest points on the wrong side, in the middle of all such lines.
    """
    out = np.array([-along[1], along[0]])
    u, v = (at - middle) @ along, (at - middle) @ out
    inside = (np.abs(u) < half) & (np.abs(v) < SIDE_M)
    u, v, z = u[inside], v[inside], height[inside]
    on_roof = (v < -cell) & (np.abs(z - roof) < 2.0 * ONE_ROOF_M)
    if on_roof.sum() < FEWEST or (v > cell).sum() < FEWEST:
        return None
    design = np.column_stack([np.ones(u.size), u, v])
    weight = np.ones(int(on_roof.sum()))
    for _ in range(5):  # the sum of the distances is made least
        root = np.sqrt(weight)
        plane = np.linalg.lstsq(design[on_roof] * root[:, None], z[on_roof] * root, rcond=None)[0]
        weight = 1.0 / np.maximum(np.abs(z[on_roof] - design[on_roof] @ plane), 0.05)
    above = z - design @ plane
    if np.hypot(plane[1], plane[2]) > STEEPEST:
        return None
    if np.mean(np.abs(above[v < -cell]) < SMOOTH_M) < SMOOTH:
        return None
    if np.mean(above[v > cell] < -STEP_M / 2.0) < LOW:
        return None
    turn, offset, wrong = _parting(u, v, above > -STEP_M / 2.0)
    if wrong > MISPLACED * u.size or abs(offset) > 2.0 * cell:
        return None
    along, out = (
        along * np.cos(turn) + out * np.sin(turn),
        out * np.cos(turn) - along * np.sin(turn),
    )
    centre = middle + out * offset
    ends = centre - along * half, centre + along * half
    return np.concatenate([*ends, out, [plane[0] + plane[2] * offset]])


def _parting(u: Floats, v: Floats, high: Bools) -> tuple[float, float, int]:
    """The line v = offset + u tan(turn) that parts the ``high`` points below it from the others.

    Its turn (radians) and offset (m), in the middle of the widest gap of those with the fewest
    points on the wrong side, and how many these are.
    """
    best: tuple[tuple[int, float], float, float] | None = None
    for turn in TURNS:
        across = v - u * np.tan(turn)
        order = np.argsort(across, kind="stable")
        across, is_high = across[order], high[order]
        # with the line behind the first k points: high ones above it, and low ones below
        wrong = is_high.sum() + np.concatenate([[0], np.cumsum(1 - 2 * is_high.astype(int))])
        fewest = int(wrong[1:-1].min())
        k = 1 + np.flatnonzero(wrong[1:-1] == fewest)
        gap = across[k] - across[k - 1]
        widest = int(np.argmax(gap))
        rank = fewest, -float(gap[widest])
        if best is None or rank < best[0]:
            best = rank, float(turn), float(across[k[widest]] + across[k[widest] - 1]) / 2.0
    assert best is not None
    return best[1], best[2], best[0][0]
