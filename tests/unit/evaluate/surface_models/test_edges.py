"""Edges that are formulas: where they stand, and how wide a model spreads them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from stereotruth.evaluate.surface_models.edges import EdgeErrors, Edges, measure

EAST = np.zeros(7)  # edges along the north, at x = 0


@pytest.mark.parametrize("sigma_m", [0.25, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("outward_m", [0.0, 0.9])
def test_resolution_is_the_spread_s_width_wherever_the_edge_lies(sigma_m, outward_m):
    edges = Edges(EAST, EAST, EAST + 1, EAST, EAST + 12, EAST + 2)
    seen = measure(edges, lambda x, y: 2 + 10 * ndtr((outward_m + 0.05 * y - x) / sigma_m))
    errors = EdgeErrors()
    errors.add(seen)
    found = errors.figures()
    assert found["resolution_m"] == pytest.approx(2.3548 * sigma_m, abs=0.05)
    assert found["outward_m"] == pytest.approx(outward_m, abs=0.02)
