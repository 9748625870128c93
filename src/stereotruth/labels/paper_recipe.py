"""The paper's own way from points to labels (section III-C).

1. A point is dropped if the windows of both images around its places do not correlate
   (:func:`correlate`), whatever the reason: hidden, changed, moved.
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

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Bools, Floats, Ints, Singles
from ..core.status import Status
from ..lidar.lattice import PER_DEG, PER_M
from .layers import layers, layers_of
from .pair_window import (
    MASKED,
    USABLE,
    Labels,
    MaskedImage,
    PairWindow,
    Patch,
    WindowLabels,
    merged_status,
    usable_at,
)
from .pixel_labels import BITS, PX, noise_variance
from .scene_inputs import SceneInputs
from .window_points import WindowGround

PART_PX = 256  # side of the parts of a block whose points are in memory at once
# A variance below this share of the mean square is what rounding leaves of a constant window.
CONSTANT = 1e-13
WIDE = 16  # columns that are summed at once
DAY_BITS, CLASS_BITS = 16, 8


class Points(NamedTuple):
    """Points [n] of a window in both frames: number of their ``pixel`` (row-major); places in steps
    of 1 / PX px, column and row in the left image and in the right one; lattice coordinates, ASPRS
    class, and day since 1970-01-01."""

    pixel: Ints
    x: Ints
    y: Ints
    x_right: Ints
    y_right: Ints
    lon_q: Ints
    lat_q: Ints
    h_q: Ints
    surface_class: Ints
    day: Ints


class Pixels(NamedTuple):
    """What a window's points leave of its pixels, arrays [h, w]: number of those ``in_frames`` and
    ``outside`` of these; whether a mask hides one (``masked``)."""

    in_frames: Ints
    outside: Ints
    masked: Bools


def points_of(ground: WindowGround, window: PairWindow) -> tuple[Points, Pixels]:
    """The points of a window, those in both frames by their pixel."""
    (rows, cols), (row, col) = window.shape, window.first
    parts = [Points(*np.empty((10, 0), np.int64))]
    outside, masked = np.zeros((2, rows * cols), np.int64)
    for block in ground.blocks():
        known = np.flatnonzero(np.isfinite(block.xy[2]))
        x, y, x_right, y_right = np.rint(block.xy[:, known] * PX).astype(np.int64)
        i, j = (x + PX // 2 >> BITS) - col, (y + PX // 2 >> BITS) - row
        inside = (i >= 0) & (j >= 0) & (i < cols) & (j < rows)
        y_right = y + np.clip(y_right - y, -PX // 2, PX // 2 - 1)
        lattice = block.lon_q, block.lat_q, block.h_q, block.surface_class, block.day
        taken = (q[known][inside].astype(np.int64) for q in lattice)
        places = (q[inside] for q in (j * cols + i, x, y, x_right, y_right))
        points = Points(*places, *taken)
        here = usable_at(window.left, points.y >> BITS, points.x >> BITS)
        there = usable_at(window.right, points.y_right >> BITS, points.x_right >> BITS)
        framed = here & there == USABLE
        outside += np.bincount(points.pixel[~framed], minlength=outside.size)
        hidden = (here | there) & MASKED != 0
        masked += np.bincount(points.pixel[hidden], minlength=masked.size)
        parts.append(Points(*(values[framed] for values in points)))
    points = Points(*(np.concatenate(values) for values in zip(*parts)))
    in_frames = np.bincount(points.pixel, minlength=outside.size)
    shape = window.shape
    return points, Pixels(
        in_frames.reshape(shape), outside.reshape(shape), masked.reshape(shape) > 0
    )


@inlined
def _add_row(
    images: tuple[Singles, Singles], at: tuple[int, int], across: tuple[float, float],
    down: tuple[float, float], first: tuple[float, float], work: Singles,
) -> None:  # fmt: skip
    """Adds a row of samples of both windows to the sums in ``work`` [7 * WIDE]: of u, v, u², v²,
    u v by column; then there are the row's values between columns.

    Rows of the flat ``images`` begin ``at``; samples lie ``across`` px past a column, ``down`` px
    past the row before, and count about the ``first`` one. By WIDE columns, since one sum would
    take its samples one after the other; in one array, as in :mod:`.window_sums`.
    """
    (fx, gx), (fy, gy), (p, q) = across, down, first
    a, b = images[0][at[0] :], images[1][at[1] :]
    for i in range(WIDE):
        here = (a[i] - p) + fx * (a[i + 1] - a[i])
        there = (b[i] - q) + gx * (b[i + 1] - b[i])
        u = work[5 * WIDE + i] + fy * (here - work[5 * WIDE + i])
        v = work[6 * WIDE + i] + gy * (there - work[6 * WIDE + i])
        work[i], work[WIDE + i] = work[i] + u, work[WIDE + i] + v
        work[2 * WIDE + i] += u * u
        work[3 * WIDE + i] += v * v
        work[4 * WIDE + i] += u * v
        work[5 * WIDE + i], work[6 * WIDE + i] = here, there


@kernel
def _correlate(
    left: Singles, right: Singles, widths: tuple[int, int], places: Ints, size: int, out: Singles
) -> None:
    """Of points whose windows begin at the ``places`` [4, n] (steps) of both flat images, of rows
    of so many pixels (``widths``) and WIDE pixels more at the end."""
    work, n, step, mask = np.zeros(7 * WIDE, np.float32), size * size, np.float32(1 / PX), PX - 1
    for k in range(out.size):
        x, y, x_right, y_right = places[0, k], places[1, k], places[2, k], places[3, k]
        across = np.float32(x & mask) * step, np.float32(x_right & mask) * step
        down = np.float32(y & mask) * step, np.float32(y_right & mask) * step
        su, sv, suu, svv, suv = 0.0, 0.0, 0.0, 0.0, 0.0
        one = (y >> BITS) * widths[0] + (x >> BITS)
        other = (y_right >> BITS) * widths[1] + (x_right >> BITS)
        first = left[one], right[other]
        for part in range(0, size, WIDE):
            for row in range(size + 1):
                at = one + row * widths[0] + part, other + row * widths[1] + part
                _add_row((left, right), at, across, down, first, work)
                if row == 0:  # there is no row before
                    for c in range(5 * WIDE):
                        work[c] = 0.0
            for c in range(min(size - part, WIDE)):
                su, sv, suu = su + work[c], sv + work[WIDE + c], suu + work[2 * WIDE + c]
                svv, suv = svv + work[3 * WIDE + c], suv + work[4 * WIDE + c]
        aa, bb, ab = suu - su * su / n, svv - sv * sv / n, suv - su * sv / n
        square_a, square_b = suu + n * first[0] * first[0], svv + n * first[1] * first[1]
        out[k] = 0.0
        if aa > CONSTANT * square_a and bb > CONSTANT * square_b:
            out[k] = min(max(ab / np.sqrt(aa * bb), -1.0), 1.0)


def correlate(points: Points, left: Patch, right: Patch, window: int) -> Singles:
    """Correlation coefficient [n] of the windows of both images around each point, in [-1, 1].

    A window is centred on the point's sub-pixel place and sampled there by bilinear interpolation.
    0 where either window is constant: no texture is no evidence that the place is the same. The
    patches must be those by which the points are in both frames, read for this ``window`` (odd,
    px).
    """
    out = np.empty(points.x.size, np.float32)
    corners = ((patch.col + window // 2, patch.row + window // 2) for patch in (left, right))
    first = np.concatenate([*map(np.array, corners)])[:, None] << BITS
    places = np.stack([points.x, points.y, points.x_right, points.y_right]) - first
    images = (np.append(patch.pixels, np.zeros(WIDE, np.float32)) for patch in (left, right))
    widths = left.pixels.shape[1], right.pixels.shape[1]
    _correlate(*images, widths, places, window, out)
    return out


def paper_layers(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[dict[str, NDArray], Ints] | None:
    """The layers of a window and the numbers of its points, all, in both frames and used; None
    without points."""
    every = layers(scene.settings, scene.view, scene.has_masks)
    shape = rows.stop - rows.start, cols.stop - cols.start
    out = {name: np.full(shape, layer.fill, layer.dtype) for name, layer in every.items()}
    counts, has_points = np.zeros(3, np.int64), False
    for row in range(rows.start, rows.stop, PART_PX):
        for col in range(cols.start, cols.stop, PART_PX):
            part = (
                slice(row, min(row + PART_PX, rows.stop)),
                slice(col, min(col + PART_PX, cols.stop)),
            )
            made = _layers_of_part(scene, *part)
            if made is None:
                continue
            has_points = True
            counts += made[1]
            where = tuple(
                slice(edge.start - whole.start, edge.stop - whole.start)
                for edge, whole in zip(part, (rows, cols))
            )
            for name, values in made[0].items():
                out[name][where] = values
    if isinstance(image := scene.pair.images[0], MaskedImage):
        masked = image.mask[rows, cols] != 0
        for name, layer in every.items():
            out[name][masked] = Status.MASKED if name == "status" else layer.fill
    return (out, counts) if has_points else None


def _layers_of_part(
    scene: SceneInputs, rows: slice, cols: slice
) -> tuple[dict[str, NDArray], Ints] | None:
    footprint = scene.windows.footprint(rows, cols)
    if footprint is None:
        return None
    ground = scene.windows.ground(scene.windows.strips(rows, cols, footprint), None)
    if ground is None:
        return None
    window = scene.points_window(rows, cols, footprint, scene.settings.window)
    points, pixels = points_of(ground, window)
    labels, correlation = paper_labels(scene, window, points, pixels)
    labels, inner = labels.within(window.inner), window.inner
    in_frames, outside = pixels.in_frames[inner].sum(), pixels.outside[inner].sum()
    if in_frames + outside == 0:
        return None
    used = labels.point_count[np.isin(labels.status, (Status.LABELLED, Status.BELOW_MINIMUM_COUNT))]
    no_change = np.zeros(labels.status.shape, np.uint8)
    values = layers_of(labels, correlation[inner], no_change, scene.pair, rows, cols)
    return values, np.array([in_frames + outside, in_frames, used.sum()])


def paper_labels(
    scene: SceneInputs, window: PairWindow, points: Points, pixels: Pixels
) -> tuple[WindowLabels, Floats]:
    """Labels of a window from its ``points`` in both frames, and the mean correlation [h, w] of the
    points used."""
    settings, shape = scene.settings, window.shape
    correlation = correlate(points, window.left, window.right, settings.window)
    use = np.flatnonzero(correlation >= settings.correlation_threshold)
    use = use[np.argsort(points.pixel[use], kind="stable")]
    used = Points(*(values[use] for values in points))
    pixel, first, n = np.unique(used.pixel, return_index=True, return_counts=True)
    # whole numbers, so that the order of the points does not count
    highest = (used.h_q << CLASS_BITS | used.surface_class) << DAY_BITS | used.day
    top = np.maximum.reduceat(highest, first) if n.size else highest
    height = (top >> CLASS_BITS + DAY_BITS) / PER_M
    disparity = used.x - used.x_right
    relative = disparity - np.repeat(disparity[first], n)
    whole = np.rint(correlation[use].astype(np.float64) * PX).astype(np.int64)
    sums = [
        np.add.reduceat(values, first) if n.size else values
        for values in (used.lon_q, used.lat_q, relative, relative**2, whole)
    ]
    lon, lat = (total / n / PER_DEG for total in sums[:2])
    xy = scene.pair.model.ground_to_epipolar(lon, lat, height) if n.size else np.empty((4, 0))

    def grid(values: NDArray, nothing: float) -> NDArray:
        out = np.full(shape, nothing, np.result_type(values, type(nothing)))
        out.reshape(-1)[pixel] = values
        return out

    count = grid(n, 0)
    labelled = count > 0
    squares = grid((sums[3] - sums[2] ** 2 / n) / PX**2, 0.0)
    noise = noise_variance(count, squares, labelled, scene.rays.px_per_m)
    framed = pixels.in_frames > 0
    status = merged_status(
        {
            Status.MASKED: pixels.masked & ~framed,
            Status.OUT_OF_FRAME: (pixels.outside > 0) & ~framed,
            Status.BELOW_MINIMUM_COUNT: labelled & (count < settings.min_points),
            Status.LABELLED: labelled,
            Status.LOW_CORRELATION: framed,
        }
    )
    labels = Labels(
        grid(xy[0] - xy[2], np.nan), np.zeros((2, *shape)), noise / np.maximum(count, 1)
    )
    return WindowLabels(
        status=status,
        labels=labels,
        height=grid(height, np.nan),
        surface_class=grid(top >> DAY_BITS & (1 << CLASS_BITS) - 1, 0).astype(np.uint8),
        day=grid(top & (1 << DAY_BITS) - 1, 0).astype(np.uint16),
        point_count=count,
    ), grid(sums[4] / n / PX, np.nan)
