"""Bilinear interpolation against functions that it reproduces."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.numerics.interpolation import bilinear


def surface(col, row):
    return 3.0 + 0.5 * col - 2.0 * row + 0.25 * col * row


ROW, COL = np.mgrid[0:5, 0:7].astype(float)
GRID = surface(COL, ROW)


def test_a_bilinear_surface_comes_out_exactly_also_at_the_last_samples():
    rng = np.random.default_rng(1)
    col, row = rng.uniform(0, 6, (3, 40)), rng.uniform(0, 4, (3, 40))
    col[0, 0], row[0, 0] = 6.0, 4.0
    assert bilinear(GRID, col, row) == pytest.approx(surface(col, row), abs=1e-12)
    assert float(bilinear(GRID, 1.5, 2.5)) == pytest.approx(surface(1.5, 2.5))


def test_nothing_is_known_outside_and_beside_a_sample_that_is_not():
    assert np.isnan(bilinear(GRID, [-0.01, 6.01, 3.0, np.nan], [1.0, 1.0, 4.01, 1.0])).all()
    holes = GRID.copy()
    holes[2, 3] = np.nan
    known = np.isfinite(bilinear(holes, [2.5, 2.5, 4.5, 3.0, 1.5], [1.5, 3.5, 1.5, 2.0, 1.5]))
    assert known.tolist() == [False, True, True, False, True]
    assert np.isnan(bilinear(holes, 2.5, 2.5))
