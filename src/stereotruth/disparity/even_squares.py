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
def _plane(
    x: Steps, y: Steps, h: Steps, kinds: NDArray[np.uint8], order: Steps, start: Steps, s: int,
    cols: int, mid: tuple[int, int], off: float,
) -> tuple[bool, float, float]:  # fmt: skip
    """Whether the vertices of nine squares lie on one plane and are of one class; its slopes."""
    base, kind = np.int64(h[order[start[s]]]), kinds[order[start[s]]]
    n = su = sv = sw = suu = suv = svv = suw = svw = 0
    for first in (s - cols - 1, s - 1, s + cols - 1):
        for at in range(start[first], start[first + 3]):
            k = order[at]
            if kinds[k] != kind:
                return False, 0.0, 0.0
            u, v = np.int64(x[k] - mid[0]), np.int64(y[k] - mid[1])
            w = np.int64(h[k] - base)
            n += 1
            su, sv, sw = su + u, sv + v, sw + w
            suu, suv, svv = suu + u * u, suv + u * v, svv + v * v
            suw, svw = suw + u * w, svw + v * w
    cuu, cuv, cvv = float(n * suu - su * su), float(n * suv - su * sv), float(n * svv - sv * sv)
    cuw, cvw = float(n * suw - su * sw), float(n * svw - sv * sw)
    area = cuu * cvv - cuv * cuv
    gx, gy = (cuw * cvv - cvw * cuv) / area, (cvw * cuu - cuw * cuv) / area
    level = (float(sw) - gx * float(su) - gy * float(sv)) / float(n)
    for first in (s - cols - 1, s - 1, s + cols - 1):
        for at in range(start[first], start[first + 3]):
            k = order[at]
            above = float(h[k] - base) - gx * float(x[k] - mid[0]) - gy * float(y[k] - mid[1])
            if not abs(above - level) <= off:
                return False, 0.0, 0.0
    return True, gx, gy


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
    even = np.zeros(rows * cols, np.bool_)
    height, one_of = np.zeros(rows * cols, np.int32), np.zeros(rows * cols, np.int32)
    for j in range(1, rows - 1):
        for i in range(1, cols - 1):
            s = j * cols + i
            if not _enough(start, s, cols):
                continue
            mid = corner[0] + i * side + side // 2, corner[1] + j * side + side // 2
            even[s], gx, gy = _plane(x, y, h, kinds, order, start, s, cols, mid, off)
            if even[s]:
                base, above = np.int64(h[order[start[s]]]), 0.0
                for at in range(start[s], start[s + 1]):
                    k = order[at]
                    u, v = float(x[k] - mid[0]), float(y[k] - mid[1])
                    above += float(h[k] - base) - gx * u - gy * v
                height[s] = base + np.int64(np.rint(above / float(start[s + 1] - start[s])))
                one_of[s] = order[start[s]]
    return even, height, one_of
