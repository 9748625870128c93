"""One label per pixel from the points that passed: exact sums, then a plane to the pixel's centre.

- ``top``: mean longitude, latitude and height of the points on the surface that the pixel's centre
  sees. The mean lies beside the centre; a plane through the means of the pixel and those of its
  neighbours on the same surface takes the disparity there. No bias by the largest of several noisy
  heights, by slopes, or by mixture where a roof's edge and the ground share a pixel.
- ``paper``: mean longitude and latitude of all points, height of the highest (section III-C).

Sums are of integers, so that the order of the points leaves no trace; what is computed from
neighbours takes them in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .epipolar import EpipolarModel
from .occlusion import SURFACE_PX, box_sum, exact_sums
from .points import LATTICE_DEG, LATTICE_M, Points

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

REPRESENTATIVES = ("top", "paper")
# What airborne LiDAR has at least (m): floor of the points' noise, however few and alike they are.
HEIGHT_NOISE_M = 0.02
FEW = 3  # degrees of freedom below which the points' own spread says nothing:
FEW_NOISE_M = 0.05  # then this is taken
_PER_PX = 1 << 16  # positions, disparities and correlations are summed as integers of 2^-16 px
_PER_DEG, _PER_M = round(1 / LATTICE_DEG), round(1 / LATTICE_M)
RIDGE = 0.1  # px², keeps planes through places in a line level across it


@dataclass(frozen=True, eq=False)
class Pixels:
    """What the points of each pixel come to; arrays [h, w], NaN (0) where a pixel has none.

    ``sums`` [h * w, 4] of :func:`stereotruth.occlusion.exact_sums`; ``count``; ``x``, ``y`` (px,
    left grid) and ``disparity`` (px) of the representative point;
    ``highest`` (m); ``correlation`` mean of the points'; ``surface_class`` ASPRS class of the
    highest point; ``moments`` [h, w, 6]: sums over the points, about their mean, of uu, uv, vv, uz,
    vz, zz, with (u, v) the place in the left grid and z the disparity, px².
    """

    sums: NDArray[np.int64]
    count: NDArray[np.int64]
    x: Floats
    y: Floats
    disparity: Floats
    highest: Floats
    correlation: Floats
    surface_class: NDArray[np.uint8]
    moments: Floats


@njit(cache=True, nogil=True, error_model="numpy")
def _collect(
    pixel: NDArray[np.int64],
    use: Bools,
    h_q: NDArray[np.int64],
    classification: NDArray[np.uint8],
    xy: Floats,
    means: Floats,
    correlation: NDArray[np.float32],
    top: NDArray[np.int64],
    sums: NDArray[np.int64],
) -> None:
    """``top`` [n, 2]: greatest height and the class there (of equals, the greater).

    ``sums`` [n, 10]: u, v, z, uu, uv, vv, uz, vz, zz about ``means`` [n, 3], and correlation.
    """
    for k in range(pixel.size):
        if not use[k]:
            continue
        i = pixel[k]
        if h_q[k] > top[i, 0] or (h_q[k] == top[i, 0] and classification[k] > top[i, 1]):
            top[i, 0] = h_q[k]
            top[i, 1] = classification[k]
        u = np.int64(np.rint((xy[0, k] - means[i, 0]) * _PER_PX))
        v = np.int64(np.rint((xy[1, k] - means[i, 1]) * _PER_PX))
        z = np.int64(np.rint((xy[0, k] - xy[2, k] - means[i, 2]) * _PER_PX))
        sums[i, 0] += u
        sums[i, 1] += v
        sums[i, 2] += z
        sums[i, 3] += u * u
        sums[i, 4] += u * v
        sums[i, 5] += v * v
        sums[i, 6] += u * z
        sums[i, 7] += v * z
        sums[i, 8] += z * z
        if correlation.size:
            sums[i, 9] += np.int64(np.rint(np.float64(correlation[k]) * _PER_PX))


def condense(
    model: EpipolarModel,
    points: Points,
    xy: Floats,
    pixel: NDArray[np.int64],
    use: Bools,
    correlation: NDArray[np.float32] | None,
    shape: tuple[int, int],
    representative: str,
) -> Pixels:
    """The pixels of a window from its points in ``use``.

    ``xy`` [4, n] are x_left, y_left, x_right, y_right of the points in px, ``pixel`` their
    row-major index into ``shape``, ``correlation`` [n] theirs or None.
    """
    size = shape[0] * shape[1]
    lattice = exact_sums(points, pixel, use, size)
    count = lattice[:, 0]
    found = np.flatnonzero(count)
    n = count[found]
    lon, lat = lattice[found, 1] / n / _PER_DEG, lattice[found, 2] / n / _PER_DEG
    place = model.ground_to_epipolar(lon, lat, lattice[found, 3] / n / _PER_M)
    means = np.full((size, 3), np.nan)
    means[found] = np.stack([place[0], place[1], place[0] - place[2]], axis=1)
    top = np.full((size, 2), np.iinfo(np.int64).min)
    sums = np.zeros((size, 10), dtype=np.int64)
    nothing = np.empty(0, dtype=np.float32)
    _collect(
        pixel,
        use,
        points.h_q,
        points.classification,
        xy,
        means,
        nothing if correlation is None else correlation,
        top,
        sums,
    )
    highest, mean = np.full(size, np.nan), np.full(size, np.nan)
    highest[found] = top[found, 0] / _PER_M
    if correlation is not None:
        mean[found] = sums[found, 9] / n / _PER_PX
    surface_class = np.zeros(size, dtype=np.uint8)
    surface_class[found] = top[found, 1]
    u, v, z = (sums[:, k].astype(np.float64) for k in range(3))
    crossed = np.stack([u * u, u * v, v * v, u * z, v * z, z * z], axis=1)
    moments = (sums[:, 3:9] - crossed / np.maximum(count, 1)[:, None]) / float(_PER_PX) ** 2
    if representative == "paper":
        place = model.ground_to_epipolar(lon, lat, highest[found])
        means[found] = np.stack([place[0], place[1], place[0] - place[2]], axis=1)
    return Pixels(
        sums=lattice,
        count=count.reshape(shape),
        x=means[:, 0].reshape(shape),
        y=means[:, 1].reshape(shape),
        disparity=means[:, 2].reshape(shape),
        highest=highest.reshape(shape),
        correlation=mean.reshape(shape),
        surface_class=surface_class.reshape(shape),
        moments=moments.reshape(*shape, 6),
    )


@dataclass(frozen=True, eq=False)
class Labels:
    """Disparities (px) at the centres of pixels, arrays [h, w], NaN where there is none.

    ``slope`` [2, h, w]: of the disparity along x and y; ``variance`` (px²) of the disparity from
    the points alone.
    """

    disparity: Floats
    slope: Floats
    variance: Floats


@njit(cache=True, nogil=True, error_model="numpy")
def _plane(
    disparity: Floats,
    x: Floats,
    y: Floats,
    first_row: int,
    first_col: int,
    label: Floats,
    slope: Floats,
    spread: Floats,
) -> None:
    """``spread``: variance (px²) that the slopes' uncertainty brings to the label."""
    rows, cols = disparity.shape
    for j in range(rows):
        for i in range(cols):
            here = disparity[j, i]
            label[j, i] = here
            if not np.isfinite(here):
                continue
            n = 0
            su = sv = sz = suu = suv = svv = suz = svz = szz = 0.0
            for b in range(max(j - 1, 0), min(j + 2, rows)):
                for a in range(max(i - 1, 0), min(i + 2, cols)):
                    z = disparity[b, a] - here
                    if abs(z) <= SURFACE_PX:  # also false for NaN
                        u, v = x[b, a] - x[j, i], y[b, a] - y[j, i]
                        n += 1
                        su += u
                        sv += v
                        sz += z
                        suu += u * u
                        suv += u * v
                        svv += v * v
                        suz += u * z
                        svz += v * z
                        szz += z * z
            if n < 5:
                continue
            suu += RIDGE - su * su / n
            svv += RIDGE - sv * sv / n
            suv -= su * sv / n
            suz -= su * sz / n
            svz -= sv * sz / n
            szz -= sz * sz / n
            det = suu * svv - suv * suv
            gx = (suz * svv - svz * suv) / det
            gy = (svz * suu - suz * suv) / det
            u, v = first_col + i - x[j, i], first_row + j - y[j, i]
            label[j, i] = here + gx * u + gy * v
            slope[0, j, i] = gx
            slope[1, j, i] = gy
            rest = max(szz - gx * suz - gy * svz, 0.0) / (n - 3)
            spread[j, i] = rest * (u * u * svv - 2.0 * u * v * suv + v * v * suu) / det


