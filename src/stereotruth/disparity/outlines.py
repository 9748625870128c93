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
from numpy.typing import NDArray

from ..kernels import inlined, inner, kernel
from .feasible_lines import CORNERS, RINGS, STATES, STEEPEST, clip, line_between
from .vertices import PART, PART_BITS

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]
Bools = NDArray[np.bool_]

REACH = 12.0  # mean distances of points along an edge, to either side of a triangle
NEAR = 3.0  # within which points tell heights and the direction of a step
BAND = 2.5  # and how far off the edge points still have a say
ROUGH = 0.08  # with more points below the low and above the high surface, these are crowns
SLACK_CELLS = 0.12  # horizontal noise of points, in cells
MARGIN_CELLS = 0.2  # added to either side of the feasible span
SMALLEST = 0.1  # area of a triangle that is worth a cut, in squares of the mean distance
WIDEST = 1.5  # half the width of a strip that still tells something, in mean distances
BLOCK_BITS = PART_BITS + 3  # of parts of a cell: vertices of a row are found by such blocks
_MOST = 4096  # points that have a say at most


@kernel
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
                    out[v, 0], out[v, 1] = plane[w, 0], plane[w, 1]
    return out


@kernel
def _by_block(x: Ints, y: Ints, beside: Ints, first: Steps) -> None:
    """First vertex of each block of a row of cells, to ``first`` [rows, blocks + 1].

    ``beside``: vertices in the order of their cells.
    """
    rows, blocks = first.shape[0], first.shape[1] - 1
    k = 0
    for row in range(rows):
        for block in range(blocks):
            first[row, block] = k
            while (
                k < beside.size
                and y[beside[k]] >> PART_BITS == row
                and x[beside[k]] >> BLOCK_BITS == block
            ):
                k += 1
        first[row, blocks] = k


@inlined
def _row_of_disc(
    first: Steps, row: int, mid_x: float, mid_y: float, reach: float
) -> tuple[int, int]:
    """From which to which vertex those of a row of cells within ``reach`` of a place are."""
    south = float(row << PART_BITS)
    off = max(mid_y - south - float(PART - 1), south - mid_y, 0.0)
    half = np.sqrt(max(reach * reach - off * off, 0.0)) + 1.0
    blocks = first.shape[1] - 1
    begin = min(max(np.int64(mid_x - half) >> BLOCK_BITS, 0), blocks)
    end = max(min((np.int64(mid_x + half) >> BLOCK_BITS) + 1, blocks), begin)
    return first[row, begin], first[row, end]


@inner
def _around(
    place: Steps, first: Steps, ax: int, ay: int, ox: float, oy: float, reach: float, which: Steps,
    dx: Floats, dy: Floats,
) -> int:  # fmt: skip
    """Fills in which of the vertices ``place`` lie within ``reach`` of the place (ox, oy) from
    (ax, ay), and how far they are off; returns their number."""
    n = 0
    mid_x, mid_y = float(ax) + ox, float(ay) + oy
    bottom = max(np.int64(mid_y - reach) >> PART_BITS, 0)
    top = min((np.int64(mid_y + reach) >> PART_BITS) + 1, first.shape[0])
    for row in range(bottom, top):
        begin, end = _row_of_disc(first, row, mid_x, mid_y, reach)
        for k in range(begin, min(end, begin + _MOST - n)):
            px, py = float(place[k, 0] - ax) - ox, float(place[k, 1] - ay) - oy
            which[n], dx[n], dy[n] = k, px, py
            n += px * px + py * py <= reach * reach
    return n


@inner
def _above(x: Ints, y: Ints, h: Ints, plane: Floats, a: int, w: int, ox: float, oy: float) -> float:
    """Height of the plane of vertex w at the place (ox, oy) from vertex a."""
    u, v = ox - float(x[w] - x[a]), oy - float(y[w] - y[a])
    return float(h[w]) + plane[w, 0] * u + plane[w, 1] * v


