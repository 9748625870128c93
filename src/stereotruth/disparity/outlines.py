"""Roof edges between the points: where in its triangles a step of two surfaces lies.

A triangle that spans a step holds points of a low and of a high surface. Edges of buildings are
straight over many points, so that the points on both sides along an edge say much better than the
three of one triangle where it runs: of all lines that part the low from the high points around, as
far along the edge as there is such a line (a corner ends it), the feasible ones form a convex set
in (offset, slope), found by clipping a polygon with one constraint for each point. The step lies
within the span of this set. A triangle is cut there: what lies clearly on one side goes on that
surface's plane, the strip in between may hold anything between both.

No image has a say, so that the benchmark does not favour what images show well. All follows from
the points up to REACH around a triangle, in an order of theirs that no window changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .point_triangles import PART, PART_BITS

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

REACH = 12.0  # mean distances of points along an edge, to either side of a triangle
NEAR = 3.0  # within which points tell heights and the direction of a step
BAND = 2.5  # and how far off the edge points still have a say
BACK = 1.5  # before a corner the last points are left out: they may already lie beyond it
ROUGH = 0.08  # with more points below the low and above the high surface, these are crowns
GAP = 4.6  # points expected in an area that is empty with a chance of 1 %
SLACK_CELLS = 0.12  # horizontal noise of points, in cells
MARGIN_CELLS = 0.2  # added to either side of the feasible span
SMALLEST = 0.1  # area of a triangle that is worth a cut, in squares of the mean distance
WIDEST = 0.75  # half the width of a strip that still tells something, in mean distances
STEEPEST = 1.2  # slope of an edge against its first guess
_MOST = 4096  # points that have a say at most
_CORNERS = 24  # of the polygon of feasible lines at most


@njit(cache=True, nogil=True, error_model="numpy")
def _handed_on(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, plane: Floats, smooth: float,
    step: float,
) -> Floats:  # fmt: skip
    """Slopes [n, 2] at vertices; those without take the nearest one's whose plane they are on."""
    out = plane.copy()
    nearest = np.full(x.size, np.iinfo(np.int64).max)
    for t in range(len(corner)):
        if radius[t] > smooth:
            continue
        for i in range(3):
            v = corner[t, i]
            if not np.isnan(plane[v, 0]):
                continue
            for k in range(1, 3):
                w = corner[t, (i + k) % 3]
                if np.isnan(plane[w, 0]):
                    continue
                u, s = x[v] - x[w], y[v] - y[w]
                off = float(h[v] - h[w]) - plane[w, 0] * float(u) - plane[w, 1] * float(s)
                far = u * u + s * s
                if abs(off) <= step and far < nearest[v]:
                    nearest[v] = far
                    out[v] = plane[w]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _clip(a: Floats, b: Floats, n: int, p: float, q: float, r: float, c: Floats, d: Floats) -> int:
    """The part of a convex polygon (a, b)[n] with p a + q b <= r, to (c, d); its corners."""
    m = 0
    for i in range(n):
        k = i + 1 if i + 1 < n else 0
        here, there = p * a[i] + q * b[i] - r, p * a[k] + q * b[k] - r
        if here <= 0.0:
            c[m], d[m] = a[i], b[i]
            m += 1
        if (here < 0.0 < there) or (there < 0.0 < here):
            part = here / (here - there)
            c[m], d[m] = a[i] + part * (a[k] - a[i]), b[i] + part * (b[k] - b[i])
            m += 1
    return m


@njit(cache=True, nogil=True, error_model="numpy")
def _feasible(
    u: Floats, v: Floats, high: Bools, order: Ints, n: int, extent: float, band: float,
    slack: float, limit: Floats, polygon: Floats, spare: Floats,
) -> int:  # fmt: skip
    """The lines u = a + b v with low points at smaller and high ones at greater u.

    Points are taken by growing |v| to both sides, up to ``limit`` [2] (v < 0, v >= 0). The first
    that no line fits ends its side there: ``limit`` is set to its |v|. Returns the number of
    corners of ``polygon`` [2, :].
    """
    m = 4
    polygon[0, :4] = (-extent, extent, extent, -extent)
    polygon[1, :4] = (-STEEPEST, -STEEPEST, STEEPEST, STEEPEST)
    for k in range(n):
        i = order[k]
        side = 1 if v[i] >= 0.0 else 0
        if abs(v[i]) > limit[side]:
            continue
        low, top = np.inf, -np.inf
        for j in range(m):
            at = polygon[0, j] + polygon[1, j] * v[i]
            low, top = min(low, at), max(top, at)
        if u[i] < low - band or u[i] > top + band:
            continue
        if high[i]:  # a + b v <= u + slack
            if top <= u[i] + slack:
                continue
            found = _clip(polygon[0], polygon[1], m, 1.0, v[i], u[i] + slack, spare[0], spare[1])
        else:
            if low >= u[i] - slack:
                continue
            found = _clip(polygon[0], polygon[1], m, -1.0, -v[i], slack - u[i], spare[0], spare[1])
        if found < 3:
            limit[side] = abs(v[i])
            continue
        m = min(found, _CORNERS - 4)
        polygon[:, :m] = spare[:, :m]
    return m


