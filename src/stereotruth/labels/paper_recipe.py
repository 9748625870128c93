"""The paper's own way from points to labels (section III-C).

1. A point is dropped if the windows of both images around its places do not correlate
   (:func:`.paper_recipe.correlate`), whatever the reason: hidden, changed, moved.
2. A pixel's label is the disparity of one point: mean longitude and latitude of its points that
   are left, at the height of the highest.
3. A pixel with fewer than ``min_points`` of them has no label.

What the paper does not have is each label's uncertainty: the points' noise, pooled over 3 x 3
pixels, by the root of their number.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.config.labels import LabelSettings
from ..core.kernels import inner, kernel
from ..core.status import Status
from ..lidar.lattice import PER_DEG
from .pair_window import PairWindow, Patch, WindowLabels
from .pixel_labels import Labels, condense, noise_variance
from .view_geometry import ViewGeometry
from .window_points import BITS, PX, PixelPoints

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def paper_labels(
    settings: LabelSettings,
    model: ViewGeometry,
    points: PixelPoints,
    window: PairWindow,
    px_per_m: float,
    days: NDArray[np.uint16],
) -> WindowLabels:
    """Labels of a window from its points in both frames.

    ``window``: its patches are read for the settings' window. ``px_per_m``: disparity of a metre of
    height. ``days``: of the points, by their numbers.
    """

    def at_highest(sums: Ints, highest: Floats) -> Floats:
        """Positions [4, pixels] (px) of mean longitude and latitude at the greatest height."""
        xy = np.full((4, highest.size), np.nan)
        known = np.flatnonzero(sums[:, 0])
        lon, lat = (sums[known, axis] / sums[known, 0] / PER_DEG for axis in (1, 2))
        xy[:, known] = model.ground_to_epipolar(lon, lat, highest[known])
        return xy

    every = np.ones(points.points.size, dtype=np.bool_)
    correlation = correlate(points, every, window.left, window.right, settings.window)
    correlated = correlation >= settings.correlation_threshold
    pixels = condense(points, correlated, at_highest, correlation)
    labelled = pixels.count > 0
    level = np.zeros((2, *labelled.shape))
    noise = noise_variance(pixels, labelled, level, px_per_m)
    labels = Labels(
        disparity=np.where(labelled, pixels.disparity, np.nan),
        slope=level,
        variance=noise / np.maximum(pixels.count, 1),
    )
    status = np.full(points.shape, Status.NO_POINTS, dtype=np.uint8)
    status[points.outside.reshape(points.shape) > 0] = Status.OUT_OF_FRAME
    status[points.masked.reshape(points.shape)] = Status.MASKED
    status[points.count > 0] = Status.LOW_CORRELATION
    status[labelled] = Status.LABELLED
    status[labelled & (pixels.count < settings.min_points)] = Status.BELOW_MINIMUM_COUNT
    return WindowLabels(
        status=status,
        labels=labels,
        height=pixels.highest,
        surface_class=pixels.surface_class,
        day=days[pixels.day],
        point_count=pixels.count,
        correlation=pixels.correlation,
        change=np.zeros(status.shape, np.uint8),
        beyond=np.zeros(status.shape, np.uint32),
    )


Singles = NDArray[np.float32]
Records = NDArray[np.void]


_MASK = PX - 1
_TILE = 64  # windows along a row that share differences of columns
_BLOCK = 256  # windows that are summed at once,
_WIDE = 1032  # the pixels under them; limits the window to 777 px
# A variance below this share of the mean square is what rounding leaves of a constant window.
CONSTANT = 1e-13


class _Task(NamedTuple):
    """Points of a window by pixel (see :class:`.window_points.PixelPoints`), those to ``use``, and
    both images' patches with the pixel at the origin of each; side of the ``window``, px."""

    points: Records
    start: Ints
    use: NDArray[np.bool_]
    shape: tuple[int, int]
    first: tuple[int, int]
    left: Singles
    right: Singles
    left_origin: tuple[int, int]
    right_origin: tuple[int, int]
    window: int


class _Tables(NamedTuple):
    """Sums over the windows along a part of a row.

    ``slot_of`` [shifts, 3]: number of the ``products`` of both images that have a shift of columns
    and rows, -1 for none; ``products`` [slots, 4, _TILE + 1]; ``own`` [3, 4, _TILE + 2] of the left
    image: products, products beside, sums; ``other`` [3, 3, 4, columns]: the same of the right one,
    for three rows; ``work`` [4 * _WIDE].
    """

    slot_of: Ints
    products: Floats
    own: Floats
    other: Floats
    work: Floats


