"""Edges of roofs: where the LiDAR has them, and by how much an image shows them elsewhere.

An edge is a straight line between the points of a smooth roof and points that lie lower by STEP_M,
along LENGTH_M. Across it, an image has several lines (parapets, gutters, sunlit walls), each of
which has a say by its share of the contrast: the offset is that at which most of them lie near the
edges, within ROOF_RIM_M. Opposite edges tell how far points and lines lie inwards of each other.
See docs/explanation/real_sensors.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter1d

from ..core.numerics.arrays import Bools, Floats, Ints, Singles
from ..core.numerics.geometry import metres_per_degree
from ..core.numerics.statistics import TO_SIGMA
from ..sensor.images import Source
from ..sensor.rpc import SensorModel
from .least_squares_matching import warp_patch

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
ROOF_RIM_M = 0.5  # m: lines of one edge lie within, as both sides of a parapet do
INWARD_M = 0.3  # m, standard deviation of how far points lie inwards of a roof's edge
STEP_PX = 0.5  # of a profile across an edge
BLUR_PX = 1.0  # standard deviation, before slopes are taken
LINE_SIGMAS = 6.0  # of the slopes' scatter along an edge, that those of a line stand out
LINE_PX = 0.7  # px, of a line's place
GRID_M = 0.2  # between the offsets that are tried
ROUNDS = 30
FEWEST_EDGES = 12  # edges with a line, of an image
MARGIN_PX = 6
LARGEST_PX = 1500  # of a window that is read for the edges of a site
WIDE_M = 10.0  # m, standard deviation of an offset in a direction that no edge tells
BESIDE_EDGES = np.array([WIDE_M, WIDE_M, INWARD_M]) ** -2.0  # information, m⁻²


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
    site: Ints

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


@dataclass(frozen=True, eq=False)
class PlanOffset:
    """``offset`` [2] m (east, north) by which all edges lie off in an image, what it shows minus
    where the sensor model has them; ``halves`` [2, 2] by each half of the edges alone;
    ``inward_m`` of the points; ``covariance`` [2, 2] m² by the scatter of edges and halves;
    ``middle`` [3] (lon, lat, height) of the ``edges``, of which there are so many."""

    offset: Floats
    halves: Floats
    inward_m: float
    covariance: Floats
    middle: Floats
    edges: int


@dataclass(frozen=True, eq=False)
class _Projected:
    """n edges in an image, px: both ends, unit normals outward [n, 2]; ``change`` [n, 3]: px along
    the normal for a metre to the east, to the north, and outward."""

    start: Floats
    end: Floats
    normal: Floats
    change: Floats

    @classmethod
    def of(cls, sensor: SensorModel, edges: RoofEdges) -> _Projected:
        height, middle = edges.height, edges.middle
        metres = metres_per_degree(float(middle[:, 1].mean()))

        def project(ground: Floats) -> Floats:
            return np.stack(sensor.project(ground[:, 0], ground[:, 1], height), axis=1)

        start, end, centre = project(edges.start), project(edges.end), project(middle)
        along = (end - start) / np.maximum(np.hypot(*(end - start).T), 1e-9)[:, None]
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        moved = [edges.outward, *(middle + way / metres for way in np.eye(2))]
        ways = [project(ground) - centre for ground in moved]
        normal *= np.where(np.sum(ways[0] * normal, axis=1) < 0.0, -1.0, 1.0)[:, None]
        change = np.column_stack([np.sum(way * normal, axis=1) for way in (*ways[1:], ways[0])])
        return cls(start, end, normal, change)


@dataclass(frozen=True, eq=False)
class _Lines:
    """k lines beside edges: index int[k] of the ``edge``; ``offset`` px [k] along its normal;
    ``share`` [k] of the contrast of its edge."""

    edge: Ints
    offset: Floats
    share: Floats


def plan_offset(
    source: Source, sensor: SensorModel, edges: RoofEdges, reach_m: float
) -> PlanOffset | str:
    """The offset within ``reach_m`` of all edges in an image, or why it is not known."""
    if len(edges) < FEWEST_EDGES:
        return f"the LiDAR has only {len(edges)} edges of roofs here"
    at = _Projected.of(sensor, edges)
    lines = _find_lines(source, at, edges.site, reach_m)
    if np.unique(lines.edge).size < FEWEST_EDGES:
        return f"an image shows only {np.unique(lines.edge).size} edges of roofs"
    change = at.change[lines.edge]
    every = np.ones(lines.edge.size, bool)
    estimate, normal, scores = _estimate(lines, change, every, reach_m)
    sites = edges.site[lines.edge]
    groups = sites if np.unique(sites).size >= FEWEST_EDGES else lines.edge
    groups = np.unique(groups, return_inverse=True)[1]
    odd = groups % 2 == 1
    halves = np.array([_estimate(lines, change, half, reach_m)[0][:2] for half in (odd, ~odd)])
    total = np.stack([np.bincount(groups, score) for score in scores.T])
    inverse = np.linalg.inv(normal)
    covariance = (inverse @ (total @ total.T + np.diag(BESIDE_EDGES)) @ inverse)[:2, :2]
    apart = halves[0] - halves[1]  # parapets of one side of all roofs, say, have no scatter
    used = np.unique(lines.edge)
    middle = np.column_stack([edges.middle, edges.height])[used].mean(axis=0)
    return PlanOffset(
        estimate[:2],
        halves,
        float(estimate[2]),
        covariance + np.outer(apart, apart) / 4.0,
        middle,
        used.size,
    )


def _estimate(
    lines: _Lines, change: Floats, chosen: Bools, reach_m: float
) -> tuple[Floats, Floats, Floats]:
    """(east, north, outward) [3] m by the ``chosen`` lines, normal matrix, and scores [k, 3].

    ``change`` [k, 3] px per m. From the offset at which most of them lie near their edges on, by
    weights that fall off as a normal distribution does.
    """
    width = np.hypot(ROOF_RIM_M * change[:, 2], LINE_PX)
    share = np.where(chosen, lines.share, 0.0)
    axis = np.arange(-np.floor(reach_m / GRID_M), np.floor(reach_m / GRID_M) + 1) * GRID_M
    tried = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    votes = np.zeros(len(tried))
    for k in np.flatnonzero(share):  # memory of one line
        off = (lines.offset[k] - tried @ change[k, :2]) / width[k]
        votes += share[k] * np.exp(-0.5 * off * off)
    estimate = np.append(tried[np.argmax(votes)], 0.0)
    for _ in range(ROUNDS):
        residual = lines.offset - change @ estimate
        weight = share * np.exp(-0.5 * (residual / width) ** 2) / width**2
        normal = (change * weight[:, None]).T @ change + np.diag(BESIDE_EDGES)
        last = estimate
        estimate = np.linalg.solve(normal, change.T @ (weight * lines.offset))
        if np.abs(estimate - last).max() < 1e-5:
            break
    residual = lines.offset - change @ estimate
    return np.round(estimate, 6), normal, change * (weight * residual)[:, None]


def _find_lines(source: Source, at: _Projected, sites: Ints, reach_m: float) -> _Lines:
    """Lines within ``reach_m`` of all edges; read site by site."""
    edge, offset, share = [], [], []
    for site in np.unique(sites):
        members = np.flatnonzero(sites == site)
        reach = reach_m * float(at.change[members, 2].max()) + MARGIN_PX
        ends = np.concatenate([at.start[members], at.end[members]])
        if not np.isfinite(ends).all():
            continue
        low = np.maximum(np.floor(ends.min(axis=0) - reach).astype(int), 0)
        high = np.minimum(np.ceil(ends.max(axis=0) + reach).astype(int) + 1, source.size)
        if (low >= high).any() or (high - low).max() > LARGEST_PX:
            continue
        picture = source.read(*low.tolist(), *(high - low).tolist())
        for k in members:
            ends_of = at.start[k] - low, at.end[k] - low
            reach = reach_m * float(at.change[k, 2])
            places, contrast = _lines_across(picture, *ends_of, at.normal[k], reach)
            edge += [k] * len(places)
            offset += places.tolist()
            share += (contrast / contrast.sum()).tolist() if len(places) else []
    return _Lines(np.array(edge, np.int64), np.array(offset), np.array(share))


def _lines_across(
    picture: Singles, start: Floats, end: Floats, normal: Floats, reach: float
) -> tuple[Floats, Floats]:
    """Offsets px [k] along the ``normal`` at which lines along an edge stand out in a picture, and
    their contrast [k]; none where the picture does not show all of it."""
    across = np.arange(-reach - 2.0, reach + 2.0 + STEP_PX, STEP_PX)
    count = max(int(np.hypot(*(end - start))), 4)
    grey = np.empty((count, across.size), np.float32)
    step = np.column_stack([normal * STEP_PX, (end - start) / count])  # by column, by row
    middle = start + step[:, 1] * (count // 2 + 0.5) + normal * across[across.size // 2]
    warp_patch(picture, *middle, step, (1.0, 1.0), grey)
    if not np.isfinite(grey).all():
        return np.empty(0), np.empty(0)
    smooth = gaussian_filter1d(grey.astype(np.float64), BLUR_PX / STEP_PX, axis=1)
    slopes = np.gradient(smooth, STEP_PX, axis=1)
    median = np.median(slopes, axis=0)
    # 1.25: of a median by a mean's; a blurred image has a value of its own every second pixel
    scatter = 1.25 * TO_SIGMA * np.median(np.abs(slopes - median), axis=0) / np.sqrt(count / 2.0)
    size = np.abs(median)
    stands_out = size >= LINE_SIGMAS * np.maximum(scatter, 0.5 * np.median(scatter))
    peak = stands_out[1:-1] & (size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])
    k = 1 + np.flatnonzero(peak & (np.abs(across[1:-1]) <= reach) & (size[1:-1] > 0.0))
    bend = size[k - 1] - 2.0 * size[k] + size[k + 1]
    return across[k] + STEP_PX * 0.5 * (size[k - 1] - size[k + 1]) / bend, size[k]
