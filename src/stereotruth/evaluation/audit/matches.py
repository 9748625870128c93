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
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import spline_filter

from ...dataset import sift_matches

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]
Bools = NDArray[np.bool_]


SMOOTHING_PX = 0.7  # standard deviation: what is left aliases by less than 0.01 px
HALF = 8  # px: windows of 17 x 17,
WEIGHT_PX = 4.5  # weighted by a Gaussian of this standard deviation
ITERATIONS = 15
CONVERGED = 0.002  # px
MOVE_PX = 1.5  # that a match may move from where SIFT has it
STEEPEST = 0.6  # px of disparity per px
LABELLED = 0.6  # of a window, by weight, where labels are held against a match
LABEL_MOVE_PX = 3.0  # by which that may move the match: a window's middle may stand out
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


@njit(cache=True, nogil=True, error_model="numpy")
def _taps(f: float, value: Floats, slope: Floats) -> None:
    """Weights of four coefficients, the second of which lies ``f`` px before the position."""
    g = 1.0 - f
    value[0] = g * g * g / 6.0
    value[1] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0
    value[2] = (3.0 * g * g * g - 6.0 * g * g + 4.0) / 6.0
    value[3] = f * f * f / 6.0
    slope[0] = -g * g / 2.0
    slope[1] = (3.0 * f * f - 4.0 * f) / 2.0
    slope[2] = (4.0 * g - 3.0 * g * g) / 2.0
    slope[3] = f * f / 2.0


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(c: Picture, x: float, y: float, taps: Floats) -> tuple[float, float, float]:
    """Value and slopes along x and y of a spline, four columns and rows from the border on."""
    i, j = int(np.floor(x)), int(np.floor(y))
    _taps(x - i, taps[0], taps[1])
    _taps(y - j, taps[2], taps[3])
    value, along, down = 0.0, 0.0, 0.0
    for b in range(4):
        v, s = 0.0, 0.0
        for a in range(4):
            p = c[j - 1 + b, i - 1 + a]
            v += taps[0, a] * p
            s += taps[1, a] * p
        value += taps[2, b] * v
        along += taps[2, b] * s
        down += taps[3, b] * v
    return value, along, down


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(a: Floats, b: Floats) -> bool:
    """Solve a @ p = b, positive definite, in place: p in ``b``, the inverse in ``a``."""
    n = b.size
    for k in range(n):
        pivot = a[k, k]
        if not pivot > 1e-12:
            return False
        a[k, k] = 1.0
        for j in range(n):
            a[k, j] /= pivot
        b[k] /= pivot
        for i in range(n):
            if i != k:
                factor = a[i, k]
                a[i, k] = 0.0
                for j in range(n):
                    a[i, j] -= factor * a[k, j]
                b[i] -= factor * b[k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _match(
    left: Picture, right: Picture, weight: Floats, x0: int, y0: int, d: float, p: float, out: Floats
) -> None:
    """Fill ``out`` [6] by disparity, its slopes, parallax, sigma and correlation, or NaN.

    ``left``, ``right``: splines; starts from disparity ``d`` and parallax ``p``.
    """
    half = weight.shape[0] // 2
    out[:] = np.nan
    rows, cols = left.shape
    if x0 - half < 2 or y0 - half < 2 or x0 + half > cols - 4 or y0 + half > rows - 4:
        return
    taps = np.empty((4, 4))
    a = np.empty((2 * half + 1, 2 * half + 1, 3))  # value and slopes of the left window
    b = np.empty((2 * half + 1, 2 * half + 1, 3))
    mean_a, total = 0.0, 0.0
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            v, gx, gy = _sample(left, float(x0 + i - half), float(y0 + j - half), taps)
            a[j, i, 0], a[j, i, 1], a[j, i, 2] = v, gx, gy
            mean_a += weight[j, i] * v
            total += weight[j, i]
    mean_a /= total
    at = np.array([d, 0.0, 0.0, p])
    design, middle = np.empty(4), np.empty(4)
    for _ in range(ITERATIONS):
        mean_b = 0.0
        for j in range(2 * half + 1):
            for i in range(2 * half + 1):
                u, v = i - half, j - half
                x = x0 + u - (at[0] + at[1] * u + at[2] * v)
                y = y0 + v + at[3]
                if not (x >= 2.0 and y >= 2.0 and x <= cols - 4.0 and y <= rows - 4.0):
                    return
                b[j, i, 0], b[j, i, 1], b[j, i, 2] = _sample(right, x, y, taps)
                mean_b += weight[j, i] * b[j, i, 0]
        mean_b /= total
        aa, ab, bb = 0.0, 0.0, 0.0
        for j in range(2 * half + 1):
            for i in range(2 * half + 1):
                w, s, t = weight[j, i], a[j, i, 0] - mean_a, b[j, i, 0] - mean_b
                aa += w * s * s
                ab += w * s * t
                bb += w * t * t
        if aa <= 0.0 or bb <= 0.0 or ab <= 0.0:
            return
        gain = np.sqrt(aa / bb)
        normal, rhs = np.zeros((4, 4)), np.zeros(4)
        middle[:] = 0.0
        misfit = 0.0
        for j in range(2 * half + 1):
            for i in range(2 * half + 1):
                w = weight[j, i]
                gx = 0.5 * (a[j, i, 1] + gain * b[j, i, 1])
                gy = 0.5 * (a[j, i, 2] + gain * b[j, i, 2])
                design[0], design[3] = -gx, gy
                design[1], design[2] = -gx * (i - half), -gx * (j - half)
                miss = a[j, i, 0] - mean_a - gain * (b[j, i, 0] - mean_b)
                misfit += w * miss * miss
                for m in range(4):
                    middle[m] += w * design[m]
                    rhs[m] += w * design[m] * miss
                    for n in range(4):
                        normal[m, n] += w * design[m] * design[n]
        for m in range(4):  # the means of the windows are taken out: so are those of the design
            for n in range(4):
                normal[m, n] -= middle[m] * middle[n] / total
        if not _solve(normal, rhs):
            return
        for m in range(4):
            at[m] += rhs[m]
        if abs(at[0] - d) > MOVE_PX or abs(at[3] - p) > MOVE_PX:
            return
        if max(abs(at[1]), abs(at[2])) > STEEPEST:
            return
        if max(abs(rhs[0]), abs(rhs[3])) < CONVERGED:
            out[:4] = at
            out[4] = np.sqrt(misfit / (total - 4.0) * normal[0, 0])
            out[5] = ab / np.sqrt(aa * bb)
            return


@njit(cache=True, nogil=True, error_model="numpy")
def _match_all(left: Picture, right: Picture, weight: Floats, start: Floats, out: Floats) -> None:
    for k in range(start.shape[0]):
        x0, y0 = int(start[k, 0]), int(start[k, 1])
        _match(left, right, weight, x0, y0, start[k, 2], start[k, 3], out[k])


def least_squares(left: Picture, right: Picture, start: Floats) -> Matches:
    """Least-squares matches of a pair [h, w] from ``start`` [n, 4]: x, y, disparity, parallax.

    Those that do not converge near their start, or fit poorly, are left out.
    """
    out = np.empty((len(start), 6))
    _match_all(spline(smooth(left)), spline(smooth(right)), _weight(), start, out)
    d, along, down, parallax, sigma, correlation = out.T
    found = Matches(start[:, 0], start[:, 1], d, along, down, parallax, sigma, correlation)
    with np.errstate(invalid="ignore"):
        return found.take((correlation >= MIN_CORRELATION) & (sigma <= POOR_SIGMA))


@njit(cache=True, nogil=True, error_model="numpy")
def _offset(
    left: Picture,
    right: Picture,
    labels: Picture,
    weight: Floats,
    x0: int,
    y0: int,
    d: float,
    p: float,
    out: Floats,
) -> None:
    """Fill ``out`` [2] by label less disparity and correlation, or NaN; starts as :func:`_match`.

    Unknowns are one offset of all labels of the window, and the parallax.
    """
    half = weight.shape[0] // 2
    out[:] = np.nan
    rows, cols = left.shape
    if x0 - half < 2 or y0 - half < 2 or x0 + half > cols - 4 or y0 + half > rows - 4:
        return
    if np.isnan(labels[y0, x0]):
        return
    taps = np.empty((4, 4))
    most = (2 * half + 1) ** 2
    place, a, b = np.empty((most, 4)), np.empty((most, 3)), np.empty((most, 3))
    n, mean_a, total, whole = 0, 0.0, 0.0, 0.0
    for j in range(2 * half + 1):
        for i in range(2 * half + 1):
            w, x, y = weight[j, i], x0 + i - half, y0 + j - half
            whole += w
            label = labels[y, x]
            if np.isnan(label):
                continue
            place[n, 0], place[n, 1], place[n, 2], place[n, 3] = x, y, label, w
            a[n, 0], a[n, 1], a[n, 2] = _sample(left, float(x), float(y), taps)
            mean_a += w * a[n, 0]
            total += w
            n += 1
    if total < LABELLED * whole:
        return
    mean_a /= total
    first = labels[y0, x0] - d
    offset, parallax = first, p
    for _ in range(ITERATIONS):
        mean_b = 0.0
        for k in range(n):
            x, y = place[k, 0] - place[k, 2] + offset, place[k, 1] + parallax
            if not (x >= 2.0 and y >= 2.0 and x <= cols - 4.0 and y <= rows - 4.0):
                return
            b[k, 0], b[k, 1], b[k, 2] = _sample(right, x, y, taps)
            mean_b += place[k, 3] * b[k, 0]
        mean_b /= total
        aa, ab, bb = 0.0, 0.0, 0.0
        for k in range(n):
            w, s, t = place[k, 3], a[k, 0] - mean_a, b[k, 0] - mean_b
            aa += w * s * s
            ab += w * s * t
            bb += w * t * t
        if aa <= 0.0 or bb <= 0.0 or ab <= 0.0:
            return
        gain = np.sqrt(aa / bb)
        sx, sy, xx, xy, yy, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            w = place[k, 3]
            gx = 0.5 * (a[k, 1] + gain * b[k, 1])
            gy = 0.5 * (a[k, 2] + gain * b[k, 2])
            miss = a[k, 0] - mean_a - gain * (b[k, 0] - mean_b)
            sx += w * gx
            sy += w * gy
            xx += w * gx * gx
            xy += w * gx * gy
            yy += w * gy * gy
            bx += w * gx * miss
            by += w * gy * miss
        xx, xy, yy = xx - sx * sx / total, xy - sx * sy / total, yy - sy * sy / total
        det = xx * yy - xy * xy
        if not det > 0.0:
            return
        along, down = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
        offset += along
        parallax += down
        if abs(offset - first) > LABEL_MOVE_PX or abs(parallax - p) > MOVE_PX:
            return
        if max(abs(along), abs(down)) < CONVERGED:
            out[0], out[1] = offset, ab / np.sqrt(aa * bb)
            return


@njit(cache=True, nogil=True, error_model="numpy")
def _offset_all(
    left: Picture, right: Picture, labels: Picture, weight: Floats, start: Floats, out: Floats
) -> None:
    for k in range(start.shape[0]):
        x0, y0 = int(start[k, 0]), int(start[k, 1])
        _offset(left, right, labels, weight, x0, y0, start[k, 2], start[k, 3], out[k])


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
    _offset_all(*pictures, labels, _weight(), start, out)
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
