"""Resampling of an image at given positions: cubic convolution with six taps along each axis.

Keys' six-point kernel (IEEE TASSP 29, 1981, section VI), exact sub-pixel weights, in vector
instructions; wider where the image is downsampled. Nodata is NaN.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

Floats = NDArray[np.float64]


# Of waves of 6 px, Keys' six points leave 0.6 % rms, four points 2.1 %, Lanczos' eight 0.7 %; but
# Lanczos bends a ramp by 0.015 px, and OpenCV's remap rounds positions to 1/32 px.
RADIUS = 3  # px, of the interpolation kernel
ANTIALIAS = 1.2  # source px per epipolar px above which the kernel is widened
KERNEL = "cubic convolution, 6 x 6 taps (Keys 1981, fourth order), widened where downsampling"
TILE = 64  # px; 64 x 64 px of float32 and their margins fit a cache of 32 KB
NO_WEIGHT = 1e-6  # of 65535: less than a tenth of a digital number
# Rows are taps, columns powers 3 to 0 of f: Keys' kernel at f + 2, f + 1, f, 1 - f, 2 - f, 3 - f
TAP_POLYNOMIALS = (
    np.array(
        [
            [1, -2, 1, 0],
            [-7, 15, -8, 0],
            [16, -28, 0, 12],
            [-16, 20, 8, 0],
            [7, -6, -1, 0],
            [-1, 1, 0, 0],
            [0, 0, 0, 0],
            [0, 0, 0, 0],
        ]
    )
    / 12
)
INT32 = ir.IntType(32)
LANES, LANE_NUMBERS = ir.VectorType(ir.FloatType(), 8), ir.VectorType(INT32, 8)


@njit(cache=True, nogil=True, error_model="numpy")
def _kernel(s: float) -> float:
    """Keys' six-point kernel (IEEE TASSP 29, 1981, section VI); reproduces cubic polynomials."""
    s = abs(s)
    if s < 1.0:
        return (4.0 * s - 7.0) * s * s / 3.0 + 1.0
    if s < 2.0:
        return ((-7.0 * s + 36.0) * s - 59.0) * s / 12.0 + 2.5
    if s < 3.0:
        return ((s - 8.0) * s + 21.0) * s / 12.0 - 1.5
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def tap_weights(at: float, first: int, scale: float, weights: Floats) -> None:
    """Weights of the source samples first, first + 1, … for the value at ``at``; sum 1."""
    if scale == 1.0:  # the same without branches
        f = at - first - 2.0
        e = 1.0 - f
        weights[0] = (((f - 2.0) * f + 1.0) * f) / 12.0
        weights[5] = (((e - 2.0) * e + 1.0) * e) / 12.0
        weights[1] = (((-7.0 * f + 15.0) * f - 8.0) * f) / 12.0
        weights[4] = (((-7.0 * e + 15.0) * e - 8.0) * e) / 12.0
        weights[2] = (4.0 * f - 7.0) * f * f / 3.0 + 1.0
        weights[3] = (4.0 * e - 7.0) * e * e / 3.0 + 1.0
        return
    total = 0.0
    for k in range(weights.size):
        weights[k] = _kernel((at - (first + k)) / scale)
        total += weights[k]
    for k in range(weights.size):
        weights[k] /= total


def _lanes(values: Iterable[float]) -> ir.Constant:
    return ir.Constant(LANES, [ir.Constant(ir.FloatType(), float(np.float32(v))) for v in values])


def _spread(builder: ir.IRBuilder, vector: ir.Value, lane: int) -> ir.Value:
    """All lanes hold the vector's lane ``lane``."""
    return builder.shuffle_vector(vector, vector, ir.Constant(LANE_NUMBERS, [lane] * 8))


def _polynomials(builder: ir.IRBuilder, f: ir.Value) -> ir.Value:
    """The weights of the taps at ``f``, by Horner's rule in all lanes."""
    first = builder.insert_element(ir.Constant(LANES, ir.Undefined), f, ir.Constant(INT32, 0))
    f = _spread(builder, first, 0)
    weights = _lanes(TAP_POLYNOMIALS[:, 0])
    for power in range(1, 4):
        weights = builder.fadd(builder.fmul(weights, f), _lanes(TAP_POLYNOMIALS[:, power]))
    return weights


