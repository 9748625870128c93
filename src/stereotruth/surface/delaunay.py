"""Exact Delaunay triangles of vertices over the ground.

Facets need triangles that are the same whatever window, block, file or order the points come in. So

- vertices lie at integer positions (:mod:`.vertices`), and every test is exact in 64-bit integers;
- ties of cocircular vertices, as a gridded cloud has them everywhere, are broken by a symbolic
  perturbation: each vertex is lifted off the paraboloid by an infinitesimal that grows with its
  rank, south to north, then west to east (Devillers and Teillaud 2011). The Delaunay triangulation
  is then unique, and depends neither on the order of insertion nor on the window;
- a triangle of the points of a window is one of all points if its circumcircle lies where all
  points are known. Triangles of a greater circumradius than asked for are dropped, and a window
  knows the points of a halo around what it needs (:class:`.scale.SurfaceScale`).

Why not Qhull (scipy.spatial.Delaunay): it joggles or merges cocircular points as their order has
it, and took 13 us a vertex where the insertion here takes 0.7 us.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Steps = NDArray[np.int32]

# Beyond this width (parts of a cell) the sums of the exact tests could leave 64 bits: 8000 px.
MAX_PARTS = 1 << 19
_SPLIT = 20  # bits; see _in_circle


# ---------------------------------------------------------------------------------- exact tests


@inner
def _turn(x: Ints, y: Ints, a: int, b: int, c: int) -> int:
    """Twice the signed area of a triangle: positive if it runs counter-clockwise."""
    return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])


@inner
def _in_circle(x: Ints, y: Ints, a: int, b: int, c: int, d: int) -> bool:
    """Whether ``d`` lies in the circumcircle of the counter-clockwise (a, b, c); never a tie.

    Of products of 40 and 40 bits the first factor is split, so that no sum leaves 64 bits.
    """
    ax, ay = x[a] - x[d], y[a] - y[d]
    bx, by = x[b] - x[d], y[b] - y[d]
    cx, cy = x[c] - x[d], y[c] - y[d]
    p, q, r = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    u, v, w = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    mask = (1 << _SPLIT) - 1
    low = (p & mask) * u + (q & mask) * v + (r & mask) * w
    high = (p >> _SPLIT) * u + (q >> _SPLIT) * v + (r >> _SPLIT) * w + (low >> _SPLIT)
    if high != 0:
        return high > 0
    if low & mask:
        return True
    # Cocircular: the vertex of the highest rank is lifted most. Its cofactor decides, or, where
    # the other three lie on a line, that of the next.
    s0, s1, s2, s3 = a, b, c, d
    for _ in range(3):  # four entries, sorted by falling rank
        if _before(x, y, s0, s1):
            s0, s1 = s1, s0
        if _before(x, y, s1, s2):
            s1, s2 = s2, s1
        if _before(x, y, s2, s3):
            s2, s3 = s3, s2
    for s in (s0, s1, s2, s3):
        if s == d:
            return False  # -turn(a, b, c), which is not 0
        if s == a:
            sign = _turn(x, y, d, b, c)
        elif s == b:
            sign = _turn(x, y, a, d, c)
        else:
            sign = _turn(x, y, a, b, d)
        if sign != 0:
            return sign > 0
    return False


@inner
def _before(x: Ints, y: Ints, s: int, t: int) -> bool:
    return y[s] < y[t] or (y[s] == y[t] and x[s] < x[t])


# ------------------------------------------------------------------------------------ insertion


@kernel
def _keys(x: Ints, y: Ints, bits: int, out: Ints) -> None:
    """Order of insertion: rounds of four times the vertices each, along a Hilbert curve."""
    for k in range(x.size):
        mixed = (np.uint64(x[k]) * np.uint64(0x9E3779B97F4A7C15)) ^ (
            np.uint64(y[k]) * np.uint64(0xC2B2AE3D27D4EB4F)
        )
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
        level = np.int64(0)
        while level < 6 and mixed & np.uint64(3) == np.uint64(3):
            mixed >>= np.uint64(2)
            level += 1
        px, py = x[k], y[k]
        key = np.int64(0)
        side = np.int64(1) << (bits - 1)
        while side > 0:
            rx = np.int64(1) if px & side else np.int64(0)
            ry = np.int64(1) if py & side else np.int64(0)
            key = (key << 2) | ((3 * rx) ^ ry)
            if ry == 0:
                if rx == 1:
                    px, py = ~px, ~py
                px, py = py, px
            side >>= 1
        out[k] = ((6 - level) << 40) | key


@inner
def _replace(neighbour: Steps, t: int, old: int, new: int) -> None:
    if t >= 0:
        for i in range(3):
            if neighbour[t, i] == old:
                neighbour[t, i] = new


@inner
def _set(corner: Steps, neighbour: Steps, t: int, v: tuple, n: tuple) -> None:
    corner[t, 0], corner[t, 1], corner[t, 2] = v
    neighbour[t, 0], neighbour[t, 1], neighbour[t, 2] = n


@kernel
def _insert_all(x: Ints, y: Ints, corner: Steps, neighbour: Steps) -> int:
    """Delaunay triangles of vertices inside the square of the last four; returns their number.

    Vertices are inserted in their order: neighbours should follow each other, in memory too.
    ``corner`` [m, 3] vertices counter-clockwise, ``neighbour`` [m, 3]: the triangle opposite each.
    """
    size = x.size
    south_west, south_east, north_east, north_west = size - 4, size - 3, size - 2, size - 1
    _set(corner, neighbour, 0, (south_west, south_east, north_east), (-1, 1, -1))
    _set(corner, neighbour, 1, (south_west, north_east, north_west), (-1, -1, 0))
    n = 2
    t = 0
    stack = np.empty(1024, np.int32)
    for p in range(size - 4):
        while True:  # walk
            edge = -1
            moved = False
            for i in range(3):
                a, b = corner[t, (i + 1) % 3], corner[t, (i + 2) % 3]
                turn = _turn(x, y, a, b, p)
                if turn < 0:
                    t = neighbour[t, i]
                    moved = True
                    break
                if turn == 0:
                    edge = i
            if not moved:
                break
        if edge < 0:
            a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
            na, nb, nc = neighbour[t, 0], neighbour[t, 1], neighbour[t, 2]
            t1, t2 = n, n + 1
            n += 2
            _set(corner, neighbour, t, (a, b, p), (t1, t2, nc))
            _set(corner, neighbour, t1, (b, c, p), (t2, t, na))
            _set(corner, neighbour, t2, (c, a, p), (t, t1, nb))
            _replace(neighbour, na, t, t1)
            _replace(neighbour, nb, t, t2)
            stack[0], stack[1], stack[2] = t, t1, t2
            waiting = 3
        else:
            c, a, b = corner[t, edge], corner[t, (edge + 1) % 3], corner[t, (edge + 2) % 3]
            opposite_a, opposite_b = neighbour[t, (edge + 1) % 3], neighbour[t, (edge + 2) % 3]
            u = neighbour[t, edge]
            k = 0
            while neighbour[u, k] != t:
                k += 1
            d = corner[u, k]
            # u runs (d, b, a)
            beyond_b, beyond_a = neighbour[u, (k + 1) % 3], neighbour[u, (k + 2) % 3]
            t2, u2 = n, n + 1
            n += 2
            _set(corner, neighbour, t, (c, a, p), (u2, t2, opposite_b))
            _set(corner, neighbour, t2, (b, c, p), (t, u, opposite_a))
            _set(corner, neighbour, u, (d, b, p), (t2, u2, beyond_a))
            _set(corner, neighbour, u2, (a, d, p), (u, t, beyond_b))
            _replace(neighbour, opposite_a, t, t2)
            _replace(neighbour, beyond_b, u, u2)
            stack[0], stack[1], stack[2], stack[3] = t, t2, u, u2
            waiting = 4
        while waiting:
            waiting -= 1
            t = stack[waiting]
            u = neighbour[t, 2]
            if u < 0:
                continue
            k = 0
            while neighbour[u, k] != t:
                k += 1
            q = corner[u, k]
            a, b = corner[t, 0], corner[t, 1]
            if not _in_circle(x, y, a, b, p, q):
                continue
            # u runs (q, b, a)
            beyond_b, beyond_a = neighbour[u, (k + 1) % 3], neighbour[u, (k + 2) % 3]
            before_a, before_b = neighbour[t, 0], neighbour[t, 1]
            _set(corner, neighbour, t, (a, q, p), (u, before_b, beyond_b))
            _set(corner, neighbour, u, (q, b, p), (before_a, t, beyond_a))
            _replace(neighbour, before_a, t, u)
            _replace(neighbour, beyond_b, u, t)
            if waiting + 2 > stack.size:
                longer = np.empty(2 * stack.size, np.int32)
                longer[: stack.size] = stack
                stack = longer
            stack[waiting], stack[waiting + 1] = t, u
            waiting += 2
    return n


# ------------------------------------------------------------------------------------ triangles


class Triangles(NamedTuple):
    """Triangles [m], counter-clockwise over the ground, in the order of their vertices.

    ``corner`` int32[m, 3]: vertices, the first of the lowest number; ``neighbour`` int32[m, 3]: the
    triangle opposite each vertex, -1 for none; ``radius`` float64[m]: of the circumcircle, in parts
    of a cell.
    """

    corner: Steps
    neighbour: Steps
    radius: Floats


@inner
def _circumradius(x: Ints, y: Ints, a: int, b: int, c: int) -> float:
    u, v = float(x[b] - x[a]), float(y[b] - y[a])
    s, t = float(x[c] - x[b]), float(y[c] - y[b])
    p, q = float(x[a] - x[c]), float(y[a] - y[c])
    sides = (u * u + v * v) * (s * s + t * t) * (p * p + q * q)
    return np.sqrt(sides) / (2.0 * float(_turn(x, y, a, b, c)))


@kernel
def _tidy(
    x: Ints, y: Ints, order: Ints, corner: Steps, neighbour: Steps, limit: float
) -> tuple[Steps, Steps, Floats]:
    """Triangles of circumradius up to ``limit`` without the square's corners, in order.

    ``order``: the number that each vertex gets.
    """
    size, vertices = len(corner), order.size
    radius = np.empty(size)
    start = np.zeros(vertices + 1, np.int32)
    for t in range(size):
        a, b, c = corner[t, 0], corner[t, 1], corner[t, 2]
        radius[t] = np.inf
        if max(a, b, c) >= vertices:
            continue
        a, b, c = order[a], order[b], order[c]
        n0, n1, n2 = neighbour[t, 0], neighbour[t, 1], neighbour[t, 2]
        p, q, r = corner[t, 0], corner[t, 1], corner[t, 2]
        while b < a or c < a:
            a, b, c = b, c, a
            p, q, r = q, r, p
            n0, n1, n2 = n1, n2, n0
        radius[t] = _circumradius(x, y, p, q, r)
        _set(corner, neighbour, t, (a, b, c), (n0, n1, n2))
        if radius[t] <= limit:
            start[a + 1] += 1
    for v in range(vertices):
        start[v + 1] += start[v]
    kept = start[vertices]
    order = np.empty(kept, np.int32)
    filled = start.copy()
    for t in range(size):
        if radius[t] <= limit:
            v = corner[t, 0]
            k = filled[v]
            filled[v] += 1
            while k > start[v] and corner[order[k - 1], 1] > corner[t, 1]:
                order[k] = order[k - 1]
                k -= 1
            order[k] = t
    new = np.full(size, -1, np.int32)
    for k in range(kept):
        new[order[k]] = k
    corners, neighbours, radii = (
        np.empty((kept, 3), np.int32),
        np.empty((kept, 3), np.int32),
        np.empty(kept),
    )
    for k in range(kept):
        t = order[k]
        radii[k] = radius[t]
        for i in range(3):
            corners[k, i] = corner[t, i]
            other = neighbour[t, i]
            neighbours[k, i] = new[other] if other >= 0 else -1
    return corners, neighbours, radii


def triangulate(x: Ints, y: Ints, max_radius: float) -> Triangles:
    """Delaunay triangles of circumradius up to ``max_radius`` of distinct integer positions [n].

    ``x``, ``y`` int64 [n], no smaller than 0, less than MAX_PARTS apart; sorted by (y, x) if the
    order of the triangles is to follow the ground. ``max_radius`` in the same units.
    """
    n = x.size
    # The square's corners lie beyond all circumcircles that are kept.
    spare = 2 * int(np.ceil(max_radius)) + 2
    end = int(max(x.max(initial=0), y.max(initial=0))) + spare
    if end + spare >= MAX_PARTS:
        raise ValueError(f"positions {end} parts of a cell apart, at most {MAX_PARTS} are exact")
    keys = np.empty(n, np.int64)
    _keys(x, y, max(end.bit_length(), 1), keys)
    order = np.argsort(keys, kind="stable")
    every_x = np.concatenate([x[order], [-spare, end, end, -spare]]).astype(np.int64)
    every_y = np.concatenate([y[order], [-spare, -spare, end, end]]).astype(np.int64)
    corner, neighbour = (np.empty((2 * n + 2, 3), np.int32) for _ in range(2))
    count = _insert_all(every_x, every_y, corner, neighbour)
    return Triangles(
        *_tidy(every_x, every_y, order, corner[:count], neighbour[:count], float(max_radius))
    )
