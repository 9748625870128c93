"""A map projection's way to longitude and latitude as polynomials on patches of ground.

PROJ takes 130 to 900 ns for a point, these polynomials 6. In a patch of 500 m by 500 m and 1000 m
of height, longitude, latitude and what the datum changes of the height are quadratic in the
plane, and change linearly with height by an amount that is linear in the plane. A patch is fitted
to PROJ where a point first needs it, and checked against PROJ on a grid of other points up to its
corners, where a kink (a datum grid's cell edge) shows most; a patch that misses
:data:`TOLERANCE_DEG` or :data:`TOLERANCE_M` is not used. Patches lie on one lattice of the map
projection and depend on nothing else, so that a point comes out the same in any file and chunk.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel

Floats = NDArray[np.float64]
Exact = Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Floats]]


PATCH_M = 500.0
SLAB_M = 1000.0
TOLERANCE_DEG = 1e-10  # 0.01 mm; a tenth of the step in which points are stored
TOLERANCE_M = 1e-6
_LIMIT = 1 << 20  # patches from the origin along x and y; further out PROJ is asked
_LIMIT_UP = 1 << 10
_NOWHERE = -1
_BLOCK = 256
_AT_ONCE = 256  # patches fitted in one go


@inner
def _locate(
    per_unit: float,
    x: Floats,
    y: Floats,
    z: Floats,
    key: NDArray[np.int64],
    u: Floats,
    v: Floats,
    w: Floats,
) -> bool:
    """Key of each point's patch (_NOWHERE: too far away) and its place in it; whether all are one.

    u, v: -0.5 to 0.5 across the patch; w: 0 to 1 up through its slab.
    """
    low, high = np.int64(1) << 62, np.int64(_NOWHERE)
    for i in range(x.size):
        a, b, c = x[i] * per_unit, y[i] * per_unit, z[i] * (1.0 / SLAB_M)
        col, row, slab = np.floor(a), np.floor(b), np.floor(c)
        u[i], v[i], w[i] = a - col - 0.5, b - row - 0.5, c - slab
        near = (abs(col) < _LIMIT) & (abs(row) < _LIMIT) & (abs(slab) < _LIMIT_UP)  # no NaN either
        packed = ((row + _LIMIT) * (2 * _LIMIT) + col + _LIMIT) * (2 * _LIMIT_UP) + slab + _LIMIT_UP
        k = np.int64(packed if near else _NOWHERE)
        key[i] = k
        low, high = min(low, k), max(high, k)
    return low == high


@inner
def _polynomial(c: Floats, u: Floats, v: Floats, w: Floats, out: Floats) -> None:
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
    for k in range(u.size):
        value = c0 + u[k] * (c1 + u[k] * c3 + v[k] * c4) + v[k] * (c2 + v[k] * c5)
        out[k] = value + w[k] * (c6 + u[k] * c7 + v[k] * c8)


@kernel
def _evaluate(
    keys: NDArray[np.int64],
    coefficients: Floats,
    per_unit: float,
    x: Floats,
    y: Floats,
    z: Floats,
    out: Floats,
    missing: NDArray[np.int64],
) -> int:
    """Fill out [3, n] with longitude, latitude, change of height; NaN where no patch is usable.

    ``keys`` [k] of known patches, sorted; ``coefficients`` [k, 3, 9]. Returns how many unknown
    patches were met, each perhaps more than once; their keys are in ``missing``. Then ``out`` is
    not whole.
    """
    key = np.empty(_BLOCK, np.int64)
    place = np.empty((3, _BLOCK))
    found = 0
    for start in range(0, x.size, _BLOCK):
        block = slice(start, min(start + _BLOCK, x.size))
        size = block.stop - start
        u, v, w = place[0, :size], place[1, :size], place[2, :size]
        alike = _locate(per_unit, x[block], y[block], z[block], key, u, v, w)
        i = 0
        while i < size:
            end = size if alike else i + 1
            while end < size and key[end] == key[i]:
                end += 1
            at = np.searchsorted(keys, key[i])
            if key[i] == _NOWHERE:
                out[:, start + i : start + end] = np.nan
            elif at == keys.size or keys[at] != key[i]:
                if found < missing.size and (found == 0 or missing[found - 1] != key[i]):
                    missing[found] = key[i]
                    found += 1
            else:
                for m in range(3):
                    target = out[m, start + i : start + end]
                    _polynomial(coefficients[at, m], u[i:end], v[i:end], w[i:end], target)
            i = end
    return found


def _places(steps: Floats, heights: Floats) -> Floats:
    """[3, n]: u, v, w of a grid of points in a patch."""
    return np.stack([g.reshape(-1) for g in np.meshgrid(steps, steps, heights)])


def _terms(places: Floats) -> Floats:
    """[n, 9]: what the coefficients of a patch are multiplied by."""
    u, v, w = places
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v, w, w * u, w * v], axis=1)


_NODES = _places(np.cos(np.pi * np.array([1, 3, 5, 7]) / 8) / 2, np.array([0.0, 1.0]))
_CHECKS = _places(np.linspace(-0.5, 0.5, 5), np.array([0.0, 0.5, 1.0]))
_SOLVE = np.linalg.pinv(_terms(_NODES))
_CHECK_TERMS = _terms(_CHECKS)
_PLACES = np.concatenate([_NODES, _CHECKS], axis=1)


class PatchedTransform:
    """``exact`` by polynomials on patches where these agree with it, else ``exact`` itself.

    ``exact`` takes coordinates of a map projection and heights in m, each float64[n], to longitude,
    latitude in degrees and height in m; inf where it cannot. ``unit_m``: metres per map unit.
    """

    def __init__(self, exact: Exact, unit_m: float) -> None:
        self.exact = exact
        self.side = PATCH_M / unit_m
        self._keys = np.empty(0, np.int64)
        self._coefficients = np.empty((0, 3, 9))

    def __call__(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Longitude, latitude (degrees) and height (m), as ``exact`` to the tolerances."""
        x, y, z = (np.ascontiguousarray(values, np.float64) for values in (x, y, z))
        out = np.empty((3, x.size))
        missing = np.empty(_AT_ONCE, np.int64)
        while found := _evaluate(
            self._keys, self._coefficients, 1.0 / self.side, x, y, z, out, missing
        ):
            self._fit(np.unique(missing[:found]))
        out[2] += z
        unknown = np.flatnonzero(np.isnan(out[0]))
        if unknown.size:
            out[:, unknown] = self.exact(x[unknown], y[unknown], z[unknown])
        return out[0], out[1], out[2]

    def _fit(self, keys: NDArray[np.int64]) -> None:
        """Take in new patches; NaN for those that do not agree with ``exact``."""
        plane, slab = np.divmod(keys, 2 * _LIMIT_UP)
        row, col = np.divmod(plane, 2 * _LIMIT)
        x = (col[:, None] - _LIMIT + 0.5 + _PLACES[0]) * self.side
        y = (row[:, None] - _LIMIT + 0.5 + _PLACES[1]) * self.side
        z = (slab[:, None] - _LIMIT_UP + _PLACES[2]) * SLAB_M
        lon, lat, height = self.exact(x.reshape(-1), y.reshape(-1), z.reshape(-1))
        values = np.stack([lon, lat, height - z.reshape(-1)]).reshape(3, *x.shape)
        values[~np.isfinite(values)] = np.nan
        first = values[:, :, :1]  # differences, for the sake of the last digits
        nodes = _NODES.shape[1]
        rise = values[:, :, :nodes] - first
        # Not by @: its last bits depend on how many patches are fitted together.
        coefficients = sum(rise[:, :, k, None] * _SOLVE[:, k] for k in range(nodes))
        miss = np.abs(coefficients @ _CHECK_TERMS.T + first - values[:, :, nodes:]).max(axis=2)
        good = (miss[:2] <= TOLERANCE_DEG).all(axis=0) & (miss[2] <= TOLERANCE_M)
        coefficients[:, :, 0] += first[:, :, 0]
        coefficients[:, ~good] = np.nan
        keys = np.concatenate([self._keys, keys])
        order = np.argsort(keys)
        self._keys = keys[order]
        self._coefficients = np.concatenate([self._coefficients, coefficients.transpose(1, 0, 2)])[
            order
        ]
