"""What a dataset's files mean: values of labels, their sign, and which image they belong to."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.kernels import kernel
from stereotruth.epipolar.window_sums import BEND, SURFACE_PX

from .estimates import Estimate, cells, ratio, share
from .matches import Matches

Floats = NDArray[np.float64]


STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625)  # px; a finer step does no harm
STRAY_SHARE = 1e-3  # of the pixels that have one and the same value, outside the range,
SPIKE_SHARE = 5e-3  # inside it;
AROUND_PX = 0.5  # more of them than all others within this
AGREE_PX = 1.0
WRONG_PX = 1.5
HALF = 3  # px: labels are averaged over 7 x 7, on one surface,
FILLED = 0.6  # where so many carry it
AS_STATED, SIGN, SWAPPED, SWAPPED_SIGN = (
    "as stated",
    "opposite sign",
    "images swapped",
    "on the right image",
)


class Values(NamedTuple):
    """Facts of a label file. Shares are of all pixels; ``outside`` of the labelled ones.

    ``step``: px that all labels are multiples of, or None. ``strays``: values outside the range
    that many pixels have, more than the values beside them, with their shares: a nodata value that
    nobody declared. ``spikes``: such values inside the range.
    """

    labelled: float
    low: float
    high: float
    outside: float
    step: float | None
    strays: list[tuple[float, float]]
    spikes: list[tuple[float, float]]


def label_values(labels: NDArray[Any], disparity_range: tuple[float, float]) -> Values:
    """Facts of labels [h, w] (px, NaN: nodata as declared) in a range [least, most)."""
    known = labels[np.isfinite(labels)].astype(np.float64)
    if not known.size:
        return Values(0.0, np.nan, np.nan, 0.0, None, [], [])
    atoms, counts = np.unique(known, return_counts=True)
    inside = (atoms >= disparity_range[0]) & (atoms < disparity_range[1])
    step = next((s for s in STEPS if np.all(atoms % s == 0)), None)
    reach = max(AROUND_PX, 1.5 * (step or 0.0))
    strays, spikes = [], []
    for k in np.flatnonzero(counts >= np.where(inside, SPIKE_SHARE, STRAY_SHARE) * labels.size):
        around = np.abs(atoms - atoms[k]) <= reach
        if counts[k] > counts[around].sum() - counts[k]:
            found = spikes if inside[k] else strays
            found.append((float(atoms[k]), float(counts[k] / labels.size)))
    return Values(
        known.size / labels.size,
        float(atoms[0]),
        float(atoms[-1]),
        float(counts[~inside].sum() / known.size),
        step,
        strays,
        spikes,
    )


@kernel
def _surface_mean(labels: NDArray, xs: NDArray, ys: NDArray, out: Floats) -> None:
    rows, cols = labels.shape
    for k in range(xs.size):
        x0, y0 = xs[k], ys[k]
        out[k] = np.nan
        if x0 < HALF or y0 < HALF or x0 + HALF >= cols or y0 + HALF >= rows:
            continue
        middle = labels[y0, x0]
        n, total = 0, 0.0
        for y in range(y0 - HALF, y0 + HALF + 1):
            for x in range(x0 - HALF, x0 + HALF + 1):
                away = max(abs(x - x0), abs(y - y0))
                if abs(labels[y, x] - middle) <= SURFACE_PX + BEND * away:
                    n += 1
                    total += labels[y, x]
        if n >= FILLED * (2 * HALF + 1) ** 2:
            out[k] = total / n


def label_at(labels: NDArray[Any], x: Floats, y: Floats) -> Floats:
    """Labels at places in px, each the mean of its surface around it; NaN off smooth surfaces."""
    out = np.empty(x.size)
    xs, ys = (np.floor(v + 0.5).astype(np.int64) for v in (x, y))
    _surface_mean(np.asarray(labels, np.float64), xs, ys, out)
    return out


def _agreeing(errors: Floats) -> NDArray[np.bool_]:
    """Errors within AGREE_PX of the place around which most lie: a common offset is no matter."""
    ordered = np.sort(errors)
    last = np.searchsorted(ordered, ordered + 2 * AGREE_PX, "right")
    first = int(np.argmax(last - np.arange(ordered.size)))
    low = ordered[first]
    return (errors >= low) & (errors <= low + 2 * AGREE_PX)


def convention(labels: NDArray[Any], matches: Matches) -> tuple[str, Estimate]:
    """What the labels must mean for the matches to agree with them, a common offset aside.

    Returns the best of: as stated (d = x_left − x_right on the left image), of the opposite sign,
    with the images swapped, on the right image; and the share of the matches by which it explains
    more than the first does. Flat tiles cannot tell: then the share is small, or unknown.
    """
    rows = matches.y + matches.parallax
    on_left = label_at(labels, matches.x, matches.y)
    on_right = label_at(labels, matches.x_right, rows)
    known = np.isfinite(on_left) & np.isfinite(on_right)
    on_left, on_right, d = on_left[known], on_right[known], matches.disparity[known]
    group = cells(matches.x[known], matches.y[known])
    if d.size < 3:
        return AS_STATED, Estimate(0.0, float("inf"), 1)
    agree = {
        AS_STATED: _agreeing(on_left - d),
        SIGN: _agreeing(-on_left - d),
        SWAPPED: _agreeing(-on_right - d),
        SWAPPED_SIGN: _agreeing(on_right - d),
    }
    best = max(agree, key=lambda name: (int(agree[name].sum()), name == AS_STATED))
    more = agree[best].astype(float) - agree[AS_STATED]
    return best, ratio(more, np.ones(d.size), group)


def wrong_at(labels: NDArray[Any], value: float, bias: float, matches: Matches) -> Estimate:
    """Share of the matches on labels of this very value that contradict it, the bias aside."""
    rows, cols = (np.floor(v + 0.5).astype(int) for v in (matches.y, matches.x))
    inside = (rows >= 0) & (cols >= 0) & (rows < labels.shape[0]) & (cols < labels.shape[1])
    on = np.zeros(inside.shape, bool)
    on[inside] = labels[rows[inside], cols[inside]] == np.float32(value)
    off = np.abs(value - bias - matches.disparity[on]) > WRONG_PX
    return share(off, cells(matches.x[on], matches.y[on]))


def swapped(matches: Matches) -> Matches:
    """The matches seen from the right image, at its nearest pixels."""
    x, y = np.floor(matches.x_right + 0.5), np.floor(matches.y + matches.parallax + 0.5)
    return Matches(
        x,
        y,
        -matches.disparity,
        -matches.slope_x,
        -matches.slope_y,
        -matches.parallax,
        matches.sigma,
        matches.correlation,
    )