@inner
def _another_surface(
    x: Ints, y: Ints, h: Ints, plane: Floats, vertices: Steps, one: int, own: float, ox: float,
    oy: float, step: float, near: float, place: Steps, slopes: Floats, which: Steps, dx: Floats,
    dy: Floats, n: int,
) -> tuple[int, float, bool]:  # fmt: skip
    """One of the ``place`` nearby whose plane may be that of the ``vertices`` which are off the
    plane of vertex ``one`` (``own`` high in the middle); its height there; whether it is the higher
    one.

    -1 if there is none.
    """
    a = vertices[0]
    lift = 0.0
    for w in vertices:
        if np.isnan(plane[w, 0]):
            px, py = float(x[w] - x[a]) - ox, float(y[w] - y[a]) - oy
            off = float(h[w]) - own - plane[one, 0] * px - plane[one, 1] * py
            if abs(off) > abs(lift):
                lift = off
    other, other_h, best = -1, 0.0, near * near
    if abs(lift) <= step:
        return other, other_h, True
    least = max(abs(lift) - step, 2.0 * step)
    for k in range(n):
        w = which[k]
        r2 = dx[k] * dx[k] + dy[k] * dy[k]
        if not place[w, 3] or r2 >= best:
            continue
        at = float(place[w, 2]) - slopes[w, 0] * dx[k] - slopes[w, 1] * dy[k]
        if (at - own if lift > 0.0 else own - at) >= least:
            best, other, other_h = r2, w, at
    return other, other_h, lift > 0.0


@inlined
def _side(
    height: float, at_l: float, at_t: float, r2: float, distance: float, step: float
) -> tuple[bool, bool]:
    """Whether a point lies on either of two planes that are ``at_l`` and ``at_t`` high there, and
    on the high one. ``r2``: squared distance from the middle.

    Without branches, which the processor could not foretell.
    """
    gap = at_t - at_l
    off_l, off_t = abs(height - at_l), abs(height - at_t)
    tolerance = min(step * (1.0 + np.sqrt(r2) / (4.0 * distance)), gap / 3.0)
    return (gap >= 2.0 * step) & (min(off_l, off_t) <= tolerance), off_t < off_l


@inner
def _sides_nearby(
    place: Steps, sheet: Floats, distance: float, step: float, which: Steps, dx: Floats,
    dy: Floats, n: int, told: Floats,
) -> bool:  # fmt: skip
    """Sums over the points of either side to ``told`` [2, 5]: number, places, heights off the
    plane and their squares; False if a side has none, or too many lie beyond both.

    ``sheet`` [2, 3]: low, high plane: height in the middle, slopes.
    """
    told[:] = 0.0
    beyond = 0
    for k in range(n):
        height = float(place[which[k], 2])
        at_l = sheet[0, 0] + sheet[0, 1] * dx[k] + sheet[0, 2] * dy[k]
        at_t = sheet[1, 0] + sheet[1, 1] * dx[k] + sheet[1, 2] * dy[k]
        beyond += (height < at_l - step) | (height > at_t + step)
        r2 = dx[k] * dx[k] + dy[k] * dy[k]
        on_one, is_high = _side(height, at_l, at_t, r2, distance, step)
        if on_one and place[which[k], 3]:
            side = np.int64(is_high)
            off = height - (at_t if is_high else at_l)
            told[side, 0] += 1.0
            told[side, 1] += dx[k]
            told[side, 2] += dy[k]
            told[side, 3] += off
            told[side, 4] += off * off
    few = min(told[0, 0], told[1, 0]) == 0.0
    return not few and beyond <= ROUGH * (told[0, 0] + told[1, 0])


