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

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Floats, Ints

Steps = NDArray[np.int32]
Places = NDArray[np.int32]

# Beyond this width (parts of a cell) the sums of the exact tests could leave 64 bits: 8000 px.
MAX_PARTS = 1 << 19
_SPLIT = 20  # bits; see _in_circle
HILBERT_BITS = 6  # of a square's side in parts: two ground cells
ROUNDS = 7  # of insertion
DIGIT_BITS = 10  # by which keys are sorted
DIGIT = (1 << DIGIT_BITS) - 1
BESIDE = 3  # columns of a mesh from which on the neighbours stand
NEAR = 1 << 30  # square parts: of vertices that near each other the test needs no split


# ---------------------------------------------------------------------------------- exact tests


@inlined
def _turn(at: Places, a: int, b: int, c: int) -> int:
    """Twice the signed area of a triangle: positive if it runs counter-clockwise."""
    x, y = np.int64(at[a, 0]), np.int64(at[a, 1])
    return (at[b, 0] - x) * (at[c, 1] - y) - (at[b, 1] - y) * (at[c, 0] - x)


@inlined
def _in_circle(at: Places, a: int, b: int, c: int, d: int) -> bool:
    """Whether ``d`` lies in the circumcircle of the counter-clockwise (a, b, c); never a tie."""
    x, y = np.int64(at[d, 0]), np.int64(at[d, 1])
    ax, ay = at[a, 0] - x, at[a, 1] - y
    bx, by = at[b, 0] - x, at[b, 1] - y
    cx, cy = at[c, 0] - x, at[c, 1] - y
    p, q, r = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    u, v, w = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    if u | v | w < NEAR:  # as great as p, q, r: 30 bits times 30 bits, three of them
        lifted = p * u + q * v + r * w
        if lifted != 0:
            return lifted > 0
    else:  # of 40 and 40 bits: the first factor is split, so that no sum leaves 64 bits
        mask = (1 << _SPLIT) - 1
        low = (p & mask) * u + (q & mask) * v + (r & mask) * w
        high = (p >> _SPLIT) * u + (q >> _SPLIT) * v + (r >> _SPLIT) * w + (low >> _SPLIT)
        if high != 0:
            return high > 0
        if low & mask:
            return True
    return _tie_in_circle(at, a, b, c, d)


@inlined
def _tie_in_circle(at: Places, a: int, b: int, c: int, d: int) -> bool:
    """:func:`_in_circle` of cocircular vertices: the one of the highest rank is lifted most. Its
    cofactor decides, or, where the other three lie on a line, that of the next."""
    s0, s1, s2, s3 = a, b, c, d
    for _ in range(3):  # four entries, sorted by falling rank
        if _before(at, s0, s1):
            s0, s1 = s1, s0
        if _before(at, s1, s2):
            s1, s2 = s2, s1
        if _before(at, s2, s3):
            s2, s3 = s3, s2
    for s in (s0, s1, s2, s3):
        if s == d:
            return False  # -turn(a, b, c), which is not 0
        if s == a:
            sign = _turn(at, d, b, c)
        elif s == b:
            sign = _turn(at, a, d, c)
        else:
            sign = _turn(at, a, b, d)
        if sign != 0:
            return sign > 0
    return False


@inlined
def _before(at: Places, s: int, t: int) -> bool:
    return at[s, 1] < at[t, 1] or (at[s, 1] == at[t, 1] and at[s, 0] < at[t, 0])


# ------------------------------------------------------------------------------------ insertion


@inner
def _turns() -> NDArray[np.uint16]:
    """Along a Hilbert curve through squares by four bits of x and of y: for each of four directions
    through the greater square, and these bits, the number of the square and the direction there."""
    out = np.empty((4, 16, 16), np.uint16)
    for direction in range(4):
        for x in range(16):
            for y in range(16):
                turned, swapped, key = direction & 1, direction >> 1, 0
                for bit in (3, 2, 1, 0):
                    rx, ry = (x >> bit & 1) ^ turned, (y >> bit & 1) ^ turned
                    if swapped:
                        rx, ry = ry, rx
                    key = key << 2 | ((3 * rx) ^ ry)
                    if ry == 0:
                        turned, swapped = turned ^ rx, 1 - swapped
                out[direction, x, y] = key << 2 | swapped << 1 | turned
    return out


