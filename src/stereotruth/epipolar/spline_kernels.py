"""Compiled kernels of the epipolar model: bicubic splines, forward and inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.interpolation import cubic_slopes, cubic_weights
from ..sensor.rpc import project_block

Floats = NDArray[np.float64]


# One image's packed model: [0:6] x and y affine, [6] col_min, [7] cells per px along columns,
# [8] row_min, [9] cells per px along rows, [10] n, [11] start of the x coefficients (0: none),
# [12:12 + n²] coefficients of y, then those of x. The same splines follow as polynomials, 16
# coefficients for each of their (n - 3)² cells: those of y from m[12 + n²] or, if there is an x,
# m[12 + 2 n²] on, then those of x; [4 b + a] belongs to f**a g**b.
_BLOCK = 256  # points worked on together
POWERS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6  # of weights


@inner
def _row_sum(m: Floats, k: int, w: tuple[float, float, float, float]) -> float:
    return m[k] * w[0] + m[k + 1] * w[1] + m[k + 2] * w[2] + m[k + 3] * w[3]


@inner
def _patch(
    m: Floats,
    k: int,
    n: int,
    w: tuple[float, float, float, float],
    v: tuple[float, float, float, float],
) -> float:
    """Sum over the 4 × 4 coefficients from m[k]: weights w along columns, v along rows."""
    return (
        v[0] * _row_sum(m, k, w)
        + v[1] * _row_sum(m, k + n, w)
        + v[2] * _row_sum(m, k + 2 * n, w)
        + v[3] * _row_sum(m, k + 3 * n, w)
    )


@kernel
def forward_with_slopes(
    m: Floats, col: float, row: float
) -> tuple[float, float, float, float, float, float]:
    """Epipolar (x, y) of an image point and dx/dcol, dx/drow, dy/dcol, dy/drow."""
    n = int(m[10])
    top = n - 3.0
    s = (col - m[6]) * m[7]
    t = (row - m[8]) * m[9]
    if not (np.isfinite(s) and np.isfinite(t)):
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    inside_s = min(max(s, 0.0), top)
    inside_t = min(max(t, 0.0), top)
    i = min(int(inside_s), n - 4)
    j = min(int(inside_t), n - 4)
    w, dw = cubic_weights(inside_s - i), cubic_slopes(inside_s - i)
    v, dv = cubic_weights(inside_t - j), cubic_slopes(inside_t - j)
    beyond_s, beyond_t = s - inside_s, t - inside_t
    k = 12 + j * n + i
    ys = _patch(m, k, n, dw, v)
    yt = _patch(m, k, n, w, dv)
    y = _patch(m, k, n, w, v) + beyond_s * ys + beyond_t * yt
    x, xs, xt = 0.0, 0.0, 0.0
    if m[11] > 0.0:
        k += int(m[11]) - 12
        xs = _patch(m, k, n, dw, v)
        xt = _patch(m, k, n, w, dv)
        x = _patch(m, k, n, w, v) + beyond_s * xs + beyond_t * xt
    return (
        m[0] * col + m[1] * row + m[2] + x,
        m[3] * col + m[4] * row + m[5] + y,
        m[0] + xs * m[7],
        m[1] + xt * m[9],
        m[3] + ys * m[7],
        m[4] + yt * m[9],
    )


@inlined
def _cell(m: Floats, s: float, t: float) -> int:
    """Number of the spline's cell in which a place lies; -1 outside of the domain."""
    last = int(m[10]) - 4
    inside = (s >= 0.0) & (s <= last + 1.0) & (t >= 0.0) & (t <= last + 1.0)
    i, j = min(int(s if inside else 0.0), last), min(int(t if inside else 0.0), last)
    return j * (last + 1) + i if inside else -1


@inlined
def _bicubic(
    f: float,
    g: float,
    p0: tuple[float, float, float, float],
    p1: tuple[float, float, float, float],
    p2: tuple[float, float, float, float],
    p3: tuple[float, float, float, float],
) -> float:
    """Polynomial of a cell: one tuple for each power of g, in it one for each power of f."""
    a = p0[0] + f * (p0[1] + f * (p0[2] + f * p0[3]))
    b = p1[0] + f * (p1[1] + f * (p1[2] + f * p1[3]))
    c = p2[0] + f * (p2[1] + f * (p2[2] + f * p2[3]))
    d = p3[0] + f * (p3[1] + f * (p3[2] + f * p3[3]))
    return a + g * (b + g * (c + g * d))


@inlined
def _powers(m: Floats, k: int) -> tuple[float, float, float, float]:
    return m[k], m[k + 1], m[k + 2], m[k + 3]


@inner
def forward_point(m: Floats, col: float, row: float) -> tuple[float, float]:
    """Epipolar (x, y) in px of one image point; ``m`` is a packed image model."""
    s = (col - m[6]) * m[7]
    t = (row - m[8]) * m[9]
    cell = _cell(m, s, t)
    if cell < 0:
        x, y, _, _, _, _ = forward_with_slopes(m, col, row)
        return x, y
    n = int(m[10])
    f, g = s - cell % (n - 3), t - cell // (n - 3)
    x = m[0] * col + m[1] * row + m[2]
    y = m[3] * col + m[4] * row + m[5]
    k = 12 + n * n * (2 if m[11] > 0.0 else 1) + 16 * cell
    y += _bicubic(f, g, _powers(m, k), _powers(m, k + 4), _powers(m, k + 8), _powers(m, k + 12))
    if m[11] > 0.0:
        k += 16 * (n - 3) ** 2
        x += _bicubic(f, g, _powers(m, k), _powers(m, k + 4), _powers(m, k + 8), _powers(m, k + 12))
    return x, y


