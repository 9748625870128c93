"""B-spline weights against SciPy's splines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from stereotruth.core.numerics.interpolation import cubic_slopes, cubic_weights


@pytest.mark.parametrize("f", [0.0, 0.125, 0.5, 0.9, 1.0])
def test_weights_and_slopes_are_those_of_scipy(f):
    knots = np.arange(-3.0, 5.0)  # the cell from 0 to 1 has all four
    for k, (weight, slope) in enumerate(zip(cubic_weights(f), cubic_slopes(f))):
        basis = BSpline(knots, np.eye(4)[k], 3)
        assert weight == pytest.approx(float(basis(f)), abs=1e-14)
        assert slope == pytest.approx(float(basis.derivative()(f)), abs=1e-14)


def test_they_add_up_to_one_and_to_nothing():
    for f in np.linspace(0, 1, 11):
        assert sum(cubic_weights(f)) == pytest.approx(1.0, abs=1e-14)
        assert sum(cubic_slopes(f)) == pytest.approx(0.0, abs=1e-14)