@kernel
def _insertion_order(x: Ints, y: Ints, bits: int) -> Steps:
    """Order of insertion: rounds of four times the vertices each, along a Hilbert curve of squares
    of 1 << HILBERT_BITS parts, numbered by ``bits`` along each axis, a multiple of 4."""
    turns = _turns()
    keys = np.empty(x.size, np.uint32)
    for k in range(x.size):
        mixed = (np.uint64(x[k]) * np.uint64(0x9E3779B97F4A7C15)) ^ (
            np.uint64(y[k]) * np.uint64(0xC2B2AE3D27D4EB4F)
        )
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
        level = np.int64(0)
        while level < ROUNDS - 1 and mixed & np.uint64(3) == np.uint64(3):
            mixed >>= np.uint64(2)
            level += 1
        px, py = x[k] >> HILBERT_BITS, y[k] >> HILBERT_BITS
        key, direction = ROUNDS - 1 - level, 0
        for shift in range(bits - 4, -1, -4):
            turn = np.int64(turns[direction, px >> shift & 15, py >> shift & 15])
            key, direction = key << 8 | turn >> 2, turn & 3
        keys[k] = key
    # sorted by DIGIT_BITS at a time, from the last ones on
    order, sorted_order = np.arange(x.size).astype(np.int32), np.empty(x.size, np.int32)
    for shift in range(0, 2 * bits + 3, DIGIT_BITS):
        start = np.zeros((1 << DIGIT_BITS) + 1, np.int32)
        for k in range(x.size):
            start[(keys[k] >> shift & DIGIT) + 1] += 1
        for digit in range(DIGIT):
            start[digit + 1] += start[digit]
        for k in range(x.size):
            digit = keys[order[k]] >> shift & DIGIT
            sorted_order[start[digit]] = order[k]
            start[digit] += 1
        order, sorted_order = sorted_order, order
    return order


@inlined
def _side(mesh: Steps, t: int, other: int) -> int:
    """Beside which side of triangle ``t`` another lies; without branches, which the processor could
    not predict."""
    return np.int64(mesh[t, BESIDE + 1] == other) + 2 * np.int64(mesh[t, BESIDE + 2] == other)


@inlined
def _replace(mesh: Steps, t: int, old: int, new: int) -> None:
    if t >= 0:
        mesh[t, BESIDE + _side(mesh, t, old)] = new


@inlined
def _set(mesh: Steps, t: int, v: tuple, n: tuple) -> None:
    mesh[t, 0], mesh[t, 1], mesh[t, 2] = v
    mesh[t, BESIDE], mesh[t, BESIDE + 1], mesh[t, BESIDE + 2] = n


@kernel
def _insert_all(at: Places, mesh: Steps) -> int:
    """Delaunay triangles of vertices inside the square of the last four; returns their number.

    Vertices are inserted in their order: neighbours should follow each other, in memory too.
    ``at`` [n, 2]: (x, y). ``mesh`` [m, 8]: three vertices counter-clockwise, the triangle opposite
    each, -1 for none, and two spare numbers, so that a triangle is half a cache line.
    """
    size = len(at)
    south_west, south_east, north_east, north_west = size - 4, size - 3, size - 2, size - 1
    _set(mesh, 0, (south_west, south_east, north_east), (-1, 1, -1))
    _set(mesh, 1, (south_west, north_east, north_west), (-1, -1, 0))
    n = 2
    t = 0
    stack = np.empty(1024, np.int32)
    for p in range(size - 4):
        while True:  # walk
            edge = -1
            moved = False
            a, b, c = mesh[t, 0], mesh[t, 1], mesh[t, 2]
            opposite = _turn(at, b, c, p), _turn(at, c, a, p), _turn(at, a, b, p)
            for i in range(3):
                if opposite[i] < 0:
                    t = mesh[t, BESIDE + i]
                    moved = True
                    break
                if opposite[i] == 0:
                    edge = i
            if not moved:
                break
        if edge < 0:
            a, b, c = mesh[t, 0], mesh[t, 1], mesh[t, 2]
            na, nb, nc = mesh[t, BESIDE], mesh[t, BESIDE + 1], mesh[t, BESIDE + 2]
            t1, t2 = n, n + 1
            n += 2
            _set(mesh, t, (a, b, p), (t1, t2, nc))
            _set(mesh, t1, (b, c, p), (t2, t, na))
            _set(mesh, t2, (c, a, p), (t, t1, nb))
            _replace(mesh, na, t, t1)
            _replace(mesh, nb, t, t2)
            stack[0], stack[1], stack[2] = t, t1, t2
            waiting = 3
        else:
            c, a, b = mesh[t, edge], mesh[t, (edge + 1) % 3], mesh[t, (edge + 2) % 3]
            opposite_a, opposite_b = (
                mesh[t, BESIDE + (edge + 1) % 3],
                mesh[t, BESIDE + (edge + 2) % 3],
            )
            u = mesh[t, BESIDE + edge]
            k = _side(mesh, u, t)
            d = mesh[u, k]
            # u runs (d, b, a)
            beyond_b, beyond_a = mesh[u, BESIDE + (k + 1) % 3], mesh[u, BESIDE + (k + 2) % 3]
            t2, u2 = n, n + 1
            n += 2
            _set(mesh, t, (c, a, p), (u2, t2, opposite_b))
            _set(mesh, t2, (b, c, p), (t, u, opposite_a))
            _set(mesh, u, (d, b, p), (t2, u2, beyond_a))
            _set(mesh, u2, (a, d, p), (u, t, beyond_b))
            _replace(mesh, opposite_a, t, t2)
            _replace(mesh, beyond_b, u, u2)
            stack[0], stack[1], stack[2], stack[3] = t, t2, u, u2
            waiting = 4
        while waiting:
            waiting -= 1
            t = stack[waiting]
            u = mesh[t, BESIDE + 2]
            if u < 0:
                continue
            k = _side(mesh, u, t)
            q = mesh[u, k]
            a, b = mesh[t, 0], mesh[t, 1]
            if not _in_circle(at, a, b, p, q):
                continue
            # u runs (q, b, a)
            beyond_b, beyond_a = mesh[u, BESIDE + (k + 1) % 3], mesh[u, BESIDE + (k + 2) % 3]
            before_a, before_b = mesh[t, BESIDE], mesh[t, BESIDE + 1]
            _set(mesh, t, (a, q, p), (u, before_b, beyond_b))
            _set(mesh, u, (q, b, p), (before_a, t, beyond_a))
            _replace(mesh, before_a, t, u)
            _replace(mesh, beyond_b, u, t)
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


