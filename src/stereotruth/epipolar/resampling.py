"""Resampling of an image at given positions: cubic convolution with six taps along each axis.

Keys' six-point kernel (IEEE TASSP 29, 1981, section VI), exact sub-pixel weights; wider where the
image is downsampled. Nodata is NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Floats
from ..core.numerics.interpolation import (
    SIX_POINT_RADIUS,
    six_point_weights,
    six_point_weights_of_row,
)

Picture = NDArray[np.float32]


# Of waves of 6 px, Keys' six points leave 0.6 % rms, four points 2.1 %, Lanczos' eight 0.7 %; but
# Lanczos bends a ramp by 0.015 px, and OpenCV's remap rounds positions to 1/32 px.
ANTIALIAS = 1.2  # source px per epipolar px above which the kernel is widened
KERNEL = "cubic convolution, 6 x 6 taps (Keys 1981, fourth order), widened where downsampling"
TILE = 64  # px; 64 x 64 px of float32 and their margins fit a cache of 32 KB
NO_WEIGHT = 1e-6  # of 65535: less than a tenth of a digital number
# Unsigned: of signed indices Numba asks whether they count from the end, a quarter slower.
ONE, TWO, THREE, FOUR, FIVE, SIX, SEVEN = np.arange(1, 8, dtype=np.uint64)


@inlined
def _column(
    source: Picture, at: np.uint64, width: np.uint64, down: tuple[np.float32, ...]
) -> np.float32:
    """Weighted sum of six samples, one below the other."""
    return (
        source[at] * down[0]
        + source[at + width] * down[1]
        + source[at + TWO * width] * down[2]
        + source[at + THREE * width] * down[3]
        + source[at + FOUR * width] * down[4]
        + source[at + FIVE * width] * down[5]
    )


@inlined
def _six_by_six(
    source: Picture, first: np.uint64, width: np.uint64, across: Picture, down: Picture, k: int
) -> np.float32:
    """The value of 6 x 6 taps, from a flat image whose rows are ``width`` samples apart.

    ``first`` is the index of the upper-left tap; ``across`` and ``down`` [6, n] are the weights of
    all px of a row, of which this is the one with number ``k``. NaN in any sample makes NaN, and in
    any of the two to the right of a row: such px always went the way of :func:`_at_an_edge`, whose
    last bits differ.
    """
    v = down[0, k], down[1, k], down[2, k], down[3, k], down[4, k], down[5, k]
    a = _column(source, first, width, v) * across[0, k]
    b = _column(source, first + ONE, width, v) * across[1, k]
    c = _column(source, first + TWO, width, v) * across[2, k]
    d = _column(source, first + THREE, width, v) * across[3, k]
    e = _column(source, first + FOUR, width, v) * across[4, k]
    f = _column(source, first + FIVE, width, v) * across[5, k]
    g = _column(source, first + SIX, width, v) * np.float32(0.0)
    h = _column(source, first + SEVEN, width, v) * np.float32(0.0)
    return ((a + e) + (c + g)) + ((b + f) + (d + h))


@inner
def _at_an_edge(
    source: Picture,
    row: int,
    col: int,
    f_row: Picture,
    f_col: Picture,
    across: Picture,
    down: Picture,
    k: int,
) -> np.float32:
    """:func:`_six_by_six` where samples are nodata or missing; those without weight do not count.

    (row, col) is the third tap. Samples of less weight than NO_WEIGHT are taken for 0.
    """
    exact_down, exact_across = np.empty(6), np.empty(6)
    six_point_weights(f_row[k], -2, 1.0, exact_down)
    six_point_weights(f_col[k], -2, 1.0, exact_across)
    patch = np.zeros(48, np.float32)  # six rows of eight
    for j in range(6):
        if abs(exact_down[j]) < NO_WEIGHT:
            continue
        for i in range(6):
            if abs(exact_across[i]) < NO_WEIGHT:
                continue
            r, c = row - 2 + j, col - 2 + i
            if r < 0 or c < 0 or r >= source.shape[0] or c >= source.shape[1]:
                return np.float32(np.nan)
            patch[8 * j + i] = source[r, c]
    return _six_by_six(patch, np.uint64(0), np.uint64(8), across, down, k)


@inner
def _along_row(
    lattice: Floats, step: int, y: int, x: int, axis: int, whole: Floats, part: Picture
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


@inner
def _resample(source: Picture, lattice: Floats, step: int, out: NDArray[np.uint16]) -> int:
    """:func:`resample` without widening; a tile's source stays in the processor's cache."""
    rows, cols = source.shape
    flat = source.reshape(-1)
    valid = 0
    for y0 in range(0, out.shape[0], TILE):
        for x0 in range(0, out.shape[1], TILE):
            width = min(TILE, out.shape[1] - x0)
            col, row = np.empty(width), np.empty(width)
            f_col, f_row = np.empty(width, np.float32), np.empty(width, np.float32)
            across, down = np.empty((6, width), np.float32), np.empty((6, width), np.float32)
            values = np.empty(width, np.float32)
            for y in range(y0, min(y0 + TILE, out.shape[0])):
                _along_row(lattice, step, y, x0, 0, col, f_col)
                _along_row(lattice, step, y, x0, 1, row, f_row)
                six_point_weights_of_row(f_col, across)
                six_point_weights_of_row(f_row, down)
                for k in range(width):
                    c, r = col[k], row[k]
                    value = np.float32(np.nan)
                    if c >= 2.0 and r >= 2.0 and c <= cols - 6.0 and r <= rows - 4.0:
                        first = np.uint64((int(r) - 2) * cols + int(c) - 2)
                        value = _six_by_six(flat, first, np.uint64(cols), across, down, k)
                    if np.isnan(value) and (
                        c + f_col[k] >= -0.5
                        and r + f_row[k] >= -0.5
                        and c + f_col[k] <= cols - 0.5
                        and r + f_row[k] <= rows - 0.5
                    ):
                        value = _at_an_edge(source, int(r), int(c), f_row, f_col, across, down, k)
                    values[k] = value
                for k in range(width):
                    value = np.floor(values[k] + np.float32(0.5))
                    value = min(max(value, np.float32(1.0)), np.float32(65535.0))
                    there = not np.isnan(values[k])
                    out[y, x0 + k] = np.uint16(value) if there else np.uint16(0)
                    valid += there
    return valid


@inner
def sample(source: Picture, first_row: int, first_col: int, down: Floats, across: Floats) -> float:
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


@inner
def _resample_widened(
    source: Picture,
    lattice: Floats,
    step: int,
    scale: tuple[float, float],
    out: NDArray[np.uint16],
) -> int:
    """:func:`resample` with a kernel of any width."""
    across = np.empty(2 * int(np.ceil(SIX_POINT_RADIUS * scale[0])))
    down = np.empty(2 * int(np.ceil(SIX_POINT_RADIUS * scale[1])))
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
            six_point_weights(f_col[x], before_col, scale[0], across)
            six_point_weights(f_row[x], before_row, scale[1], down)
            value = sample(source, int(row[x]) + before_row, int(col[x]) + before_col, down, across)
            if np.isnan(value):
                continue
            out[y, x] = np.uint16(min(max(np.floor(value + 0.5), 1.0), 65535.0))
            valid += 1
    return valid


@kernel
def resample(
    source: Picture,
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
