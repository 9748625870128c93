"""Which triangles of points are smooth, and which span a step.

A triangle is *smooth* if its heights follow the gradient that the surface has at each of its
vertices (the gentlest of the triangles there), or the plane of such a triangle beside it (creases,
ridges) within STEP_PX, and if SUPPORT of its neighbours do, too; or if it is part of a dome (a
crown), that falls away from those planes to all sides. Every other one spans a *step*.

Thresholds are px of disparity, multiples of the mean distance of points, or cells of half a pixel.
Everything follows from the triangles around a place alone; results have the same bytes for any
window that knows the points of its halo (:class:`Scale`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from ..lidar.lattice import LATTICE_M
from .even_squares import REACH as EVEN_REACH
from .ground_in_view import GroundInView
from .outlines import REACH, Pieces, cut_at_outlines
from .pixel_labels import FEW_NOISE_M, HEIGHT_NOISE_M
from .point_triangles import triangulate
from .rays import CELL_PX
from .vertices import PART, Vertices

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

# Heights follow a plane if they are off it by no more than this (px of disparity): what is wrong
# with the label then stays below a pixel.
STEP_PX = 0.5
# Circumradius of the largest triangle that can be smooth, in mean distances of points: of points
# strewn at random, a circle of 3 distances is empty with a chance of 1e-12.
SMOOTH_RADIUS = 3.0
# That of the largest one that can be swept: three times as great, and at least so many cells (10 m
# at pixels of 0.65 m), for the ground in the LiDAR's own shadows beside walls.
SWEPT_RADIUS = 3.0
SWEPT_CELLS = 32
# A gradient counts if the triangle is no sliver: least altitude in mean distances, and in cells.
SLIVER = 0.25
SLIVER_CELLS = 0.5
# Of its three neighbours so many are smooth, too: in crowns single triangles are level by chance
# (0.26 instead of 0.47 % of the hidden pixels of a forest had labels at 1 point/m²).
SUPPORT = 2
# Trees and huts of fewer pixels are told by the images: where points are farther apart than this,
# a label between them needs a higher correlation.
NOTICED_PX = 1.5
# Mean distances of points around a top of a rough surface that say whether it is one.
ROUGH_REACH = 2.2
# Crowns bulge: all around lies below their planes, however steeply it falls, while at the foot of a
# step it rises. A triangle of a dome is no higher than this, less where points are sparse (trust).
DOME_PX = 3.0
# The surface bulges out of a triangle whose vertices lie below each other's slopes by this or more
# on the average (px; noise of points stays below). The slopes are those of the gentlest triangles,
# on the inner side of a dome, and show a part of its curvature alone.
BULGE_PX = 0.1
CURVATURE_SHOWN = 0.6


@dataclass(frozen=True)
class Scale:
    """Radii of triangles, and the halo of a window, from the mean distance of a scene's points.

    ``distance``, ``smooth``, ``swept``: parts of a cell (PART). ``halo``: cells around all that a
    window shows and what may hide it. The vertices of a triangle lie within two radii of any place
    in its circumcircle. A label follows from its triangle, the neighbours of that and theirs
    (noise), the neighbours of these (support), the triangles that share a vertex with them
    (planes), and again (gradients): six steps of two radii. Where it is cut follows from the points
    up to REACH around it and the planes there (two radii more). Which points are of a rough surface
    follows from six steps, and its labels from ``rough_halo`` around. Which vertices there are
    follows from the squares around (:mod:`.even_squares`).
    """

    distance: float
    smooth: float
    swept: float
    halo: int

    @property
    def width(self) -> float:
        """Parts of a cell between a place of a triangle and any point that tells heights there."""
        return max(REACH * self.distance + 2.0 * self.smooth, 2.0 * self.swept)

    @property
    def rough_halo(self) -> int:
        """Cells around a triangle of a rough surface whose points have a say in it: its vertices,
        those beside it and beside these (misfits), and what lies around these."""
        return int(np.ceil((6.0 * self.smooth + ROUGH_REACH * self.distance) / PART))

    @property
    def distance_px(self) -> float:
        """Mean distance of points in pixels."""
        return CELL_PX * self.distance / PART

    @property
    def points_per_px(self) -> float:
        """Points in a pixel on the average; more than four count as four."""
        return 1.0 / self.distance_px**2

    @property
    def trust(self) -> float:
        """How far a lack of points tells that nothing is there: 1 for dense points, less where
        things of NOTICED_PX fall between them."""
        return min(1.0, NOTICED_PX / self.distance_px)

    @classmethod
    def of(cls, points_per_m2: float, cell_m: float) -> Scale:
        """From the points over the ground that they cover, and the side of a cell in m.

        Density counts in steps of a factor of 1.4, so that one more file leaves the rest of a scene
        as it is.
        """
        per_cell = 2.0 ** (round(2.0 * np.log2(points_per_m2 * cell_m**2)) / 2.0)
        distance = PART * max(
            1.0 / float(np.sqrt(per_cell)), 1.0
        )  # vertices are no denser than cells
        smooth = SMOOTH_RADIUS * distance
        swept = max(SWEPT_RADIUS * smooth, float(SWEPT_CELLS * PART))
        halo = max(12 * smooth, 2 * swept) + REACH * distance + 2 * smooth
        halo = max(halo, 18 * smooth + ROUGH_REACH * distance)
        return cls(distance, smooth, swept, int(np.ceil(halo / PART)) + EVEN_REACH + 2)


@inner
def _gradient(x: Ints, y: Ints, h: Ints, a: int, b: int, c: int) -> tuple[float, float, float]:
    """Slopes (height steps per part of a cell) of a triangle, and twice its area."""
    u, v, s, t = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
    p, q = h[b] - h[a], h[c] - h[a]
    area = float(u * t - v * s)
    return float(p * t - q * v) / area, float(q * u - p * s) / area, area


@inner
def _far(corner: Steps, t: int, i: int, u: int) -> int:
    """The vertex of triangle u, opposite vertex i of triangle t, that t has not."""
    shared = corner[t, 0] + corner[t, 1] + corner[t, 2] - corner[t, i]
    return corner[u, 0] + corner[u, 1] + corner[u, 2] - shared


@kernel
def _gentlest(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, smooth: float, least: float
) -> Floats:
    """Slopes [n, 2] of the gentlest triangle at each vertex, slivers apart; NaN where none is."""
    out = np.full((x.size, 2), np.nan)
    for t in range(len(corner)):
        if radius[t] > smooth:
            continue
        a, b, c = corner[t]
        gx, gy, area = _gradient(x, y, h, a, b, c)
        longest = 0
        for p, q in ((a, b), (b, c), (c, a)):
            longest = max(longest, (x[p] - x[q]) ** 2 + (y[p] - y[q]) ** 2)
        if area * area < least * least * longest:
            continue
        steep = gx * gx + gy * gy
        for v in (a, b, c):
            old = out[v, 0] ** 2 + out[v, 1] ** 2
            if not steep > old:  # also for NaN
                # Equally steep ones: by their slopes, so that the order does not tell.
                if steep == old and (gx, gy) > (out[v, 0], out[v, 1]):
                    continue
                out[v, 0], out[v, 1] = gx, gy
    return out


@inner
def _misfit(x: Ints, y: Ints, h: Ints, v: int, w: int, gx: float, gy: float) -> float:
    """Height (steps) of w above the plane of slopes (gx, gy) through v."""
    return float(h[w] - h[v]) - gx * float(x[w] - x[v]) - gy * float(y[w] - y[v])


@kernel
def _firm(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, slopes: Floats, smooth: float,
    step: float,
) -> Bools:  # fmt: skip
    """Which triangles follow the slopes of all three vertices."""
    out = np.zeros(len(corner), np.bool_)
    for t in range(len(corner)):
        if radius[t] > smooth:
            continue
        good = True
        for i in range(3):
            v = corner[t, i]
            for k in range(1, 3):
                w = corner[t, (i + k) % 3]
                if not abs(_misfit(x, y, h, v, w, slopes[v, 0], slopes[v, 1])) <= step:
                    good = False
        out[t] = good
    return out


@kernel
def _incident(corner: Steps, vertices: int) -> tuple[Steps, Steps]:
    """Triangles at each vertex: ``list[start[v] : start[v + 1]]``."""
    start = np.zeros(vertices + 1, np.int32)
    for t in range(len(corner)):
        for i in range(3):
            start[corner[t, i] + 1] += 1
    for v in range(vertices):
        start[v + 1] += start[v]
    place = start[:-1].copy()
    out = np.empty(3 * len(corner), np.int32)
    for t in range(len(corner)):
        for i in range(3):
            v = corner[t, i]
            out[place[v]] = t
            place[v] += 1
    return start, out


@kernel
def _joined(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, firm: Bools, start: Steps,
    around: Steps, smooth: float, step: float,
) -> Bools:  # fmt: skip
    """The firm triangles, and those on the plane of a firm one that shares a vertex with them."""
    out = firm.copy()
    for t in range(len(corner)):
        if firm[t] or radius[t] > smooth:
            continue
        for i in range(3):
            v = corner[t, i]
            for k in range(start[v], start[v + 1]):
                f = around[k]
                if not firm[f]:
                    continue
                gx, gy, _ = _gradient(x, y, h, corner[f, 0], corner[f, 1], corner[f, 2])
                b, c = corner[t, (i + 1) % 3], corner[t, (i + 2) % 3]
                if (
                    abs(_misfit(x, y, h, v, b, gx, gy)) <= step
                    and abs(_misfit(x, y, h, v, c, gx, gy)) <= step
                ):
                    out[t] = True
                    break
            if out[t]:
                break
    return out


@kernel
def _domed(
    x: Ints, y: Ints, h: Ints, corner: Steps, neighbour: Steps, radius: Floats, slopes: Floats,
    smooth: float, step: float, height: float,
) -> Bools:  # fmt: skip
    """Triangles no higher than ``height`` that bulge: what is beside them lies on their planes or
    below, and their vertices on the slopes of each other or below, by ``step`` at most above."""
    out = np.zeros(len(corner), np.bool_)
    for t in range(len(corner)):
        a, b, c = corner[t]
        low, high = min(h[a], h[b], h[c]), max(h[a], h[b], h[c])
        good = radius[t] <= smooth and high - low <= height
        for v, w, u in ((a, b, c), (b, c, a), (c, a, b)):
            if not good:
                break
            for other in (w, u):
                if not _misfit(x, y, h, v, other, slopes[v, 0], slopes[v, 1]) <= step:
                    good = False
        if not good:
            continue
        gx, gy, _ = _gradient(x, y, h, a, b, c)
        for i in range(3):
            u = neighbour[t, i]
            if u < 0:
                good = False
                break
            far = _far(corner, t, i, u)
            if _misfit(x, y, h, a, far, gx, gy) > step:
                good = False
        out[t] = good
    return out


@kernel
def _supported(smooth: Bools, neighbour: Steps) -> Bools:
    """The smooth triangles of which SUPPORT neighbours are smooth, too."""
    out = np.zeros(len(smooth), np.bool_)
    for t in range(len(smooth)):
        number = 0
        for i in range(3):
            u = neighbour[t, i]
            number += u >= 0 and smooth[u]
        out[t] = smooth[t] and number >= SUPPORT
    return out


@kernel
def _bulges(
    x: Ints, y: Ints, h: Ints, corner: Steps, chosen: Bools, slopes: Floats, least: float
) -> Floats:  # fmt: skip
    """By how much the vertices of each chosen triangle lie below each other's slopes on the
    average, height steps; 0 for less than ``least``."""
    out = np.zeros(len(corner))
    for t in range(len(corner)):
        if not chosen[t]:
            continue
        below = 0.0
        for i in range(3):
            v = corner[t, i]
            for k in range(1, 3):
                w = corner[t, (i + k) % 3]
                below -= _misfit(x, y, h, v, w, slopes[v, 0], slopes[v, 1]) / 6.0
        if below >= least:
            out[t] = below
    return out


@kernel
def _squares(
    x: Ints, y: Ints, h: Ints, count: Steps, corner: Steps, neighbour: Steps, smooth: Bools
) -> tuple[Floats, Floats]:
    """Per triangle, of its smooth neighbours: squared misfits of their far vertices, number.

    A misfit is divided by what it amounts to where all points have a variance of one.
    """
    total, number = np.zeros(len(corner)), np.zeros(len(corner))
    for t in range(len(corner)):
        if not smooth[t]:
            continue
        a, b, c = corner[t]
        gx, gy, area = _gradient(x, y, h, a, b, c)
        for i in range(3):
            u = neighbour[t, i]
            if u < 0 or not smooth[u]:
                continue
            far = _far(corner, t, i, u)
            # Barycentric coordinates of the far vertex.
            wa = ((x[b] - x[far]) * (y[c] - y[far]) - (y[b] - y[far]) * (x[c] - x[far])) / area
            wb = ((x[c] - x[far]) * (y[a] - y[far]) - (y[c] - y[far]) * (x[a] - x[far])) / area
            wc = 1.0 - wa - wb
            off = _misfit(x, y, h, a, far, gx, gy)
            scale = wa * wa / count[a] + wb * wb / count[b] + wc * wc / count[c]
            total[t] += off * off / (1.0 / count[far] + scale)
            number[t] += 1.0
    return total, number


@kernel
def _variances(
    neighbour: Steps, smooth: Bools, total: Floats, number: Floats, few: float, least: float
) -> Floats:
    """Variance of a point's height at each smooth triangle, pooled with its neighbours.

    ``few`` counts as one misfit more, ``least`` is the floor (steps²).
    """
    out = np.zeros(len(smooth))
    for t in range(len(smooth)):
        if not smooth[t]:
            continue
        s, n = total[t] + few, number[t] + 1.0
        for i in range(3):
            u = neighbour[t, i]
            if u >= 0:
                s += total[u]
                n += number[u]
        out[t] = max(s / n, least)
    return out


def _around(corner: Steps, chosen: Bools, vertices: int) -> Bools:
    """Which vertices the ``chosen`` triangles have."""
    out = np.zeros(vertices, np.bool_)
    out[corner[chosen].reshape(-1)] = True
    return out


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """The surface of a window's points, and where it steps.

    ``vertices``, and triangles of them: ``smooth`` [m, 3] on the surface, with the variance
    ``noise`` [m] of their points' heights (lattice steps²), and above which the surface bulges by
    ``bulge`` [m] (lattice steps) times the sum of the products of two barycentric coordinates, the
    form of a quadratic function between its values at the vertices; ``steps`` [k, 3] that may hold
    any surface between the heights ``span`` [k, 2] (lattice steps); of the first ``rough`` of these
    nobody knows which surfaces they hold, the others lie between two known ones. ``uneven`` [n]:
    which of the first vertices, those of points, share a triangle with one of a step, and may
    have a say in what is seen.
    """

    vertices: Vertices
    smooth: Steps
    noise: Floats
    bulge: Floats
    steps: Steps
    span: Ints
    rough: int
    uneven: Bools


def ground_surface(
    vertices: Vertices,
    scale: Scale,
    px_per_m: float,
    cell: tuple[int, int],
    view: GroundInView | None = None,
) -> GroundSurface:
    """Triangles of ``vertices``, told apart by STEP_PX; ``px_per_m``: disparity per m of height;
    ``cell``: (lon, lat) size in lattice steps. With a ``view``, those in it alone."""
    if view is not None:
        vertices = view.with_halo(vertices, scale.halo)
    x, y, h = vertices.x, vertices.y, vertices.h_q
    triangles = triangulate(x, y, scale.swept)
    corner, radius = triangles.corner, triangles.radius
    step = STEP_PX / px_per_m / LATTICE_M
    least = max(SLIVER * scale.distance, SLIVER_CELLS * PART)
    slopes = _gentlest(x, y, h, corner, radius, scale.smooth, least)
    firm = _firm(x, y, h, corner, radius, slopes, scale.smooth, step)
    start, around = _incident(corner, x.size)
    smooth = _joined(x, y, h, corner, radius, firm, start, around, scale.smooth, step)
    beside = triangles.neighbour
    smooth = _supported(smooth, beside)
    height = scale.trust * DOME_PX / STEP_PX * step
    smooth |= _domed(x, y, h, corner, beside, radius, slopes, scale.smooth, step, height)
    total, number = _squares(x, y, h, vertices.count, corner, triangles.neighbour, smooth)
    floors = (FEW_NOISE_M / LATTICE_M) ** 2, (HEIGHT_NOISE_M / LATTICE_M) ** 2
    noise = _variances(triangles.neighbour, smooth, total, number, *floors)
    bulge = _bulges(x, y, h, corner, smooth, slopes, BULGE_PX / STEP_PX * step) / CURVATURE_SHOWN
    plane = _gentlest(x, y, h, corner, np.where(smooth, radius, np.inf), scale.smooth, least)
    seen = np.ones(len(corner), np.bool_)
    if view is not None:
        seen = view.touching(vertices, corner)
    uneven = _around(corner, _around(corner, ~smooth, x.size)[corner].any(axis=1), x.size)
    if view is not None:
        uneven &= view.near(vertices, scale.rough_halo)
    cut, pieces = cut_at_outlines(
        x, y, h, corner, radius, smooth, seen, plane, scale.distance, scale.smooth, step, *floors
    )
    whole, smooth = corner[~smooth & ~cut & seen], smooth & seen
    span = np.stack([h[whole].min(axis=1), h[whole].max(axis=1)], axis=1)
    vertices, faces, strips = _with_pieces(vertices, corner, pieces, cell)
    return GroundSurface(
        vertices,
        np.concatenate([corner[smooth], faces]),
        np.concatenate([noise[smooth], pieces.noise]),
        np.concatenate([bulge[smooth], np.zeros(pieces.noise.size)]),
        np.concatenate([whole, strips]),
        np.concatenate([span, np.rint(pieces.heights).astype(np.int64)]),
        len(whole),
        uneven,
    )


@kernel
def _placed(
    pieces: Floats, of: Steps, corner: Steps, size: int, cell: tuple[int, int], lon_q: Ints,
    lat_q: Ints, x: Ints, y: Ints,
) -> None:  # fmt: skip
    """Places of the corners of ``pieces`` [n, 3, :] (x, y from the first vertex of the triangle
    ``of`` [n]), to the elements from ``size`` on."""
    for n in range(len(of)):
        first = corner[of[n], 0]
        for i in range(3):
            k = size + 3 * n + i
            across, along = pieces[n, i, 0], pieces[n, i, 1]
            lon_q[k] = lon_q[first] + np.int64(np.rint(across * (cell[0] / PART)))
            lat_q[k] = lat_q[first] + np.int64(np.rint(along * (cell[1] / PART)))
            x[k], y[k] = x[first] + np.int64(np.rint(across)), y[first] + np.int64(np.rint(along))


def _with_pieces(
    vertices: Vertices, corner: Steps, pieces: Pieces, cell: tuple[int, int]
) -> tuple[Vertices, Steps, Steps]:
    """The vertices and the corners of pieces; these [n, 3] of faces and [k, 3] of strips."""
    size = vertices.x.size
    faces, strips = 3 * len(pieces.face_of), 3 * len(pieces.strip_of)
    joined = {}
    for f in fields(Vertices):
        own = getattr(vertices, f.name)
        joined[f.name] = np.empty(size + faces + strips, own.dtype)
        joined[f.name][:size] = own
    places = [joined[name] for name in ("lon_q", "lat_q", "x", "y")]
    _placed(pieces.faces, pieces.face_of, corner, size, cell, *places)
    _placed(pieces.strips, pieces.strip_of, corner, size + faces, cell, *places)
    height, classes = joined["h_q"][size:], joined["surface_class"][size:]
    np.rint(pieces.faces[..., 2].reshape(-1), out=height[:faces], casting="unsafe")
    height[faces:] = np.repeat(np.rint(pieces.heights[:, 0]), 3)
    classes[:faces] = np.repeat(vertices.surface_class[pieces.anchor], 3)
    classes[faces:] = np.repeat(vertices.surface_class[corner[pieces.strip_of, 0]], 3)
    joined["count"][size:] = 1
    index = np.arange(size, size + faces + strips, dtype=np.int32).reshape(-1, 3)
    return Vertices(**joined), index[: faces // 3], index[faces // 3 :]
