"""Cubic convolution against polynomials, which it reproduces."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.interpolation import (
    four_point_value,
    four_point_weights,
    six_point_kernel,
    six_point_weights,
    six_point_weights_of_row,
)

PLACES = np.linspace(0.0, 1.0, 21)


@pytest.mark.parametrize("power", [0, 1, 2])
def test_four_points_reproduce_quadratic_polynomials(power):
    samples = np.arange(-1.0, 3.0) ** power
    assert four_point_value(*samples, PLACES) == pytest.approx(PLACES**power, abs=1e-14)


def test_weights_of_four_points_give_their_value():
    samples = np.random.default_rng(1).uniform(1, 2000, 4)
    for f in PLACES:
        weights = np.empty(4)
        four_point_weights(f, weights)
        assert weights.sum() == pytest.approx(1.0, abs=1e-14)
        assert weights @ samples == pytest.approx(four_point_value(*samples, f), rel=1e-13)


@pytest.mark.parametrize("power", [0, 1, 2, 3])
def test_six_points_reproduce_cubic_polynomials(power):
    row = np.empty((6, PLACES.size), np.float32)
    six_point_weights_of_row(PLACES.astype(np.float32), row)
    for k, f in enumerate(PLACES):
        weights = np.empty(6)
        six_point_weights(f, -2, 1.0, weights)
        assert weights @ np.arange(-2.0, 4.0) ** power == pytest.approx(f**power, abs=1e-12)
        assert weights == pytest.approx(row[:, k], abs=1e-6)
        assert weights == pytest.approx(
            [six_point_kernel(f - tap) for tap in range(-2, 4)], abs=1e-12
        )


def test_a_widened_kernel_keeps_a_ramp_and_weighs_as_far_as_it_is_wide():
    weights = np.empty(12)
    six_point_weights(10.3, 5, 2.0, weights)
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    assert weights @ np.arange(5.0, 17.0) == pytest.approx(10.3, abs=0.02)
    assert six_point_kernel(3.0) == six_point_kernel(-3.5) == 0.0
    assert six_point_kernel(0.0) == 1.0
