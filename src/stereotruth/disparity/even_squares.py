"""One vertex in place of many where the ground is even.

Points that are denser than pixels tell nothing more of even ground than one in four pixels does,
and triangles of all of them took most of the time of dense clouds. A square of SIDE by SIDE cells
becomes one vertex in its middle, as high as the mean of its points there, if all vertices of the
nine squares around lie within EVEN_PX of one plane and are of one class. Squares lie on the global
lattice and sums are of integers, so that neither window nor order of the points leaves a trace.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel

Ints = NDArray[np.int64]
Steps = NDArray[np.int32]

SIDE = 4  # cells: two pixels
EVEN_PX = 0.15  # of disparity off the plane at most
FEWEST = 3  # vertices of a square
FEWEST_AROUND = 36  # of the nine squares: a quarter of their cells
REACH = 3 * SIDE  # cells around a vertex that have a say in whether it stays


@inner
def _by_square(square: Steps, start: Steps) -> Steps:
    """Vertices in the order of their squares; ``start`` [squares + 1] takes where each begins."""
    start[:] = 0
    for k in square:
        start[k + 1] += 1
    for k in range(start.size - 1):
        start[k + 1] += start[k]
    place = start[:-1].copy()
    out = np.empty(square.size, np.int32)
    for k in range(square.size):
        out[place[square[k]]] = k
        place[square[k]] += 1
    return out


@inner
def _enough(start: Steps, s: int, cols: int) -> bool:
    """Whether a square and those around it hold points enough."""
    if start[s + 1] - start[s] < FEWEST:
        return False
    around = 0
    for first in (s - cols - 1, s - 1, s + cols - 1):
        for q in range(first, first + 3):
            if start[q + 1] == start[q]:
                return False
        around += start[first + 3] - start[first]
    return around >= FEWEST_AROUND


@inner
def _moments(places: Steps, start: Steps, first: int, out: Ints) -> None:
    """Of a row of squares from square ``first`` on: sums over the vertices of each to ``out``.

    ``places`` [n, 3] of vertices: x, y from the middle of their square, height; heights count from
    that of the square's first. ``out`` [cols, 8]: sums of x, y, h, xx, xy, yy, xh, yh.
    """
    for i in range(out.shape[0]):
        begin, end = start[first + i], start[first + i + 1]
        su = sv = sw = suu = suv = svv = suw = svw = 0
        for at in range(begin, end):
            u, v = np.int64(places[at, 0]), np.int64(places[at, 1])
            w = np.int64(places[at, 2]) - np.int64(places[begin, 2])
            su, sv, sw = su + u, sv + v, sw + w
            suu, suv, svv = suu + u * u, suv + u * v, svv + v * v
            suw, svw = suw + u * w, svw + v * w
        row = out[i]
        row[0], row[1], row[2], row[3] = su, sv, sw, suu
        row[4], row[5], row[6], row[7] = suv, svv, suw, svw


@inner
def _plane(
    places: Steps, moments: Ints, start: Steps, s: int, i: int, j: int, cols: int, side: int,
    off: float,
) -> tuple[bool, float, float]:  # fmt: skip
    """Whether the vertices of nine squares lie on one plane; its slopes.

    ``moments`` [3, cols, 8] of the rows of squares by their number modulo 3.
    """
    base = np.int64(places[start[s], 2])
    n = su = sv = sw = suu = suv = svv = suw = svw = 0
    for down in range(-1, 2):
        v = down * side
        for across in range(-1, 2):
            u = across * side
            q = s + down * cols + across
            number = np.int64(start[q + 1] - start[q])
            w = np.int64(places[start[q], 2]) - base
            m = moments[(j + down) % 3, i + across]
            n += number
            su, sv, sw = su + m[0] + number * u, sv + m[1] + number * v, sw + m[2] + number * w
            suu += m[3] + u * (2 * m[0] + number * u)
            suv += m[4] + u * m[1] + v * (m[0] + number * u)
            svv += m[5] + v * (2 * m[1] + number * v)
            suw += m[6] + u * m[2] + w * (m[0] + number * u)
            svw += m[7] + v * m[2] + w * (m[1] + number * v)
    cuu, cuv, cvv = float(n * suu - su * su), float(n * suv - su * sv), float(n * svv - sv * sv)
    cuw, cvw = float(n * suw - su * sw), float(n * svw - sv * sw)
    area = cuu * cvv - cuv * cuv
    gx, gy = (cuw * cvv - cvw * cuv) / area, (cvw * cuu - cuw * cuv) / area
    level = (float(sw) - gx * float(su) - gy * float(sv)) / float(n)
    for down in range(-1, 2):
        for across in range(-1, 2):
            q = s + down * cols + across
            for at in range(start[q], start[q + 1]):
                u, v = places[at, 0] + across * side, places[at, 1] + down * side
                w = np.int64(places[at, 2]) - base
                above = float(w) - gx * float(u) - gy * float(v)
                if not abs(above - level) <= off:
                    return False, 0.0, 0.0
    return True, gx, gy


@inner
def _placed(
    x: Steps, y: Steps, h: Steps, kinds: NDArray[np.uint8], order: Steps, start: Steps,
    shape: tuple[int, int], side: int, corner: tuple[int, int], places: Steps, kind: Steps,
) -> None:  # fmt: skip
    """Vertices in the order of their squares, to ``places`` as :func:`_moments` wants them.

    ``kind`` [rows * cols] takes the class of all vertices of a square, -1 if they differ.
    """
    for s in range(start.size - 1):
        j, i = divmod(s, shape[1])
        mid = corner[0] + i * side + side // 2, corner[1] + j * side + side // 2
        kind[s] = kinds[order[start[s]]] if start[s + 1] > start[s] else -1
        for at in range(start[s], start[s + 1]):
            k = order[at]
            places[at, 0], places[at, 1], places[at, 2] = x[k] - mid[0], y[k] - mid[1], h[k]
            if kinds[k] != kind[s]:
                kind[s] = -1


@kernel
def even_squares(
    x: Steps, y: Steps, h: Steps, kinds: NDArray[np.uint8], square: Steps, shape: tuple[int, int],
    side: int, corner: tuple[int, int], off: float,
) -> tuple[NDArray[np.bool_], Steps, Steps]:  # fmt: skip
    """Which squares [rows * cols] are even, their height in the middle, one vertex of each.

    ``x``, ``y``, ``h``, ``kinds`` (class) [n]: vertices; ``square`` [n]: that of each, of ``shape``
    (rows, cols), each ``side`` wide, the first with its lower corner at ``corner`` (x, y). Heights
    within ``off`` of a plane lie on it. x, y and side have one unit, heights and ``off`` another.
    Squares at the border of the window are not even: nobody knows what is beyond.
    """
    rows, cols = shape
    start = np.empty(rows * cols + 1, np.int32)
    order = _by_square(square, start)
    places, kind = np.empty((order.size, 3), np.int32), np.empty(rows * cols, np.int32)
    _placed(x, y, h, kinds, order, start, shape, side, corner, places, kind)
    even = np.zeros(rows * cols, np.bool_)
    height, one_of = np.zeros(rows * cols, np.int32), np.zeros(rows * cols, np.int32)
    moments = np.empty((3, cols, 8), np.int64)
    for j in range(rows):
        _moments(places, start, j * cols, moments[j % 3])
        # with this row, those around the one before are complete
        for i in range(1, cols - 1 if j > 1 else 1):
            s = (j - 1) * cols + i
            alike = kind[s] >= 0
            for q in (s - cols, s, s + cols):
                alike &= (kind[q - 1] == kind[s]) & (kind[q] == kind[s]) & (kind[q + 1] == kind[s])
            if not alike or not _enough(start, s, cols):
                continue
            even[s], gx, gy = _plane(places, moments, start, s, i, j - 1, cols, side, off)
            if even[s]:
                base, above = np.int64(places[start[s], 2]), 0.0
                for at in range(start[s], start[s + 1]):
                    u, v = float(places[at, 0]), float(places[at, 1])
                    above += float(places[at, 2] - base) - gx * u - gy * v
                height[s] = base + np.int64(np.rint(above / float(start[s + 1] - start[s])))
                one_of[s] = order[start[s]]
    return even, height, one_of