@inner
def _sides(
    place: Steps, first: Steps, ax: int, ay: int, ox: float, oy: float, reach: float,
    sheet: Floats, distance: float, step: float, nx: float, ny: float, widest: float, u: Floats,
    v: Floats, high: Bools,
) -> tuple[int, int, int]:  # fmt: skip
    """Places of the points of either side across (nx, ny) and along the step, and which are
    high; their number; least and greatest height of all within ``reach``.

    Those that lie more than ``widest`` beyond the steepest lines through the middle, low ones, and
    high ones on their own side, can neither bound the step nor tell a gap.
    """
    m = 0
    least, most = np.int32(np.iinfo(np.int32).max), np.int32(np.iinfo(np.int32).min)
    mid_x, mid_y = float(ax) + ox, float(ay) + oy
    bottom = max(np.int64(mid_y - reach) >> PART_BITS, 0)
    top = min((np.int64(mid_y + reach) >> PART_BITS) + 1, first.shape[0])
    for row in range(bottom, top):
        begin, end = _row_of_disc(first, row, mid_x, mid_y, reach)
        for k in range(begin, min(end, begin + _MOST - m)):
            px, py = float(place[k, 0] - ax) - ox, float(place[k, 1] - ay) - oy
            r2 = px * px + py * py
            inside = r2 <= reach * reach
            height = place[k, 2]
            least = min(least, height) if inside else least
            most = max(most, height) if inside else most
            across, along = nx * px + ny * py, nx * py - ny * px
            at_l = sheet[0, 0] + sheet[0, 1] * px + sheet[0, 2] * py
            at_t = sheet[1, 0] + sheet[1, 1] * px + sheet[1, 2] * py
            on_one, is_high = _side(float(height), at_l, at_t, r2, distance, step)
            u[m], v[m], high[m] = across, along, is_high
            near = across <= widest + STEEPEST * abs(along)
            m += inside & on_one & near & (place[k, 3] != 0)
    return m, least, most


@inner
def _parts(
    x: Ints, y: Ints, h: Ints, vertices: Steps, sheet: Floats, ox: float, oy: float, step: float,
    slack: float, p: float, q: float, r: float, width: float,
) -> bool:  # fmt: skip
    """Whether the triangle's own vertices lie where the line and the planes have them."""
    a = vertices[0]
    for w in vertices:
        px, py = float(x[w] - x[a]), float(y[w] - y[a])
        s = p * px + q * py - r
        off_l = float(h[w]) - sheet[0, 0] - sheet[0, 1] * (px - ox) - sheet[0, 2] * (py - oy)
        off_t = float(h[w]) - sheet[1, 0] - sheet[1, 1] * (px - ox) - sheet[1, 2] * (py - oy)
        if abs(off_l) <= step:
            good = s <= width + slack
        elif abs(off_t) <= step:
            good = s >= -width - slack
        else:
            good = abs(s) <= width + 2.0 * slack
        if not good:
            return False
    return True


