"""What the surface between the points shows, what hides it in either view, and its labels.

The points of a window are triangles over the ground (:mod:`.point_triangles`). What a pixel shows
between points is known where its triangle goes on the plane of its neighbours; where heights step
between points, nobody knows where in the triangle (:mod:`.smooth_triangles`). So

1. a pixel's centre sees the nearest of the smooth triangles. Its disparity is linear in them, or
   quadratic where they bulge: the value is the LiDAR's, never that of a match;
2. a triangle that spans a step may hold any surface between its lowest and highest vertex: the
   prism over it is drawn into both views. A pixel whose ray may meet a prism before its smooth
   triangle has no label, from either camera. Without this, 6 to 10 % of the hidden pixels
   had labels at 0.25 to 4 points/m², with it 0.05 to 0.2 %, for 0.5 to 3 % of the visible ones;
3. the ray to the right camera starts at the pixel's own place in the right image: each triangle is
   asked for the pixels that it covers there, so that no grid of the right view rounds edges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from ..lidar.lattice import LATTICE_M
from .image_patches import MASKED, USABLE, Patch
from .local_projection import LocalProjection
from .pixel_labels import Labels
from .smooth_triangles import STEP_PX, GroundSurface
from .status import Status, is_labelled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]
# A surface that turns away from the right camera is hidden. So obliquely that a pixel shrinks to
# this width there, points and their noise do not tell (forests, 6 points/m²: with 0.2 1 % more of
# the visible pixels and 0.2 of the hidden ones had labels, with 0.4 1.3 and 0.1 fewer).
LEAST_WIDTH = 0.3
# What lies in front of a surface by less is the surface itself.
TOLERANCE_PX = 0.25
NOTHING, SHOWN, STEP_IN_LEFT, STEP_IN_RIGHT, BEHIND_IN_RIGHT = range(5)
_STATUS = np.array(
    [
        Status.NO_POINTS,
        Status.LABELLED_BETWEEN,
        Status.EDGE_IN_PIXEL,
        Status.EDGE_IN_PIXEL,
        Status.HIDDEN_IN_RIGHT,
    ],
    dtype=np.uint8,
)
_CHUNK = 1 << 15  # prisms that are projected at once


@inner
def _crossing(xa: float, ya: float, xb: float, yb: float, y: float) -> float:
    """Where an edge meets a row; the same for both triangles beside it."""
    if yb < ya or (yb == ya and xb < xa):
        xa, ya, xb, yb = xb, yb, xa, ya
    return xa + (y - ya) * ((xb - xa) / (yb - ya))


@inner
def _span(x: tuple, y: tuple, row: float) -> tuple[float, float]:
    """Lowest and highest column of a triangle in a row, (inf, -inf) for none."""
    low, high = np.inf, -np.inf
    for i in range(3):
        k = (i + 1) % 3
        if y[i] == y[k]:
            if y[i] == row:
                low, high = min(low, x[i], x[k]), max(high, x[i], x[k])
        elif min(y[i], y[k]) <= row <= max(y[i], y[k]):
            at = _crossing(x[i], y[i], x[k], y[k], row)
            low, high = min(low, at), max(high, at)
    return low, high


@inner
def _plane(x: tuple, y: tuple, d: tuple) -> tuple[float, float]:
    """Slopes of a value given at three places of an image; not finite if they lie in a line."""
    u, v, s, t = x[1] - x[0], y[1] - y[0], x[2] - x[0], y[2] - y[0]
    p, q = d[1] - d[0], d[2] - d[0]
    area = u * t - v * s
    return (p * t - q * v) / area, (q * u - p * s) / area


@inner
def _triple(values: Floats, t: Steps) -> tuple[float, float, float]:
    return values[t[0]], values[t[1]], values[t[2]]


@inner
def _face_in_left(
    x: tuple, y: tuple, d: tuple, first: tuple[int, int], number: int, nearest: Floats, shown: Steps
) -> None:
    """Raises ``nearest`` [rows, cols] to a face's disparity, and sets ``shown`` to its ``number``.

    Of faces of equal disparity the first one stays.
    """
    rows, cols = nearest.shape
    top = max(int(np.ceil(min(y[0], y[1], y[2]))), first[0])
    bottom = min(int(np.floor(max(y[0], y[1], y[2]))), first[0] + rows - 1)
    left = max(int(np.ceil(min(x[0], x[1], x[2]))), first[1])
    right = min(int(np.floor(max(x[0], x[1], x[2]))), first[1] + cols - 1)
    if top > bottom or left > right:  # most triangles lie between the centres of pixels
        return
    gx, gy = _plane(x, y, d)
    if not np.isfinite(gx + gy):
        return
    lowest, highest = min(d[0], d[1], d[2]), max(d[0], d[1], d[2])
    for row in range(top, bottom + 1):
        low, high = _span(x, y, float(row))
        if not low <= high:
            continue
        left = max(int(np.ceil(low)), first[1])
        right = min(int(np.floor(high)), first[1] + cols - 1)
        for col in range(left, right + 1):
            value = d[0] + gx * (col - x[0]) + gy * (row - y[0])
            value = min(max(value, lowest), highest)
            j, i = row - first[0], col - first[1]
            if value > nearest[j, i]:
                nearest[j, i] = value
                shown[j, i] = number


@kernel
def nearest_faces(
    xy: Floats, corner: Steps, first: tuple[int, int], nearest: Floats, shown: Steps
) -> None:
    """The triangle of the greatest disparity at each pixel's centre, and that disparity.

    ``xy`` [4, vertices]: places in both images, px. Of equals, the triangle of the lower number.
    """
    for t in range(len(corner)):
        x, y = _triple(xy[0], corner[t]), _triple(xy[1], corner[t])
        xr = _triple(xy[2], corner[t])
        d = (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
        _face_in_left(x, y, d, first, t, nearest, shown)


@inner
def _face_in_right(
    x: tuple, y: tuple, d: tuple, first: tuple[int, int], width: int, start: Steps, place: Floats,
    limit: Floats, hidden: Bools,
) -> None:  # fmt: skip
    """Marks the pixels that a face covers in the right view, and whose ``limit`` it exceeds.

    Pixels are sorted by row and whole column there: those of column ``first[1] + k`` in row
    ``first[0] + j`` from ``start[j * width + k]`` on. ``place`` (column) and ``limit`` (disparity)
    of each.
    """
    rows = (start.size - 1) // width
    top = max(int(np.ceil(min(y[0], y[1], y[2]))), first[0])
    bottom = min(int(np.floor(max(y[0], y[1], y[2]))), first[0] + rows - 1)
    if top > bottom:
        return
    gx, gy = _plane(x, y, d)
    if not np.isfinite(gx + gy):
        return
    lowest, highest = min(d[0], d[1], d[2]), max(d[0], d[1], d[2])
    for row in range(top, bottom + 1):
        low, high = _span(x, y, float(row))
        if not low <= high:
            continue
        left = max(int(np.floor(low)) - first[1], 0)
        right = min(int(np.floor(high)) - first[1], width - 1)
        if left > right:
            continue
        base = (row - first[0]) * width
        for k in range(start[base + left], start[base + right + 1]):
            if hidden[k] or not low <= place[k] <= high or highest <= limit[k]:
                continue
            value = d[0] + gx * (place[k] - x[0]) + gy * (row - y[0])
            hidden[k] = min(max(value, lowest), highest) > limit[k]


@kernel
def _smooth_in_right(
    xy: Floats, corner: Steps, first: tuple[int, int], width: int, start: Steps, place: Floats,
    limit: Floats, hidden: Bools,
) -> None:  # fmt: skip
    for t in range(len(corner)):
        x, xr = _triple(xy[0], corner[t]), _triple(xy[2], corner[t])
        d = (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
        y = _triple(xy[3], corner[t])
        _face_in_right(xr, y, d, first, width, start, place, limit, hidden)


# Faces of a prism, of its vertices 0, 1, 2 at the top and 3, 4, 5 below these.
_FACES = ((0, 1, 2), (0, 1, 3), (1, 3, 4), (1, 2, 4), (2, 4, 5), (2, 0, 5), (0, 5, 3))


@kernel
def _prisms_in_left(xy: Floats, first: tuple[int, int], nearest: Floats) -> None:
    """``xy`` [4, prisms, 6]."""
    any_prism = np.empty(nearest.shape, np.int32)
    for t in range(xy.shape[1]):
        x, y, xr = xy[0, t], xy[1, t], xy[2, t]
        for a, b, c in _FACES:
            d = (x[a] - xr[a], x[b] - xr[b], x[c] - xr[c])
            _face_in_left((x[a], x[b], x[c]), (y[a], y[b], y[c]), d, first, t, nearest, any_prism)


@kernel
def _prisms_in_right(
    xy: Floats, first: tuple[int, int], width: int, start: Steps, place: Floats, limit: Floats,
    hidden: Bools,
) -> None:  # fmt: skip
    for t in range(xy.shape[1]):
        x, xr, y = xy[0, t], xy[2, t], xy[3, t]
        for a, b, c in _FACES:
            d = (x[a] - xr[a], x[b] - xr[b], x[c] - xr[c])
            _face_in_right(
                (xr[a], xr[b], xr[c]), (y[a], y[b], y[c]), d, first, width, start, place, limit,
                hidden,
            )  # fmt: skip


@kernel
def at_pixels(
    xy: Floats, h: Ints, classes: NDArray[np.uint8], count: Steps, corner: Steps, noise: Floats,
    bulge: Floats, shown: Steps, first: tuple[int, int], slope: Floats, variance: Floats,
    height: Floats, rise: Floats, surface_class: NDArray[np.uint8],
) -> None:  # fmt: skip
    """What the triangle that each pixel shows has at its centre, and the ``rise`` of the surface
    above it; ``variance`` in height steps², ``height`` and ``rise`` in steps."""
    rows, cols = shown.shape
    for j in range(rows):
        for i in range(cols):
            t = shown[j, i]
            if t < 0:
                continue
            v = corner[t]
            x, y, xr = _triple(xy[0], v), _triple(xy[1], v), _triple(xy[2], v)
            slope[0, j, i], slope[1, j, i] = _plane(
                x, y, (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
            )
            u, w = first[1] + i - x[0], first[0] + j - y[0]
            bx, by = _plane(x, y, (0.0, 1.0, 0.0))
            cx, cy = _plane(x, y, (0.0, 0.0, 1.0))
            b = min(max(bx * u + by * w, 0.0), 1.0)
            c = min(max(cx * u + cy * w, 0.0), 1.0 - b)
            a = 1.0 - b - c
            variance[j, i] = noise[t] * (
                a * a / count[v[0]] + b * b / count[v[1]] + c * c / count[v[2]]
            )
            rise[j, i] = bulge[t] * (a * b + b * c + c * a)
            height[j, i] = h[v[0]] + b * float(h[v[1]] - h[v[0]]) + c * float(h[v[2]] - h[v[0]])
            surface_class[j, i] = classes[v[0] if a >= b and a >= c else v[1] if b >= c else v[2]]


Where = tuple[tuple[int, int], int, NDArray[np.int32], Floats, Floats]


def by_right_column(
    row: Ints, col: Ints, disparity: Floats, first: tuple[int, int]
) -> tuple[Ints, Where]:
    """Pixels [n] of a window, one at least, in their order in the right image, and where they are
    there: what the tests of that view take."""
    place = col + first[1] - disparity
    column = np.floor(place).astype(np.int64)
    low = int(column.min())
    width = int(column.max()) - low + 1
    rows = int(row.max()) + 1
    key = row.astype(np.int64) * width + column - low
    order = np.argsort(key, kind="stable")
    start = np.zeros(rows * width + 1, np.int32)
    np.cumsum(np.bincount(key, minlength=rows * width), out=start[1:])
    return order, ((first[0], low), width, start, place[order], disparity[order] + TOLERANCE_PX)


@dataclass(frozen=True, eq=False)
class Places:
    """Smooth triangles ``corner`` [m, 3] of vertices at ``xy`` [4, n] (px in both images), in a
    window whose first pixel is (row, col) ``first``."""

    xy: Floats
    corner: Steps
    first: tuple[int, int]

    def hidden(self, where: Where) -> Bools:
        """Which places, as :func:`by_right_column` gives them, lie behind a triangle."""
        behind = np.zeros(where[3].size, np.bool_)
        _smooth_in_right(self.xy, self.corner, *where, behind)
        return behind


@dataclass(frozen=True, eq=False)
class Between:
    """What the surface between the points shows at the centres of pixels; arrays [h, w].

    ``outcome``: NOTHING (no smooth triangle), SHOWN (a label, seen by both cameras), STEP_IN_LEFT
    (a triangle that spans a step may be nearer to the left camera), STEP_IN_RIGHT (to the right
    one), BEHIND_IN_RIGHT (a smooth triangle hides it from there). ``disparity`` px, its ``slope``
    [2, h, w] and ``variance`` px² (of the points alone), ``height`` m and ``surface_class`` (ASPRS,
    of the nearest vertex) of the smooth triangle that is nearest, NaN (0) where there is none.
    ``bulging``: whether the surface bulges out of its triangle. ``places``: the smooth triangles in
    both images.
    """

    outcome: NDArray[np.uint8]
    disparity: Floats
    slope: Floats
    variance: Floats
    height: Floats
    surface_class: NDArray[np.uint8]
    bulging: Bools
    places: Places


def surface_between(
    surface: GroundSurface,
    local: LocalProjection,
    first: tuple[int, int],
    shape: tuple[int, int],
    px_per_m: float,
) -> Between:
    """Labels of a window of ``shape`` whose first pixel is (row, col) ``first``.

    ``local`` projects all that lies in the box of the vertices.
    """
    vertices, corner = surface.vertices, surface.smooth
    xy = local.at_points(vertices.lon_q, vertices.lat_q, vertices.h_q)
    nearest, shown = np.full(shape, -np.inf), np.full(shape, -1, np.int32)
    nearest_faces(xy, corner, first, nearest, shown)
    before = np.full(shape, -np.inf)
    steps_in_left(surface, local, slice(0, len(surface.steps)), first, before)
    outcome = np.where(shown >= 0, np.uint8(SHOWN), np.uint8(NOTHING))
    outcome[before > nearest + TOLERANCE_PX] = STEP_IN_LEFT

    places = Places(xy, corner, first)
    row, col = np.nonzero(outcome == SHOWN)
    if row.size:
        order, where = by_right_column(row, col, nearest[row, col], first)
        behind = places.hidden(where)
        unsure = steps_in_right(surface, local, slice(0, len(surface.steps)), where)
        found = np.where(behind, BEHIND_IN_RIGHT, np.where(unsure, STEP_IN_RIGHT, SHOWN))
        outcome[row[order], col[order]] = found

    known = shown >= 0
    slope, variance, height = np.zeros((2, *shape)), np.zeros(shape), np.full(shape, np.nan)
    rise = np.zeros(shape)
    classes = np.zeros(shape, np.uint8)
    at_pixels(
        xy, vertices.h_q, vertices.surface_class, vertices.count, corner, surface.noise,
        surface.bulge, shown, first, slope, variance, height, rise, classes,
    )  # fmt: skip
    outcome[(outcome == SHOWN) & (1.0 - slope[0] < LEAST_WIDTH)] = BEHIND_IN_RIGHT
    return Between(
        outcome=outcome,
        disparity=np.where(known, nearest + rise * LATTICE_M * px_per_m, np.nan),
        slope=slope,
        variance=variance * (LATTICE_M * px_per_m) ** 2,
        height=(height + rise) * LATTICE_M,
        surface_class=classes,
        bulging=rise > 0.0,
        places=places,
    )


def steps_in_left(
    surface: GroundSurface, local: LocalProjection, steps: slice, first: tuple[int, int],
    highest: Floats,
) -> None:  # fmt: skip
    """Raises ``highest`` [rows, cols] to the disparity that some of the ``steps`` may have."""
    for prisms in _prisms(surface, local, steps.start, steps.stop):
        _prisms_in_left(prisms, first, highest)


def steps_in_right(
    surface: GroundSurface, local: LocalProjection, steps: slice, where: Where
) -> Bools:
    """Which places, as :func:`by_right_column` gives them, some of the ``steps`` may hide."""
    hidden = np.zeros(where[3].size, np.bool_)
    for prisms in _prisms(surface, local, steps.start, steps.stop):
        _prisms_in_right(prisms, *where, hidden)
    return hidden


def _prisms(
    surface: GroundSurface, local: LocalProjection, start: int, end: int
) -> Iterator[Floats]:
    """Places [4, prisms, 6] (px) of the corners of steps at their greatest and least height."""
    for first in range(start, end, _CHUNK):
        chunk = slice(first, min(first + _CHUNK, end))
        corner = surface.steps[chunk]
        ends = np.repeat(surface.span[chunk, ::-1], 3, axis=1)
        lon, lat = (np.tile(q[corner], 2) for q in (surface.vertices.lon_q, surface.vertices.lat_q))
        yield local.at_points(*(v.reshape(-1) for v in (lon, lat, ends))).reshape(4, -1, 6)


def between_labels(
    between: Between,
    own: Labels,
    left: Patch,
    right: Patch,
    first: tuple[int, int],
    porous: bool = False,
) -> tuple[Labels, NDArray[np.uint8]]:
    """Labels of a window whose first pixel is (row, col) ``first``, and the status of its pixels.

    Pixels whose ``own`` points lie on the surface that their centre sees count as measured, and
    keep the label that these give if it is the surer one (one point is less than three around it,
    and no plane bulges). Points of another surface tell of an edge in the pixel. Only where points
    are so sparse that others show through between them (``porous``) those behind are hidden, as the
    ground is that a tower leans over. ``left``, ``right``: patches that tell the frames.
    """
    status = _STATUS[between.outcome]
    shown = between.outcome == SHOWN
    row, col = np.nonzero(shown)
    place = col + first[1] - between.disparity[row, col]
    in_left = usable_at(left, row + first[0], col + first[1])
    in_right = usable_at(right, row + first[0], np.floor(place).astype(np.int64))
    inside, masked = in_left & in_right == USABLE, (in_left | in_right) & MASKED != 0
    status[row[~inside], col[~inside]] = Status.OUT_OF_FRAME
    status[row[masked], col[masked]] = Status.MASKED
    between_points = status == Status.LABELLED_BETWEEN
    with np.errstate(invalid="ignore"):
        lift = own.disparity - between.disparity
        measured = between_points & (np.abs(lift) <= STEP_PX)
        other = lift > STEP_PX if porous else np.abs(lift) > STEP_PX
        status[between_points & other] = Status.EDGE_IN_PIXEL
    status[measured] = Status.LABELLED
    surer = measured & (own.variance <= between.variance) & ~between.bulging
    return Labels(
        np.where(surer, own.disparity, np.where(is_labelled(status), between.disparity, np.nan)),
        np.where(surer, own.slope, between.slope),
        np.where(surer, own.variance, between.variance),
    ), status


def usable_at(patch: Patch, row: Ints, col: Ints) -> NDArray[np.uint8]:
    """Of :class:`.image_patches.Patch`, at pixels [n]; 0 outside the patch."""
    r, c = row - patch.row, col - patch.col
    inside = (r >= 0) & (c >= 0) & (r < patch.usable.shape[0]) & (c < patch.usable.shape[1])
    found = np.zeros(r.size, np.uint8)
    found[inside] = patch.usable[r[inside], c[inside]]
    return found
