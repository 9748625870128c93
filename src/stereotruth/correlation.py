"""The paper's filter (section III-C): do both images show the same around a projected point?

A window is centred on the point's sub-pixel position in each rectified image and sampled there by
bilinear interpolation; the filter's measure is the correlation coefficient of the two windows.

- Result in [-1, 1] up to rounding (float32 arithmetic on centred samples).
- 0 where either window is constant: no texture is no evidence that the place is the same.
- NaN where a pixel that the interpolation may touch, (window + 1)² in each image, is nodata or
  lies outside the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# Samples of a window row that are worked on at once; a constant, so that LLVM uses vector
# registers: 4.1 M points/s per core (window 9) against 2.2 M/s.
LANES = 16


class Array2D(Protocol):
    """What is read of an image: a NumPy or Zarr array [y, x], uint16, 0 for nodata."""

    shape: tuple[int, ...]

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]: ...


@dataclass(frozen=True)
class Patch:
    """Part of an image, ready for the filter.

    ``pixels`` float32 [rows, cols], zero outside the image, with LANES + 1 more columns than
    ``usable`` has. ``usable`` uint8: 1 where a window whose centre lies in [col, col + 1) x
    [row, row + 1) touches neither nodata nor the image's edge. (``row``, ``col``) is the image's
    pixel at the patch's origin.
    """

    pixels: NDArray[np.float32]
    usable: NDArray[np.uint8]
    row: int
    col: int


def read_patch(image: Array2D, rows: slice, cols: slice, window: int) -> Patch:
    """The patch that serves points with ``rows``, ``cols`` [start, stop) as nearest pixels.

    ``rows`` and ``cols`` may reach beyond the image. ``window`` (odd, px) = 1 asks for no more
    than the four pixels of a bilinear interpolation.
    """
    half = window // 2
    row, col = rows.start - half - 1, cols.start - half - 1
    height, width = rows.stop + half + 1 - row, cols.stop + half + 1 - col
    spare = -(-window // LANES) * LANES + 1
    pixels = np.zeros((height + 1, width + spare), dtype=np.float32)
    top, bottom = max(row, 0), min(row + height + 1, image.shape[0])
    left, right = max(col, 0), min(col + width + 1, image.shape[1])
    if top < bottom and left < right:
        pixels[top - row : bottom - row, left - col : right - col] = image[top:bottom, left:right]
    # Count of nodata pixels in [-half, half + 1]² around every pixel, by an integral image.
    bad = np.zeros((height + 2, width + 2), dtype=np.int32)
    np.cumsum(pixels[:, : width + 1] == 0.0, axis=0, dtype=np.int32, out=bad[1:, 1:])
    np.cumsum(bad, axis=1, out=bad)
    n = 2 * half + 2
    usable = np.zeros((height, width), dtype=np.uint8)
    inner = bad[n:, n:] - bad[:-n, n:] - bad[n:, :-n] + bad[:-n, :-n] == 0
    usable[half : half + inner.shape[0], half : half + inner.shape[1]] = inner
    return Patch(pixels, usable, row, col)


@njit(cache=True, nogil=True, error_model="numpy")
def _in_frame(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    left_origin: tuple[int, int],
    right_origin: tuple[int, int],
    xy: Floats,
    out: NDArray[np.bool_],
) -> None:
    for k in range(xy.shape[1]):
        c = int(np.floor(xy[0, k])) - left_origin[1]
        r = int(np.floor(xy[1, k])) - left_origin[0]
        ok = 0 <= r < left.shape[0] and 0 <= c < left.shape[1] and left[r, c] != 0
        if ok:
            c = int(np.floor(xy[2, k])) - right_origin[1]
            r = int(np.floor(xy[3, k])) - right_origin[0]
            ok = 0 <= r < right.shape[0] and 0 <= c < right.shape[1] and right[r, c] != 0
        out[k] = ok


def in_frame(left: Patch, right: Patch, xy: Floats) -> NDArray[np.bool_]:
    """Whether both windows of each point can be sampled; ``xy`` [4, n] as in :func:`correlate`."""
    out = np.empty(xy.shape[1], dtype=np.bool_)
    _in_frame(left.usable, right.usable, (left.row, left.col), (right.row, right.col), xy, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sample(pixels, base, width, fx, fy, rows, across, out):
    """``out`` [rows * LANES]: bilinear samples; unsigned indices need no test of their sign."""
    for i in range(uint64(rows + 1)):
        start = base + i * width
        for j in range(uint64(LANES)):
            value = pixels[start + j]
            across[i * uint64(LANES) + j] = value + fx * (pixels[start + j + uint64(1)] - value)
    for k in range(uint64(rows * LANES)):
        out[k] = across[k] + fy * (across[k + uint64(LANES)] - across[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _correlate(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    left_usable: NDArray[np.uint8],
    right_usable: NDArray[np.uint8],
    left_origin: tuple[int, int],
    right_origin: tuple[int, int],
    xy: Floats,
    window: int,
    out: NDArray[np.float32],
) -> None:
    """``left`` and ``right`` are the patches' pixels, flat."""
    half = window // 2
    parts = (window + LANES - 1) // LANES
    left_width = left_usable.shape[1] + parts * LANES + 1
    right_width = right_usable.shape[1] + parts * LANES + 1
    size = window * LANES
    a = np.empty((parts, size), np.float32)
    b = np.empty((parts, size), np.float32)
    across = np.empty(size + LANES, np.float32)
    s = np.empty((3, LANES), np.float32)
    count = np.float32(window * window)
    for k in range(xy.shape[1]):
        left_col, left_row = int(np.floor(xy[0, k])), int(np.floor(xy[1, k]))
        right_col, right_row = int(np.floor(xy[2, k])), int(np.floor(xy[3, k]))
        c, r = left_col - left_origin[1], left_row - left_origin[0]
        d, q = right_col - right_origin[1], right_row - right_origin[0]
        if not (
            0 <= r < left_usable.shape[0]
            and 0 <= c < left_usable.shape[1]
            and 0 <= q < right_usable.shape[0]
            and 0 <= d < right_usable.shape[1]
            and left_usable[r, c] != 0
            and right_usable[q, d] != 0
        ):
            out[k] = np.nan
            continue
        mean_a = np.float32(0.0)
        mean_b = np.float32(0.0)
        for part in range(parts):
            at = part * LANES - half
            _sample(
                left,
                uint64((r - half) * left_width + c + at),
                uint64(left_width),
                np.float32(xy[0, k] - left_col),
                np.float32(xy[1, k] - left_row),
                window,
                across,
                a[part],
            )
            _sample(
                right,
                uint64((q - half) * right_width + d + at),
                uint64(right_width),
                np.float32(xy[2, k] - right_col),
                np.float32(xy[3, k] - right_row),
                window,
                across,
                b[part],
            )
            s[:2] = 0.0
            for i in range(uint64(window)):
                for j in range(uint64(LANES)):
                    s[0, j] += a[part, i * uint64(LANES) + j]
                    s[1, j] += b[part, i * uint64(LANES) + j]
            for j in range(min(LANES, window - part * LANES)):
                mean_a += s[0, j]
                mean_b += s[1, j]
        # By division, so that a constant window gives exactly its value, and variance 0.
        mean_a /= count
        mean_b /= count
        aa = np.float32(0.0)
        bb = np.float32(0.0)
        ab = np.float32(0.0)
        for part in range(parts):
            s[:] = 0.0
            for i in range(uint64(window)):
                for j in range(uint64(LANES)):
                    u = a[part, i * uint64(LANES) + j] - mean_a
                    v = b[part, i * uint64(LANES) + j] - mean_b
                    s[0, j] += u * u
                    s[1, j] += v * v
                    s[2, j] += u * v
            for j in range(min(LANES, window - part * LANES)):
                aa += s[0, j]
                bb += s[1, j]
                ab += s[2, j]
        out[k] = ab / np.sqrt(aa * bb) if aa > 0.0 and bb > 0.0 else 0.0


def correlate(left: Patch, right: Patch, xy: Floats, window: int) -> NDArray[np.float32]:
    """Correlation coefficient of the two windows of each point, float32[n]; see the module.

    ``xy`` float64[4, n] = x_left, y_left, x_right, y_right in px of the rectified images; the
    patches must have been read for this ``window`` (odd, px). A point's value does not depend on
    the others or on the patch.
    """
    out = np.empty(xy.shape[1], dtype=np.float32)
    _correlate(
        left.pixels.reshape(-1),
        right.pixels.reshape(-1),
        left.usable,
        right.usable,
        (left.row, left.col),
        (right.row, right.col),
        np.ascontiguousarray(xy),
        window,
        out,
    )
    return out