@intrinsic
def six_by_six(typing, source, first, width, f_col, f_row):
    """The value of 6 x 6 taps, float32, from a flat image whose rows are ``width`` samples apart.

    ``first`` is the index of the upper-left tap; the position lies ``f_col``, ``f_row`` in [0, 1]
    past the third tap. Rows are read 8 samples wide, the last two with weight 0: NaN in any of
    them makes NaN.

    In vector instructions of its own: 64 M px/s in all; written out in Python, which Numba leaves
    scalar, 33; by gathers for 64 px at once, 47.
    """
    signature = types.float32(source, types.int64, types.int64, types.float32, types.float32)

    def generate(context, builder, signature, arguments):
        array, first, width, f_col, f_row = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        across, down = _polynomials(builder, f_col), _polynomials(builder, f_row)
        total = _lanes([0.0] * 8)
        for j in range(6):
            at = builder.add(first, builder.mul(width, ir.Constant(width.type, j)))
            line = builder.load(builder.bitcast(builder.gep(data, [at]), LANES.as_pointer()))
            line.align = 4
            total = builder.fadd(total, builder.fmul(line, _spread(builder, down, j)))
        total = builder.fmul(total, across)
        for shift in (4, 2, 1):
            turn = ir.Constant(LANE_NUMBERS, [(lane + shift) % 8 for lane in range(8)])
            total = builder.fadd(total, builder.shuffle_vector(total, total, turn))
        return builder.extract_element(total, ir.Constant(INT32, 0))

    return signature, generate


@njit(cache=True, nogil=True, error_model="numpy")
def _at_an_edge(
    source: NDArray[np.float32],
    row: int,
    col: int,
    f_row: np.float32,
    f_col: np.float32,
    patch: NDArray[np.float32],
) -> np.float32:
    """:func:`six_by_six` where samples are nodata or missing; those without weight do not count.

    (row, col) is the third tap. The same bits as without an edge where all samples are there.
    """
    down, across = np.empty(6), np.empty(6)
    tap_weights(f_row, -2, 1.0, down)
    tap_weights(f_col, -2, 1.0, across)
    patch[:] = 0.0
    for j in range(6):
        if abs(down[j]) < NO_WEIGHT:
            continue
        for i in range(6):
            if abs(across[i]) < NO_WEIGHT:
                continue
            r, c = row - 2 + j, col - 2 + i
            if r < 0 or c < 0 or r >= source.shape[0] or c >= source.shape[1]:
                return np.float32(np.nan)
            patch[j, i] = source[r, c]
    return six_by_six(patch.reshape(-1), 0, 8, f_col, f_row)


@njit(cache=True, nogil=True, error_model="numpy")
def _along_row(
    lattice: Floats, step: int, y: int, x: int, axis: int, whole: Floats, part: NDArray[np.float32]
) -> None:
    """Source positions of ``whole.size`` px from (x, y) on: whole px and the rest, in [0, 1].

    Bilinear between the lattice's nodes, relative to the whole px of the cell's first node: the
    same bits wherever the source's window begins.
    """
    j = y // step
    g = (y - j * step) / step
    k = 0
    while k < whole.size:
        i = (x + k) // step
        skip = x + k - i * step
        count = min(step - skip, whole.size - k)
        base = np.floor(lattice[axis, j, i])
        left = lattice[axis, j, i] - base + g * (lattice[axis, j + 1, i] - lattice[axis, j, i])
        right = (
            lattice[axis, j, i + 1]
            - base
            + g * (lattice[axis, j + 1, i + 1] - lattice[axis, j, i + 1])
        )
        slope = (right - left) / step
        for t in range(count):
            at = left + (skip + t) * slope
            down = np.floor(at)
            whole[k + t] = base + down
            part[k + t] = np.float32(at - down)
        k += count


