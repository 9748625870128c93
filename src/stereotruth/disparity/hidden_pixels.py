"""What hides a point from the left or the right view, seen from the point cloud itself.

The paper (section III-C) removes hidden points by the correlation of image windows alone
(:mod:`stereotruth.disparity.paper_correlation`). Here the points decide by themselves:

1. A pixel shows the surface that its centre sees. Points that others, nearer to the left camera
   (of larger disparity), surround in the left image are covered; the uncovered point nearest to
   the centre tells the surface (:func:`.seen_surface.seen_surface`).
2. The scene is a grid of ground cells, each as high as the top surface of its points. Below its top
   a cell counts as solid, so that walls hide although no LiDAR point lies on them
   (:class:`SurfaceBuilder`).
3. What a pixel shows is hidden in a view if the ray from there to that camera, which rises along a
   straight track over the ground, runs into a cell (:func:`hidden_pixels`).

Nothing is tuned to a scene: ray directions, cell size and tolerances follow from the epipolar
model. Cells lie on the global lattice of the points and rays depend on the model only, so that
results do not depend on blocks, files or their order.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..lidar.lattice import LATTICE_DEG, LATTICE_M
from .one_surface import SURFACE_PX
from .view_geometry import ViewGeometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]


# Cells are finer than pixels, so that walls stand where they are: 0.7 % more of the visible pixels
# were kept than with cells of a pixel, at equal shares of hidden ones.
CELL_PX = 0.5
# A ray is stopped by a cell that reaches TOLERANCE_PX of disparity (as height) above it. A cell
# with a step of SURFACE_PX before it is taken to begin AHEAD_CELLS earlier (roof edges are sampled
# on their inner side). The ray's first NEAREST_CELLS do not count (noise would hide itself).
TOLERANCE_PX = 0.25
AHEAD_CELLS = 0.75
NEAREST_CELLS = 0.5
# Rounds of filling cells without points: radius in cells within which three known ones are needed.
FILL_RADII = (1, 2, 4)
_TILE = 8  # cells, of the coarse grid of maxima that bounds the search
_PER_M = round(1 / LATTICE_M)


@dataclass(frozen=True, eq=False)
class Rays:
    """Directions of the rays to both cameras, and the size of the surface's cells.

    ``track`` float64[2, 2, 3]: (view, lon or lat, coefficients of 1, x, y): degrees that a ray to
    the left (0) or right (1) camera moves over the ground per metre of height, as a linear function
    of the left epipolar pixel. ``cell``: (lon, lat) size of a cell in lattice steps.
    ``px_per_m``: disparity per metre of height in the scene's middle.
    """

    track: Floats
    cell: tuple[int, int]
    px_per_m: float

    @classmethod
    def of(cls, model: ViewGeometry) -> Rays:
        """From the epipolar model alone."""
        rows, cols = model.shape
        # An odd count, so that the middle of the grid is among the places.
        y, x = (
            c.reshape(-1)
            for c in np.meshgrid(
                np.linspace(0, rows - 1, 5), np.linspace(0, cols - 1, 5), indexing="ij"
            )
        )
        low = np.full(x.size, float(model.reference_height))
        rise = 50.0  # m
        lon, lat = model.epipolar_to_ground(x, y, low)
        base = model.ground_to_epipolar(lon, lat, low)
        x_high = x.copy()
        left = np.stack(model.epipolar_to_ground(x, y, low + rise))
        right = left
        disparity = np.zeros(x.size)
        for step in range(4):  # x_left of the point of the right ray at the greater height
            right = np.stack(model.epipolar_to_ground(x_high, y, low + rise))
            there = model.ground_to_epipolar(*right, low + rise)
            if step == 0:
                disparity = there[0] - there[2] - (base[0] - base[2])
            x_high += base[2] - there[2]
        design = np.stack([np.ones(x.size), x, y], axis=1)
        seen = np.isfinite(lon) & np.isfinite(left).all(0) & np.isfinite(right).all(0)
        track = np.empty((2, 2, 3))
        for view, end in enumerate((left, right)):
            for axis, start in enumerate((lon, lat)):
                values = (end[axis] - start)[seen] / rise
                track[view, axis] = np.linalg.lstsq(design[seen], values, rcond=None)[0]
        track = np.round(track, 15)  # degrees: drops what depends on the linear algebra library
        # Square cells on the ground, of the area of a left pixel.
        middle = (
            np.array([cols / 2, cols / 2 + 1, cols / 2]),
            np.array([rows / 2] * 2 + [rows / 2 + 1]),
        )
        lon3, lat3 = model.epipolar_to_ground(*middle, np.full(3, float(model.reference_height)))
        shrink = np.cos(np.radians(lat3[0]))
        area = abs(
            (lon3[1] - lon3[0]) * (lat3[2] - lat3[0]) - (lon3[2] - lon3[0]) * (lat3[1] - lat3[0])
        )  # degrees²
        side = CELL_PX * np.sqrt(area * shrink) / LATTICE_DEG  # steps of latitude
        cell = (max(round(side / shrink), 1), max(round(side), 1))
        return cls(track, cell, float(np.round(np.nanmedian(disparity) / rise, 9)))

    def reach(self, cols: slice, rows: slice) -> Floats:
        """[2, 2] (lon, lat; lowest, highest) degrees per metre that any ray from a window moves."""
        corners = np.array(
            [[1.0, x, y] for x in (cols.start, cols.stop) for y in (rows.start, rows.stop)]
        )
        moves = self.track @ corners.T  # [view, axis, corner]
        low = np.minimum(moves.min(axis=(0, 2)), 0.0)
        high = np.maximum(moves.max(axis=(0, 2)), 0.0)
        return np.stack([low, high], axis=1)


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights of ground cells [j (lat), i (lon)] in m, -inf where unknown.

    (``row``, ``col``): global index of the first cell, lattice coordinate // cell size.
    ``ceiling``: the highest of each square of _TILE cells.
    """

    height: NDArray[np.float32]
    ceiling: NDArray[np.float32]
    row: int
    col: int


