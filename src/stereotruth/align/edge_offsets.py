"""By how much an image shows the edges of roofs elsewhere than its sensor model has them.

Across each edge, the slopes of the grey values are looked at, as their median along the edge has
them. Roofs have parapets, gutters and overhangs, and sunlit walls: an image has several lines
beside each other, and which of them is the LiDAR's edge is not known. So every line has a say by
its share of the contrast, and the offset is that at which most of them lie near the edges, within
ROOF_RIM_M. Opposite edges tell how far points and lines lie inwards or outwards of each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from ..core.numerics.geometry import metres_per_degree
from ..core.numerics.statistics import TO_SIGMA
from ..sensor.images import Source
from ..sensor.rpc import SensorModel
from .roof_edges import RoofEdges

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


ROOF_RIM_M = 0.5  # m: lines of one edge lie within, as both sides of a parapet do
INWARD_M = 0.3  # m, standard deviation of how far points lie inwards of a roof's edge
STEP_PX = 0.5  # of a profile across an edge
BLUR_PX = 1.0  # standard deviation, before slopes are taken
LINE_SIGMAS = 6.0  # of the slopes' scatter along an edge, that those of a line stand out
LINE_PX = 0.7  # px, of a line's place
GRID_M = 0.2  # between the offsets that are tried
ROUNDS = 30
FEWEST = 12  # edges with a line, of an image
MARGIN_PX = 4
LARGEST_PX = 1500  # of a window that is read for the edges of a site
WIDE_M = 10.0  # m, standard deviation of an offset in a direction that no edge tells


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

    edge: Integers
    offset: Floats
    share: Floats


def plan_offset(
    source: Source, sensor: SensorModel, edges: RoofEdges, reach_m: float
) -> PlanOffset | str:
    """The offset within ``reach_m`` of all edges in an image, or why it is not known."""
    if len(edges) < FEWEST:
        return f"the LiDAR has only {len(edges)} edges of roofs here"
    at = _Projected.of(sensor, edges)
    lines = _find_lines(source, at, edges.site, reach_m)
    if np.unique(lines.edge).size < FEWEST:
        return f"an image shows only {np.unique(lines.edge).size} edges of roofs"
    change = at.change[lines.edge]
    every = np.ones(lines.edge.size, bool)
    estimate, normal, scores = _estimate(lines, change, every, reach_m)
    sites = edges.site[lines.edge]
    groups = sites if np.unique(sites).size >= FEWEST else lines.edge
    groups = np.unique(groups, return_inverse=True)[1]
    odd = groups % 2 == 1
    halves = np.array([_estimate(lines, change, half, reach_m)[0][:2] for half in (odd, ~odd)])
    total = np.stack([np.bincount(groups, score) for score in scores.T])
    inverse = np.linalg.inv(normal)
    covariance = (inverse @ (total @ total.T + np.diag(_prior())) @ inverse)[:2, :2]
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


def _prior() -> Floats:
    """Information [3] that stands beside the edges, m⁻²."""
    return np.array([WIDE_M, WIDE_M, INWARD_M]) ** -2.0


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
        normal = (change * weight[:, None]).T @ change + np.diag(_prior())
        last = estimate
        estimate = np.linalg.solve(normal, change.T @ (weight * lines.offset))
        if np.abs(estimate - last).max() < 1e-5:
            break
    residual = lines.offset - change @ estimate
    return np.round(estimate, 6), normal, change * (weight * residual)[:, None]


def _find_lines(source: Source, at: _Projected, sites: Integers, reach_m: float) -> _Lines:
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
    picture: NDArray[np.float32], start: Floats, end: Floats, normal: Floats, reach: float
) -> tuple[Floats, Floats]:
    """Offsets px [k] along the ``normal`` at which lines along an edge stand out in a picture, and
    their contrast [k]; none where the picture does not show all of it."""
    across = np.arange(-reach - 2.0, reach + 2.0 + STEP_PX, STEP_PX)
    count = max(int(np.hypot(*(end - start))), 4)
    along = (np.arange(count) + 0.5) / count
    base = start + (end - start) * along[:, None]
    place = (base[:, None, :] + normal * across[:, None]).astype(np.float32)
    grey = cv2.remap(
        picture, place[..., 0], place[..., 1], cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"),
    )  # fmt: skip
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
