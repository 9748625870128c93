"""Interpolation against SciPy's splines, and against functions that it reproduces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from stereotruth.core.numerics.interpolation import (
    bilinear,
    cubic_slopes,
    cubic_weights,
    four_point_value,
    four_point_weights,
    six_point_kernel,
    six_point_weights,
    six_point_weights_of_row,
)

PLACES = np.linspace(0.0, 1.0, 21)


def test_weights_and_slopes_of_b_splines_are_those_of_scipy():
    knots = np.arange(-3.0, 5.0)  # the cell from 0 to 1 has all four
    for f in PLACES:
        for k, (weight, slope) in enumerate(zip(cubic_weights(f), cubic_slopes(f))):
            basis = BSpline(knots, np.eye(4)[k], 3)
            assert weight == pytest.approx(float(basis(f)), abs=1e-14)
            assert slope == pytest.approx(float(basis.derivative()(f)), abs=1e-14)


def surface(col, row):
    return 3.0 + 0.5 * col - 2.0 * row + 0.25 * col * row


def test_a_bilinear_surface_comes_out_exactly_and_nothing_beside_it():
    row, col = np.mgrid[0:5, 0:7].astype(float)
    grid, rng = surface(col, row), np.random.default_rng(1)
    x, y = rng.uniform(0, 6, (3, 40)), rng.uniform(0, 4, (3, 40))
    x[0, 0], y[0, 0] = 6.0, 4.0
    assert bilinear(grid, x, y) == pytest.approx(surface(x, y), abs=1e-12)
    assert np.isnan(bilinear(grid, [-0.01, 6.01, 3.0, np.nan], [1.0, 1.0, 4.01, 1.0])).all()
    grid[2, 3] = np.nan
    known = np.isfinite(bilinear(grid, [2.5, 2.5, 4.5, 3.0, 1.5], [1.5, 3.5, 1.5, 2.0, 1.5]))
    assert known.tolist() == [False, True, True, False, True]


def test_four_points_reproduce_quadratic_polynomials():
    for power in range(3):
        samples = np.arange(-1.0, 3.0) ** power
        assert four_point_value(*samples, PLACES) == pytest.approx(PLACES**power, abs=1e-14)
        for f in PLACES:
            weights = np.empty(4)
            four_point_weights(f, weights)
            assert weights @ samples == pytest.approx(f**power, abs=1e-13)


def test_six_points_reproduce_cubic_polynomials():
    row = np.empty((6, PLACES.size), np.float32)
    six_point_weights_of_row(PLACES.astype(np.float32), row)
    for k, f in enumerate(PLACES):
        weights = np.empty(6)
        six_point_weights(f, -2, 1.0, weights)
        for power in range(4):
            assert weights @ np.arange(-2.0, 4.0) ** power == pytest.approx(f**power, abs=1e-12)
        assert weights == pytest.approx(row[:, k], abs=1e-6)
        by_kernel = [six_point_kernel(f - tap) for tap in range(-2, 4)]
        assert weights == pytest.approx(by_kernel, abs=1e-12)


def test_a_widened_kernel_keeps_a_ramp():
    weights = np.empty(12)
    six_point_weights(10.3, 5, 2.0, weights)
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    assert weights @ np.arange(5.0, 17.0) == pytest.approx(10.3, abs=0.02)
