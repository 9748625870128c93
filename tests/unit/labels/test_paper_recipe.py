"""The correlation filter against SciPy's interpolation and NumPy's correlation coefficient."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from stereotruth.labels.pair_window import PairWindow, read_patch
from stereotruth.labels.paper_recipe import correlate, points_of
from stereotruth.labels.window_points import PointBlock

SHAPE = (120, 160)
ROWS, COLS = slice(-6, 130), slice(-6, 180)


def value_of(left, right, xy, window, rows=ROWS, cols=COLS, order=None) -> np.ndarray:
    """Coefficient by point, NaN for those that are not in both frames."""
    patches = [read_patch(image, rows, cols, window) for image in (left, right)]
    number = np.arange(xy.shape[1]) if order is None else order
    classes = np.zeros(number.size, np.uint8)
    block = PointBlock(number, number, number, classes, classes, xy[:, number])
    ground = SimpleNamespace(blocks=lambda: [block])
    points, _ = points_of(ground, PairWindow(rows, cols, 0, *patches))
    value = np.full(xy.shape[1], np.nan, dtype=np.float32)
    value[points.lon_q] = correlate(points, *patches, window)
    return value


def images() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    left, other = (gaussian_filter(rng.random(SHAPE), 1.2) * 20000 + 100 for _ in range(2))
    right = other.copy()
    right[:, 5:] = 0.7 * left[:, :-5] + 0.3 * other[:, 5:]
    return left.astype(np.uint16), right.astype(np.uint16)


def reference(left: np.ndarray, right: np.ndarray, xy: np.ndarray, window: int) -> np.ndarray:
    """Point by point in float64; NaN where a window leaves an image or meets a zero."""
    half = window // 2
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1]
    out = np.full(xy.shape[1], np.nan)
    for k in range(xy.shape[1]):
        samples = []
        for image, x, y in ((left, xy[0, k], xy[1, k]), (right, xy[2, k], xy[3, k])):
            c, r = int(np.floor(x)), int(np.floor(y))
            if min(c, r) - half < 0 or c + half + 1 >= SHAPE[1] or r + half + 1 >= SHAPE[0]:
                break
            if (image[r - half : r + half + 2, c - half : c + half + 2] == 0).any():
                break
            at = [y + rows, x + cols]
            samples.append(map_coordinates(image.astype(float), at, order=1).ravel())
        else:
            out[k] = np.corrcoef(*samples)[0, 1]
    return out


@pytest.mark.parametrize("window", [3, 9])
def test_against_numpy_and_scipy(window) -> None:
    """Within 1e-6; the same points are in both frames."""
    left, right = images()
    left[60:63, 80:83] = 0
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-4, SHAPE[1] + 4, 1500), rng.uniform(-4, SHAPE[0] + 4, 1500)
    x[:100], y[:100] = np.round(x[:100]), np.round(y[:100])
    xy = np.stack([x, y, x + rng.uniform(3, 7, x.size), y + rng.uniform(-0.49, 0.49, x.size)])
    xy = np.round(xy * 65536) / 65536  # as places are stored
    value = value_of(left, right, xy, window)
    expected = reference(left, right, xy, window)
    assert np.array_equal(np.isnan(value), np.isnan(expected))
    assert 300 < np.isfinite(value).sum() < 1500
    assert np.nanmax(np.abs(value - expected)) < 1e-6


def test_a_value_depends_on_nothing_but_its_point() -> None:
    left, right = images()
    rng = np.random.default_rng(2)
    xy = np.stack([rng.uniform(60, 90, 200), rng.uniform(50, 70, 200)] * 2)
    xy[2] += 5
    value = value_of(left, right, xy, 9)
    assert np.isfinite(value).all()
    part = slice(49, 72), slice(55, 110)
    assert np.array_equal(value, value_of(left, right, xy, 9, *part))
    assert np.array_equal(value, value_of(left, right, xy, 9, order=rng.permutation(200)))
    alone = value_of(left, right, xy, 9, order=np.array([7]))
    assert alone[7] == value[7]


def test_constant_windows_have_no_correlation() -> None:
    """Exactly 0 for every digital number, next to full range, and at any phase."""
    left, _ = images()
    rng = np.random.default_rng(3)
    xy = np.stack([rng.uniform(20, 100, 50), rng.uniform(20, 90, 50)] * 2)
    for number in (1, 77, 4095, 40_001, 65_535):
        flat = np.full(SHAPE, number, np.uint16)
        for pair in ((flat, left), (left, flat), (flat, flat)):
            assert (value_of(*pair, xy, 9) == 0.0).all()
    faint = np.full(SHAPE, 65_000, np.uint16) + (np.indices(SHAPE).sum(axis=0) % 3).astype(
        np.uint16
    )
    assert np.allclose(value_of(faint, faint, xy, 9), 1.0, atol=1e-4)
