"""Ground to epipolar pixels by polynomials, one for each cube of the points' lattice.

RPCs and epipolar splines are smooth: over 52 m (58 m along a meridian) a cubic polynomial of
longitude, latitude and height is off by 1e-8 px (on large images) to 2e-6 px (on images of 700 px,
whose splines bend more), and takes a tenth of the time. Cubes are those of the global lattice and a
polynomial depends on nothing but the model, so that a point has the same position in whatever
window it is worked on. Where a polynomial is off by more than POLYNOMIAL_ERROR_PX, the model itself
is taken.

The polynomial is the least-squares fit to the model on 4 x 4 x 4 nodes (at 1/8, 3/8, 5/8 and 7/8 of
each side), by the Gram polynomials of four equidistant nodes (Abramowitz & Stegun 22.17), which are
orthogonal there: sums in a fixed order, no linear algebra library.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels import inner, kernel
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, LATTICE_M
from .view_geometry import ViewGeometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


CUBE_BITS = CELL_BITS - 1  # lattice steps along a cube's side
POLYNOMIAL_ERROR_PX = 1e-5  # at the corners and the middle of a cube
_PER_DEG, _PER_M = round(1 / LATTICE_DEG), round(1 / LATTICE_M)
_SCALE = 8.0 / (1 << CUBE_BITS)  # nodes lie at -3, -1, 1 and 3
# Gram polynomials: their values at the nodes, the sums of their squares, their coefficients.
_GRAM = np.array([[1, 1, 1, 1], [-3, -1, 1, 3], [1, -1, -1, 1], [-1, 3, -3, 1]], dtype=np.float64)
_NORM = (_GRAM**2).sum(axis=1)
_POWERS = np.array(
    [[1, 0, 0, 0], [0, 1, 0, 0], [-5 / 4, 0, 1 / 4, 0], [0, -41 / 12, 0, 5 / 12]], dtype=np.float64
)
_TERMS = np.array(
    [(a, b, c) for a in range(4) for b in range(4 - a) for c in range(4 - a - b)], dtype=np.int64
)
_NODES = np.stack(np.meshgrid(*[[-3.0, -1.0, 1.0, 3.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
_CHECKS = np.vstack(
    [np.stack(np.meshgrid(*[[-4.0, 4.0]] * 3, indexing="ij"), -1).reshape(-1, 3), np.zeros((1, 3))]
)
_RISE_M = 1.0  # between two heights, for the slope of the model itself
_RUN = 512  # points that are worked on at once; see _at_points


@inner
def _cubic(c: Floats, i: int, x: float, y: float, z: float) -> float:
    """The polynomial with coefficients c[i:i+20] in the order of _TERMS (nested)."""
    return (
        c[i]
        + z * (c[i + 1] + z * (c[i + 2] + z * c[i + 3]))
        + y
        * (c[i + 4] + z * (c[i + 5] + z * c[i + 6]) + y * (c[i + 7] + z * c[i + 8] + y * c[i + 9]))
        + x
        * (
            c[i + 10]
            + z * (c[i + 11] + z * c[i + 12])
            + y * (c[i + 13] + z * c[i + 14] + y * c[i + 15])
            + x * (c[i + 16] + z * c[i + 17] + y * c[i + 18] + x * c[i + 19])
        )
    )


@inner
def _rise(c: Floats, i: int, x: float, y: float, z: float) -> float:
    """Slope of :func:`_cubic` along z."""
    return (
        c[i + 1]
        + z * (2.0 * c[i + 2] + z * 3.0 * c[i + 3])
        + y * (c[i + 5] + z * 2.0 * c[i + 6] + y * c[i + 8])
        + x * (c[i + 11] + z * 2.0 * c[i + 12] + y * c[i + 14] + x * c[i + 17])
    )


@kernel
def _fit(
    values: Floats,
    checks: Floats,
    positions: Floats,
    gram: Floats,
    norm: Floats,
    powers: Floats,
    terms: Ints,
    tolerance: float,
    out: Floats,
    good: Bools,
) -> None:
    """``values`` [4, cubes, 64] at nodes, ``checks`` [4, cubes, 9] at ``positions``; ``out``
    [cubes, 80]."""
    row = np.empty((4, 4, 4))
    for cube in range(out.shape[0]):
        good[cube] = True
        for axis in range(4):
            row[:] = 0.0
            base = values[axis, cube, 0]
            for t in range(len(terms)):
                p, q, r = terms[t]
                total = 0.0
                for i in range(4):
                    for j in range(4):
                        for k in range(4):
                            weight = gram[p, i] * gram[q, j] * gram[r, k]
                            total += weight * (values[axis, cube, 16 * i + 4 * j + k] - base)
                total /= norm[p] * norm[q] * norm[r]
                for i in range(p + 1):
                    for j in range(q + 1):
                        for k in range(r + 1):
                            row[i, j, k] += total * powers[p, i] * powers[q, j] * powers[r, k]
            row[0, 0, 0] += base
            for t in range(len(terms)):
                p, q, r = terms[t]
                out[cube, 20 * axis + t] = row[p, q, r]
            for k in range(len(positions)):
                value = _cubic(
                    out[cube], 20 * axis, positions[k, 0], positions[k, 1], positions[k, 2]
                )
                if not abs(value - checks[axis, cube, k]) <= tolerance:  # also for NaN
                    good[cube] = False


@kernel
def _at_points(
    low: Ints,
    shape: Ints,
    coefficients: Floats,
    good: Bools,
    lon_q: Ints,
    lat_q: Ints,
    h_q: Ints,
    out: Floats,
    lifted: Bools,
    rise: Singles,
) -> int:
    """Returns how many points lie in cubes that are not ``good``: of these out[0] is NaN; fills
    ``rise`` [4, n] of those that are ``lifted`` [n or 0].

    By runs of points in one cube, and blocks of these through small arrays: vectorised.
    """
    bad = 0
    mask = (1 << CUBE_BITS) - 1
    position = np.empty(3 * _RUN)
    values = np.empty(4 * _RUN)
    chosen = np.empty(_RUN, np.int64)
    c = np.empty(80)
    n = lon_q.size
    start = 0
    while start < n:
        i, j, k = lon_q[start] >> CUBE_BITS, lat_q[start] >> CUBE_BITS, h_q[start] >> CUBE_BITS
        end = start + 1
        last = min(n, start + _RUN)
        while (
            end < last
            and lon_q[end] >> CUBE_BITS == i
            and lat_q[end] >> CUBE_BITS == j
            and h_q[end] >> CUBE_BITS == k
        ):
            end += 1
        cube = ((i - low[0]) * shape[1] + j - low[1]) * shape[2] + k - low[2]
        if not good[cube]:
            bad += end - start
        for m in range(80):  # a slice takes seconds to compile
            c[m] = coefficients[cube, m]
        size = end - start
        for m in range(size):
            position[m] = (lon_q[start + m] & mask) * _SCALE - 4.0
            position[_RUN + m] = (lat_q[start + m] & mask) * _SCALE - 4.0
            position[2 * _RUN + m] = (h_q[start + m] & mask) * _SCALE - 4.0
        for m in range(size):
            x, y, z = position[m], position[_RUN + m], position[2 * _RUN + m]
            values[m] = _cubic(c, 0, x, y, z)
            values[_RUN + m] = _cubic(c, 20, x, y, z)
            values[2 * _RUN + m] = _cubic(c, 40, x, y, z)
            values[3 * _RUN + m] = _cubic(c, 60, x, y, z)
        for axis in range(4):
            out[axis, start:end] = values[axis * _RUN : axis * _RUN + size]
        if not good[cube]:
            out[0, start:end] = np.nan
        if lifted.size:
            count = 0
            for m in range(size):
                chosen[count] = m
                count += lifted[start + m]
            for q in range(count):
                m = chosen[q]
                for axis in range(3):
                    position[axis * _RUN + q] = position[axis * _RUN + m]
            for q in range(count):
                x, y, z = position[q], position[_RUN + q], position[2 * _RUN + q]
                values[q] = _rise(c, 0, x, y, z) * _SCALE
                values[_RUN + q] = _rise(c, 20, x, y, z) * _SCALE
                values[2 * _RUN + q] = _rise(c, 40, x, y, z) * _SCALE
                values[3 * _RUN + q] = _rise(c, 60, x, y, z) * _SCALE
            for axis in range(4):
                for q in range(count):
                    rise[axis, start + chosen[q]] = values[axis * _RUN + q]
        start = end
    return bad


@kernel
def _at_means(
    low: Ints,
    shape: Ints,
    coefficients: Floats,
    good: Bools,
    sums: Ints,
    out: Floats,
) -> int:
    """As _at_points; NaN where there are no points."""
    bad = 0
    for p in range(sums.shape[0]):
        n = sums[p, 0]
        if n == 0:
            out[:, p] = np.nan
            continue
        cube = 0
        position = (0.0, 0.0, 0.0)
        side = n << CUBE_BITS
        i, j, k = sums[p, 1] // side, sums[p, 2] // side, sums[p, 3] // side
        # Integers as far as they go: what is divided is the same wherever windows begin.
        position = (
            (sums[p, 1] - i * side) / n * _SCALE - 4.0,
            (sums[p, 2] - j * side) / n * _SCALE - 4.0,
            (sums[p, 3] - k * side) / n * _SCALE - 4.0,
        )
        cube = ((i - low[0]) * shape[1] + j - low[1]) * shape[2] + k - low[2]
        if not good[cube]:
            bad += 1
        for axis in range(4):
            out[axis, p] = _cubic(
                coefficients[cube], 20 * axis, position[0], position[1], position[2]
            )
    return bad


@dataclass(frozen=True, eq=False)
class LocalProjection:
    """The polynomials of the cubes in a box, and the model that they stand for.

    ``low``, ``shape`` int64[3]: first cube and number of cubes along longitude, latitude, height;
    ``coefficients`` [cubes, 80] (x_left, y_left, x_right, y_right; 20 each); ``good`` [cubes].
    """

    model: ViewGeometry
    low: Ints
    shape: Ints
    coefficients: Floats
    good: Bools

    @classmethod
    def of(cls, model: ViewGeometry, low: ArrayLike, high: ArrayLike) -> LocalProjection:
        """For points between two corners, lattice (lon, lat, height), both included."""
        first = np.asarray(low, dtype=np.int64) >> CUBE_BITS
        shape = (np.asarray(high, dtype=np.int64) >> CUBE_BITS) - first + 1
        corner = np.indices(shape).reshape(3, -1, 1) + first[:, None, None]
        steps = np.array([LATTICE_DEG, LATTICE_DEG, LATTICE_M])[:, None, None] * (1 << CUBE_BITS)

        def at(positions: Floats) -> Floats:
            ground = (corner + (positions.T[:, None] + 4.0) / 8.0) * steps
            values = model.ground_to_epipolar(*(g.reshape(-1) for g in ground))
            return values.reshape(4, corner.shape[1], len(positions))

        coefficients = np.empty((corner.shape[1], 80))
        good = np.empty(corner.shape[1], dtype=np.bool_)
        _fit(
            at(_NODES),
            at(_CHECKS),
            _CHECKS,
            _GRAM,
            _NORM,
            _POWERS,
            _TERMS,
            POLYNOMIAL_ERROR_PX,
            coefficients,
            good,
        )
        return cls(model, first, shape, coefficients, good)

    def _cube(self, *lattice: Ints) -> Ints:
        i, j, k = (q - low for q, low in zip(lattice, self.low))
        return (i * self.shape[1] + j) * self.shape[2] + k

    def at_points(self, lon_q: Ints, lat_q: Ints, h_q: Ints) -> Floats:
        """float64[4, n] = x_left, y_left, x_right, y_right (px) of lattice points in the box."""
        none = np.empty(0, np.bool_), np.empty((4, 0), np.float32)
        return self._at((lon_q, lat_q, h_q), *none)

    def with_rise(
        self, lon_q: Ints, lat_q: Ints, h_q: Ints, lifted: Bools
    ) -> tuple[Floats, Singles]:
        """:meth:`at_points`, and by how much a lattice step of height changes it, float32[4, n]: of
        the points that are ``lifted`` [n], undefined of the others."""
        rise = np.empty((4, lon_q.size), np.float32)
        return self._at((lon_q, lat_q, h_q), lifted, rise), rise

    def _at(self, lattice: tuple[Ints, Ints, Ints], lifted: Bools, rise: Singles) -> Floats:
        """:meth:`at_points`; fills ``rise`` where points are ``lifted``, unless that is empty."""
        out, cubes = np.empty((4, lattice[0].size)), (self.low, self.shape, self.coefficients)
        if _at_points(*cubes, self.good, *lattice, out, lifted, rise):
            bad = np.isnan(out[0])
            lon, lat, h = (q[bad] / per for q, per in zip(lattice, (_PER_DEG, _PER_DEG, _PER_M)))
            out[:, bad] = self.model.ground_to_epipolar(lon, lat, h)
            if lifted.size:
                higher = self.model.ground_to_epipolar(lon, lat, h + _RISE_M)
                rise[:, bad] = (higher - out[:, bad]) / (_RISE_M * _PER_M)
        return out

    def at_means(self, sums: Ints) -> Floats:
        """As :meth:`at_points` of mean points; NaN where there are none.

        ``sums`` int64[n, 4]: number of points, sums of their lattice coordinates.
        """
        out = np.empty((4, len(sums)))
        if _at_means(self.low, self.shape, self.coefficients, self.good, sums, out):
            n = np.maximum(sums[:, 0], 1)
            lattice = [sums[:, axis] // (n << CUBE_BITS) for axis in (1, 2, 3)]
            bad = np.flatnonzero(sums[:, 0])
            bad = bad[~self.good[self._cube(*(q[bad] for q in lattice))]]
            lon, lat, h = (sums[bad, axis] / n[bad] for axis in (1, 2, 3))
            out[:, bad] = self.model.ground_to_epipolar(lon / _PER_DEG, lat / _PER_DEG, h / _PER_M)
        return out
