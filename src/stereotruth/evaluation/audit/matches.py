"""Sub-pixel matches of a pair that know nothing of its labels.

SIFT key points (:mod:`stereotruth.dataset.sift_matches`) are matched over some rows and a wide
range of disparities of either sign; least-squares matching (Gruen 1985) then finds, in a window
around the left pixel nearest the key point, the disparity there, its two slopes, and the vertical
parallax.
What keeps it free of bias:

- both images are smoothed alike before (``SMOOTHING_PX``) and the right one is interpolated by
  cubic B-splines, so that no sub-pixel phase is preferred to another;
- the slopes of the grey values are the mean of both windows', so that noise draws nothing;
- the disparity is that of the plane at the window's middle pixel, whatever the texture's centre.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter

from ...dataset import sift_matches
from .match_kernels import match_all, offset_all

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]
Bools = NDArray[np.bool_]


SMOOTHING_PX = 0.7  # standard deviation: what is left aliases by less than 0.01 px
HALF = 8  # px: windows of 17 x 17,
WEIGHT_PX = 4.5  # weighted by a Gaussian of this standard deviation
MIN_CORRELATION = 0.7
POOR_SIGMA = 0.25  # px, by the match's own residuals
ROW_STEP_PX = 9.0  # of the search for rows that are far off: SIFT looks 5 px up and down
ROW_STEPS = 4
FEW = 30  # key points matched: fewer, and other rows are tried


@dataclass(frozen=True, eq=False)
class Matches:
    """n matches; all in px. ``x``, ``y``: pixels of the left image (whole numbers).

    ``disparity`` x_left − x_right there, ``slope_x``, ``slope_y`` its change per px, ``parallax``
    y_right − y_left, ``sigma`` of the disparity by the residuals, ``correlation`` of the windows.
    """

    x: Floats
    y: Floats
    disparity: Floats
    slope_x: Floats
    slope_y: Floats
    parallax: Floats
    sigma: Floats
    correlation: Floats

    def __len__(self) -> int:
        return self.x.size

    def take(self, chosen: NDArray[Any]) -> Matches:
        """Those of an index or a mask."""
        return Matches(*(getattr(self, f.name)[chosen] for f in fields(self)))

    @property
    def x_right(self) -> Floats:
        """Columns in the right image."""
        return self.x - self.disparity


def grey(image: NDArray[Any]) -> Picture:
    """An image [h, w] or [h, w, 3] (RGB) as float32[h, w]."""
    if image.ndim == 3:
        return cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY)
    return image.astype(np.float32)


def smooth(image: Picture) -> Picture:
    """As both images are before they are compared."""
    return cv2.GaussianBlur(image, (0, 0), SMOOTHING_PX, borderType=cv2.BORDER_REFLECT)


def spline(image: Picture) -> Picture:
    """Coefficients of the cubic B-spline through an image, float32[h, w]."""
    return spline_filter(image.astype(np.float64), order=3, mode="mirror").astype(np.float32)


def least_squares(left: Picture, right: Picture, start: Floats) -> Matches:
    """Least-squares matches of a pair [h, w] from ``start`` [n, 4]: x, y, disparity, parallax.

    Those that do not converge near their start, or fit poorly, are left out.
    """
    out = np.empty((len(start), 6))
    match_all(spline(smooth(left)), spline(smooth(right)), _weight(), start, out)
    d, along, down, parallax, sigma, correlation = out.T
    found = Matches(start[:, 0], start[:, 1], d, along, down, parallax, sigma, correlation)
    with np.errstate(invalid="ignore"):
        return found.take((correlation >= MIN_CORRELATION) & (sigma <= POOR_SIGMA))


def label_offsets(left: Picture, right: Picture, labels: NDArray[Any], matches: Matches) -> Floats:
    """Labels less disparity at each match, px; NaN without labels or where the images do not fit.

    A match is the mean of its window: on a crown or a ridge, where key points are, that is less
    than the label in its middle (0.5 px in a forest, with labels that are right to 0.03 px). So the
    window is matched once more, from where the match has it, in the shape that the labels give it.
    """
    start = np.column_stack([matches.x, matches.y, matches.disparity, matches.parallax])
    out = np.empty((len(matches), 2))
    labels = np.ascontiguousarray(labels, np.float32)
    pictures = spline(smooth(left)), spline(smooth(right))
    offset_all(*pictures, labels, _weight(), start, out)
    with np.errstate(invalid="ignore"):
        return np.where(out[:, 1] >= MIN_CORRELATION, out[:, 0], np.nan)


def _weight() -> Floats:
    offset = np.arange(-HALF, HALF + 1) / WEIGHT_PX
    return np.exp(-0.5 * (offset[:, None] ** 2 + offset[None, :] ** 2))


def _without_nodata(picture: Picture, half: int) -> Bools:
    """Pixels around which no pixel is nodata (0) within ``half`` px."""
    empty = (picture == 0).astype(np.uint8)
    blank = cv2.dilate(empty, np.ones((2 * half + 1,) * 2, np.uint8))
    return blank == 0


def match_pair(
    left: NDArray[Any], right: NDArray[Any], reach_px: float, *, nodata: bool = True
) -> Matches:
    """Matches of a pair [h, w] or [h, w, 3] with disparities up to ``reach_px`` of either sign.

    Rows may be some 40 px off as a whole, and 5 px around that. ``nodata``: 0 is no grey value.
    """
    a, b = grey(left), grey(right)
    points = sift_matches.key_points(a), sift_matches.key_points(b)
    if not (points[0].x.size and points[1].x.size):
        return least_squares(a, b, np.empty((0, 4)))
    best: tuple[Any, Any] = sift_matches.match(*points, (-reach_px, reach_px))
    for step in range(1, ROW_STEPS + 1):
        if best[0].size >= FEW:
            break
        for shift in (-step * ROW_STEP_PX, step * ROW_STEP_PX):
            moved = points[1]._replace(y=points[1].y + shift)
            found = sift_matches.match(points[0], moved, (-reach_px, reach_px))
            best = found if found[0].size > best[0].size else best
    i, j = best
    x, y = points[0].x[i], points[0].y[i]
    start = np.column_stack(
        [np.floor(x + 0.5), np.floor(y + 0.5), x - points[1].x[j], points[1].y[j] - y]
    )
    _, first = np.unique(start[:, :2], axis=0, return_index=True)  # key points of one pixel
    start = start[np.sort(first)]
    if nodata:
        inside = _without_nodata(a, HALF)
        rows, cols = start[:, 1].astype(int), start[:, 0].astype(int)
        start = start[inside[np.clip(rows, 0, len(a) - 1), np.clip(cols, 0, a.shape[1] - 1)]]
    return least_squares(a, b, start)
