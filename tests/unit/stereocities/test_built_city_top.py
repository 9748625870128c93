"""The top surface of a city against what is known of it."""

from __future__ import annotations

import numpy as np
import pytest

from stereocities.layout import frame_of
from stereocities.surfaces import terrain_heights
from stereocities.world import build_surfaces, top_surface

from ...synthetic.small_cities import GROUND, ONE_BOX, ROOF


def test_a_single_box_is_as_high_and_wide_as_it_is():
    x, y, length, width, height = ONE_BOX.single_box
    places = np.array([
        [x, y, 0.0], [x + length / 2 - 0.01, y + width / 2 - 0.01, 0.0],
        [x + length / 2 + 0.02, y, 0.0],
    ])  # fmt: skip
    places[:, 2] = height  # the plan position is that of the roof's height
    lon, lat, _ = frame_of(ONE_BOX).to_geodetic(places).T
    found, kind = top_surface(ONE_BOX, lon, lat)
    assert kind.tolist() == [ROOF, ROOF, GROUND]
    assert found[0] - found[2] == pytest.approx(height, abs=0.01)
    ground = frame_of(ONE_BOX).from_geodetic(np.array([[lon[2], lat[2], found[2]]]))
    expected = terrain_heights(build_surfaces(ONE_BOX), ground[:, :2])[0, 0]
    assert ground[0, 2] == pytest.approx(expected, abs=1e-3)


def test_there_is_nothing_outside():
    found, kind = top_surface(ONE_BOX, np.array([ONE_BOX.lon + 1]), np.array([ONE_BOX.lat]))
    assert np.isnan(found[0]) and kind[0] == 0
