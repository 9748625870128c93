"""The points of a window by pixel, and what it may see of the surface over the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.hull import corners_of_hull
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from ..lidar.point_store import PointStore
from ..lidar.smooth_maps import LocalProjection
from ..surface.surface_store import WindowSurface
from .pair_window import MASKED, USABLE, PairWindow, Patch, read_patch
from .scene_inputs import SceneInputs
from .shifted_agreement import SHIFTED_PX
from .view_geometry import Rays, ViewGeometry

BLOCK = 1 << 16  # points that go through the projection at once, while they are in the cache


@dataclass(frozen=True, eq=False)
class WindowPoints:
    """The points of a window ``by_pixel``; the ``projection`` of all ground around; the
    ``surface`` around, None with the recipe paper."""

    by_pixel: PixelPoints
    projection: LocalProjection
    surface: WindowSurface | None


def read_window(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[PairWindow, WindowPoints] | None:
    """The images and points of a window of the left grid; None if it has no points."""
    footprint = scene.windows.footprint(rows, cols)
    if footprint is None:
        return None
    window = _window(scene, rows, cols, footprint)
    surface = None
    if blocks := scene.surface_blocks(rows, cols):
        surface = scene.ground.window(blocks)
    elif scene.on_surface:
        return None
    points = _points(scene, scene.windows.strips(rows, cols, footprint), window, surface)
    return None if points is None else (window, points)


def _window(scene: SceneInputs, rows: slice, cols: slice, footprint: Footprint) -> PairWindow:
    """Of the left image, the window with its margin; of the right one, all that its points can be
    seen in."""
    margin, size = scene.margin, scene.images_window
    rows = slice(rows.start - margin, rows.stop + margin)
    cols = slice(cols.start - margin, cols.stop + margin)
    x, y, height = (
        grid.reshape(-1)
        for grid in np.meshgrid(
            np.linspace(cols.start - 1.0, cols.stop, 5),
            np.linspace(rows.start - 1.0, rows.stop, 5),
            [footprint.low, footprint.high],
        )
    )
    model, (left, right) = scene.pair.model, scene.pair.images
    x_right = model.ground_to_epipolar(*model.epipolar_to_ground(x, y, height), height)[2]
    x_right = x_right[np.isfinite(x_right)]
    # A few pixels more, for what is not linear in between, and what shifted disparities show.
    more = 8 + SHIFTED_PX
    there = slice(int(x_right.min(initial=0.0)) - more, int(x_right.max(initial=0.0)) + more + 1)
    patches = read_patch(left, rows, cols, size), read_patch(right, rows, there, size)
    return PairWindow(rows, cols, margin, *patches)


def _points(
    scene: SceneInputs, strips: Sequence[Box], window: PairWindow, surface: WindowSurface | None
) -> WindowPoints | None:
    """The points of some strips of the ground; None if none is in the window."""
    if not strips:
        return None
    box = [edge(strip[k] for strip in strips) for k, edge in enumerate((min, min, max, max))]
    heights = scene.windows.heights(box)
    if heights is None:
        return None
    origin = int(np.floor(box[0] / LATTICE_DEG)), int(np.floor(box[1] / LATTICE_DEG))
    low = [*origin, round(heights[0] / LATTICE_M)]
    high = [*(int(np.ceil(edge / LATTICE_DEG)) for edge in box[2:]), round(heights[1] / LATTICE_M)]
    if surface is not None:
        vertices = surface.vertices
        lattice = vertices.lon_q, vertices.lat_q, vertices.h_q
        low = [min(q, int(values.min())) for q, values in zip(low, lattice)]
        high = [max(q, int(values.max())) for q, values in zip(high, lattice)]
    projection = LocalProjection.of(scene.pair.model, low, high)
    collection = Collection(window.shape, window.first, origin, window.left, window.right)
    for strip in strips:
        for store in scene.stores:
            points = store.query(*strip)
            for start in range(0, len(points), BLOCK):
                block = slice(start, start + BLOCK)
                lattice = points.lon_q[block], points.lat_q[block], points.h_q[block]
                attributes = points.classification[block], scene.day_numbers[points.day[block]]
                collection.add(*lattice, *attributes, projection.at_points(*lattice))
    by_pixel = collection.sorted()
    if by_pixel.points.size == 0 and not by_pixel.outside.any():
        return None
    return WindowPoints(by_pixel, projection, surface)


Box = tuple[float, float, float, float]
Floats = NDArray[np.float64]


READ_POINTS = 1 << 20  # about as many are read at once


class Footprint(NamedTuple):
    """Where the points of a window are: box of those that it can show, with their heights (m);
    box ``around`` of what can hide these."""

    box: Box
    low: float
    high: float
    around: Box


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

    def touched(self, rows: slice, cols: slice) -> list[PointStore]:
        """The stores that have points of a window, or in the same cells."""
        footprint = self.footprint(rows, cols)
        strips = [] if footprint is None else self.strips(rows, cols, footprint)
        return [
            store
            for store in self.stores
            if any(store.height_range(*strip) is not None for strip in strips)
        ]

    def parts(self, rows: slice, cols: slice, max_points: int) -> list[tuple[slice, slice]]:
        """The window cut along its longer side until no part expects more points."""
        footprint = self.footprint(rows, cols)
        if footprint is None:
            return []
        tall, broad = rows.stop - rows.start, cols.stop - cols.start
        many = self.expected(self.strips(rows, cols, footprint)) > max_points
        if not many or max(tall, broad) <= 128:
            return [(rows, cols)]
        if tall > broad:
            middle = rows.start + tall // 2
            halves = [(slice(rows.start, middle), cols), (slice(middle, rows.stop), cols)]
        else:
            middle = cols.start + broad // 2
            halves = [(rows, slice(cols.start, middle)), (rows, slice(middle, cols.stop))]
        return [window for half in halves for window in self.parts(*half, max_points)]


Ints = NDArray[np.int64]
Records = NDArray[np.void]
Bytes = NDArray[np.uint8]
Counts = NDArray[np.int32]


BITS = 16
PX = 1 << BITS  # steps per px
_PART = 1 << 20  # points that are collected in one piece
POINT = np.dtype(
    [
        ("disparity", np.int32),  # steps
        ("lon", np.int32),  # lattice steps from the window's origin
        ("lat", np.int32),
        ("height", np.int32),  # lattice steps
        ("u", np.int16),  # steps from the pixel's centre, in the left image
        ("v", np.int16),
        ("parallax", np.int16),  # y_right - y_left, steps; half a pixel at most
        ("surface_class", np.uint8),
        ("day", np.uint8),  # number among the days of the scene's points
    ],
    align=True,  # 24 bytes
)


@dataclass(frozen=True, eq=False)
class PixelPoints:
    """Points of a window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``.

    ``points`` POINT[n] are those in both frames; pixel p (row-major) has those from ``start[p]`` to
    ``start[p + 1]``. ``outside`` [pixels]: number of points that are not in both frames;
    ``masked`` bool[pixels]: whether a mask hides one of them.
    ``origin``: lattice (lon, lat) from which the points count.
    """

    points: Records
    start: Ints
    outside: NDArray[np.int32]
    masked: NDArray[np.bool_]
    shape: tuple[int, int]
    first: tuple[int, int]
    origin: tuple[int, int]

    @cached_property
    def count(self) -> NDArray[np.int32]:
        """Number of points in both frames by pixel, [rows, cols]."""
        return np.diff(self.start).astype(np.int32).reshape(self.shape)


class _Block(NamedTuple):
    """Points [n]: lattice coordinates, ASPRS class, number of the day, ``xy`` [4, n] (px) in both
    images."""

    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    surface_class: Bytes
    day: Bytes
    xy: Floats


class _Frames(NamedTuple):
    """A window of ``shape`` (rows, cols) whose first pixel is (row, col) ``first``; lattice (lon,
    lat) ``origin`` from which points count; pixels of both patches that are ``usable``, and the
    pixel at the ``origin`` of each patch."""

    shape: tuple[int, int]
    first: tuple[int, int]
    origin: tuple[int, int]
    left: Bytes
    right: Bytes
    left_origin: tuple[int, int]
    right_origin: tuple[int, int]


class _Pixels(NamedTuple):
    """Per pixel: ``count`` [pixels + 1] of the points in both frames, from the second element on;
    number of those ``outside``, whether a mask hides one."""

    count: Counts
    outside: Counts
    masked: NDArray[np.bool_]


@kernel
def _take(block: _Block, frames: _Frames, points: Records, pixel: Counts, pixels: _Pixels) -> int:
    """Fills ``points`` and ``pixel`` with those in both frames; returns how many these are."""
    lon_q, lat_q, h_q, xy = block.lon_q, block.lat_q, block.h_q, block.xy
    surface_class, day = block.surface_class, block.day
    shape, first, origin = frames.shape, frames.first, frames.origin
    left, right = frames.left, frames.right
    left_origin, right_origin = frames.left_origin, frames.right_origin
    count, outside, masked = pixels.count, pixels.outside, pixels.masked
    n = 0
    half = PX // 2
    low_x, low_y = first[1] - 1.0, first[0] - 1.0
    high_x, high_y = float(first[1] + shape[1]), float(first[0] + shape[0])
    for k in range(lon_q.size):
        x, y, x_right, y_right = xy[0, k], xy[1, k], xy[2, k], xy[3, k]
        if not (low_x < x < high_x and low_y < y < high_y and np.isfinite(x_right)):
            continue
        u, v = np.int64(np.rint(x * PX)), np.int64(np.rint(y * PX))
        col, row = (u + half) >> BITS, (v + half) >> BITS
        i, j = col - first[1], row - first[0]
        if i < 0 or j < 0 or i >= shape[1] or j >= shape[0]:
            continue
        p = j * shape[1] + i
        # The test is of the places as rounded: what is read later lies in the frame.
        u_right = np.int64(np.rint(x_right * PX))
        shift = min(max(np.int64(np.rint(y_right * PX)) - v, -half), half - 1)
        # In line: as a function that takes arrays, it took 20 of 29 ns.
        c, r = (u >> BITS) - left_origin[1], (v >> BITS) - left_origin[0]
        d, q = (u_right >> BITS) - right_origin[1], (v + shift >> BITS) - right_origin[0]
        framed = 0 <= r < left.shape[0] and 0 <= c < left.shape[1]
        framed = framed and 0 <= q < right.shape[0] and 0 <= d < right.shape[1]
        if framed:
            in_left, in_right = left[np.uint64(r), np.uint64(c)], right[np.uint64(q), np.uint64(d)]
            framed = in_left & in_right == USABLE
            masked[p] |= (in_left | in_right) & MASKED != 0
        if not framed:
            outside[p] += 1
            continue
        point = points[n]
        point.disparity = u - u_right
        point.lon = lon_q[k] - origin[0]
        point.lat = lat_q[k] - origin[1]
        point.height = h_q[k]
        point.u = u - (col << BITS)
        point.v = v - (row << BITS)
        point.parallax = shift
        point.surface_class = surface_class[k]
        point.day = day[k]
        pixel[n] = p
        count[p + 1] += 1
        n += 1
    return n


@kernel
def _scatter(points: Records, pixel: Counts, cursor: Ints, out: Records) -> None:
    """Points [n] to the next free element of their ``pixel``, which ``cursor`` counts."""
    for k in range(pixel.size):
        out[cursor[pixel[k]]] = points[k]
        cursor[pixel[k]] += 1


@dataclass(eq=False)
class Collection:
    """Takes the points of a window, block by block."""

    shape: tuple[int, int]
    first: tuple[int, int]
    origin: tuple[int, int]
    left: Patch
    right: Patch
    parts: list[tuple[Records, NDArray[np.int32]]] = field(default_factory=list)
    taken: int = 0  # of the last part

    def __post_init__(self) -> None:
        size = self.shape[0] * self.shape[1]
        count, outside = (np.zeros(n, dtype=np.int32) for n in (size + 1, size))
        self.pixels = _Pixels(count, outside, np.zeros(size, dtype=np.bool_))
        self.frames = _Frames(
            self.shape,
            self.first,
            self.origin,
            self.left.usable,
            self.right.usable,
            (self.left.row, self.left.col),
            (self.right.row, self.right.col),
        )

    def add(
        self, lon_q: Ints, lat_q: Ints, h_q: Ints, surface_class: Bytes, day: Bytes, xy: Floats
    ) -> None:
        """Points by lattice coordinates, class and number of the day, and where they are seen:
        ``xy`` [4, n], px."""
        if not self.parts or self.taken + lon_q.size > self.parts[-1][1].size:
            self._close()
            size = max(_PART, lon_q.size)
            self.parts.append((np.empty(size, dtype=POINT), np.empty(size, dtype=np.int32)))
        points, pixel = (array[self.taken :] for array in self.parts[-1])
        block = _Block(lon_q, lat_q, h_q, surface_class, day, xy)
        self.taken += _take(block, self.frames, points, pixel, self.pixels)

    def _close(self) -> None:
        if self.parts:
            self.parts[-1] = tuple(array[: self.taken] for array in self.parts[-1])
        self.taken = 0

    def sorted(self) -> PixelPoints:
        """All that was taken; empties the collection."""
        self._close()
        start = np.cumsum(self.pixels.count, dtype=np.int64)
        points = np.empty(int(start[-1]), dtype=POINT)
        cursor = start[:-1].copy()
        for part in range(len(self.parts)):
            _scatter(*self.parts[part], cursor, points)
            self.parts[part] = None
        self.parts = []
        outside, masked = self.pixels.outside, self.pixels.masked
        return PixelPoints(points, start, outside, masked, self.shape, self.first, self.origin)