class _Part(NamedTuple):
    """A part of a row of windows: that of pixel row ``r`` from column ``x0`` on, ``width``
    windows."""

    r: int
    x0: int
    width: int


@inner
def _products(
    a: Singles,
    b: Singles,
    row_a: int,
    row_b: int,
    col_a: int,
    col_b: int,
    count: int,
    window: int,
    work: Floats,
    out: Floats,
) -> None:
    """Sums over windows of products of two images' pixels, for ``count`` windows along a row.

    ``out`` [4, >= count]: window c begins at (row_a + i, col_a + c) in ``a`` and (row_b + j,
    col_b + c) in ``b``, for (i, j) = (0, 0), (0, 1), (1, 0), (1, 1). All are integers below 2**53:
    exact, so that sums may be carried along. ``work`` [4 * _WIDE].
    """
    for c0 in range(0, count, _BLOCK):
        size = min(_BLOCK, count - c0)
        length = size + window - 1
        work[:length] = work[_WIDE : _WIDE + length] = work[2 * _WIDE : 2 * _WIDE + length] = 0.0
        for r in range(0, window - 1, 2):  # two rows at once: fewer ways to the memory and back
            a0 = a[row_a + r, col_a + c0 : col_a + c0 + length]
            a1 = a[row_a + r + 1, col_a + c0 : col_a + c0 + length]
            a2 = a[row_a + r + 2, col_a + c0 : col_a + c0 + length]
            b0 = b[row_b + r, col_b + c0 : col_b + c0 + length]
            b1 = b[row_b + r + 1, col_b + c0 : col_b + c0 + length]
            b2 = b[row_b + r + 2, col_b + c0 : col_b + c0 + length]
            for x in range(a0.size):
                p, q, o = np.float64(a0[x]), np.float64(a1[x]), np.float64(a2[x])
                s, t, u = np.float64(b0[x]), np.float64(b1[x]), np.float64(b2[x])
                work[x] += p * s + q * t
                work[_WIDE + x] += p * t + q * u
                work[2 * _WIDE + x] += q * s + o * t
        first, end = window - 1, window
        a0 = a[row_a + first, col_a + c0 : col_a + c0 + length]
        a1 = a[row_a + end, col_a + c0 : col_a + c0 + length]
        b0 = b[row_b + first, col_b + c0 : col_b + c0 + length]
        b1 = b[row_b + end, col_b + c0 : col_b + c0 + length]
        a2 = a[row_a, col_a + c0 : col_a + c0 + length]
        b2 = b[row_b, col_b + c0 : col_b + c0 + length]
        for x in range(a0.size):
            p, q, o = np.float64(a0[x]), np.float64(a1[x]), np.float64(a2[x])
            s, t, u = np.float64(b0[x]), np.float64(b1[x]), np.float64(b2[x])
            work[x] += p * s
            work[_WIDE + x] += p * t
            work[2 * _WIDE + x] += q * s
            # Windows from the second row on: those from the first, one row less and one more.
            work[3 * _WIDE + x] = work[x] - o * u + q * t
        t00 = t01 = t10 = t11 = 0.0
        for x in range(length):
            t00 += work[x]
            t01 += work[_WIDE + x]
            t10 += work[2 * _WIDE + x]
            t11 += work[3 * _WIDE + x]
            c = x - window + 1
            if c >= 0:
                out[0, c0 + c], out[1, c0 + c], out[2, c0 + c], out[3, c0 + c] = t00, t01, t10, t11
                t00 -= work[c]
                t01 -= work[_WIDE + c]
                t10 -= work[2 * _WIDE + c]
                t11 -= work[3 * _WIDE + c]


@inner
def _sums(
    a: Singles, row: int, col: int, count: int, window: int, work: Floats, out: Floats
) -> None:
    """``out`` [2, >= count]: sums over windows that begin at (row + i, col + c); as _products."""
    for c0 in range(0, count, _BLOCK):
        size = min(_BLOCK, count - c0)
        for i in range(2):
            work[: size + window - 1] = 0.0
            for r in range(window):
                pixels = a[row + i + r, col + c0 : col + c0 + size + window - 1]
                for x in range(pixels.size):
                    work[x] += pixels[x]
            total = 0.0
            for x in range(window - 1):
                total += work[x]
            for x in range(size):
                total += work[x + window - 1]
                out[i, c0 + x] = total
                total -= work[x]


