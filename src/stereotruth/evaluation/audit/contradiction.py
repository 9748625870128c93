"""Labels that the images contradict: does the left image fit the right one better elsewhere?

For labels on a regular grid, the pixels of the label's own surface in a window are brought to the
right image by their labels, and by the labels plus every shift up to the range of the tile: the
correlation coefficient at the label (within ``NEAR_PX``) is held against the best one elsewhere
(beyond ``APART_PX``, a peak of its own). A window so shaped neither mixes surfaces at a roof's edge
nor fails on a slope.

Elsewhere wins by chance, too, the more often the more shifts are tried and the less texture there
is. How often is measured: the same search runs in a decoy, rows of the right image that cannot hold
the match. Labels beaten on their own rows less labels beaten in the decoy are those that the images
contradict; the share has no bias but that a wrong label may lose to the decoy as well, which makes
it smaller, never larger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...epipolar.one_surface import BEND, SURFACE_PX
from ...kernels import inner, kernel
from ...numerics.cubic_convolution import four_point_weights
from .estimates import Estimate, cells, ratio

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]
Picture = NDArray[np.float32]


STEP_PX = 10  # between the labels that are tried
HALF = 6  # px: windows of 13 x 13
MIN_SUPPORT = 70  # pixels of the surface in the window
NEAR_PX = 1  # the label is right to this
APART_PX = 3  # from here on it is elsewhere
REACH_PX = 64
MARGIN = 0.2  # of correlation, by which elsewhere must be better,
CLEAR = 0.8  # and good
DECOY_ROWS = (29, -37, 43, -51)  # in turn


@dataclass(frozen=True, eq=False)
class Scan:
    """n labels that were tried: pixel ``x``, ``y``; correlations, NaN where there is no peak.

    ``here`` at the label, ``there`` the best elsewhere, ``shift`` px from the label to it,
    ``decoy`` the best in the rows that cannot hold the match.
    """

    x: Floats
    y: Floats
    here: Floats
    there: Floats
    shift: Floats
    decoy: Floats

    @property
    def beaten(self) -> Bools:
        """Labels that another place on the rows beats."""
        return _beats(self.there, self.here)

    @property
    def beaten_by_chance(self) -> Bools:
        """Labels that the decoy beats."""
        return _beats(self.decoy, self.here)

    def contradicted(self) -> Estimate:
        """Share of the labels that the images contradict."""
        more = self.beaten.astype(float) - self.beaten_by_chance
        return ratio(more, np.ones(more.size), cells(self.x, self.y))


def _beats(there: Floats, here: Floats) -> Bools:
    with np.errstate(invalid="ignore"):
        return (there >= CLEAR) & (there - here >= MARGIN)


@inner
def _correlate(
    right: Picture, values: Floats, rows: NDArray, first: NDArray, taps: Floats, n: int, shift: int
) -> float:
    """Correlation of n left ``values`` with the right image, ``shift`` columns on; NaN outside."""
    sa, sb, saa, sbb, sab = 0.0, 0.0, 0.0, 0.0, 0.0
    width = right.shape[1]
    for k in range(n):
        i = first[k] + shift
        if i < 0 or i + 4 > width:
            return np.nan
        row = right[rows[k]]
        b = (
            taps[k, 0] * row[i]
            + taps[k, 1] * row[i + 1]
            + taps[k, 2] * row[i + 2]
            + taps[k, 3] * row[i + 3]
        )
        a = values[k]
        sa += a
        sb += b
        saa += a * a
        sbb += b * b
        sab += a * b
    va, vb = saa - sa * sa / n, sbb - sb * sb / n
    if va <= 1e-6 * saa or vb <= 1e-6 * sbb:
        return 0.0
    return (sab - sa * sb / n) / np.sqrt(va * vb)


@inner
def _best(
    right: Picture,
    values: Floats,
    rows: NDArray,
    first: NDArray,
    taps: Floats,
    n: int,
    low: int,
    high: int,
    work: Floats,
) -> tuple[float, int]:
    """The best peak at column shifts low … high beyond APART_PX: correlation (NaN none), shift."""
    best, at = np.nan, 0
    for shift in range(low - 1, high + 2):
        work[shift - low + 1] = _correlate(right, values, rows, first, taps, n, shift)
    for shift in range(low, high + 1):
        if abs(shift) < APART_PX:
            continue
        k = shift - low + 1
        c = work[k]
        peak = c >= work[k - 1] and c >= work[k + 1]  # false beside NaN
        if peak and not c <= best:
            best, at = c, shift
    return best, at


@kernel
def _scan(
    left: Picture,
    right: Picture,
    labels: Picture,
    xs: NDArray,
    ys: NDArray,
    low: float,
    high: float,
    decoys: NDArray,
    out: Floats,
) -> None:
    """Fill ``out`` [n, 4]: here, there, shift, decoy."""
    height, width = left.shape
    most = (2 * HALF + 1) ** 2
    values, rows, first = np.empty(most), np.empty(most, np.int64), np.empty(most, np.int64)
    other = np.empty(most, np.int64)
    taps, between = np.empty((most, 4)), np.empty((most, 4))
    before = np.empty(most, np.int64)
    work = np.empty(2 * REACH_PX + 3)
    for s in range(xs.size):
        out[s] = np.nan
        x0, y0 = xs[s], ys[s]
        middle = labels[y0, x0]
        n = 0
        for y in range(max(y0 - HALF, 0), min(y0 + HALF + 1, height)):
            for x in range(max(x0 - HALF, 0), min(x0 + HALF + 1, width)):
                d = labels[y, x]
                away = max(abs(x - x0), abs(y - y0))
                if not abs(d - middle) <= SURFACE_PX + BEND * away:
                    continue
                at = x - d
                i = int(np.floor(at))
                values[n], rows[n], first[n] = left[y, x] - left[y0, x0], y, i - 1
                four_point_weights(at - i, taps[n])
                at += 0.5
                i = int(np.floor(at))
                before[n] = i - 1
                four_point_weights(at - i, between[n])
                n += 1
        if n < MIN_SUPPORT:
            continue
        here = np.nan
        for shift in range(-NEAR_PX, NEAR_PX + 1):
            c = _correlate(right, values, rows, first, taps, n, shift)
            if not c <= here:
                here = c
            if shift < NEAR_PX:
                c = _correlate(right, values, rows, before, between, n, shift)
                if not c <= here:
                    here = c
        if np.isnan(here):
            continue
        # a column further right is a smaller disparity
        least = max(int(np.ceil(middle - high)), -REACH_PX)
        most_right = min(int(np.floor(middle - low)), REACH_PX)
        if most_right <= least:
            continue
        decoy = decoys[s]
        inside = True
        for k in range(n):
            other[k] = rows[k] + decoy
            inside = inside and other[k] >= 0 and other[k] < height
        if not inside:
            for k in range(n):
                other[k] = rows[k] - decoy
        out[s, 0] = here
        out[s, 1], shift = _best(right, values, rows, first, taps, n, least, most_right, work)
        out[s, 2] = -shift
        out[s, 3], shift = _best(right, values, other, first, taps, n, least, most_right, work)


def scan_labels(
    left: Picture, right: Picture, labels: NDArray[Any], reach: tuple[float, float]
) -> Scan:
    """Try labels [h, w] (px, NaN: none) of a pair [h, w] whose rows correspond.

    ``reach``: least and largest disparity that may be right in this tile, px. Labels whose window
    leaves the right image, or holds too few labels of one surface, are not tried.
    """
    ys, xs = (v.ravel() for v in np.mgrid[0 : left.shape[0] : STEP_PX, 0 : left.shape[1] : STEP_PX])
    there = np.isfinite(labels[ys, xs])
    xs, ys = xs[there], ys[there]
    decoys = np.resize(np.array(DECOY_ROWS), xs.size)
    out = np.empty((xs.size, 4))
    _scan(
        np.ascontiguousarray(left, np.float32),
        np.ascontiguousarray(right, np.float32),
        np.ascontiguousarray(labels, np.float32),
        xs,
        ys,
        *reach,
        decoys,
        out,
    )
    tried = np.isfinite(out[:, 0])
    return Scan(xs[tried].astype(float), ys[tried].astype(float), *out[tried].T)
