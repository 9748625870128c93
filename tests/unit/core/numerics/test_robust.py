"""Robust estimates of what is known, with blunders in it."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.statistics import (
    biweight,
    huber_weights,
    median_and_nmad,
    reweighted_fit,
    robust_sigma,
    tukey_weights,
)

TRUE = np.array([2.0, -0.5])


def line(blunders: float, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    x = rng.uniform(-5, 5, 400)
    y = TRUE[0] + TRUE[1] * x + rng.normal(0, noise, x.size)
    y[rng.choice(x.size, int(blunders * x.size), replace=False)] += 8.0
    return np.column_stack([np.ones(x.size), x]), y


def test_deviations_of_a_normal_distribution():
    errors = np.random.default_rng(2).normal(0.3, 0.5, 40000)
    assert median_and_nmad(errors) == pytest.approx((0.3, 0.5), abs=0.02)
    assert robust_sigma(errors - 0.3, 0.0) == pytest.approx(0.5, abs=0.02)
    assert robust_sigma(errors, 3.0) == 3.0


def test_weights_fall_from_one_to_nothing():
    assert biweight(np.array([0.0, 0.5, -0.5, 1.0, 7.0, np.nan])).tolist() == [
        1, 0.5625, 0.5625, 0, 0, 0,
    ]  # fmt: skip
    assert tukey_weights(np.array([0.0, 4.685])) == pytest.approx([1, 0])
    assert huber_weights(np.array([0.0, -1.345, 2.69])) == pytest.approx([1, 1, 0.5])


@pytest.mark.parametrize("weights", [tukey_weights, huber_weights])
def test_blunders_do_not_move_a_line(weights):
    design, values = line(blunders=0.2)
    plain = np.linalg.lstsq(design, values, rcond=None)[0]
    assert abs(plain[0] - TRUE[0]) > 1.0
    start = np.array([np.median(values), 0.0])
    found = reweighted_fit(design, values, weights, least_sigma=1e-4, start=start)
    # Huber's weight of a blunder is small and not nothing
    assert found == pytest.approx(TRUE, abs=0.012 if weights is tukey_weights else 0.06)


def test_exact_values_come_out_exactly():
    design, values = line(blunders=0.0, noise=0.0)
    found = reweighted_fit(design, values, huber_weights, least_sigma=1e-3)
    assert found == pytest.approx(TRUE, abs=1e-9)
