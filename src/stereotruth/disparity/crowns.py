"""Labels of rough surfaces, as crowns are, with an uncertainty of their own.

On a rough surface no triangle of points goes on the plane of its neighbours, so that
:mod:`.smooth_triangles` calls all of them steps. Between points that lie close together such a
surface is still known to some tenths of a pixel. So

1. points far below others all around them went through the surface (:func:`_passed`): they are left
   out, and the others, its tops, are triangulated anew (:class:`RoughSurface`);
2. a pixel's value is linear in the triangle of tops that is nearest to the left camera;
3. a pixel is labelled if no other triangle, smooth or steep, nor a step between known surfaces may
   be nearer to either camera, if nothing near it is much higher, and if the pixels beside it keep
   their order in the right image (:func:`_narrowest`);
4. the uncertainty follows from what is between the points: how far tops are off the planes of the
   triangles beside them, how much the triangle rises, and how much higher the pixels beside it are.

No image has a say in which surface a pixel shows. All follows from the points around a pixel alone,
in an order that no window changes.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from ..lidar.lattice import LATTICE_M
from .local_projection import LocalProjection
from .point_triangles import triangulate
from .smooth_triangles import ROUGH_REACH, STEP_PX, GroundSurface, Scale
from .status import WATER_CLASS
from .surface_between import (
    STEP_IN_LEFT,
    STEP_IN_RIGHT,
    TOLERANCE_PX,
    Between,
    Places,
    at_pixels,
    by_right_column,
    nearest_faces,
    steps_in_left,
    steps_in_right,
)
from .vertices import Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

# A point went through the surface if points higher than it by PASSED_PX (disparity) lie in all
# directions around it, no farther than ROUGH_REACH mean distances of points, and are no fewer than
# the others there: a gap between crowns keeps its ground.
PASSED_PX = 1.0
SECTORS = 12
_ROOT_3 = np.sqrt(3.0)
WIDEST_GAP = 4  # empty sectors in a row, which leave no half of the directions without a point
STEEP_PX = 6.0  # a triangle that rises by more is the side of something
# A pixel has no label if one up to HIGHER_REACH px off is higher by HIGHER_PX: an outline that
# points tell to a pixel alone may cover it in either view.
HIGHER_PX, HIGHER_REACH = 1.5, 3
# Nor if one of the next BESIDE_PX of its row lies less far to its right in the right image: there
# the surface turns away. More labels and more hidden ones go together. Of crowns with lobes, at 4
# points/m², 52, 57 and 60 % of the visible and 0.66, 0.72 and 0.86 % of the hidden pixels had
# labels with 0.8, 0.65 and 0.5.
LEAST_WIDTH = 0.65
BESIDE_PX = 12
# Standard uncertainty, px, where points are a pixel apart: of its own, and per px of misfit, of the
# triangle's rise, and of what is higher beside the pixel. It grows with the distance of points to
# the power of GROWTH.
OWN, MISFIT, RISE, HIGHER = 0.078, 0.134, 0.18, 0.26
GROWTH = 0.75


@inner
def _bucket(value: int, side: int) -> int:
    return value // side


@kernel
def _by_bucket(x: Ints, y: Ints, side: int, cols: int, rows: int) -> tuple[Steps, Steps]:
    """Vertices by square: ``list[start[k] : start[k + 1]]``, in their order."""
    start = np.zeros(rows * cols + 1, np.int32)
    for k in range(x.size):
        start[_bucket(y[k], side) * cols + _bucket(x[k], side) + 1] += 1
    for k in range(rows * cols):
        start[k + 1] += start[k]
    place = start[:-1].copy()
    out = np.empty(x.size, np.int32)
    for k in range(x.size):
        b = _bucket(y[k], side) * cols + _bucket(x[k], side)
        out[place[b]] = k
        place[b] += 1
    return start, out


@inner
def _sector(dx: int, dy: int) -> int:
    """One of SECTORS directions of 30 degrees, counter-clockwise from east."""
    across, along = float(abs(dx)), float(abs(dy))
    part = 0 if along * _ROOT_3 < across else 1 if along < across * _ROOT_3 else 2
    if dy >= 0:
        return part if dx > 0 else 5 - part
    return 6 + part if dx < 0 else 11 - part


@kernel
def _passed(
    x: Ints, y: Ints, h: Ints, radius: float, step: float, side: int, cols: int,
    start: Steps, members: Steps,
) -> Bools:  # fmt: skip
    """Which vertices lie below a surface around them: see PASSED_PX.

    ``step``: height steps; ``side``, ``cols``, ``start``, ``members``: of :func:`_by_bucket`.
    """
    out = np.zeros(x.size, np.bool_)
    rows = (start.size - 1) // cols
    filled = np.empty(SECTORS, np.bool_)
    for k in range(x.size):
        filled[:] = False
        higher = others = 0
        j, i = _bucket(y[k], side), _bucket(x[k], side)
        for b in range(max(j - 1, 0), min(j + 2, rows)):
            for a in range(max(i - 1, 0), min(i + 2, cols)):
                for m in range(start[b * cols + a], start[b * cols + a + 1]):
                    v = members[m]
                    dx, dy = x[v] - x[k], y[v] - y[k]
                    if v == k or float(dx * dx + dy * dy) > radius * radius:
                        continue
                    if h[v] - h[k] > step:
                        higher += 1
                        filled[_sector(dx, dy)] = True
                    else:
                        others += 1
        if higher < 3 or higher < others:
            continue
        empty = widest = 0
        for s in range(2 * SECTORS):
            empty = 0 if filled[s % SECTORS] else empty + 1
            widest = max(widest, empty)
        out[k] = widest <= WIDEST_GAP
    return out


@kernel
def _misfits(x: Ints, y: Ints, h: Ints, corner: Steps, neighbour: Steps, kept: Bools) -> Floats:
    """Root mean square by which the far vertices of the triangles beside each one are off its
    plane, as the noise of one point, height steps; NaN where there is none beside."""
    size = len(corner)
    total, number = np.zeros(size), np.zeros(size)
    for t in range(size):
        if not kept[t]:
            continue
        a, b, c = corner[t]
        u, v, s, w = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
        area = float(u * w - v * s)
        for i in range(3):
            other = neighbour[t, i]
            if other < 0 or not kept[other]:
                continue
            shared = a + b + c - corner[t, i]
            far = corner[other, 0] + corner[other, 1] + corner[other, 2] - shared
            p, q = float(x[far] - x[a]), float(y[far] - y[a])
            wb, wc = (p * w - q * s) / area, (q * u - p * v) / area
            wa = 1.0 - wb - wc
            off = h[far] - wa * h[a] - wb * h[b] - wc * h[c]
            total[t] += off * off / (1.0 + wa * wa + wb * wb + wc * wc)
            number[t] += 1.0
    out = np.full(size, np.nan)
    for t in range(size):
        squares, n = total[t], number[t]
        for i in range(3):
            other = neighbour[t, i]
            if other >= 0:
                squares += total[other]
                n += number[other]
        if n > 0.0:
            out[t] = np.sqrt(squares / n)
    return out


@kernel
def _higher(disparity: Floats, reach: int) -> Floats:
    """By how much the highest disparity up to ``reach`` px around is above each pixel's own, px;
    NaN where a pixel has none."""
    rows, cols = disparity.shape
    along, out = np.empty_like(disparity), np.empty_like(disparity)
    for j in range(rows):
        for i in range(cols):
            along[j, i] = -np.inf
            for a in range(max(i - reach, 0), min(i + reach + 1, cols)):
                if disparity[j, a] > along[j, i]:  # false for NaN
                    along[j, i] = disparity[j, a]
    for j in range(rows):
        for i in range(cols):
            high = -np.inf
            for b in range(max(j - reach, 0), min(j + reach + 1, rows)):
                high = max(high, along[b, i])
            out[j, i] = high - disparity[j, i]
    return out


@kernel
def _narrowest(disparity: Floats) -> Floats:
    """How far to the right of each pixel's column in the right image the next BESIDE_PX of its row
    lie there at least, px: 1 on a level surface, below 0 if one of them hides the pixel."""
    rows, cols = disparity.shape
    out = np.full(disparity.shape, np.inf)
    for j in range(rows):
        for i in range(cols):
            for a in range(i + 1, min(i + BESIDE_PX + 1, cols)):
                apart = (a - i) - (disparity[j, a] - disparity[j, i])
                if apart < out[j, i]:  # false for NaN
                    out[j, i] = apart
    return out


@dataclass(frozen=True, eq=False)
class RoughSurface:
    """Triangles of the tops of rough surfaces.

    ``corner`` [m, 3]: of ``vertices``, the tops; ``misfit`` [m]: by how much these are off the
    planes of the triangles beside, px of disparity; ``rise`` [m]: height of a triangle, px;
    ``gentle`` [m]: neither steep nor alone.
    """

    vertices: Vertices
    corner: Steps
    misfit: Floats
    rise: Floats
    gentle: Bools

    @classmethod
    def of(cls, surface: GroundSurface, scale: Scale, px_per_m: float) -> RoughSurface:
        """Of the points around the steps of a surface; ``px_per_m``: disparity of a m of height."""
        step = px_per_m * LATTICE_M
        points = _taken(surface.vertices, np.flatnonzero(surface.uneven))
        radius = ROUGH_REACH * scale.distance
        side = int(np.ceil(radius))
        cols, rows = (int(v.max(initial=0)) // side + 1 for v in (points.x, points.y))
        buckets = _by_bucket(points.x, points.y, side, cols, rows)
        place = points.x, points.y, points.h_q
        passed = _passed(*place, radius, PASSED_PX / step, side, cols, *buckets)
        tops = _taken(points, np.flatnonzero(~passed))
        found = triangulate(tops.x, tops.y, scale.smooth)
        rise = np.ptp(tops.h_q[found.corner], axis=1) * step
        flat = rise <= STEEP_PX
        place = tops.x, tops.y, tops.h_q
        misfit = _misfits(*place, found.corner, found.neighbour, flat) * step
        return cls(tops, found.corner, misfit, rise, flat & np.isfinite(misfit))


def _taken(vertices: Vertices, index: Ints) -> Vertices:
    return Vertices(*(getattr(vertices, f.name)[index] for f in fields(Vertices)))


@dataclass(frozen=True, eq=False)
class Crowns:
    """What rough surfaces show at the centres of pixels; arrays [h, w].

    ``shown``: both cameras see it. ``disparity`` px, its ``slope`` [2, h, w] and ``variance`` px²
    (of the points and of what is between them), ``height`` m, ``surface_class`` (ASPRS, of the
    nearest point): NaN (0) where there is none.
    """

    shown: Bools
    disparity: Floats
    slope: Floats
    variance: Floats
    height: Floats
    surface_class: NDArray[np.uint8]


def crowns(
    surface: GroundSurface,
    between: Between,
    local: LocalProjection,
    first: tuple[int, int],
    scale: Scale,
    px_per_m: float,
) -> Crowns:
    """The rough surfaces of a window whose first pixel is (row, col) ``first``.

    Shown at pixels of which the points leave open what they show (``between``). ``local`` projects
    all that lies in the box of the vertices; ``px_per_m``: disparity of a m of height.
    """
    shape = between.outcome.shape
    rough = RoughSurface.of(surface, scale, px_per_m)
    tops, corner = rough.vertices, rough.corner[rough.gentle]
    xy = local.at_points(tops.lon_q, tops.lat_q, tops.h_q)
    nearest, index = np.full(shape, -np.inf), np.full(shape, -1, np.int32)
    nearest_faces(xy, corner, first, nearest, index)
    disparity = np.where(index >= 0, nearest, np.nan)
    before = np.where(np.isnan(between.disparity), -np.inf, between.disparity)
    nearest_faces(xy, rough.corner[~rough.gentle], first, before, np.empty(shape, np.int32))
    steps_in_left(surface, local, _known(surface), first, before)
    all_around = np.fmax(disparity, np.where(np.isneginf(before), np.nan, before))
    is_open = (between.outcome == STEP_IN_LEFT) | (between.outcome == STEP_IN_RIGHT)
    # what smooth triangles show has labels already, as far as it is certain
    with np.errstate(invalid="ignore"):
        shown = is_open & (disparity > before - TOLERANCE_PX)
        shown &= ~(np.abs(disparity - between.disparity) <= STEP_PX)
        shown &= _higher(all_around, HIGHER_REACH) <= HIGHER_PX
    shown &= _narrowest(all_around) >= LEAST_WIDTH
    row, col = np.nonzero(shown)
    hidden = _hidden_in_right(surface, between.places, rough.corner, xy, local, row, col, disparity)
    shown[row, col] = ~hidden
    slope, height = np.zeros((2, *shape)), np.full(shape, np.nan)
    spare, rise, classes = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.uint8)
    flat = np.zeros(len(corner))
    at_pixels(
        xy, tops.h_q, tops.surface_class, tops.count, corner, flat, flat, index, first, slope,
        spare, height, rise, classes,
    )  # fmt: skip
    parts = (
        np.full(shape, OWN),
        MISFIT * np.append(rough.misfit[rough.gentle], np.nan)[index],
        RISE * np.append(rough.rise[rough.gentle], np.nan)[index],
        HIGHER * _higher(all_around, 1),
    )
    variance = sum(part**2 for part in parts) * scale.distance_px ** (2.0 * GROWTH)
    shown &= classes != WATER_CLASS
    return Crowns(shown, disparity, slope, variance, height * LATTICE_M, classes)


def _known(surface: GroundSurface) -> slice:
    """The steps between two known surfaces."""
    return slice(surface.rough, len(surface.steps))


def _hidden_in_right(
    surface: GroundSurface, smooth: Places, corner: Steps, xy: Floats, local: LocalProjection,
    row: Ints, col: Ints, disparity: Floats,
) -> Bools:  # fmt: skip
    """Which pixels [n] a smooth triangle, one of the tops ``corner`` at ``xy``, or a step between
    known surfaces hides from the right camera."""
    out = np.zeros(row.size, np.bool_)
    if row.size == 0:
        return out
    order, where = by_right_column(row, col, disparity[row, col], smooth.first)
    hidden = smooth.hidden(where) | steps_in_right(surface, local, _known(surface), where)
    out[order] = hidden | Places(xy, corner, smooth.first).hidden(where)
    return out
