"""The resampling kernel against its formula."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.resampling import resample


def test_interpolation_error_of_the_kernel() -> None:
    """Against the exact wave; bicubic (a = -0.5) and OpenCV's for comparison, in the comments."""
    col, row = np.meshgrid(np.arange(200.0), np.arange(200.0))
    rng = np.random.default_rng(0)
    at = rng.uniform(5, 190, (2, 9, 9))
    for length, tolerance in ((4.0, 0.045), (6.0, 0.008), (10.0, 0.0015)):
        wave = 10000 + 8000 * np.sin(2 * np.pi / length * (col + 0.3 * row))
        got = np.empty(81)
        for k in range(81):
            lattice = np.repeat(np.repeat(at.reshape(2, 81)[:, k, None, None], 2, 1), 2, 2)
            out = np.zeros((1, 1), dtype=np.uint16)
            assert resample(wave.astype(np.float32), lattice, 16, (1.0, 1.0), out) == 1
            got[k] = out[0, 0]
        c, r = at.reshape(2, 81)
        exact = 10000 + 8000 * np.sin(2 * np.pi / length * (c + 0.3 * r))
        assert np.sqrt(np.mean((got - exact) ** 2)) / 8000 < tolerance


def keys_value(source: np.ndarray, col: float, row: float, scale: tuple[float, float]) -> float:
    """Keys (1981), section VI, as a double sum; NaN where a tap with weight has no value."""

    def kernel(s: np.ndarray) -> np.ndarray:
        s = np.abs(s)
        pieces = [
            (s < 1, 4 / 3 * s**3 - 7 / 3 * s**2 + 1),
            (s < 2, -7 / 12 * s**3 + 3 * s**2 - 59 / 12 * s + 15 / 6),
            (s < 3, 1 / 12 * s**3 - 2 / 3 * s**2 + 21 / 12 * s - 3 / 2),
        ]
        return np.select(*zip(*pieces), 0.0)

    taps = []
    for axis, at in enumerate((col, row)):
        reach = int(np.ceil(3 * scale[axis])) + 1
        first = int(np.floor(at)) - reach
        numbers = np.arange(first, first + 2 * reach + 1)
        weights = kernel((at - numbers) / scale[axis])
        taps.append((numbers, weights / weights.sum()))
    total = 0.0
    for c, across in zip(*taps[0]):
        for r, down in zip(*taps[1]):
            if min(abs(across), abs(down)) > 1e-6:
                there = 0 <= c < source.shape[1] and 0 <= r < source.shape[0]
                total += across * down * source[r, c] if there else np.nan
    return total


@pytest.mark.parametrize(
    ("angle", "scale"), [(3.0, (1.0, 1.0)), (200.0, (1.0, 1.0)), (90.4, (1.7, 1.3))]
)
def test_values_are_those_of_the_formula(angle: float, scale: tuple[float, float]) -> None:
    """With holes of nodata, and past all four edges; of white noise over all of uint16."""
    rng = np.random.default_rng(1)
    source = rng.integers(1, 65535, (29, 37)).astype(np.float32)
    source[rng.random(source.shape) < 0.004] = np.nan
    step = 16
    x, y = np.meshgrid(*2 * [np.arange(0, 64 + step, step) - 32.0])
    turn = np.radians(angle)
    lattice = np.stack(
        [
            18.3 + scale[0] * (np.cos(turn) * x - np.sin(turn) * y),
            14.4 + scale[1] * (np.sin(turn) * x + np.cos(turn) * y),
        ]
    )
    out = np.zeros((58, 61), dtype=np.uint16)
    count = resample(source, lattice, step, scale, out)
    assert count == np.count_nonzero(out) > 100
    y, x = np.indices(out.shape)
    fine = [np.array([[bilinear(a, i, j, step) for i in x[0]] for j in y[:, 0]]) for a in lattice]
    expected = np.array(
        [[keys_value(source, c, r, scale) for c, r in zip(*line)] for line in zip(*fine)]
    )
    inside = (
        (fine[0] >= -0.5)
        & (fine[1] >= -0.5)
        & (fine[0] <= source.shape[1] - 0.5)
        & (fine[1] <= source.shape[0] - 0.5)
    )
    assert np.array_equal(out > 0, inside & np.isfinite(expected))
    error = out[out > 0] - np.clip(expected[out > 0], 1, 65535)
    assert np.abs(error).max() < 0.53  # float32 sums; measured 0.517


def bilinear(nodes: np.ndarray, x: int, y: int, step: int) -> float:
    (i, f), (j, g) = divmod(x, step), divmod(y, step)
    f, g = f / step, g / step
    near, far = ((1 - f) * nodes[k, i] + f * nodes[k, i + 1] for k in (j, j + 1))
    return (1 - g) * near + g * far


def test_the_window_of_the_source_does_not_matter() -> None:
    """Bits are the same wherever the source's window begins, and where a tile's row does."""
    rng = np.random.default_rng(3)
    source = rng.integers(1, 65535, (400, 400)).astype(np.float32)
    source[150:153, 220] = np.nan
    x, y = np.meshgrid(*2 * [np.arange(0.0, 208, 16)])
    lattice = np.stack([320.1 - 1.013 * y + 0.01 * x, 93.7 + 0.987 * x - 0.02 * y])
    whole = np.zeros((192, 192), dtype=np.uint16)
    resample(source, lattice, 16, (1.0, 1.0), whole)
    assert (whole == 0).any()
    window = np.ascontiguousarray(source[86:300, 105:331])
    moved = lattice - np.array([105, 86])[:, None, None]
    part = np.zeros((160, 176), dtype=np.uint16)
    resample(window, moved[:, 2:, 1:].copy(), 16, (1.0, 1.0), part)
    assert np.array_equal(part, whole[32:, 16:])


def test_whole_pixels_are_copied() -> None:
    """No tap but the pixel's own has weight there: nodata beside it and edges do not matter."""
    source = np.random.default_rng(0).integers(1, 60000, (16, 16)).astype(np.float32)
    source[7, 7] = np.nan
    lattice = np.stack(np.meshgrid([0.0, 16.0], [0.0, 16.0]))
    out = np.zeros((16, 16), dtype=np.uint16)
    assert resample(source, lattice, 16, (1.0, 1.0), out) == 255
    expected = np.nan_to_num(source)
    assert np.array_equal(out, expected)
