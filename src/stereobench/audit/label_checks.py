"""What labels and images of a pair say of each other, beside the matches that are off.

- Meaning: sign, sides and values of a label file.
- Contradiction: where the left image fits the right one clearly better elsewhere than at the label.
- Hidden pixels: labels that others of their row hide from the right view.
- Registration: whether labels lie on the pixels that they belong to.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereotruth.core.numerics.arrays import Bools, Floats
from stereotruth.epipolar.surface_windows import shifted_correlations, surface_correlation
from stereotruth.epipolar.warping import warp_rows
from stereotruth.epipolar.window_sums import BEND, SURFACE_PX

from .estimates import NOTHING, Estimate, cells, location, ratio, share
from .matches import Matches

Labels = NDArray[np.floating]  # [h, w] px, NaN: none
Picture = NDArray[np.float32]

# ------------------------------------------------------------------------------------- meaning

STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625)  # px; a finer step does no harm
STRAY_SHARE = 1e-3  # of the pixels that have one and the same value, outside the range,
SPIKE_SHARE = 5e-3  # inside it;
AROUND_PX = 0.5  # more of them than all others within this
AGREE_PX = 1.0
WRONG_PX = 1.5
MEAN_HALF = 3  # px: labels are averaged over 7 x 7, on one surface,
FILLED = 0.6  # where so many carry it
AS_STATED, SIGN = "as stated", "opposite sign"
SWAPPED, SWAPPED_SIGN = "images swapped", "on the right image"

# Contradiction.
SCAN_STEP_PX = 10  # between the labels that are tried
HALF = 6  # px: windows of 13 x 13
MIN_SUPPORT = 70  # pixels of the surface in the window
NEAR_PX = 1  # the label is right to this
APART_PX = 3  # from here on it is elsewhere
REACH_PX = 64
MARGIN = 0.2  # of correlation, by which elsewhere must be better,
CLEAR = 0.8  # and good
MASK_STEP_PX = 3  # between those that are tried where labels are to be masked,
MASK_CELLS = 5  # by the majority of so many in each direction
DECOY_ROWS = (29, -37, 43, -51)  # in turn

# Hidden pixels.
FOLD_PX = 1.0  # labels that are right to some tenths of a px fold by less
WINDOW = 9  # px
IN_FRONT = 0.15  # of correlation: crowns fold, too, and what lies below them is seen as well
LARGER, SMALLER = "larger", "smaller"

# Registration.
HEIGHT_STEP_PX = 1.5  # of labels within AROUND_STEP_PX of a pixel
AROUND_STEP_PX = 3
FARTHEST_PX = 3
MIN_PIXELS = 2000
MOVES = [
    (x, y)
    for far in range(1, FARTHEST_PX + 1)
    for x, y in ((far, 0), (-far, 0), (0, far), (0, -far))
]


class Values(NamedTuple):
    """Facts of a label file. Shares are of all pixels; ``outside`` of the labelled ones.

    ``step``: px that all labels are multiples of, or None. ``strays``: values outside the range
    that many pixels have, more than the values beside them, with their shares: a nodata value that
    nobody declared. ``spikes``: such values inside the range.
    """

    labelled: float
    low: float | None
    high: float | None
    outside: float
    step: float | None
    strays: list[tuple[float, float]]
    spikes: list[tuple[float, float]]


def label_values(labels: Labels, disparity_range: tuple[float, float]) -> Values:
    """Facts of labels (NaN: nodata as declared) in a range [least, most)."""
    known = labels[np.isfinite(labels)].astype(np.float64)
    if not known.size:
        return Values(0.0, None, None, 0.0, None, [], [])
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
    labelled, outside = known.size / labels.size, float(counts[~inside].sum() / known.size)
    return Values(labelled, float(atoms[0]), float(atoms[-1]), outside, step, strays, spikes)


def label_at(labels: Labels, x: Floats, y: Floats) -> Floats:
    """Labels [n] at places in px, each the mean of its surface around it; NaN off smooth ones."""
    rows, cols = labels.shape
    i, j = (np.floor(v + 0.5).astype(np.int64) for v in (y, x))
    out = np.full(i.size, np.nan)
    inside = (j >= MEAN_HALF) & (i >= MEAN_HALF) & (j + MEAN_HALF < cols) & (i + MEAN_HALF < rows)
    down, across = np.indices((2 * MEAN_HALF + 1,) * 2).reshape(2, -1) - MEAN_HALF
    around = labels[i[inside, None] + down, j[inside, None] + across].astype(np.float64)
    middle = labels[i[inside], j[inside]].astype(np.float64)[:, None]
    near = np.abs(around - middle) <= SURFACE_PX + BEND * np.maximum(np.abs(down), np.abs(across))
    count = near.sum(axis=1)
    mean = np.where(near, around, 0.0).sum(axis=1) / np.maximum(count, 1)
    out[inside] = np.where(count >= FILLED * down.size, mean, np.nan)
    return out


def _agreeing(errors: Floats) -> Bools:
    """Errors within AGREE_PX of the place around which most lie: a common offset is no matter."""
    ordered = np.sort(errors)
    last = np.searchsorted(ordered, ordered + 2 * AGREE_PX, "right")
    low = ordered[int(np.argmax(last - np.arange(ordered.size)))]
    return (errors >= low) & (errors <= low + 2 * AGREE_PX)


def convention(labels: Labels, matches: Matches) -> tuple[str, Estimate]:
    """What the labels must mean for the matches to agree with them, a common offset aside.

    Returns the best of: as stated (d = x_left − x_right on the left image), of the opposite sign,
    with the images swapped, on the right image; and the share of the matches by which it explains
    more than the first does. Flat tiles cannot tell: then the share is small, or unknown.
    """
    on_left = label_at(labels, matches.x, matches.y)
    on_right = label_at(labels, matches.x_right, matches.y + matches.parallax)
    known = np.isfinite(on_left) & np.isfinite(on_right)
    on_left, on_right, d = on_left[known], on_right[known], matches.disparity[known]
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
    return best, share(more, cells(matches.x[known], matches.y[known]))


def wrong_at(labels: Labels, value: float, bias: float, matches: Matches) -> Estimate:
    """Share of the matches on labels of this very value that contradict it, the bias aside."""
    rows, cols = (np.floor(v + 0.5).astype(int) for v in (matches.y, matches.x))
    inside = (rows >= 0) & (cols >= 0) & (rows < labels.shape[0]) & (cols < labels.shape[1])
    on = np.zeros(inside.shape, bool)
    on[inside] = labels[rows[inside], cols[inside]] == np.float32(value)
    off = np.abs(value - bias - matches.disparity[on]) > WRONG_PX
    return share(off.astype(float), cells(matches.x[on], matches.y[on]))


def swapped(matches: Matches) -> Matches:
    """The matches seen from the right image, at its nearest pixels."""
    x, y = matches.x_right, matches.y + matches.parallax
    return Matches(np.floor(x + 0.5), np.floor(y + 0.5), -matches.disparity, -matches.parallax)


# ------------------------------------------------------------------------------- contradiction


class Scan(NamedTuple):
    """n labels that were tried: pixel ``x``, ``y``; correlations, NaN where there is no peak.

    ``here`` at the label, ``there`` the best elsewhere, ``decoy`` the best in the rows that cannot
    hold the match.
    """

    x: Floats
    y: Floats
    here: Floats
    there: Floats
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
        return share(self.beaten.astype(float) - self.beaten_by_chance, cells(self.x, self.y))


def _beats(there: Floats, here: Floats) -> Bools:
    with np.errstate(invalid="ignore"):
        return (there >= CLEAR) & (there - here >= MARGIN)


def contradicted_labels(
    left: Picture, right: Picture, labels: Labels, reach: tuple[float, float]
) -> Bools:
    """Labels [h, w] around which another place beats most of those tried, and no decoy does."""
    scan = scan_labels(left, right, labels, reach, MASK_STEP_PX)
    tried, beaten = np.zeros((2, *(-(-size // MASK_STEP_PX) for size in labels.shape)))
    at = (scan.y / MASK_STEP_PX).astype(int), (scan.x / MASK_STEP_PX).astype(int)
    tried[at], beaten[at] = 1.0, scan.beaten & ~scan.beaten_by_chance
    most = cv2.blur(beaten, (MASK_CELLS,) * 2) > 0.5 * cv2.blur(tried, (MASK_CELLS,) * 2)
    around = np.kron(most, np.ones((MASK_STEP_PX,) * 2, bool))[: labels.shape[0], : labels.shape[1]]
    return around & np.isfinite(labels)


def _best_peak(correlation: Floats) -> Floats:
    """The best peak of each row [n, odd] beyond APART_PX of the middle; NaN for none."""
    middle = correlation.shape[1] // 2
    here = correlation[:, 1:-1]
    peak = (here >= correlation[:, :-2]) & (here >= correlation[:, 2:])  # false beside NaN
    peak &= np.abs(np.arange(-middle + 1, middle)) >= APART_PX
    best = np.where(peak, here, -np.inf).max(axis=1, initial=-np.inf)
    return np.where(np.isfinite(best), best, np.nan)


def scan_labels(
    left: Picture,
    right: Picture,
    labels: Labels,
    reach: tuple[float, float],
    step: int = SCAN_STEP_PX,
) -> Scan:
    """Try labels on a grid of ``step`` px of a pair [h, w] whose rows correspond.

    The pixels of the label's own surface in a window are brought to the right image by their
    labels, and by the labels plus every shift up to ``reach``, the least and largest disparity (px)
    that may be right in this tile: so shaped, a window neither mixes surfaces at a roof's edge nor
    fails on a slope. Elsewhere wins by chance, too, the more often the more shifts are tried and
    the less texture there is. How often is measured: the same search runs in a decoy, rows of the
    right image that cannot hold the match. Labels whose window leaves the right image, or holds too
    few labels of one surface, are not tried.
    """
    steps = (slice(0, size, step) for size in left.shape)
    y, x = (v.ravel() for v in np.mgrid[tuple(steps)])
    # a column further right is a smaller disparity
    first = np.maximum(np.ceil(labels[y, x] - reach[1]), -REACH_PX)
    last = np.minimum(np.floor(labels[y, x] - reach[0]), REACH_PX)
    wide = first < last  # false without a label
    x, y = x[wide], y[wide]
    # and one more, beside which a peak is lower
    limits = np.column_stack([first[wide] - 1, last[wide] + 1]).astype(np.int64)

    def correlations(down: Any, limits: NDArray[np.int64], ahead: float = 0.0) -> Floats:
        places = np.column_stack([x, y, np.broadcast_to(down, x.shape)])
        return shifted_correlations(
            left, right, labels, places, limits, ahead, half=HALF, least=MIN_SUPPORT
        )

    near = np.broadcast_to([-NEAR_PX, NEAR_PX], limits.shape)
    halfway = correlations(0, near - [0, 1], 0.5)[:, :-1]
    here = np.concatenate([correlations(0, near), halfway], axis=1).max(axis=1, initial=-1.0)
    decoy = np.resize(np.array(DECOY_ROWS), x.size)
    inside = (y - HALF + decoy >= 0) & (y + HALF + decoy < len(left))
    by_chance = correlations(np.where(inside, decoy, -decoy), limits)
    there = correlations(0, limits)
    out = np.stack([x, y, here, _best_peak(there), _best_peak(by_chance)]).astype(float)
    return Scan(*out[:, np.isfinite(here)])


# ------------------------------------------------------------------------------- hidden pixels


def hidden_labels(labels: Labels, nearer: str = LARGER) -> Bools:
    """Labels that others of their row hide from the right view, by the labels' own geometry.

    Along a row, x_right = x − d of a surface that both views see grows with x. Where it folds back,
    two places of the left image meet on one column of the right, and the one in front hides the
    other. ``nearer``: whether larger disparities are in front, as where they grow with height (the
    place in front then lies to the right), or smaller ones.
    """
    x_right = np.arange(labels.shape[1]) - np.asarray(labels, np.float64)
    from_front = x_right[:, ::-1] if nearer == LARGER else -x_right
    least = np.minimum.accumulate(np.where(np.isnan(from_front), np.inf, from_front), axis=1)
    behind = from_front > least + FOLD_PX  # false without a label
    return behind[:, ::-1] if nearer == LARGER else behind


def who_is_in_front(left: Picture, right: Picture, labels: Labels) -> Estimate:
    """How much better the larger disparities of folds correlate than the smaller ones do.

    What is hidden does not correlate. Above zero: larger disparities are in front. 0 is nodata of
    the images [h, w]. Unknown where too few labels fold.
    """
    far, near = hidden_labels(labels, LARGER), hidden_labels(labels, SMALLER)
    disparity = np.asarray(labels, np.float64)
    warped = warp_rows(right, np.arange(labels.shape[1])[None, :] - disparity)
    flat = np.zeros((2, *labels.shape), np.float32)
    correlation = surface_correlation(left, warped, disparity, flat, WINDOW)
    y, x = np.nonzero((near ^ far) & np.isfinite(correlation))
    value, larger = correlation[y, x].astype(float), near[y, x]
    names, group = np.unique(cells(x.astype(float), y.astype(float)), return_inverse=True)
    count, total = (
        np.stack([np.bincount(group, side * v, names.size) for side in (larger, ~larger)])
        for v in (1.0, value)
    )
    both = (count > 0).all(axis=0)
    mean = total[:, both] / count[:, both]
    return location(mean[0] - mean[1], names[both])


# -------------------------------------------------------------------------------- registration


def better_place(left: Picture, right: Picture, labels: Labels) -> tuple[tuple[int, int], Estimate]:
    """The best move (x, y) of the labels other than none, and what it takes off the difference.

    Labels moved by a pixel or two against their image hardly change where surfaces are smooth.
    Beside steps they do: there, the left image is compared with the right one as brought to it by
    the labels, and by the labels moved up, down, left and right; the squared difference is least
    where the labels belong. Returned is the share of the difference that the move takes off, below
    zero where labels belong. ``left``, ``right``: smoothed, their rows correspond. Unknown where
    there are too few steps.
    """
    known = np.isfinite(labels)
    around = np.ones((2 * AROUND_STEP_PX + 1,) * 2, np.uint8)
    high = cv2.dilate(np.where(known, labels, np.float32(-1e6)), around)
    low = cv2.erode(np.where(known, labels, np.float32(1e6)), around)
    beside_steps = known & (high - low >= HEIGHT_STEP_PX)
    rows, cols = labels.shape
    wide = np.pad(labels, FARTHEST_PX, constant_values=np.nan)
    target = (left - left.mean()) / max(float(left.std()), 1e-6)
    mean, spread = float(right.mean()), max(float(right.std()), 1e-6)

    def misses(x: int, y: int) -> Floats:
        """Squared differences beside steps, of labels moved x px to the right and y px down."""
        moved = wide[FARTHEST_PX - y :, FARTHEST_PX - x :][:rows, :cols]
        warped = warp_rows(right, np.arange(cols) - moved.astype(np.float64))
        return (target - (warped - mean) / spread)[beside_steps] ** 2

    here = misses(0, 0)
    row, col = (v.astype(float) for v in np.nonzero(beside_steps))
    best, gain = (0, 0), NOTHING
    for move in MOVES:
        there = misses(*move)
        both = np.isfinite(here) & np.isfinite(there)
        if both.sum() < MIN_PIXELS:
            continue
        # a car or a shadow that only one image has must not decide
        top = np.percentile(here[both], 99)
        a, b = np.minimum(here[both], top), np.minimum(there[both], top)
        found = ratio(a - b, a, cells(col[both], row[both]))
        if not found.value <= gain.value:
            best, gain = move, found
    return best, gain