@kernel
def _cuts(
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, plane: Floats,
    beside: Ints, place: Steps, slopes: Floats, first: Steps, distance: float, step: float,
    line: Floats, sheets: Floats, noise: Floats, anchor: Steps, few: float, least: float,
) -> None:  # fmt: skip
    """For each of the triangles that may span a step of two surfaces: where, and their planes.

    ``line`` [m, 4]: (p, q, r, w): places with p x + q y - r <= -w lie low, >= w high, x and y from
    the triangle's first vertex; w NaN for none. ``sheets`` [m, 8]: low, high plane: height at the
    first vertex, slopes; least and greatest height around. ``noise`` [m, 2]: variance of heights
    about both. ``anchor`` [m, 2]: vertices that tell the planes' classes. ``beside``: the vertices
    of triangles that are not smooth, their ``place`` [n, 4] (x, y, h, whether they have a plane)
    and its ``slopes`` [n, 2];
    ``first``: see :func:`_by_block`.
    """
    reach, near, band = REACH * distance, NEAR * distance, BAND * distance
    slack = SLACK_CELLS * PART
    which = np.empty(_MOST, np.int32)
    dx, dy = np.empty(_MOST), np.empty(_MOST)
    u, v, high = np.empty(_MOST), np.empty(_MOST), np.empty(_MOST, np.bool_)
    order, start = np.empty(_MOST, np.int32), np.empty(RINGS + 1, np.int32)
    lines, value = np.empty((STATES + 1, 2, CORNERS)), np.empty(CORNERS)
    size, taken, limit = np.empty(STATES + 1, np.int32), np.empty(STATES + 1), np.empty(2)
    sheet, told = np.empty((2, 3)), np.empty((2, 5))
    for t in range(len(corner)):
        line[t, 3] = np.nan
        a, b, c = corner[t]
        area = float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))
        if area < 2.0 * SMALLEST * distance * distance:
            continue
        ox = float(x[b] - x[a] + x[c] - x[a]) / 3.0
        oy = float(y[b] - y[a] + y[c] - y[a]) / 3.0
        # surfaces of its own vertices, in the middle
        low, top, low_h, top_h, bare = -1, -1, np.inf, -np.inf, False
        for w in corner[t]:
            if np.isnan(plane[w, 0]):
                bare = True
                continue
            at = _above(x, y, h, plane, a, w, ox, oy)
            if at < low_h:
                low, low_h = w, at
            if at > top_h:
                top, top_h = w, at
        one_only = top_h - low_h <= 2.0 * step
        if low < 0 or (one_only and not bare):
            continue
        n = _around(place, first, x[a], y[a], ox, oy, near, which, dx, dy)
        if one_only:
            other, other_h, is_top = _another_surface(
                x, y, h, plane, corner[t], low, 0.5 * (low_h + top_h), ox, oy, step, near, place,
                slopes, which, dx, dy, n,
            )  # fmt: skip
            if other < 0:
                continue
            other = beside[other]
            if is_top:
                top, top_h = other, other_h
            else:
                low, low_h = other, other_h
        sheet[0, 0], sheet[0, 1], sheet[0, 2] = low_h, plane[low, 0], plane[low, 1]
        sheet[1, 0], sheet[1, 1], sheet[1, 2] = top_h, plane[top, 0], plane[top, 1]
        if not _sides_nearby(place, sheet, distance, step, which, dx, dy, n, told):
            continue
        nx = told[1, 1] / told[1, 0] - told[0, 1] / told[0, 0]
        ny = told[1, 2] / told[1, 0] - told[0, 2] / told[0, 0]
        length = np.sqrt(nx * nx + ny * ny)
        if length == 0.0:
            continue
        nx, ny = nx / length, ny / length
        extent = 4.0 * radius[t]
        m, least_h, most_h = _sides(
            place, first, x[a], y[a], ox, oy, reach, sheet, distance, step, nx, ny, extent + band,
            u, v, high,
        )  # fmt: skip
        at = line_between(
            u, v, high, m, extent, reach, distance, band, slack, limit, lines, size, taken, value,
            order, start,
        )  # fmt: skip
        found = size[at]
        mean_a = mean_b = 0.0
        for j in range(found):
            mean_a, mean_b = mean_a + lines[at, 0, j], mean_b + lines[at, 1, j]
        mean_a, mean_b = mean_a / found, mean_b / found
        norm = np.sqrt(1.0 + mean_b * mean_b)
        width = 0.0
        for w in corner[t]:
            along = nx * (float(y[w] - y[a]) - oy) - ny * (float(x[w] - x[a]) - ox)
            for j in range(found):
                off = lines[at, 0, j] - mean_a + (lines[at, 1, j] - mean_b) * along
                width = max(width, abs(off) / norm)
        width += MARGIN_CELLS * PART
        if width > WIDEST * distance:
            continue
        # (u - a - b v) / norm, in x and y from the first vertex
        p, q = (nx + mean_b * ny) / norm, (ny - mean_b * nx) / norm
        r = mean_a / norm + p * ox + q * oy
        if not _parts(x, y, h, corner[t], sheet, ox, oy, step, slack, p, q, r, width):
            continue
        line[t, 0], line[t, 1], line[t, 2], line[t, 3] = p, q, r, width
        for side in range(2):
            level, gx, gy = sheet[side]
            sheets[t, 3 * side] = level + told[side, 3] / told[side, 0] - gx * ox - gy * oy
            sheets[t, 3 * side + 1], sheets[t, 3 * side + 2] = gx, gy
            noise[t, side] = max((told[side, 4] + few) / (told[side, 0] + 1.0), least)
        sheets[t, 6], sheets[t, 7] = least_h, most_h
        anchor[t, 0], anchor[t, 1] = low, top