def at_centres(pixels: Pixels, valid: Bools, first: tuple[int, int], px_per_m: float) -> Labels:
    """Labels of the ``valid`` pixels of a window whose first pixel is (row, col) ``first``.

    Pixels with fewer than four neighbours on their surface keep the disparity of their point. The
    outermost ring of pixels lacks neighbours. ``px_per_m``: disparity of a metre of height.
    """
    disparity = np.where(valid, pixels.disparity, np.nan)
    label = np.empty(disparity.shape)
    slope, spread = np.zeros((2, *disparity.shape)), np.zeros(disparity.shape)
    _plane(disparity, pixels.x, pixels.y, *first, label, slope, spread)
    variance = _noise(pixels, valid, slope, px_per_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.where(valid, variance / pixels.count + spread, np.nan)
    return Labels(label, slope, variance)


def at_points(pixels: Pixels, valid: Bools, px_per_m: float) -> Labels:
    """As :func:`at_centres`, with the disparity of each pixel's representative point."""
    level = np.zeros((2, *valid.shape))
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = _noise(pixels, valid, level, px_per_m) / pixels.count
    return Labels(
        np.where(valid, pixels.disparity, np.nan), level, np.where(valid, variance, np.nan)
    )


def _noise(pixels: Pixels, valid: Bools, slope: Floats, px_per_m: float) -> Floats:
    """Variance (px²) of a point's disparity about its surface, pooled over 3 x 3 pixels."""
    uu, uv, vv, uz, vz, zz = np.moveaxis(pixels.moments, -1, 0)
    gx, gy = slope
    rest = zz - 2.0 * (gx * uz + gy * vz) + gx * gx * uu + 2.0 * gx * gy * uv + gy * gy * vv
    squares = box_sum(np.where(valid, np.maximum(rest, 0.0), 0.0))
    freedom = box_sum(np.where(valid, pixels.count - 1.0, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.where(freedom >= FEW, squares / freedom, (FEW_NOISE_M * px_per_m) ** 2)
    return np.maximum(variance, (HEIGHT_NOISE_M * px_per_m) ** 2)
