"""Triangles over an image: which pixels have their centres in one, and planes through it."""

from __future__ import annotations

import numpy as np

from ..kernels import inner

Three = tuple[float, float, float]


@inner
def edge_crossing(xa: float, ya: float, xb: float, yb: float, y: float) -> float:
    """Column where an edge between (xa, ya) and (xb, yb) meets the row ``y``.

    The same bits for both triangles beside the edge, so that no pixel is lost between them.
    """
    if yb < ya or (yb == ya and xb < xa):
        xa, ya, xb, yb = xb, yb, xa, ya
    return xa + (y - ya) * ((xb - xa) / (yb - ya))


@inner
def row_span(x: Three, y: Three, row: float) -> tuple[float, float]:
    """Lowest and highest column of a triangle in a row, both included; (inf, -inf) for none."""
    low, high = np.inf, -np.inf
    for i in range(3):
        k = (i + 1) % 3
        if y[i] == y[k]:
            if y[i] == row:
                low, high = min(low, x[i], x[k]), max(high, x[i], x[k])
        elif min(y[i], y[k]) <= row <= max(y[i], y[k]):
            at = edge_crossing(x[i], y[i], x[k], y[k], row)
            low, high = min(low, at), max(high, at)
    return low, high


@inner
def plane_slopes(x: Three, y: Three, value: Three) -> tuple[float, float]:
    """Slopes along x and y of a value at the corners; not finite if these lie in a line."""
    u, v, s, t = x[1] - x[0], y[1] - y[0], x[2] - x[0], y[2] - y[0]
    p, q = value[1] - value[0], value[2] - value[0]
    area = u * t - v * s
    return (p * t - q * v) / area, (q * u - p * s) / area


@inner
def corner_shares(x: Three, y: Three, across: float, down: float) -> tuple[float, float]:
    """Shares of the second and the third corner at a position that lies so far from the first one:
    barycentric coordinates, that of the first being what is left to 1.

    Of a position outside of the triangle by roundings, those of its border.
    """
    bx, by = plane_slopes(x, y, (0.0, 1.0, 0.0))
    cx, cy = plane_slopes(x, y, (0.0, 0.0, 1.0))
    b = min(max(bx * across + by * down, 0.0), 1.0)
    return b, min(max(cx * across + cy * down, 0.0), 1.0 - b)