@njit(cache=True, nogil=True, error_model="numpy")
def _resample(
    source: NDArray[np.float32], lattice: Floats, step: int, out: NDArray[np.uint16]
) -> int:
    """:func:`resample` without widening; a tile's source stays in the processor's cache."""
    rows, cols = source.shape
    flat = source.reshape(-1)
    patch = np.zeros((6, 8), dtype=np.float32)
    valid = 0
    for y0 in range(0, out.shape[0], TILE):
        for x0 in range(0, out.shape[1], TILE):
            width = min(TILE, out.shape[1] - x0)
            col, row = np.empty(width), np.empty(width)
            f_col, f_row = np.empty(width, np.float32), np.empty(width, np.float32)
            values = np.empty(width, np.float32)
            for y in range(y0, min(y0 + TILE, out.shape[0])):
                _along_row(lattice, step, y, x0, 0, col, f_col)
                _along_row(lattice, step, y, x0, 1, row, f_row)
                for k in range(width):
                    c, r = col[k], row[k]
                    value = np.float32(np.nan)
                    if c >= 2.0 and r >= 2.0 and c <= cols - 6.0 and r <= rows - 4.0:
                        first = (int(r) - 2) * cols + int(c) - 2
                        value = six_by_six(flat, first, cols, f_col[k], f_row[k])
                    if np.isnan(value) and (
                        c + f_col[k] >= -0.5
                        and r + f_row[k] >= -0.5
                        and c + f_col[k] <= cols - 0.5
                        and r + f_row[k] <= rows - 0.5
                    ):
                        value = _at_an_edge(source, int(r), int(c), f_row[k], f_col[k], patch)
                    values[k] = value
                for k in range(width):
                    value = np.floor(values[k] + np.float32(0.5))
                    value = min(max(value, np.float32(1.0)), np.float32(65535.0))
                    there = not np.isnan(values[k])
                    out[y, x0 + k] = np.uint16(value) if there else np.uint16(0)
                    valid += there
    return valid


@njit(cache=True, nogil=True, error_model="numpy")
def sample(
    source: NDArray[np.float32], first_row: int, first_col: int, down: Floats, across: Floats
) -> float:
    """Weighted sum of source samples; NaN where a sample with weight is nodata or missing."""
    rows, cols = source.shape
    if (
        first_row >= 0
        and first_col >= 0
        and first_row + down.size <= rows
        and first_col + across.size <= cols
    ):
        total = 0.0
        for j in range(down.size):
            part = 0.0
            for i in range(across.size):
                part += across[i] * source[first_row + j, first_col + i]
            total += down[j] * part
        if not np.isnan(total):
            return total
    total = 0.0  # at an edge or at nodata: samples without weight do not count
    for j in range(down.size):
        if abs(down[j]) < NO_WEIGHT:
            continue
        for i in range(across.size):
            if abs(across[i]) < NO_WEIGHT:
                continue
            r, c = first_row + j, first_col + i
            if r < 0 or c < 0 or r >= rows or c >= cols:
                return np.nan
            total += down[j] * across[i] * source[r, c]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _resample_widened(
    source: NDArray[np.float32],
    lattice: Floats,
    step: int,
    scale: tuple[float, float],
    out: NDArray[np.uint16],
) -> int:
    """:func:`resample` with a kernel of any width."""
    across = np.empty(2 * int(np.ceil(RADIUS * scale[0])))
    down = np.empty(2 * int(np.ceil(RADIUS * scale[1])))
    width = out.shape[1]
    col, row = np.empty(width), np.empty(width)
    f_col, f_row = np.empty(width, np.float32), np.empty(width, np.float32)
    valid = 0
    for y in range(out.shape[0]):
        _along_row(lattice, step, y, 0, 0, col, f_col)
        _along_row(lattice, step, y, 0, 1, row, f_row)
        for x in range(width):
            out[y, x] = 0
            if not (
                col[x] + f_col[x] >= -0.5
                and row[x] + f_row[x] >= -0.5
                and col[x] + f_col[x] <= source.shape[1] - 0.5
                and row[x] + f_row[x] <= source.shape[0] - 0.5
            ):
                continue
            before_col, before_row = 1 - across.size // 2, 1 - down.size // 2
            tap_weights(f_col[x], before_col, scale[0], across)
            tap_weights(f_row[x], before_row, scale[1], down)
            value = sample(source, int(row[x]) + before_row, int(col[x]) + before_col, down, across)
            if np.isnan(value):
                continue
            out[y, x] = np.uint16(min(max(np.floor(value + 0.5), 1.0), 65535.0))
            valid += 1
    return valid


@njit(cache=True, nogil=True, error_model="numpy")
def resample(
    source: NDArray[np.float32],
    lattice: Floats,
    step: int,
    scale: tuple[float, float],
    out: NDArray[np.uint16],
) -> int:
    """Fill ``out`` from ``source``; returns how many pixels got a value.

    ``source`` [row, col], C order, holds NaN for nodata. ``lattice`` [2, k, l] gives the source's
    (col, row) at every ``step``-th pixel of ``out``, first pixel included and past its end.
    ``scale`` is the widening of the kernel along (col, row), 1 for none. Nodata is 0, values are
    1 to 65535.
    """
    if scale[0] == 1.0 and scale[1] == 1.0:
        return _resample(source, lattice, step, out)
    return _resample_widened(source, lattice, step, scale, out)
