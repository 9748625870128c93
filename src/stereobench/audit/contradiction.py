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

from stereotruth.epipolar.surface_windows import shifted_correlations

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


def _best_peak(correlation: Floats) -> tuple[Floats, Floats]:
    """The best peak of each row [n, odd] beyond APART_PX of the middle: correlation (NaN for none),
    shift."""
    middle = correlation.shape[1] // 2
    shift = np.arange(-middle + 1, middle)
    here = correlation[:, 1:-1]
    peak = (here >= correlation[:, :-2]) & (here >= correlation[:, 2:])  # false beside NaN
    score = np.where(peak & (np.abs(shift) >= APART_PX), here, -np.inf)
    best = np.argmax(score, axis=1)
    most = score[np.arange(len(score)), best]
    return np.where(np.isfinite(most), most, np.nan), shift[best].astype(float)


def scan_labels(
    left: Picture, right: Picture, labels: NDArray[Any], reach: tuple[float, float]
) -> Scan:
    """Try labels [h, w] (px, NaN: none) of a pair [h, w] whose rows correspond.

    ``reach``: least and largest disparity that may be right in this tile, px. Labels whose window
    leaves the right image, or holds too few labels of one surface, are not tried.
    """
    y, x = (v.ravel() for v in np.mgrid[0 : left.shape[0] : STEP_PX, 0 : left.shape[1] : STEP_PX])
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
    decoy = np.where(inside, decoy, -decoy)
    there, shift = _best_peak(correlations(0, limits))
    by_chance, _ = _best_peak(correlations(decoy, limits))
    out = np.stack([x, y, here, there, -shift, by_chance]).astype(float)
    return Scan(*out[:, np.isfinite(here)])