@njit(cache=True, nogil=True, error_model="numpy")
def _floor_divide(q: int, divisor: int, inverse: float) -> int:
    """q // divisor of 0 <= q < 2**31 and a divisor below 2**20; exact, and without a division."""
    return np.int64((q + 0.5) * inverse)


@njit(cache=True, nogil=True, error_model="numpy")
def _raise_tops(
    lon_q: Ints,
    lat_q: Ints,
    h_q: Ints,
    first: tuple[int, int],
    cell: tuple[int, int],
    top: Steps,
    index: Steps,
    height: Steps,
) -> None:
    """Takes points into the greatest height of each cell; fills ``index`` and ``height``."""
    cols = top.shape[1]
    inverse = (1.0 / cell[0], 1.0 / cell[1])
    west, south = first[0] * cell[0], first[1] * cell[1]
    for k in range(lon_q.size):
        i = _floor_divide(lon_q[k] - west, cell[0], inverse[0])
        j = _floor_divide(lat_q[k] - south, cell[1], inverse[1])
        index[k] = j * cols + i
        height[k] = h_q[k]
        top[j, i] = max(top[j, i], height[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_tops(
    index: Steps, height: Steps, top: Steps, tolerance: int, count: Steps, below: Ints
) -> None:
    """Per cell, of the points at most ``tolerance`` below its top: number, sum of the depths."""
    for k in range(index.size):
        depth = top[index[k]] - height[k]
        if depth <= tolerance:
            count[index[k]] += 1
            below[index[k]] += depth


@njit(cache=True, nogil=True, error_model="numpy")
def _means_of_tops(
    top: Steps, count: Steps, below: Ints, per_m: int, out: NDArray[np.float32]
) -> None:
    for k in range(top.size):
        n = np.int64(count[k])
        out[k] = (n * top[k] - below[k]) / n / per_m if n > 0 else -np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _tile_tops(height: NDArray[np.float32], out: NDArray[np.float32]) -> None:
    """The highest of each square of _TILE cells."""
    out[:] = -np.inf
    for j in range(height.shape[0]):
        for i in range(height.shape[1]):
            out[j // _TILE, i // _TILE] = max(out[j // _TILE, i // _TILE], height[j, i])


@njit(cache=True, nogil=True, error_model="numpy")
def _holes(height: NDArray[np.float32], reach: int, out: Ints) -> int:
    """Fills ``out`` with the flat indices of unknown cells near known ones; returns their number.

    Near: in squares of ``reach`` cells beside one with known cells; others are out of reach.
    """
    rows, cols = height.shape
    known = np.zeros(((rows - 1) // reach + 3, (cols - 1) // reach + 3), np.bool_)
    for j in range(rows):
        for i in range(cols):
            if height[j, i] > -np.inf:
                known[j // reach + 1, i // reach + 1] = True
    n = 0
    for q in range(known.shape[0] - 2):
        for p in range(known.shape[1] - 2):
            if not known[q : q + 3, p : p + 3].any():
                continue
            for j in range(q * reach, min((q + 1) * reach, rows)):
                for i in range(p * reach, min((p + 1) * reach, cols)):
                    if height[j, i] == -np.inf:
                        out[n] = j * cols + i
                        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_holes(height: NDArray[np.float32], holes: Ints, radius: int) -> int:
    """Fills ``holes`` (flat indices); moves those that stay to the front, returns their number."""
    rows, cols = height.shape
    value = np.empty(holes.size, np.float32)
    for n in range(holes.size):
        j, i = holes[n] // cols, holes[n] % cols
        value[n] = -np.inf
        known = 0
        lowest = np.float32(np.inf)
        for b in range(max(j - radius, 0), min(j + radius + 1, rows)):
            for a in range(max(i - radius, 0), min(i + radius + 1, cols)):
                if height[b, a] > -np.inf:
                    known += 1
                    lowest = min(lowest, height[b, a])
        if known >= 3:
            value[n] = lowest
    left = 0
    for n in range(holes.size):
        if value[n] > -np.inf:
            height[holes[n] // cols, holes[n] % cols] = value[n]
        else:
            holes[left] = holes[n]
            left += 1
    return left


@dataclass(eq=False)
class SurfaceBuilder:
    """Takes points, block by block, into the surface of a box of the ground.

    ``low``, ``high``: corners (lattice lon, lat), both included; no point lies beyond.
    """

    rays: Rays
    low: tuple[int, int]
    high: tuple[int, int]
    parts: list[tuple[Steps, Steps]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.first = tuple(int(q // side) for q, side in zip(self.low, self.rays.cell))
        last = [q // side for q, side in zip(self.high, self.rays.cell)]
        shape = last[1] - self.first[1] + 1, last[0] - self.first[0] + 1
        self.top = np.full(shape, np.iinfo(np.int32).min, dtype=np.int32)

    def add(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> None:
        """Points by lattice coordinates."""
        index, height = np.empty(lon_q.size, np.int32), np.empty(lon_q.size, np.int32)
        _raise_tops(lon_q, lat_q, h_q, self.first, self.rays.cell, self.top, index, height)
        self.parts.append((index, height))

    def built(self) -> Surface:
        """The surface of all that was taken.

        A cell's height is the mean of its top surface. Cells without points take the lowest of
        their neighbours, if three are known, in rounds of growing radius (roofs do not grow).
        """
        top = self.top.reshape(-1)
        count, below = np.zeros(top.size, np.int32), np.zeros(top.size, np.int64)
        tolerance = int(SURFACE_PX / self.rays.px_per_m * _PER_M)
        for index, depth in self.parts:
            _sum_tops(index, depth, top, tolerance, count, below)
        self.parts = []
        height = np.empty(self.top.shape, dtype=np.float32)
        _means_of_tops(top, count, below, _PER_M, height.reshape(-1))
        holes = np.empty(height.size, dtype=np.int64)  # only what is needed is written
        n = _holes(height, sum(FILL_RADII), holes)
        for radius in FILL_RADII:
            n = _fill_holes(height, holes[:n], radius)
        ceiling = np.empty([-(-n // _TILE) for n in height.shape], dtype=np.float32)
        _tile_tops(height, ceiling)
        return Surface(height, ceiling, self.first[1], self.first[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _to_border(place: float, size: float, speed: float) -> tuple[float, float]:
    """Way to the next border of cells of a ``size``, and between borders, along one axis."""
    if speed == 0.0:
        return np.inf, np.inf
    return (size - place if speed > 0.0 else place) / abs(speed), size / abs(speed)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_hidden(
    height: NDArray[np.float32],
    ceiling: NDArray[np.float32],
    top: float,
    i: int,
    j: int,
    a: float,
    b: float,
    start: float,
    du: float,
    dv: float,
    ahead: float,
    nearest: float,
    tolerance: float,
    step: float,
) -> bool:
    """Does the ray from place (a, b) in [0, 1)² of cell (i, j) at height ``start`` hit a cell?

    (du, dv): cells per metre of rise; ``top``: no cell is higher (m). The cell of the start does
    not count: what lies above the start there is the business of
    :func:`.seen_surface.seen_surface`.
    """
    speed = np.sqrt(du * du + dv * dv)
    if speed < 1e-6:  # the camera stands in the zenith
        return False
    if start + tolerance >= top:
        return False
    rise = 1.0 / speed  # m per cell of way
    du *= rise
    dv *= rise
    step_i, step_j = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    rows, cols = height.shape
    # From tile to tile: the way to the end of the last one that reaches up to the ray.
    p, q = i // _TILE, j // _TILE
    next_u, between_u = _to_border(i - p * _TILE + a, _TILE, du)
    next_v, between_v = _to_border(j - q * _TILE + b, _TILE, dv)
    way = 0.0
    end = -1.0
    while 0 <= p < ceiling.shape[1] and 0 <= q < ceiling.shape[0]:
        ray = start + max(way - ahead, nearest) * rise + tolerance
        if ray >= top:
            break
        if ceiling[q, p] > ray:
            end = min(next_u, next_v) + 1e-6
        if next_u < next_v:
            way = next_u
            next_u += between_u
            p += step_i
        else:
            way = next_v
            next_v += between_v
            q += step_j
    next_u, between_u = _to_border(a, 1.0, du)
    next_v, between_v = _to_border(b, 1.0, dv)
    before = height[j, i]
    while True:
        if next_u < next_v:
            way = next_u
            next_u += between_u
            i += step_i
        else:
            way = next_v
            next_v += between_v
            j += step_j
        if way > end or i < 0 or j < 0 or i >= cols or j >= rows:
            return False
        here = height[j, i]
        if here - before > step:
            way -= ahead
        if here > start + max(way, nearest) * rise + tolerance:
            return True
        before = here


@njit(cache=True, nogil=True, error_model="numpy")
def _hidden(
    height: NDArray[np.float32],
    ceiling: NDArray[np.float32],
    origin: tuple[int, int],
    cell: tuple[int, int],
    sums: Ints,
    track: Floats,
    first: tuple[int, int],
    width: int,
    ahead: float,
    nearest: float,
    tolerance: float,
    step: float,
    out: NDArray[np.uint8],
) -> None:
    """``out`` [bins]: 0 seen in both views, 1 hidden from the left, 2 from the right only.

    ``track`` in cells per metre; bin k is the pixel at row first[0] + k // width and column
    first[1] + k % width.
    """
    top = -np.inf
    for tile in ceiling.flat:
        top = max(top, tile)
    for k in range(sums.shape[0]):
        out[k] = 0
        n = sums[k, 0]
        if n == 0:
            continue
        # Integer arithmetic keeps the place free of any block's origin.
        i = sums[k, 1] // (n * cell[0])
        j = sums[k, 2] // (n * cell[1])
        a = (sums[k, 1] - i * n * cell[0]) / (n * cell[0])
        b = (sums[k, 2] - j * n * cell[1]) / (n * cell[1])
        start = sums[k, 3] / n / _PER_M
        y = float(first[0] + k // width)
        x = float(first[1] + k % width)
        for view in range(2):
            t = track[view]
            du = t[0, 0] + t[0, 1] * x + t[0, 2] * y
            dv = t[1, 0] + t[1, 1] * x + t[1, 2] * y
            if _is_hidden(
                height,
                ceiling,
                top,
                i - origin[1],
                j - origin[0],
                a,
                b,
                start,
                du,
                dv,
                ahead,
                nearest,
                tolerance,
                step,
            ):
                out[k] = view + 1
                break


def hidden_pixels(
    surface: Surface, rays: Rays, sums: Ints, rows: slice, cols: slice
) -> NDArray[np.uint8]:
    """Whether what each pixel of a window shows is hidden.

    ``sums`` [pixels, 4] are those of :class:`.pixel_labels.Pixels`, pixels in row-major order of
    ``rows`` x ``cols`` of the left epipolar grid. Returns uint8 [pixels]: 0 seen in both
    views (or no point), 1 hidden from the left, 2 hidden from the right.
    """
    out = np.empty(len(sums), dtype=np.uint8)
    per_cell = np.array(rays.cell, dtype=np.float64)[None, :, None] * LATTICE_DEG
    _hidden(
        surface.height,
        surface.ceiling,
        (surface.row, surface.col),
        rays.cell,
        sums,
        rays.track / per_cell,
        (rows.start, cols.start),
        cols.stop - cols.start,
        AHEAD_CELLS,
        NEAREST_CELLS,
        TOLERANCE_PX / rays.px_per_m,
        SURFACE_PX / rays.px_per_m,
        out,
    )
    return out