@inner
def _moments(
    square: Floats, beside: Floats, sums: Floats, c: int, fx: float, fy: float
) -> tuple[float, float]:
    """Sum and sum of squares of the interpolated samples of window c of one image.

    ``square``, ``beside`` [4, ...]: products of the image with itself, and with itself one column
    on; ``sums`` as by _sums; (fx, fy) phase of the window.
    """
    gx, gy = 1.0 - fx, 1.0 - fy
    total = gy * (gx * sums[0, c] + fx * sums[0, c + 1])
    total += fy * (gx * sums[1, c] + fx * sums[1, c + 1])
    one = gx * gx * square[0, c] + fx * fx * square[0, c + 1] + 2.0 * gx * fx * beside[0, c]
    two = gx * gx * square[3, c] + fx * fx * square[3, c + 1] + 2.0 * gx * fx * beside[3, c]
    mixed = gx * gx * square[1, c] + fx * fx * square[1, c + 1]
    mixed += gx * fx * (beside[1, c] + beside[2, c])
    return total, gy * gy * one + fy * fy * two + 2.0 * gy * fy * mixed


@inner
def _steps(point: Records, x: int) -> tuple[int, int, int, int]:
    """Position of a point of pixel column ``x`` in steps: column and row from the one above in the
    left image, then in the right one."""
    u = (x << BITS) + point.u
    v = np.int64(point.v) & _MASK
    return u, v, u - point.disparity, v + point.parallax


@inner
def _origin(task: _Task, part: _Part) -> tuple[int, int, int]:
    """Of the first window of a part: row and column in the left patch, row in the right one."""
    half = task.window // 2
    row = part.r + task.first[0] - task.left_origin[0] - half
    col = part.x0 + task.first[1] - task.left_origin[1] - half
    return row, col, part.r + task.first[0] - task.right_origin[0] - half


@inner
def _mark_demand(
    task: _Task, part: _Part, zero: int, slot_of: Ints
) -> tuple[int, int, int, int, int, int]:
    """Marks the shifts of the points of a part in ``slot_of``; least and greatest shift of columns,
    column in the right image, and shift of rows. ``zero``: shift of columns that counts as 0."""
    points, start, use, first = task.points, task.start, task.use, task.first
    rows, cols = task.shape
    r, x0, width = part
    _, col, _ = _origin(task, part)
    half = task.window // 2
    low, high = len(slot_of), -1
    west, east = task.right.shape[1], -1
    up, down = 1, -1
    for j in range(max(r, 0), min(r + 2, rows)):
        for i in range(max(x0, 0), min(x0 + width + 1, cols)):
            for k in range(start[j * cols + i], start[j * cols + i + 1]):
                if not use[k] or (points[k].v < 0) != (j > r):
                    continue
                c = i - x0 - (1 if points[k].u < 0 else 0)
                if c < 0 or c >= width:
                    continue
                _, _, u_right, v_right = _steps(points[k], first[1] + i)
                d = (u_right >> BITS) - task.right_origin[1] - half
                e = v_right >> BITS
                s = d - col - c + zero
                slot_of[s - 1, e + 1] = slot_of[s, e + 1] = slot_of[s + 1, e + 1] = 0
                low, high = min(low, s), max(high, s)
                west, east = min(west, d), max(east, d)
                up, down = min(up, e), max(down, e)
    return low, high, west, east, up, down


@inner
def _fill_tables(task: _Task, part: _Part, zero: int, demand: tuple, tables: _Tables) -> None:
    """The sums that the marked shifts need; ``demand``: of :func:`_mark_demand`."""
    left, right, window, work = task.left, task.right, task.window, tables.work
    slot_of, products, own, other = tables.slot_of, tables.products, tables.own, tables.other
    low, high, west, east, up, down = demand
    width = part.width
    row, col, row_right = _origin(task, part)
    n = 0
    for s in range(low - 1, high + 2):
        for e in range(up, down + 1):
            if slot_of[s, e + 1] < 0:
                continue
            slot_of[s, e + 1] = n
            begin = col + s - zero
            cut = max(0, -begin)
            count = min(width + 1, right.shape[1] - window + 1 - begin) - cut
            if count > 0:
                q, a, b = row_right + e, col + cut, begin + cut
                _products(left, right, row, q, a, b, count, window, work, products[n, :, cut:])
            n += 1
    _products(left, left, row, row, col, col, width + 1, window, work, own[0])
    _products(left, left, row, row, col, col + 1, width, window, work, own[1])
    _sums(left, row, col, width + 1, window, work, own[2])
    for e in range(up, down + 1):
        q, count = row_right + e, east - west + 2
        mine = other[e + 1]
        _products(right, right, q, q, west, west, count, window, work, mine[0])
        _products(right, right, q, q, west, west + 1, count - 1, window, work, mine[1])
        _sums(right, q, west, count, window, work, mine[2])


