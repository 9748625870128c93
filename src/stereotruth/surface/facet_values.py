"""What facets have at the centres of an image's pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import corner_shares, plane_slopes
from .vertices import Vertices

Steps = NDArray[np.int32]


class Facets(NamedTuple):
    """Triangles ``corner`` [m, 3] of vertices, with the ``variance`` [m] of a point's height there
    (lattice steps²) and the ``bulge`` [m] of the surface above each (lattice steps)."""

    corner: Steps
    variance: NDArray[np.floating]
    bulge: NDArray[np.floating]


class PixelValues(NamedTuple):
    """What triangles have at the centres of pixels [h, w]: ``slope`` [2, h, w] of the disparity;
    ``variance`` (lattice steps²), ``height`` and ``rise`` of the surface above its triangle
    (lattice steps); ``surface_class`` and ``day`` of the nearest vertex."""

    slope: Floats
    variance: Floats
    height: Floats
    rise: Floats
    surface_class: NDArray[np.uint8]
    day: NDArray[np.uint16]

    @classmethod
    def none(cls, shape: tuple[int, int]) -> PixelValues:
        """Of pixels without a triangle."""
        height, classes = np.full(shape, np.nan), np.zeros(shape, np.uint8)
        values = np.zeros((2, *shape)), np.zeros(shape), height, np.zeros(shape)
        return cls(*values, classes, np.zeros(shape, np.uint16))


@inlined
def triple(values: Floats, t: tuple) -> tuple[float, float, float]:
    """Of a triangle's three corners ``t``."""
    return values[t[0]], values[t[1]], values[t[2]]


@kernel
def interpolate(
    facets: Facets, vertices: Vertices, xy: Floats, index: Steps, first: tuple[int, int],
    out: PixelValues,
) -> None:  # fmt: skip
    """What the facet ``index`` [h, w] of each pixel has at its centre (eq. 10 and 11 of
    docs/explanation/surface.md), to ``out``."""
    corner, noise, bulge = facets.corner, facets.variance, facets.bulge
    h, count, classes, days = vertices.h_q, vertices.count, vertices.surface_class, vertices.day
    slope, variance, height, rise = out.slope, out.variance, out.height, out.rise
    surface_class, day = out.surface_class, out.day
    x_left, y_left, x_right = xy[0], xy[1], xy[2]
    rows, cols = index.shape
    for j in range(rows):
        for i in range(cols):
            t = index[j, i]
            if t < 0:
                continue
            v = corner[t, 0], corner[t, 1], corner[t, 2]
            x, y, xr = triple(x_left, v), triple(y_left, v), triple(x_right, v)
            slope[0, j, i], slope[1, j, i] = plane_slopes(
                x, y, (x[0] - xr[0], x[1] - xr[1], x[2] - xr[2])
            )
            b, c = corner_shares(x, y, first[1] + i - x[0], first[0] + j - y[0])
            a = 1.0 - b - c
            variance[j, i] = noise[t] * (
                a * a / count[v[0]] + b * b / count[v[1]] + c * c / count[v[2]]
            )
            rise[j, i] = bulge[t] * (a * b + b * c + c * a)
            height[j, i] = h[v[0]] + b * float(h[v[1]] - h[v[0]]) + c * float(h[v[2]] - h[v[0]])
            nearest = v[0] if a >= b and a >= c else v[1] if b >= c else v[2]
            surface_class[j, i], day[j, i] = classes[nearest], days[nearest]
