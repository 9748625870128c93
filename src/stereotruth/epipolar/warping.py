"""One image seen through the disparities of another, and how well the two then agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import inlined, kernel
from ..core.numerics.arrays import Floats
from ..core.numerics.interpolation import four_point_value


@inlined
def values_in_row(row: NDArray, at: Floats, taps: NDArray, out: NDArray) -> None:
    """Values at columns ``at`` [n] of a row to ``out``; see :func:`warp_rows`. ``taps`` [4, n or
    more]: scratch.

    In loops of one kind each, of which all but the second are vectorised.
    """
    last = row.size - 3.0
    if last < 1.0:
        out[: at.size] = np.nan
        return
    a, b, c, d = taps[0], taps[1], taps[2], taps[3]
    for k in range(at.size):
        inside = (at[k] >= 1.0) & (at[k] <= last)  # false for NaN
        at[k] = at[k] if inside else np.nan
    for k in range(at.size):
        i = int(at[k]) if at[k] >= 1.0 else 1
        a[k], b[k], c[k], d[k] = row[i - 1], row[i], row[i + 1], row[i + 2]
    for k in range(at.size):
        value = four_point_value(a[k], b[k], c[k], d[k], at[k] - np.floor(at[k]))
        known = (a[k] != 0.0) & (b[k] != 0.0) & (c[k] != 0.0) & (d[k] != 0.0)
        out[k] = value if known else np.nan


@kernel
def _warp(image: NDArray, x: Floats, out: Floats) -> None:
    at, taps = np.empty(x.shape[1]), np.empty((4, x.shape[1]), image.dtype)
    for y in range(len(x)):
        at[:] = x[y]
        values_in_row(image[y], at, taps, out[y])


def warp_rows(image: NDArray[np.floating], x: Floats) -> Floats:
    """Values float64[h, w] of an image [h, W] at columns ``x`` [h, w] of the same rows.

    Cubic convolution of four pixels. NaN where x is NaN, where one of the four columns is nodata
    (0) or outside the image.
    """
    out = np.empty(x.shape)
    _warp(*(np.ascontiguousarray(values, np.float64) for values in (image, x)), out)
    return out


@dataclass
class CorrelationSum:
    """Sums of two images' values, from which their correlation coefficient follows."""

    count: int = 0
    a: float = 0.0
    b: float = 0.0
    aa: float = 0.0
    bb: float = 0.0
    ab: float = 0.0

    def add(self, a: Floats, b: Floats) -> None:
        """Add pairs of finite values."""
        self.count += a.size
        self.a += float(a.sum())
        self.b += float(b.sum())
        self.aa += float((a * a).sum())
        self.bb += float((b * b).sum())
        self.ab += float((a * b).sum())

    def merge(self, other: CorrelationSum) -> None:
        """Add the sums of other pixels."""
        for name in ("count", "a", "b", "aa", "bb", "ab"):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def coefficient(self) -> float:
        """Pearson's; NaN for fewer than two pairs or a constant image."""
        n = self.count
        if n < 2:
            return float("nan")
        va, vb = self.aa - self.a**2 / n, self.bb - self.b**2 / n
        if va <= 0 or vb <= 0:
            return float("nan")
        return (self.ab - self.a * self.b / n) / float(np.sqrt(va * vb))

    def match(self, b: Floats) -> Floats:
        """``b`` brought to the brightness of ``a`` by the linear regression of a on b."""
        n = max(self.count, 1)
        variance = self.bb - self.b**2 / n
        gain = (self.ab - self.a * self.b / n) / variance if variance > 0 else 1.0
        return gain * (b - self.b / n) + self.a / n


def warp_window(right: Any, disparity: Floats, rows: slice, cols: slice) -> Floats:
    """The right image (array [y, x], may be Zarr) in the left geometry of a window, NaN unlabelled.

    ``disparity`` float64[h, w] px of the window.
    """
    x = np.arange(cols.start, cols.stop)[None, :] - disparity
    known = np.isfinite(x)
    if not known.any():
        return np.full(disparity.shape, np.nan)
    first = max(int(np.floor(x[known].min())) - 2, 0)
    last = min(int(np.ceil(x[known].max())) + 3, right.shape[1])
    if last - first < 4:
        return np.full(disparity.shape, np.nan)
    part = np.asarray(right[rows, first:last], dtype=np.float64)
    return warp_rows(part, x - first)


def agreement(left: Floats, warped: Floats) -> CorrelationSum:
    """Sums over the pixels that both images show: left (0 is nodata), warped (NaN: none)."""
    total = CorrelationSum()
    good = np.isfinite(warped) & (left != 0)
    total.add(left[good], warped[good])
    return total