@inner
def _fill_coefficients(
    task: _Task, part: _Part, zero: int, west: int, tables: _Tables, out: Singles
) -> None:
    """Correlation coefficients of the points of a part; ``west``: first column of the right image
    in the tables."""
    points, start, use, first = task.points, task.start, task.use, task.first
    slot_of, products, own, other = tables.slot_of, tables.products, tables.own, tables.other
    rows, cols = task.shape
    r, x0, width = part
    _, col, _ = _origin(task, part)
    half, number = task.window // 2, float(task.window * task.window)
    for j in range(max(r, 0), min(r + 2, rows)):
        for i in range(max(x0, 0), min(x0 + width + 1, cols)):
            for k in range(start[j * cols + i], start[j * cols + i + 1]):
                if not use[k] or (points[k].v < 0) != (j > r):
                    continue
                c = i - x0 - (1 if points[k].u < 0 else 0)
                if c < 0 or c >= width:
                    continue
                u, v, u_right, v_right = _steps(points[k], first[1] + i)
                d = (u_right >> BITS) - task.right_origin[1] - half
                e = v_right >> BITS
                s = d - col - c + zero
                fx, fy = (u & _MASK) / PX, v / PX
                ex, ey = (u_right & _MASK) / PX, (v_right & _MASK) / PX
                gx, gy, hx, hy = 1.0 - fx, 1.0 - fy, 1.0 - ex, 1.0 - ey
                before = products[slot_of[s - 1, e + 1]]
                here = products[slot_of[s, e + 1]]
                after = products[slot_of[s + 1, e + 1]]
                together = 0.0
                for m in range(4):
                    weight = (gy if m < 2 else fy) * (hy if m % 2 == 0 else ey)
                    along = gx * hx * here[m, c] + fx * ex * here[m, c + 1]
                    along += gx * ex * after[m, c] + fx * hx * before[m, c + 1]
                    together += weight * along
                a, aa = _moments(own[0], own[1], own[2], c, fx, fy)
                mine = other[e + 1]
                b, bb = _moments(mine[0], mine[1], mine[2], d - west, ex, ey)
                aa, bb = number * aa, number * bb
                vary_a, vary_b = aa - a * a, bb - b * b
                out[k] = 0.0
                if vary_a > CONSTANT * aa and vary_b > CONSTANT * bb:
                    r_ab = (number * together - a * b) / np.sqrt(vary_a * vary_b)
                    out[k] = min(max(r_ab, -1.0), 1.0)


@kernel
def _correlate(task: _Task, out: Singles) -> None:
    """Correlation coefficients of all points to ``out``."""
    rows, cols = task.shape
    columns = task.right.shape[1]
    zero = cols + 3
    shifts = zero + columns + 3
    tables = _Tables(
        np.full((shifts, 3), -1, np.int64),
        np.empty((shifts * 3, 4, _TILE + 1)),  # only what is needed is written
        np.empty((3, 4, _TILE + 2)),
        np.empty((3, 3, 4, columns + 2)),
        np.empty(4 * _WIDE),
    )
    for r in range(-1, rows):
        for x0 in range(-1, cols, _TILE):
            part = _Part(r, x0, min(_TILE, cols - x0))
            demand = _mark_demand(task, part, zero, tables.slot_of)
            if demand[1] < 0:
                continue
            _fill_tables(task, part, zero, demand, tables)
            _fill_coefficients(task, part, zero, demand[2], tables, out)
            for s in range(demand[0] - 1, demand[1] + 2):
                tables.slot_of[s] = -1


def correlate(
    points: PixelPoints, use: NDArray[np.bool_], left: Patch, right: Patch, window: int
) -> NDArray[np.float32]:
    """Correlation coefficient of the two windows of each point [n] in ``use``, else NaN.

    The patches must be those by which the points are in both frames, read for this ``window`` (odd,
    px). A point's value does not depend on the others or on the patches.
    """
    out = np.full(use.size, np.nan, dtype=np.float32)
    task = _Task(
        points.points,
        points.start,
        use,
        points.shape,
        points.first,
        left.pixels,
        right.pixels,
        (left.row, left.col),
        (right.row, right.col),
        window,
    )
    _correlate(task, out)
    return out
