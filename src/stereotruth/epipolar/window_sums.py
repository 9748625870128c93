"""Compiled sums over windows of pixels that show one surface.

The window of a pixel holds the pixels up to ``reach`` px off, one of so many (``every``) along each
axis, whose disparity is near the plane through its own, and that are as bright as it in both images
where brightness is given.

Neighbours are added in one order, row by row, in float32 about the centre's values (within 1e-5 of
float64), so that results have the same bytes whatever part of a grid is worked on. Pixels of a row
are worked on in runs: those that are asked about and the few between them, one per vector lane.
Where few pixels are asked about many shifts, what belongs to a window is gathered once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, inner, kernel
from ..core.numerics.arrays import Bools, Floats, Ints, Singles
from ..core.numerics.interpolation import four_point_weights

Runs = NDArray[np.int32]
Image = NDArray[np.floating]

# Points that differ by no more than this in disparity (px) belong to one surface: a slope of 45°
# spans 0.6 px over a pixel of GF-7, a storey 3 px. Pixels may be off the plane by BEND px more for
# each pixel between them.
SURFACE_PX = 1.0
BEND = 0.1
# Pixels of a row that are worked on at once, in whole registers; TOGETHER neighbours of a row are
# added to the sums in one go. What belongs together lies at constant distances in one array: LLVM
# vectorises only if few may overlap.
BLOCK, REGISTER, TOGETHER = 256, 16, 3
GAP = 8  # pixels that nobody wants and that end no run of wanted ones

# [4, h, wide]: brightness of both images, and by how much it may differ; [0, …]: by anything. No
# argument of a kernel here is of two types, since each would be compiled by itself.
Bright = Singles
ANY_BRIGHTNESS: Bright = np.empty((0, 0, 0), np.float32)


@kernel
def wanted_runs(wanted: Bools) -> Runs:
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


# ------------------------------------------------------------------ who belongs to a window


class Members(NamedTuple):
    """Who may belong to whose window. Arrays of ``shape`` [h, w] are of the centres, those with
    ``reach`` columns more on the left and some on the right, see :func:`padded`, of neighbours.

    ``disparity``, ``slope`` [2, h, w]: the plane through each centre; ``counted`` [h, wide]:
    disparity of the neighbours that count, else NaN; ``first_row``: the first of the rows of the
    arrays that count, of which one of ``every`` does, or -1 where they are counted from the centre.
    """

    disparity: Singles
    slope: Singles
    counted: Singles
    reach: int
    every: int
    first_row: int


@kernel
def _pad(
    values: Singles, counts: Bools, reach: int, rows: tuple[int, int], fill: float, out: Singles
) -> None:
    cols = values.shape[2]
    for n in range(len(values)):
        for y in range(rows[0], values.shape[1], rows[1]):
            row = out[n, y]
            row[:reach], row[reach + cols :] = fill, fill
            for x in range(cols):
                value = values[n, y, x]
                row[reach + x] = value if np.isfinite(value) else fill
            if len(counts):
                for x in range(cols):
                    row[reach + x] = row[reach + x] if counts[y, x] else fill


def padded(
    values: Image,
    fill: float,
    reach: int,
    every: int = 1,
    first_row: int = -1,
    counts: Bools | None = None,
) -> Singles:
    """``values`` [n, h, w] as float32 with the columns that windows may reach into; ``fill`` there,
    where a pixel has none, and where ``counts`` [h, w] is false. Of the rows that count, see
    :class:`Members`."""
    wide = reach + values.shape[2] + reach + TOGETHER * every + REGISTER
    out = np.empty((*values.shape[:2], wide), np.float32)
    rows = (0, 1) if first_row < 0 else (first_row, every)
    counted = np.empty((0, 0), np.bool_) if counts is None else np.ascontiguousarray(counts)
    _pad(np.ascontiguousarray(values, np.float32), counted, reach, rows, np.float32(fill), out)
    return out


def members_of(
    disparity: Image,
    slope: Image,
    counts: Bools,
    reach: int,
    every: int = 1,
    first_row: int = -1,
) -> Members:
    """Of the neighbours that ``counts`` [h, w] chooses."""
    level, slopes = (np.ascontiguousarray(of, dtype=np.float32) for of in (disparity, slope))
    (counted,) = padded(level[None], np.nan, reach, every, first_row, counts)
    return Members(level, slopes, counted, reach, every, first_row)


@inner
def _centres(members: Members, bright: Bright, y: int, x0: int, size: int, c: Singles) -> None:
    """``c`` [7 * BLOCK]: disparity, its slopes, and brightness of ``size`` pixels of a row."""
    disparity, slope = members.disparity, members.slope
    for k in range(size):
        c[k] = disparity[y, x0 + k]
        c[BLOCK + k] = slope[0, y, x0 + k]
        c[2 * BLOCK + k] = slope[1, y, x0 + k]
    if len(bright):
        for m in range(4):
            for k in range(size):
                c[(3 + m) * BLOCK + k] = bright[m, y, members.reach + x0 + k]


@inner
def _rows_of(members: Members, y: int) -> range:
    """The rows that may belong to windows of row ``y``."""
    reach, every, top = members.reach, members.every, members.first_row
    if top < 0:
        top = (y - reach) % every
    top += (max(y - reach - top, 0) + every - 1) // every * every
    return range(top, min(y + reach + 1, len(members.disparity)), every)


@inlined
def _is_near(disparity: float, plane: float, limit: float) -> float:
    """1 of a disparity that counts, else 0."""
    return np.float32(1.0) if abs(disparity - plane) <= limit else np.float32(0.0)


@inlined
def _tolerance_px(down: int, across: int, reach: int) -> float:
    """By how much a pixel so many px off may be off the plane; less than 0 beyond the reach."""
    limit = np.float32(SURFACE_PX + BEND * max(abs(down), abs(across)))
    return limit if across <= reach else np.float32(-1.0)


@inlined
def _belong(
    members: Members, bright: Bright, b: int, at: int, y: int, step: int, size: int, c: Singles,
    weight: Singles,
) -> None:  # fmt: skip
    """``weight`` [3 * BLOCK]: 1 of neighbours that belong to the windows of a row's pixels, else 0.

    These are ``step`` px off along row ``b``, from column ``at`` of the padded arrays on, and twice
    every px on. ``c``: of :func:`_centres` of row ``y``.
    """
    every, reach, down = members.every, members.reach, np.float32(b - y)
    second, third = step + every, step + 2 * every
    across = np.float32(step), np.float32(second), np.float32(third)
    limit = (
        _tolerance_px(b - y, step, reach),
        _tolerance_px(b - y, second, reach),
        _tolerance_px(b - y, third, reach),
    )
    d = members.counted[b, at:]
    dd, ddd = d[every:], d[2 * every :]
    for k in range(size):
        level, along, rise = c[k], c[BLOCK + k], down * c[2 * BLOCK + k]
        weight[k] = _is_near(d[k], level + across[0] * along + rise, limit[0])
        weight[BLOCK + k] = _is_near(dd[k], level + across[1] * along + rise, limit[1])
        weight[2 * BLOCK + k] = _is_near(ddd[k], level + across[2] * along + rise, limit[2])
    if len(bright):
        for m in range(TOGETHER):
            first, w = at + m * every, weight[m * BLOCK :]
            u, v = bright[0, b, first:], bright[1, b, first:]
            for k in range(size):
                same = _is_near(u[k], c[3 * BLOCK + k], c[5 * BLOCK + k])
                w[k] = w[k] * (same * _is_near(v[k], c[4 * BLOCK + k], c[6 * BLOCK + k]))


# ------------------------------------------------------------------ sums


@inlined
def _add_left(
    values: Singles, every: int, centre: Singles, size: int, weight: Singles, sums: Singles
) -> None:
    """Adds TOGETHER neighbours to the ``sums`` of 1, u and u²; then there are their u, weighted."""
    u, uu, uuu = values, values[every:], values[2 * every :]
    for k in range(size):
        e, f, g = weight[k], weight[BLOCK + k], weight[2 * BLOCK + k]
        ue, uf, ug = (u[k] - centre[k]) * e, (uu[k] - centre[k]) * f, (uuu[k] - centre[k]) * g
        sums[k] = sums[k] + e + f + g
        sums[BLOCK + k] = sums[BLOCK + k] + ue + uf + ug
        sums[2 * BLOCK + k] = sums[2 * BLOCK + k] + ue * ue + uf * uf + ug * ug
        sums[3 * BLOCK + k], sums[4 * BLOCK + k], sums[5 * BLOCK + k] = ue, uf, ug


@inlined
def _add_right(
    values: Singles, every: int, centre: Singles, size: int, weight: Singles, left: Singles,
    sums: Singles,
) -> None:  # fmt: skip
    """Adds TOGETHER neighbours to the ``sums`` of v, v² and u v; ``left``: of :func:`_add_left`."""
    v, vv, vvv = values, values[every:], values[2 * every :]
    for k in range(size):
        ve = (v[k] - centre[k]) * weight[k]
        vf = (vv[k] - centre[k]) * weight[BLOCK + k]
        vg = (vvv[k] - centre[k]) * weight[2 * BLOCK + k]
        ue, uf, ug = left[3 * BLOCK + k], left[4 * BLOCK + k], left[5 * BLOCK + k]
        sums[k] = sums[k] + ve + vf + vg
        sums[BLOCK + k] = sums[BLOCK + k] + ve * ve + vf * vf + vg * vg
        sums[2 * BLOCK + k] = sums[2 * BLOCK + k] + ue * ve + uf * vf + ug * vg


@kernel
def correlate(
    members: Members, bright: Bright, left: Singles, warped: Singles, least: int, runs: Runs,
    out: Singles, moments: Singles,
) -> None:  # fmt: skip
    """Correlation of the ``left`` image [h, wide] with each of several ``warped`` [n, h, wide], to
    ``out`` [n, h, w], in windows that hold ``least`` pixels; outside of ``runs`` all is NaN.

    ``moments`` [4, h, w]: number of pixels, and sums of u², v² and u v about the means of both, of
    the first of the images.
    """
    last, reach = len(warped), members.reach
    out[:], moments[:] = np.nan, np.nan
    centre, weight = np.empty(7 * BLOCK, np.float32), np.empty(3 * BLOCK, np.float32)
    images = np.empty((last + 1, BLOCK), np.float32)
    of_left, of_both = np.empty(6 * BLOCK, np.float32), np.empty((last, 3 * BLOCK), np.float32)
    zero = np.float32(0.0)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        _centres(members, bright, y, x0, size, centre)
        images[last, :size] = left[y, reach + x0 : reach + x0 + size]
        for n in range(last):
            images[n, :size] = warped[n, y, reach + x0 : reach + x0 + size]
        whole = (size + REGISTER - 1) // REGISTER * REGISTER
        of_left[: 3 * BLOCK], of_both[:] = zero, zero
        for b in _rows_of(members, y):
            for step in range(-reach, reach + 1, TOGETHER):
                at = reach + x0 + step
                _belong(members, bright, b, at, y, step, whole, centre, weight)
                _add_left(left[b, at:], 1, images[last], whole, weight, of_left)
                for n in range(last):
                    _add_right(warped[n, b, at:], 1, images[n], whole, weight, of_left, of_both[n])
        for k in range(size):
            count, su = of_left[k], of_left[BLOCK + k]
            if count < least:
                continue
            suu = of_left[2 * BLOCK + k] - su * su / count
            for n in range(last):
                sv = of_both[n, k]
                svv = of_both[n, BLOCK + k] - sv * sv / count
                suv = of_both[n, 2 * BLOCK + k] - su * sv / count
                out[n, y, x0 + k] = suv / np.sqrt(suu * svv) if suu > zero and svv > zero else zero
                if n == 0:
                    moments[0, y, x0 + k], moments[1, y, x0 + k] = count, suu
                    moments[2, y, x0 + k], moments[3, y, x0 + k] = svv, suv


@inlined
def _add_count(size: int, weight: Singles, sums: Singles) -> None:
    """Adds TOGETHER neighbours to their number."""
    for k in range(size):
        sums[k] = sums[k] + weight[k] + weight[BLOCK + k] + weight[2 * BLOCK + k]


@inlined
def _add_values(values: Singles, every: int, size: int, weight: Singles, sums: Singles) -> None:
    """Adds TOGETHER neighbours to the sum of the values."""
    v, vv, vvv = values, values[every:], values[2 * every :]
    for k in range(size):
        e, f, g = weight[k], weight[BLOCK + k], weight[2 * BLOCK + k]
        sums[k] = sums[k] + e * v[k] + f * vv[k] + g * vvv[k]


@kernel
def take_means(members: Members, bright: Bright, values: Singles, runs: Runs, out: Singles) -> None:
    """Means of the ``values`` [n, h, wide] over the windows of ``runs`` to ``out`` [n, h, w]; NaN
    outside of these."""
    last, reach, every = len(values), members.reach, members.every
    out[:] = np.nan
    centre, weight = np.empty(7 * BLOCK, np.float32), np.empty(3 * BLOCK, np.float32)
    count, sums = np.empty(BLOCK, np.float32), np.empty((last, BLOCK), np.float32)
    zero = np.float32(0.0)
    for run in runs:
        y, x0, size = run[0], run[1], run[2] - run[1]
        _centres(members, bright, y, x0, size, centre)
        whole = (size + REGISTER - 1) // REGISTER * REGISTER
        count[:], sums[:] = zero, zero
        for b in _rows_of(members, y):
            for step in range(-reach, reach + 1, TOGETHER * every):
                at = reach + x0 + step
                _belong(members, bright, b, at, y, step, whole, centre, weight)
                _add_count(whole, weight, count)
                for n in range(last):
                    _add_values(values[n, b, at:], every, whole, weight, sums[n])
        for n in range(last):
            for k in range(size):
                out[n, y, x0 + k] = sums[n, k] / count[k]


# ------------------------------------------------------------------ few pixels, many shifts


@inlined
def _correlation_at(
    right: Singles, values: Floats, rows: Ints, cols: Ints, taps: Floats, n: int, shift: int
) -> float:
    """Correlation of n left ``values`` with the right image, ``shift`` columns on; NaN outside."""
    sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0
    height, width = right.shape
    for k in range(n):
        i, y = cols[k] + shift, rows[k]
        if i < 0 or i + 4 > width or y < 0 or y >= height:
            return np.nan
        a, row = values[k], right[y]
        b = taps[k, 0] * row[i] + taps[k, 1] * row[i + 1]
        b += taps[k, 2] * row[i + 2] + taps[k, 3] * row[i + 3]
        sa += a
        sb += b
        saa += a * a
        sbb += b * b
        sab += a * b
    va, vb = saa - sa * sa / n, sbb - sb * sb / n
    if va <= 1e-6 * saa or vb <= 1e-6 * sbb:
        return 0.0
    return (sab - sa * sb / n) / np.sqrt(va * vb)


@kernel
def correlate_shifted(
    left: Singles, right: Singles, disparity: Singles, places: Ints, limits: Ints, ahead: float,
    half: int, least: int, out: Floats,
) -> None:  # fmt: skip
    """Correlation of the windows of pixels [n] with those of the right image that lie whole columns
    from where the ``disparity`` has them, to the middle of ``out`` [n, odd] and beside it.

    ``places`` [n, 3]: column, row, and rows on in the right image; ``limits`` [n, 2]: first and
    last shift; ``ahead``: px, added to all of them. NaN for other shifts, where a window leaves the
    right image, and where it holds less than ``least`` pixels.
    """
    out[:] = np.nan
    most = (2 * half + 1) ** 2
    values, taps = np.empty(most), np.empty((most, 4))
    rows, cols = np.empty(most, np.int64), np.empty(most, np.int64)
    for s in range(len(places)):
        x0, y0, down = places[s]
        n = 0
        for y in range(max(y0 - half, 0), min(y0 + half + 1, left.shape[0])):
            for x in range(max(x0 - half, 0), min(x0 + half + 1, left.shape[1])):
                limit = _tolerance_px(y - y0, x - x0, half)
                if not abs(disparity[y, x] - disparity[y0, x0]) <= limit:
                    continue
                at = x - disparity[y, x] + ahead
                i = int(np.floor(at))
                values[n], rows[n], cols[n] = left[y, x] - left[y0, x0], y + down, i - 1
                four_point_weights(at - i, taps[n])
                n += 1
        if n < least:
            continue
        for shift in range(limits[s, 0], limits[s, 1] + 1):
            at = out.shape[1] // 2 + shift
            out[s, at] = _correlation_at(right, values, rows, cols, taps, n, shift)