@kernel
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
        p, q, r, w = line[t]
        lowest, highest = sheets[t, 6], sheets[t, 7]
        for i in range(3):
            v = corner[t, i]
            px[i], py[i] = float(x[v] - x[corner[t, 0]]), float(y[v] - y[corner[t, 0]])
        for side in range(2):
            sign = 1.0 if side == 0 else -1.0
            m = clip(px, py, 3, sign * p, sign * q, sign * r - w, ax, ay)
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
        m = clip(px, py, 3, p, q, r + w, ax, ay)
        m = clip(ax, ay, m, -p, -q, w - r, bx, by)
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
    x: Ints, y: Ints, h: Ints, corner: Steps, radius: Floats, smooth: Bools, seen: Bools,
    plane: Floats, distance: float, smooth_radius: float, step: float, few: float, least: float,
) -> tuple[Bools, Pieces]:  # fmt: skip
    """Which triangles [m] are cut, and their parts.

    ``x``, ``y``, ``h`` [n]: vertices in the order of their cells; ``corner`` [m, 3], ``radius``
    [m]: triangles, ``smooth`` [m] those on one surface; of the others, those ``seen`` [m] are cut;
    ``plane`` [n, 2]: slopes of the surface at each vertex, NaN for none; ``distance``: mean one of
    points; ``step``: heights off a plane by more are not on it; ``few``, ``least``: see
    :func:`.smooth_triangles.ground_surface`.
    """
    for _ in range(2):
        plane = _handed_on(x, y, h, corner, radius, plane, smooth_radius, step)
    # Of the points, those beside a step alone can bound it.
    at_step = np.zeros(x.size, np.bool_)
    at_step[corner[~smooth].reshape(-1)] = True
    beside = np.flatnonzero(at_step)
    slopes = plane[beside]
    place = np.stack([x[beside], y[beside], h[beside], ~np.isnan(slopes[:, 0])], axis=1)
    place = place.astype(np.int32)
    cells, rows = (int(v[beside].max(initial=-1)) for v in (x >> BLOCK_BITS, y >> PART_BITS))
    first = np.empty((rows + 1, cells + 2), np.int32)
    _by_block(x, y, beside, first)
    of = np.flatnonzero(~smooth & seen & (radius <= smooth_radius)).astype(np.int32)
    size = of.size
    line, sheets, noise = np.empty((size, 4)), np.empty((size, 8)), np.empty((size, 2))
    anchor = np.empty((size, 2), np.int32)
    _cuts(
        x, y, h, corner[of], radius[of], plane, beside, place, slopes, first, distance, step,
        line, sheets, noise, anchor, few, least,
    )  # fmt: skip
    told = ~np.isnan(line[:, 3])
    of, line, sheets, noise, anchor = (each[told] for each in (of, line, sheets, noise, anchor))
    cut = np.zeros(len(corner), np.bool_)
    cut[of] = True
    many = of.size
    faces, face_of, face_high = (
        np.empty((4 * many, 3, 3)), np.empty(4 * many, np.int32), np.empty(4 * many, np.bool_),
    )  # fmt: skip
    strips, strip_of, heights = (
        np.empty((3 * many, 3, 2)), np.empty(3 * many, np.int32), np.empty((3 * many, 2)),
    )  # fmt: skip
    n, k = _pieces(
        x, y, corner[of], line, sheets, faces, face_of, face_high, strips, strip_of, heights
    )
    part, side = face_of[:n], face_high[:n].astype(np.int64)
    return cut, Pieces(
        faces[:n], of[part], noise[part, side], anchor[part, side], strips[:k], of[strip_of[:k]],
        heights[:k],
    )  # fmt: skip
