"""Where the points of a window are, and what it may see of the surface over the ground.

A window of the left epipolar grid shows the points of a box on the ground that depends on their
heights; what can hide these lies around it. Points come in blocks, with their places in both images
(:meth:`WindowGround.blocks`), so that no window's points are in memory at once.

Ground is in view if a surface there, at any height of the points around it, may be seen in the
window's pixels from either camera: blocks of the surface's store, then squares of these. The points
of a window hold more: low ground where only a tower would hide something.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.arrays import Bools, Bytes, Floats, Ints
from ..core.numerics.geometry import corners_of_hull
from ..core.numerics.windows import box_max
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from ..lidar.point_store import PointStore
from ..lidar.smooth_maps import LocalProjection
from ..surface.scale import PART_BITS
from ..surface.surface_store import SQUARE_BITS, Block, Region, WindowSurface
from ..surface.vertices import Vertices
from .view_geometry import Rays, ViewGeometry

Box = tuple[float, float, float, float]

READ_POINTS = 1 << 20  # about as many are read at once
MOST_POINTS = 2_000_000  # of a window whose surface is worked on at once
BLOCK = 1 << 16  # points that go through the projection at once, while they are in the cache


SPARE_PX = 3.0  # for what is not linear in a square or between places of a block, and roundings
# A pixel may see a surface that is extrapolated beyond its points: its position in the right image
# lies up to this much farther off.
EXTRAPOLATED_PX = 16.0


class Footprint(NamedTuple):
    """Where the points of a window are: box of those that it can show, with their heights (m);
    box ``around`` of what can hide these."""

    box: Box
    low: float
    high: float
    around: Box


class PointBlock(NamedTuple):
    """Points [n]: lattice coordinates, ASPRS class, day since 1970-01-01 (0: not known), ``xy``
    [4, n] (px) in both images."""

    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    surface_class: Bytes
    day: NDArray[np.uint16]
    xy: Floats


@dataclass(frozen=True, eq=False)
class WindowGround:
    """The points of ``strips`` of the ground, the ``projection`` of all ground around, and the
    ``surface`` around, None with the recipe paper."""

    stores: tuple[PointStore, ...]
    strips: Sequence[Box]
    projection: LocalProjection
    surface: WindowSurface | None

    def blocks(self) -> Iterator[PointBlock]:
        """All points, by block."""
        for strip in self.strips:
            for store in self.stores:
                points = store.query(*strip)
                for start in range(0, len(points), BLOCK):
                    part = slice(start, start + BLOCK)
                    lattice = points.lon_q[part], points.lat_q[part], points.h_q[part]
                    xy = self.projection.at_points(*lattice)
                    yield PointBlock(*lattice, points.classification[part], points.day[part], xy)


@dataclass(frozen=True, eq=False)
class PointWindows:
    """The points of ``stores`` by windows (rows, cols) of the left epipolar grid.

    ``margin``: pixels around a window whose points have a say in it. ``reach``: degrees (lon, lat)
    around a place of the surface between triangles there and their vertices.
    """

    model: ViewGeometry
    rays: Rays
    stores: tuple[PointStore, ...]
    margin: int
    reach: tuple[float, float]

    def ground_box(self, rows: slice, cols: slice, low: float, high: float) -> Box | None:
        """lon, lat box (degrees) of what a window of the left grid can show at these heights."""
        ground = self.ground_outline(rows, cols, low, high)
        if ground.size == 0:
            return None
        (west, south), (east, north) = ground.min(axis=1), ground.max(axis=1)
        # Two pixels more, for the curvature of the edges.
        spare = 4.0 * np.array(self.rays.cell) * LATTICE_DEG
        return west - spare[0], south - spare[1], east + spare[0], north + spare[1]

    def ground_outline(self, rows: slice, cols: slice, low: float, high: float) -> Floats:
        """lon, lat [2, n] (degrees) along the edges of a window and its margin at two heights."""
        margin = self.margin
        x = np.linspace(cols.start - margin - 1.0, cols.stop + margin, 5)
        y = np.linspace(rows.start - margin - 1.0, rows.stop + margin, 5)
        edge_x = np.concatenate([x, x, np.full(5, x[0]), np.full(5, x[-1])])
        edge_y = np.concatenate([np.full(5, y[0]), np.full(5, y[-1]), y, y])
        ground = np.hstack(
            [np.stack(self.model.epipolar_to_ground(edge_x, edge_y, h)) for h in (low, high)]
        )
        return ground[:, np.isfinite(ground).all(axis=0)]

    def heights(self, box: Box) -> tuple[float, float] | None:
        """Lowest and highest point (m) of the stores' cells that a box touches."""
        each = [r for r in (store.height_range(*box) for store in self.stores) if r is not None]
        return (min(r[0] for r in each), max(r[1] for r in each)) if each else None

    def footprint(self, rows: slice, cols: slice) -> Footprint | None:
        """Of a window; None if there are no points."""
        low = min(store.bounds[4] for store in self.stores)
        top = high = max(store.bounds[5] for store in self.stores)
        box = None
        for _ in range(3):  # heights narrow the box, the box narrows the heights
            box = self.ground_box(rows, cols, low, high)
            heights = None if box is None else self.heights(box)
            if heights is None:
                return None
            low, high = heights
        moves = self.rays.moves(cols, rows)
        spare = np.array(self.reach) + self.spare
        around = box
        for _ in range(3):
            rise = top - low
            around = (
                box[0] + moves[0, 0] * rise - spare[0],
                box[1] + moves[1, 0] * rise - spare[1],
                box[2] + moves[0, 1] * rise + spare[0],
                box[3] + moves[1, 1] * rise + spare[1],
            )
            top = self.heights(around)[1]
        return Footprint(box, low, high, around)

    @property
    def spare(self) -> Floats:
        """Degrees (lon, lat) of two cells around, for what is not linear in between."""
        return 2.0 * np.array(self.rays.cell) * LATTICE_DEG

    def strips(
        self, rows: slice, cols: slice, footprint: Footprint, *, by_row: bool = False
    ) -> list[Box]:
        """Boxes, one for some rows of cells of the stores each, of the points a window needs.

        They cover the hull of what it can show. A box around the hull of a turned image would hold
        up to twice as many points. ``by_row``: one box for each row.
        """
        ground = self.ground_outline(rows, cols, footprint.low, footprint.high)
        box = footprint.box
        hull = ground[:, corners_of_hull(*ground)]
        after = np.roll(hull, -1, axis=1)
        rise = after[1] - hull[1]
        slope = (after[0] - hull[0]) / np.where(rise == 0.0, np.inf, rise)
        spare = self.spare
        side = LATTICE_DEG * (1 << CELL_BITS)
        first, last = (int(np.floor(edge / side)) for edge in (box[1], box[3]))
        step = max(round(READ_POINTS / max(self.expected([box]), 1.0) * (last + 1 - first)), 1)
        if by_row:
            step = 1
        strips = []
        for row in range(first, last + 1, step):
            # Half a step below the border, so that no point lies on it.
            south, north = (
                np.clip(edge * side - 0.5 * LATTICE_DEG, box[1], box[3])
                for edge in (row, row + step)
            )
            # Where the sides of the hull, cut off at the strip's borders, begin and end.
            ends = np.clip([hull[1], after[1]], south - spare[1], north + spare[1])
            lon = hull[0] + slope * (ends - hull[1])
            touched = np.ptp(ends, axis=0) > 0.0
            if touched.any():
                west, east = lon[:, touched].min(), lon[:, touched].max()
                strips.append((west - spare[0], south, east + spare[0], north))
        return strips

    def beyond_stores(self, rows: slice, cols: slice) -> float:
        """Ground (m²) whose points a window needs, and which the stores' footprints leave out.

        In whole cells of the stores, of the store that leaves out most of it.
        """
        footprint = self.footprint(rows, cols)
        if footprint is None:
            return 0.0
        boxes = np.array(self.strips(rows, cols, footprint, by_row=True)).reshape(-1, 4)
        held = [store.footprint for store in self.stores]
        return max((f.beyond_m2(boxes) for f in held if f is not None), default=0.0)

    def expected(self, boxes: Sequence[Box]) -> float:
        """About how many points lie in boxes, if the stores are evenly filled."""
        total = 0.0
        for store in self.stores:
            west, south, east, north = store.bounds[:4]
            for box in boxes:
                share = 1.0
                for a, b, low, high in (
                    (box[0], box[2], west, east),
                    (box[1], box[3], south, north),
                ):
                    share *= max(min(b, high) - max(a, low), 0.0) / max(high - low, 1e-12)
                total += store.count * share
        return total

    def parts(self, rows: slice, cols: slice) -> list[slice]:
        """The rows of a window, cut so that no part expects more than MOST_POINTS; none without
        points."""
        footprint = self.footprint(rows, cols)
        if footprint is None:
            return []
        count = int(self.expected(self.strips(rows, cols, footprint)) // MOST_POINTS) + 1
        step = -(-(rows.stop - rows.start) // count)
        every = range(rows.start, rows.stop, step)
        return [slice(first, min(first + step, rows.stop)) for first in every]

    def touched(self, rows: slice, cols: slice) -> list[PointStore]:
        """The stores that have points of a window, or in the same cells."""
        footprint = self.footprint(rows, cols)
        strips = [] if footprint is None else self.strips(rows, cols, footprint)
        return [
            store
            for store in self.stores
            if any(store.height_range(*strip) is not None for strip in strips)
        ]

    def ground(self, strips: Sequence[Box], surface: WindowSurface | None) -> WindowGround | None:
        """Of some strips of the ground with the surface around; None if no point lies there."""
        if not strips:
            return None
        box = [edge(strip[k] for strip in strips) for k, edge in enumerate((min, min, max, max))]
        heights = self.heights(box)
        if heights is None:
            return None
        low = [*(int(np.floor(edge / LATTICE_DEG)) for edge in box[:2])]
        high = [*(int(np.ceil(edge / LATTICE_DEG)) for edge in box[2:])]
        low, high = ([*q, round(height / LATTICE_M)] for q, height in zip((low, high), heights))
        if surface is not None:
            vertices = surface.vertices
            lattice = vertices.lon_q, vertices.lat_q, vertices.h_q
            low = [min(q, int(values.min())) for q, values in zip(low, lattice)]
            high = [max(q, int(values.max())) for q, values in zip(high, lattice)]
        projection = LocalProjection.of(self.model, low, high)
        return WindowGround(self.stores, strips, projection, surface)


@kernel
def _ranges(x: Ints, y: Ints, h: Ints, low: Ints, high: Ints) -> None:
    """Least and greatest height in each square."""
    for k in range(x.size):
        j, i = y[k] >> SQUARE_BITS, x[k] >> SQUARE_BITS
        low[j, i], high[j, i] = min(low[j, i], h[k]), max(high[j, i], h[k])


def blocks_in_view(
    blocks: Sequence[Block], model: ViewGeometry, first: tuple[int, int], shape: tuple[int, int]
) -> tuple[Block, ...]:
    """Of the ``blocks`` around a window, those that hold a square of :func:`ground_in_view`.

    The box around the ground of a turned window holds up to twice as many. One at least, if there
    are any, since a window may have points and no surface.
    """
    if not blocks:
        return ()
    box = np.array([block.box for block in blocks], dtype=np.float64)
    heights = np.array([block.heights for block in blocks]) * LATTICE_M
    share = np.linspace(0.0, 1.0, 3)[:, None]
    lon, lat = (box[:, k] + share * (box[:, k + 2] - box[:, k]) for k in (0, 1))
    at = [  # three places along each side, at the lowest and the highest surface around
        model.ground_to_epipolar(x * LATTICE_DEG, y * LATTICE_DEG, np.full(len(box), height))
        for x in lon
        for y in lat
        for height in (heights.min(), heights.max())
    ]
    seen = _in_view(np.stack(at, axis=1), first, shape)
    return tuple(block for block, in_view in zip(blocks, seen) if in_view) or tuple(blocks[:1])


def ground_in_view(
    vertices: Vertices,
    reach: float,
    cell: tuple[int, int],
    projection: LocalProjection,
    first: tuple[int, int],
    shape: tuple[int, int],
) -> Region:
    """Of a window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``.

    Surfaces may be as high as any of the ``vertices`` up to ``reach`` (parts of a cell) away.
    ``cell``: (lon, lat) size, lattice steps. ``projection`` holds all that lies in the box of the
    vertices.
    """
    grid = tuple((int(v.max(initial=0)) >> SQUARE_BITS) + 1 for v in (vertices.y, vertices.x))
    far = np.iinfo(np.int64).max
    low, high = np.full(grid, far), np.full(grid, -far)
    _ranges(vertices.x, vertices.y, vertices.h_q, low, high)
    around = (int(reach) >> SQUARE_BITS) + 1
    low, high = -box_max(-low, around), box_max(high, around)
    squares = high >= low
    if squares.any():
        row, col = np.nonzero(squares)
        corners = _corners(vertices, cell, row, col, low[squares], high[squares])
        xy = projection.at_points(*corners).reshape(4, 8, -1)
        squares[squares] = _in_view(xy, first, shape)
    return Region(squares)


def _corners(
    vertices: Vertices, cell: tuple[int, int], row: Ints, col: Ints, low: Ints, high: Ints
) -> Ints:
    """Lattice coordinates [3, 8 n] of the corners of squares at two heights."""
    edges = []
    for square, q, plan, size in (
        (col, vertices.lon_q, vertices.x, cell[0]),
        (row, vertices.lat_q, vertices.y, cell[1]),
    ):
        at = np.stack([square, square + 1]) * (size << (SQUARE_BITS - PART_BITS))
        at += q[0] - (plan[0] * size >> PART_BITS)
        # the projection holds the positions of points alone
        edges.append(np.clip(at, q.min(), q.max()))
    return np.hstack(
        [
            np.stack([edges[0][i], edges[1][j], height])
            for i in range(2)
            for j in range(2)
            for height in (low, high)
        ]
    )


def _in_view(xy: Floats, first: tuple[int, int], shape: tuple[int, int]) -> Bools:
    """Which parts [n] of the ground a window may see, by the positions ``xy`` [4, k, n] (px) of k
    places around each."""
    (top, side), (rows, cols) = first, shape
    unknown = ~np.isfinite(xy).all(axis=(0, 1))
    disparity = xy[0] - xy[2]
    least, most = xy.min(axis=1) - SPARE_PX, xy.max(axis=1) + SPARE_PX
    with np.errstate(invalid="ignore"):
        in_rows = (least[[1, 3]] <= top + rows - 1) & (most[[1, 3]] >= top)
        in_left = in_rows[0] & (least[0] <= side + cols - 1) & (most[0] >= side)
        shift = disparity[:, in_left & ~unknown]
        if shift.size == 0:
            return in_left | unknown
        nearest, farthest = shift.max() + EXTRAPOLATED_PX, shift.min() - EXTRAPOLATED_PX
        in_right = (least[2] <= side + cols - 1 - farthest) & (most[2] >= side - nearest)
    return in_left | (in_rows[1] & in_right) | unknown