@njit(cache=True, nogil=True, error_model="numpy")
def _no_gap(
    u: Floats, v: Floats, high: Bools, n: int, band: float, limit: Floats, polygon: Floats, m: int,
    spare: Floats,
) -> int:  # fmt: skip
    """Drops lines so far off the high points that some would lie in between; corners left.

    Of points strewn at random none lies in an area where GAP are expected with a chance of
    exp(-GAP). Low points may be missing in the LiDAR's own shadow, high ones not.
    """
    at = 0.5 * (limit[1] - limit[0])
    top = -np.inf
    k = 0
    for j in range(m):
        here = polygon[0, j] + polygon[1, j] * at
        if here > top:
            top, k = here, j
    first, last = np.inf, -np.inf
    count = 0
    for i in range(n):
        off = u[i] - polygon[0, k] - polygon[1, k] * v[i]
        if high[i] and -limit[0] <= v[i] <= limit[1] and off <= band:
            count += 1
            first, last = min(first, v[i]), max(last, v[i])
    if count < 3:
        return m
    at = 0.5 * (first + last)
    top = -np.inf
    for j in range(m):
        top = max(top, polygon[0, j] + polygon[1, j] * at)
    # GAP expected points, of count in a strip of this length and width band
    found = _clip(
        polygon[0], polygon[1], m, -1.0, -at, GAP * band / float(count) - top, spare[0], spare[1]
    )
    if found < 3:
        return m
    polygon[:, :found] = spare[:, :found]
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _cuts(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, smooth: Bools, plane: Floats,
    beside: Ints, row_start: Ints, distance: float, largest: float, step: float,
    line: Floats, sheets: Floats, noise: Floats, anchor: Steps, few: float, least: float,
) -> None:  # fmt: skip
    """For each triangle that spans a step of two surfaces: where, and their planes.

    ``line`` [m, 4]: (p, q, r, w): places with p x + q y - r <= -w lie low, >= w high, x and y from
    the triangle's first vertex; w NaN for none. ``sheets`` [m, 8]: low, high plane: height at the
    first vertex, slopes; least and greatest height around. ``noise`` [m, 2]: variance of heights
    about both. ``anchor`` [m, 2]: vertices that tell the planes' classes. ``beside``: the vertices
    of triangles that are not smooth, those of a row of cells from ``row_start`` on.
    """
    reach, near, band = REACH * distance, NEAR * distance, BAND * distance
    slack = SLACK_CELLS * PART
    rows = row_start.size - 1
    which = np.empty(_MOST, np.int64)
    dx, dy = np.empty(_MOST), np.empty(_MOST)
    u, v, high = np.empty(_MOST), np.empty(_MOST), np.empty(_MOST, np.bool_)
    polygon, spare, limit = np.empty((2, _CORNERS)), np.empty((2, _CORNERS)), np.empty(2)
    for t in range(len(corner)):
        line[t, 3] = np.nan
        if smooth[t] or radius[t] > largest:
            continue
        a, b, c = corner[t]
        area = float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
        if area < 2.0 * SMALLEST * distance * distance:
            continue
        ox = float(x[b] - x[a] + x[c] - x[a]) / 3.0
        oy = float(y[b] - y[a] + y[c] - y[a]) / 3.0
        # surfaces of its own vertices, at the middle
        low, top, low_h, top_h, bare = -1, -1, np.inf, -np.inf, False
        for i in range(3):
            w = corner[t, i]
            if np.isnan(plane[w, 0]):
                bare = True
                continue
            at = (
                float(h[w])
                + plane[w, 0] * (ox - float(x[w] - x[a]))
                + plane[w, 1] * (oy - float(y[w] - y[a]))
            )
            if at < low_h:
                low, low_h = w, at
            if at > top_h:
                top, top_h = w, at
        if low < 0 or (top_h - low_h <= 2.0 * step and not bare):
            continue
        # points around
        n = 0
        mid_x, mid_y = x[a] + int(np.floor(ox)), y[a] + int(np.floor(oy))
        far = int(np.ceil(reach))
        for row in range(
            max((mid_y - far) >> PART_BITS, 0), min(((mid_y + far) >> PART_BITS) + 1, rows)
        ):
            first, end = row_start[row], row_start[row + 1]
            west = mid_x - far
            while first < end:  # first vertex of the row at or beyond west
                half = (first + end) >> 1
                if x[beside[half]] < west:
                    first = half + 1
                else:
                    end = half
            for k in range(first, row_start[row + 1]):
                w = beside[k]
                if x[w] > mid_x + far or n == _MOST:
                    break
                px, py = float(x[w] - x[a]) - ox, float(y[w] - y[a]) - oy
                if px * px + py * py <= reach * reach:
                    which[n], dx[n], dy[n] = w, px, py
                    n += 1
        if top_h - low_h <= 2.0 * step:
            # One surface only: the other one may be known nearby.
            own = 0.5 * (low_h + top_h)
            gx, gy = plane[low, 0], plane[low, 1]
            lift = 0.0
            for i in range(3):
                w = corner[t, i]
                if np.isnan(plane[w, 0]):
                    off = (
                        float(h[w])
                        - low_h
                        - gx * (float(x[w] - x[a]) - ox)
                        - gy * (float(y[w] - y[a]) - oy)
                    )
                    if abs(off) > abs(lift):
                        lift = off
            if abs(lift) <= step:
                continue
            best = near * near
            other = -1
            other_h = 0.0
            for k in range(n):
                w = which[k]
                r2 = dx[k] * dx[k] + dy[k] * dy[k]
                if np.isnan(plane[w, 0]) or r2 >= best:
                    continue
                at = float(h[w]) - plane[w, 0] * dx[k] - plane[w, 1] * dy[k]
                if (lift > 0.0 and at >= own + max(lift - step, 2.0 * step)) or (
                    lift < 0.0 and at <= own + min(lift + step, -2.0 * step)
                ):
                    best, other, other_h = r2, w, at
            if other < 0:
                continue
            if lift > 0.0:
                top, top_h = other, other_h
            else:
                low, low_h = other, other_h
        # which points are on either, and the direction of the step
        lx, ly, tx, ty = plane[low, 0], plane[low, 1], plane[top, 0], plane[top, 1]
        sum_lx = sum_ly = sum_tx = sum_ty = 0.0
        near_l = near_t = beyond = 0
        off_l = off_t = square_l = square_t = 0.0
        m = 0
        least_h, most_h = np.inf, -np.inf
        for k in range(n):
            w = which[k]
            least_h, most_h = min(least_h, float(h[w])), max(most_h, float(h[w]))
            at_l, at_t = low_h + lx * dx[k] + ly * dy[k], top_h + tx * dx[k] + ty * dy[k]
            away = np.sqrt(dx[k] * dx[k] + dy[k] * dy[k])
            if away <= near and (float(h[w]) < at_l - step or float(h[w]) > at_t + step):
                beyond += 1
            gap = at_t - at_l
            if gap < 2.0 * step or np.isnan(plane[w, 0]):
                continue
            tolerance = min(step * (1.0 + away / (4.0 * distance)), gap / 3.0)
            is_low = abs(float(h[w]) - at_l) <= tolerance
            if not is_low and abs(float(h[w]) - at_t) > tolerance:
                continue
            which[m], dx[m], dy[m], high[m] = w, dx[k], dy[k], not is_low
            m += 1
            if away <= near:
                if is_low:
                    near_l += 1
                    sum_lx += dx[m - 1]
                    sum_ly += dy[m - 1]
                    off_l += float(h[w]) - at_l
                    square_l += (float(h[w]) - at_l) ** 2
                else:
                    near_t += 1
                    sum_tx += dx[m - 1]
                    sum_ty += dy[m - 1]
                    off_t += float(h[w]) - at_t
                    square_t += (float(h[w]) - at_t) ** 2
        if near_l == 0 or near_t == 0 or beyond > ROUGH * (near_l + near_t):
            continue
        nx, ny = sum_tx / near_t - sum_lx / near_l, sum_ty / near_t - sum_ly / near_l
        length = np.sqrt(nx * nx + ny * ny)
        if length == 0.0:
            continue
        nx, ny = nx / length, ny / length
        for k in range(m):
            u[k], v[k] = nx * dx[k] + ny * dy[k], nx * dy[k] - ny * dx[k]
        order = np.argsort(np.abs(v[:m]))
        limit[:] = reach
        extent = 4.0 * radius[t]
        found = _feasible(u, v, high, order, m, extent, band, slack, limit, polygon, spare)
        if limit[0] < reach or limit[1] < reach:
            for side in range(2):
                if limit[side] < reach:
                    limit[side] = limit[side] - BACK * distance
            found = _feasible(u, v, high, order, m, extent, band, slack, limit, polygon, spare)
            if found < 3:
                continue
        found = _no_gap(u, v, high, m, distance, limit, polygon, found, spare)
        mean_a, mean_b = polygon[0, :found].mean(), polygon[1, :found].mean()
        norm = np.sqrt(1.0 + mean_b * mean_b)
        least, most = np.inf, -np.inf
        for i in range(3):
            w = corner[t, i]
            at = nx * (float(y[w] - y[a]) - oy) - ny * (float(x[w] - x[a]) - ox)
            least, most = min(least, at), max(most, at)
        width = 0.0
        for j in range(found):
            for at in (least, most):
                width = max(
                    width, abs(polygon[0, j] - mean_a + (polygon[1, j] - mean_b) * at) / norm
                )
        width += MARGIN_CELLS * PART
        if width > WIDEST * distance:
            continue
        # (u - a - b v) / norm, in x and y from the first vertex
        p, q = (nx + mean_b * ny) / norm, (ny - mean_b * nx) / norm
        r = mean_a / norm + p * ox + q * oy
        good = True
        for i in range(3):
            w = corner[t, i]
            px, py = float(x[w] - x[a]), float(y[w] - y[a])
            s = p * px + q * py - r
            on_l = abs(float(h[w]) - low_h - lx * (px - ox) - ly * (py - oy)) <= step
            on_t = abs(float(h[w]) - top_h - tx * (px - ox) - ty * (py - oy)) <= step
            if on_l:
                good &= s <= width + slack
            elif on_t:
                good &= s >= -width - slack
            else:
                good &= abs(s) <= width + 2.0 * slack
        if not good:
            continue
        line[t, 0], line[t, 1], line[t, 2], line[t, 3] = p, q, r, width
        sheets[t, 0] = low_h + off_l / near_l - lx * ox - ly * oy
        sheets[t, 1], sheets[t, 2] = lx, ly
        sheets[t, 3] = top_h + off_t / near_t - tx * ox - ty * oy
        sheets[t, 4], sheets[t, 5] = tx, ty
        sheets[t, 6], sheets[t, 7] = least_h, most_h
        noise[t, 0] = max((square_l + few) / (near_l + 1.0), least)
        noise[t, 1] = max((square_t + few) / (near_t + 1.0), least)
        anchor[t, 0], anchor[t, 1] = low, top


