"""The tops of rough surfaces that pulses go through."""

from __future__ import annotations

import numpy as np

from stereotruth.lidar.lattice import LATTICE_M

from ...synthetic.strewn_points import CELL_M, surface_of


def test_points_that_went_through_are_left_out_but_not_the_ground_of_a_gap() -> None:
    """A rough canopy 8 m above the ground with a gap of 8 m; a quarter of the pulses go through."""
    rng = np.random.default_rng(2)

    def height(x, y):
        top = 8.0 + rng.uniform(-0.8, 0.8, x.size)
        gap = np.hypot(x - 25.0, y - 25.0) < 4.0
        return np.where(gap | (rng.random(x.size) < 0.25), 0.0, top)

    surface = surface_of(height)
    tops = surface.vertices.taken(np.unique(surface.tops.corner))
    x, y = (q / 3000 * CELL_M for q in (tops.lon_q, tops.lat_q))
    low = tops.h_q * LATTICE_M < 4.0
    far = np.hypot(x - 25.0, y - 25.0)
    well_inside = (np.abs(x - 25.0) < 17.0) & (np.abs(y - 25.0) < 17.0)
    assert low[far < 3.0].all() and (far < 3.0).sum() > 10
    assert low[(far > 6.0) & well_inside].mean() < 0.05
