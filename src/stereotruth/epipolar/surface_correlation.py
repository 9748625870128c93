"""Correlation of two images over the pixels of one surface, not of a square window.

Where heights step, a square window mixes surfaces and fails although the disparity is right.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels import inner, kernel
from .one_surface import BEND, SURFACE_PX

Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]
Steps = NDArray[np.int32]

# Pixels of a row that are worked on at once, one per vector lane: each window's sums are added in
# one order, whatever the block. 52 ns a pixel (window 9) against 240 window by window. What belongs
# together lies at constant distances in one array: LLVM vectorises only if few may overlap.
BLOCK = 256
# A run is worked on in whole registers of so many lanes, and TOGETHER neighbours of a row are added
# to the sums in one go: two thirds of the time.
REGISTER, TOGETHER = 16, 3
GAP = 8  # pixels that nobody wants and that end no run of wanted ones
DECIDED = 2.0  # standard deviations of a chance correlation that an expected one must reach


@inner
def surface_of_row(
    disparity: Singles, slope: Singles, y: int, x0: int, size: int, c: Singles
) -> None:
    """``c`` [3 * BLOCK]: disparity and slopes along x and y of ``size`` pixels of a row."""
    for k in range(size):
        c[k] = disparity[y, x0 + k]
        c[BLOCK + k] = slope[0, y, x0 + k]
        c[2 * BLOCK + k] = slope[1, y, x0 + k]


@kernel
def wanted_runs(wanted: Bools) -> Steps:
    """Pixels that are worked on at once, [n, 3]: row, first column and that after the last one.

    All ``wanted`` pixels [h, w] of a row up to a gap of more than GAP, BLOCK at most.
    """
    rows, cols = wanted.shape
    out = np.empty((rows * (cols // (GAP + 1) + 1), 3), np.int32)
    n = 0
    for y in range(rows):
        end = 0
        for x in range(cols):
            if not wanted[y, x] or x < end:
                continue
            end = x + 1
            for k in range(end, min(x + BLOCK, cols)):
                if wanted[y, k]:
                    end = k + 1
                elif k - end >= GAP:
                    break
            out[n] = y, x, end
            n += 1
    return out[:n]


@inner
def columns_inside(x0: int, size: int, cols: int, across: int) -> tuple[int, int]:
    """Pixels [first, end) of a block whose neighbour ``across`` columns on lies in the image."""
    first = max(0, -across - x0)
    return first, max(first, min(size, cols - across - x0))


@inner
def tolerance_px(down: int, across: int) -> float:
    """By how much a pixel so many px away may be off the plane through the centre."""
    return np.float32(SURFACE_PX + BEND * max(abs(down), abs(across)))


@inner
def about_means(sums: Singles, k: int) -> tuple[float, float, float]:
    """Sums of u², v² and u v about the means of u and v, from the ``sums`` [6 * BLOCK] of 1, u, v,
    u², v² and u v of pixel ``k`` of a block."""
    n, su, sv = sums[k], sums[BLOCK + k], sums[2 * BLOCK + k]
    suu = sums[3 * BLOCK + k] - su * su / n
    svv = sums[4 * BLOCK + k] - sv * sv / n
    return suu, svv, sums[5 * BLOCK + k] - su * sv / n


@inner
def _tolerance_within(down: int, across: int, half: int) -> float:
    """:func:`tolerance_px` of a pixel in a window, and less than 0 beside it."""
    return tolerance_px(down, across) if across <= half else np.float32(-1.0)


@inner
def is_near(disparity: float, plane: float, limit: float) -> float:
    """1 of a disparity that counts, else 0."""
    return np.float32(1.0) if abs(disparity - plane) <= limit else np.float32(0.0)


@kernel
def correlate(
    left: Singles,
    warped: Singles,
    disparity: Singles,
    counted: Singles,
    slope: Singles,
    half: int,
    noise: tuple[float, float],
    runs: Steps,
    out: Singles,
    expected: Singles,
) -> None:
    """Correlation of the ``left`` image with each of several ``warped`` [n, h, w], to ``out`` [n,
    h, w], of the pixels of ``runs``; outside of these all is NaN. ``expected`` [h, w]: of the
    first, see :func:`correlation_and_expected`.

    ``counted``: disparity of the pixels that count, else NaN; ``noise``: variances of both images.
    ``left``, ``warped`` and ``counted`` have columns more in which nothing counts: ``half`` on the
    left, see :func:`padded_columns`.
    """
    rows, last = len(left), len(warped) - 1
    out[:], expected[:] = np.nan, np.nan
    surface = np.empty(3 * BLOCK, np.float32)
    centre = np.empty((last + 1, 2 * BLOCK), np.float32)
    # of the first image, and then which neighbours count, and by how much they differ on the left
    sums = np.empty(12 * BLOCK, np.float32)
    others = np.empty((last, 6 * BLOCK), np.float32)
    zero = np.float32(0.0)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        surface_of_row(disparity, slope, y, x0, size, surface)
        for n in range(last + 1):
            centre[n, :size] = left[y, half + x0 : half + x0 + size]
            centre[n, BLOCK : BLOCK + size] = warped[n, y, half + x0 : half + x0 + size]
        whole = (size + REGISTER - 1) // REGISTER * REGISTER
        sums[: 6 * BLOCK], others[:] = zero, zero
        for b in range(max(y - half, 0), min(y + half + 1, rows)):
            down = np.float32(b - y)
            for step in range(-half, half + 1, TOGETHER):
                across = np.float32(step), np.float32(step + 1), np.float32(step + 2)
                limit = (
                    _tolerance_within(b - y, step, half),
                    _tolerance_within(b - y, step + 1, half),
                    _tolerance_within(b - y, step + 2, half),
                )
                at = half + x0 + step
                d, uu, vv = counted[b, at:], left[b, at:], warped[0, b, at:]
                p, c, s = surface, centre[0], sums
                for k in range(whole):
                    level, along, rise = p[k], p[BLOCK + k], down * p[2 * BLOCK + k]
                    e = is_near(d[k], level + across[0] * along + rise, limit[0])
                    f = is_near(d[k + 1], level + across[1] * along + rise, limit[1])
                    g = is_near(d[k + 2], level + across[2] * along + rise, limit[2])
                    ue, ve = (uu[k] - c[k]) * e, (vv[k] - c[BLOCK + k]) * e
                    uf, vf = (uu[k + 1] - c[k]) * f, (vv[k + 1] - c[BLOCK + k]) * f
                    ug, vg = (uu[k + 2] - c[k]) * g, (vv[k + 2] - c[BLOCK + k]) * g
                    s[k] = s[k] + e + f + g
                    s[BLOCK + k] = s[BLOCK + k] + ue + uf + ug
                    s[2 * BLOCK + k] = s[2 * BLOCK + k] + ve + vf + vg
                    s[3 * BLOCK + k] = s[3 * BLOCK + k] + ue * ue + uf * uf + ug * ug
                    s[4 * BLOCK + k] = s[4 * BLOCK + k] + ve * ve + vf * vf + vg * vg
                    s[5 * BLOCK + k] = s[5 * BLOCK + k] + ue * ve + uf * vf + ug * vg
                    s[6 * BLOCK + k], s[7 * BLOCK + k], s[8 * BLOCK + k] = e, f, g
                    s[9 * BLOCK + k], s[10 * BLOCK + k], s[11 * BLOCK + k] = ue, uf, ug
                for n in range(last):
                    vv, c, o = warped[n + 1, b, at:], centre[n + 1], others[n]
                    for k in range(whole):
                        ve = (vv[k] - c[BLOCK + k]) * s[6 * BLOCK + k]
                        vf = (vv[k + 1] - c[BLOCK + k]) * s[7 * BLOCK + k]
                        vg = (vv[k + 2] - c[BLOCK + k]) * s[8 * BLOCK + k]
                        ue, uf, ug = s[9 * BLOCK + k], s[10 * BLOCK + k], s[11 * BLOCK + k]
                        o[2 * BLOCK + k] = o[2 * BLOCK + k] + ve + vf + vg
                        o[4 * BLOCK + k] = o[4 * BLOCK + k] + ve * ve + vf * vf + vg * vg
                        o[5 * BLOCK + k] = o[5 * BLOCK + k] + ue * ve + uf * vf + ug * vg
        for k in range(size):
            count = sums[k]
            # A few pixels correlate by chance: they neither agree nor disagree.
            if count < 2 * half + 1:
                continue
            suu, svv, suv = about_means(sums, k)
            out[0, y, x0 + k] = suv / np.sqrt(suu * svv) if suu > zero and svv > zero else zero
            here, there = noise[0] * (count - 1), noise[1] * (count - 1)
            signal = max(suu * there, svv * here) - here * there  # of that with more texture
            share = signal / (signal + here * there) if signal > 0 else 0.0
            if here * there == 0.0:
                share = 1.0
            if share * np.sqrt(count) >= DECIDED:
                expected[y, x0 + k] = share
            for n in range(last):
                o = others[n]
                o[k], o[BLOCK + k], o[3 * BLOCK + k] = count, sums[BLOCK + k], sums[3 * BLOCK + k]
                suu, svv, suv = about_means(o, k)
                out[n + 1, y, x0 + k] = (
                    suv / np.sqrt(suu * svv) if suu > zero and svv > zero else zero
                )


@inner
def padded_columns(cols: int, half: int) -> int:
    """Columns of the arrays of :func:`correlate` for so many of an image."""
    return cols + 2 * half + TOGETHER + REGISTER


@kernel
def _as_compared(
    left: NDArray,
    warped: NDArray,
    disparity: Singles,
    clear: Bools,
    half: int,
    padded: Singles,
    known: Singles,
) -> None:
    """Fills ``padded`` [3, h, more than half + w + half]: ``left``, ``warped`` (0 for none), and
    disparity of those that are ``clear`` (NaN elsewhere), from column ``half`` on; ``known``:
    disparity of all. Other arrays [h, w]."""
    none = np.float32(np.nan)
    for y in range(known.shape[0]):
        padded[0, y], padded[1, y], padded[2, y] = 0.0, 0.0, none
        for x in range(known.shape[1]):
            value, d = np.float32(warped[y, x]), disparity[y, x]
            has_value = np.isfinite(value)
            known[y, x] = d if has_value else none
            padded[0, y, half + x] = left[y, x]
            padded[1, y, half + x] = value if has_value else np.float32(0.0)
            padded[2, y, half + x] = d if has_value and clear[y, x] else none


def surface_correlation(
    left: NDArray[np.floating],
    warped: NDArray[np.floating],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    window: int,
    clear: Bools | None = None,
    runs: Steps | None = None,
) -> Singles:
    """Correlation of two images [h, w] over the pixels of each pixel's surface in its window.

    Of these, the ``clear`` [h, w] ones alone where that is given; of the pixels of ``runs``
    (:func:`wanted_runs`) alone where these are.

    ``warped`` is NaN and ``disparity`` (px), with its ``slope`` [2, h, w] along x and y, anything
    where there is no label. NaN where there is no label or fewer pixels than the ``window`` (odd,
    px) is wide; 0 where either image is constant. In float32, about the centre's values: within
    1e-5 of float64.
    """
    none = 0.0, 0.0
    return correlation_and_expected(left, warped, disparity, slope, window, none, clear, runs)[0]


def correlation_and_expected(
    left: NDArray[np.floating],
    warped: NDArray[np.floating],
    disparity: NDArray[np.floating],
    slope: NDArray[np.floating],
    window: int,
    noise: tuple[float, float],
    clear: Bools | None = None,
    runs: Steps | None = None,
) -> tuple[Singles, Singles]:
    """:func:`surface_correlation`, and the one that images of the same ground have on the average.

    The latter [h, w] is in (0, 1], by the variances of the images' ``noise`` (DN²) and of the
    window in the image that varies more: the attenuation of a correlation by errors of measurement
    (Spearman 1904). NaN also where noise leaves so little of it that chance may do as well.
    """
    if clear is None:
        clear = np.ones(left.shape, np.bool_)
    rows, cols = left.shape
    known, expected = np.empty((2, rows, cols), np.float32)
    out = np.empty((1, rows, cols), np.float32)
    half = window // 2
    padded = np.empty((3, rows, padded_columns(cols, half)), np.float32)
    disparity = np.ascontiguousarray(disparity, dtype=np.float32)
    _as_compared(left, warped, disparity, clear, half, padded, known)
    correlate(
        padded[0],
        padded[1:2],
        known,
        padded[2],
        np.ascontiguousarray(slope, dtype=np.float32),
        half,
        noise,
        wanted_runs(np.isfinite(known)) if runs is None else runs,
        out,
        expected,
    )
    return out[0], expected