@njit(cache=True, nogil=True, error_model="numpy")
def _pieces(
    x: Ints, y: Ints, corner: Steps, line: Floats, sheets: Floats,
    faces: Floats, face_of: Steps, face_high: Bools, steps: Floats, step_of: Steps,
    heights: Floats,
) -> tuple[int, int]:  # fmt: skip
    """Cuts triangles at their lines into triangles.

    ``faces`` [n, 3, 3]: x, y (from the first vertex), height; ``face_of``: triangle; ``face_high``:
    of the high surface. ``steps`` [n, 3, 2], ``heights`` [n, 2]: strips, and what they may hold.
    """
    px, py = np.empty(8), np.empty(8)
    ax, ay = np.empty(8), np.empty(8)
    bx, by = np.empty(8), np.empty(8)
    n = k = 0
    for t in range(len(corner)):
        if np.isnan(line[t, 3]):
            continue
        p, q, r, w = line[t]
        lowest, highest = sheets[t, 6], sheets[t, 7]
        for i in range(3):
            v = corner[t, i]
            px[i], py[i] = float(x[v] - x[corner[t, 0]]), float(y[v] - y[corner[t, 0]])
        for side in range(2):
            sign = 1.0 if side == 0 else -1.0
            m = _clip(px, py, 3, sign * p, sign * q, sign * r - w, ax, ay)
            for j in range(1, m - 1):
                for at, c in enumerate((0, j, j + 1)):
                    faces[n, at, 0], faces[n, at, 1] = ax[c], ay[c]
                    height = (
                        sheets[t, 3 * side]
                        + sheets[t, 3 * side + 1] * ax[c]
                        + sheets[t, 3 * side + 2] * ay[c]
                    )
                    faces[n, at, 2] = min(max(height, lowest), highest)
                face_of[n], face_high[n] = t, side == 1
                n += 1
        m = _clip(px, py, 3, p, q, r + w, ax, ay)
        m = _clip(ax, ay, m, -p, -q, w - r, bx, by)
        bottom, top = np.inf, -np.inf
        for c in range(m):
            bottom = min(bottom, sheets[t, 0] + sheets[t, 1] * bx[c] + sheets[t, 2] * by[c])
            top = max(top, sheets[t, 3] + sheets[t, 4] * bx[c] + sheets[t, 5] * by[c])
        for j in range(1, m - 1):
            for at, c in enumerate((0, j, j + 1)):
                steps[k, at, 0], steps[k, at, 1] = bx[c], by[c]
            heights[k, 0] = min(max(bottom, lowest), highest)
            heights[k, 1] = min(max(top, lowest), highest)
            step_of[k] = t
            k += 1
    return n, k


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parts of the triangles that a step goes through.

    ``faces`` [n, 3, 3]: triangles on a plane, corners (x, y from the first vertex of the triangle
    ``face_of`` [n], in parts of a cell, and height), ``noise`` [n]: variance of such heights,
    ``anchor`` [n]: a vertex of the plane. ``strips`` [k, 3, 2]: triangles of ``strip_of`` [k] that
    may hold any surface between ``heights`` [k, 2]. Heights in lattice steps.
    """

    faces: Floats
    face_of: Steps
    noise: Floats
    anchor: Steps
    strips: Floats
    strip_of: Steps
    heights: Floats


def cut_at_outlines(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, smooth: Bools, plane: Floats,
    distance: float, smooth_radius: float, step: float, few: float, least: float,
) -> tuple[Bools, Pieces]:  # fmt: skip
    """Which triangles [m] are cut, and their parts.

    ``x``, ``y``, ``h`` [n]: vertices in the order of their cells; ``corner`` [m, 3], ``radius``
    [m]: triangles, ``smooth`` [m] those on one surface; ``plane`` [n, 2]: slopes of the surface at
    each vertex, NaN for none; ``distance``: mean one of points; ``step``: heights off a plane by
    more are not on it; ``few``, ``least``: see :func:`.smooth_triangles.ground_surface`.
    """
    for _ in range(2):
        plane = _handed_on(x, y, h, corner, radius, plane, smooth_radius, step)
    # Of the points, those beside a step alone can bound it.
    at_step = np.zeros(x.size, np.bool_)
    at_step[corner[~smooth].reshape(-1)] = True
    beside = np.flatnonzero(at_step)
    rows = y[beside] >> PART_BITS
    row_start = np.searchsorted(rows, np.arange(int(rows.max(initial=-1)) + 2))
    size = len(corner)
    line, sheets, noise = np.empty((size, 4)), np.empty((size, 8)), np.empty((size, 2))
    anchor = np.empty((size, 2), np.int32)
    _cuts(
        x, y, h, corner, radius, smooth, plane, beside, row_start, distance, smooth_radius, step,
        line, sheets, noise, anchor, few, least,
    )  # fmt: skip
    cut = ~np.isnan(line[:, 3])
    many = int(cut.sum())
    faces, face_of, face_high = (
        np.empty((4 * many, 3, 3)), np.empty(4 * many, np.int32), np.empty(4 * many, np.bool_),
    )  # fmt: skip
    strips, strip_of, heights = (
        np.empty((3 * many, 3, 2)), np.empty(3 * many, np.int32), np.empty((3 * many, 2)),
    )  # fmt: skip
    n, k = _pieces(x, y, corner, line, sheets, faces, face_of, face_high, strips, strip_of, heights)
    of, side = face_of[:n], face_high[:n].astype(np.int64)
    return cut, Pieces(
        faces[:n], of, noise[of, side], anchor[of, side], strips[:k], strip_of[:k], heights[:k]
    )