@kernel
def height_ranges(h: Ints, corner: Steps) -> Ints:
    """Least and greatest height [n, 2] of the vertices of triangles [n, 3]."""
    out = np.empty((len(corner), 2), np.int64)
    for t in range(len(corner)):
        a, b, c = h[corner[t, 0]], h[corner[t, 1]], h[corner[t, 2]]
        out[t, 0], out[t, 1] = min(a, b, c), max(a, b, c)
    return out


@inlined
def _circumradius(at: Places, a: int, b: int, c: int) -> float:
    u, v = float(at[b, 0] - at[a, 0]), float(at[b, 1] - at[a, 1])
    s, t = float(at[c, 0] - at[b, 0]), float(at[c, 1] - at[b, 1])
    p, q = float(at[a, 0] - at[c, 0]), float(at[a, 1] - at[c, 1])
    sides = (u * u + v * v) * (s * s + t * t) * (p * p + q * q)
    return np.sqrt(sides) / (2.0 * float(_turn(at, a, b, c)))


@kernel
def _tidy(at: Places, order: Steps, mesh: Steps, limit: float) -> tuple[Steps, Steps, Floats]:
    """Triangles of circumradius up to ``limit`` without the square's corners, in order.

    ``order``: the number that each vertex gets.
    """
    size, vertices = len(mesh), order.size
    radius = np.empty(size)
    start = np.zeros(vertices + 1, np.int32)
    for t in range(size):
        a, b, c = mesh[t, 0], mesh[t, 1], mesh[t, 2]
        radius[t] = np.inf
        if max(a, b, c) >= vertices:
            continue
        a, b, c = order[a], order[b], order[c]
        n0, n1, n2 = mesh[t, BESIDE], mesh[t, BESIDE + 1], mesh[t, BESIDE + 2]
        p, q, r = mesh[t, 0], mesh[t, 1], mesh[t, 2]
        while b < a or c < a:
            a, b, c = b, c, a
            p, q, r = q, r, p
            n0, n1, n2 = n1, n2, n0
        radius[t] = _circumradius(at, p, q, r)
        _set(mesh, t, (a, b, c), (n0, n1, n2))
        if radius[t] <= limit:
            start[a + 1] += 1
    for v in range(vertices):
        start[v + 1] += start[v]
    kept = start[vertices]
    order = np.empty(kept, np.int32)
    filled = start.copy()
    for t in range(size):
        if radius[t] <= limit:
            v = mesh[t, 0]
            k = filled[v]
            filled[v] += 1
            while k > start[v] and mesh[order[k - 1], 1] > mesh[t, 1]:
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
            corners[k, i] = mesh[t, i]
            other = mesh[t, BESIDE + i]
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
    order = _insertion_order(x, y, -(-(end >> HILBERT_BITS).bit_length() // 4) * 4)
    at = np.empty((n + 4, 2), np.int32)
    at[:n, 0], at[:n, 1] = x.take(order), y.take(order)
    at[n:] = [(-spare, -spare), (end, -spare), (end, end), (-spare, end)]
    mesh = np.empty((2 * n + 2, 8), np.int32)
    count = _insert_all(at, mesh)
    return Triangles(*_tidy(at, order, mesh[:count], float(max_radius)))
