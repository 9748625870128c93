"""Warping along rows."""

from __future__ import annotations

import numpy as np

from stereotruth.epipolar import warping


def test_warping_is_exact_on_quadratics_and_skips_nodata():
    x = np.arange(30.0)
    image = np.vstack([2 * x**2 - 3 * x + 500, np.where(x == 12, 0, 700)])
    at = np.vstack([np.linspace(1, 27, 14), np.linspace(5, 20, 14)])
    warped = warping.warp_rows(image, at)
    assert np.allclose(warped[0], 2 * at[0] ** 2 - 3 * at[0] + 500)
    spoilt = (np.floor(at[1]) >= 10) & (np.floor(at[1]) <= 13)
    assert np.array_equal(np.isnan(warped[1]), spoilt)
    assert np.isnan(warping.warp_rows(image, np.array([[0.5, np.nan], [27.5, 40.0]]))).all()