@inner
def _cell_of_all(m: Floats, col: Floats, row: Floats, f: Floats, g: Floats) -> int:
    """Number of the spline's cell in which a block of points lies, with their places f, g in it.

    -1 if the points do not share a cell, or lie outside of the domain; then f, g are not filled.
    """
    col_min, per_col, row_min, per_row = m[6], m[7], m[8], m[9]
    low, high = 1 << 30, -1
    for k in range(col.size):
        f[k] = (col[k] - col_min) * per_col
        g[k] = (row[k] - row_min) * per_row
        cell = _cell(m, f[k], g[k])
        low, high = min(low, cell), max(high, cell)
    if low != high:
        return -1
    side = int(m[10]) - 3
    i, j = low % side, low // side
    for k in range(col.size):
        f[k] -= i
        g[k] -= j
    return low


@inner
def _affine(m: Floats, k: int, col: Floats, row: Floats, out: Floats) -> None:
    a, b, c = m[k], m[k + 1], m[k + 2]
    for i in range(col.size):
        out[i] = a * col[i] + b * row[i] + c


@inner
def _add_bicubic(m: Floats, k: int, f: Floats, g: Floats, out: Floats) -> None:
    p0, p1, p2, p3 = _powers(m, k), _powers(m, k + 4), _powers(m, k + 8), _powers(m, k + 12)
    for i in range(f.size):
        out[i] += _bicubic(f[i], g[i], p0, p1, p2, p3)


@inner
def _forward_block(
    m: Floats, col: Floats, row: Floats, f: Floats, g: Floats, x: Floats, y: Floats
) -> None:
    """Fill ``x`` and ``y`` with what forward_point gives, to the bit; ``f``, ``g`` are scratch.

    The cells of the spline are thousands of pixels wide: the points of a block nearly always share
    one, and then its coefficients are loaded once.
    """
    cell = _cell_of_all(m, col, row, f, g)
    if cell < 0:
        for k in range(col.size):
            x[k], y[k] = forward_point(m, col[k], row[k])
        return
    n = int(m[10])
    _affine(m, 0, col, row, x)
    _affine(m, 3, col, row, y)
    k = 12 + n * n * (2 if m[11] > 0.0 else 1) + 16 * cell
    _add_bicubic(m, k, f, g, y)
    if m[11] > 0.0:
        _add_bicubic(m, k + 16 * (n - 3) ** 2, f, g, x)


@inner
def inverse_point(m: Floats, x: float, y: float) -> tuple[float, float]:
    """Image (col, row) in px of one epipolar point, by Newton; (NaN, NaN) if it diverges."""
    det = m[0] * m[4] - m[1] * m[3]
    col = ((x - m[2]) * m[4] - (y - m[5]) * m[1]) / det
    row = ((y - m[5]) * m[0] - (x - m[2]) * m[3]) / det
    for _ in range(30):
        fx, fy, xc, xr, yc, yr = forward_with_slopes(m, col, row)
        det = xc * yr - xr * yc
        dcol = ((x - fx) * yr - (y - fy) * xr) / det
        drow = ((y - fy) * xc - (x - fx) * yc) / det
        col += dcol
        row += drow
        step = max(abs(dcol), abs(drow))
        if step < 1e-6:  # quadratic convergence: what is left is below 1e-9 px
            return col, row
        if not np.isfinite(step):
            break
    return np.nan, np.nan


@kernel
def map_points(m: Floats, inverse: bool, a: Floats, b: Floats, out: Floats) -> None:
    """Fill ``out`` [2, n] with the forward or the inverse map of n points."""
    for i in range(a.size):
        u, v = inverse_point(m, a[i], b[i]) if inverse else forward_point(m, a[i], b[i])
        out[0, i] = u
        out[1, i] = v


@kernel
def ground_points_to_epipolar(
    sensors: Floats,
    left: Floats,
    right: Floats,
    lon: Floats,
    lat: Floats,
    height: Floats,
    out: Floats,
) -> None:
    """Fill ``out`` [4, n] with x_left, y_left, x_right, y_right of n ground points.

    ``sensors`` [2, 96] are the packed sensor models, ``left`` and ``right`` the packed epipolar
    ones. Goes in blocks, so that all loops are vectorised and stay in the cache.
    """
    # Arrays of their own: LLVM vectorises no loop that writes to two rows of one.
    columns, rows = np.empty(_BLOCK), np.empty(_BLOCK)
    s, t = np.empty(_BLOCK), np.empty(_BLOCK)
    for start in range(0, lon.size, _BLOCK):
        end = min(start + _BLOCK, lon.size)
        col, row = columns[: end - start], rows[: end - start]
        f, g = s[: end - start], t[: end - start]
        for k in range(2):
            project_block(sensors[k], lon[start:end], lat[start:end], height[start:end], col, row)
            m = left if k == 0 else right
            _forward_block(m, col, row, f, g, out[2 * k, start:end], out[2 * k + 1, start:end])
