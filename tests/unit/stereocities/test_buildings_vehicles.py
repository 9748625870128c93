"""Vehicles of a city: where each view and the truth have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereocities.appearance import VEHICLE
from stereocities.render import prepare
from stereocities.surfaces import IN_LEFT, IN_RIGHT
from stereocities.world import build_surfaces

from ...synthetic.small_cities import TOWN
from ...synthetic.wooded_cities import shown_by


def test_vehicles_are_elsewhere_in_each_view() -> None:
    city = replace(TOWN, name="Busy", character=replace(TOWN.character, vehicles=40.0))
    s, none = build_surfaces(city), build_surfaces(TOWN)
    cars = s.box_style[:, 2] == VEHICLE
    np.testing.assert_array_equal(s.boxes[~cars], none.boxes)
    np.testing.assert_array_equal(s.trees, none.trees)
    count = {bits: (s.box_view[cars] == bits).sum() for bits in (1, 2, 4, 8)}
    assert min(count.values()) >= 10
    # those that creep: the same body and paint in both views, some metres apart
    left, right = (s.boxes[cars & (s.box_view == bits)] for bits in (IN_LEFT, IN_RIGHT))
    phase = [s.box_style[cars & (s.box_view == bits), 3] for bits in (IN_LEFT, IN_RIGHT)]
    both, i, j = np.intersect1d(*phase, return_indices=True)
    assert len(both) >= 10
    way = right[j, :2] - left[i, :2]
    moved = np.hypot(*way.T)
    assert moved.min() >= 0.5 - 1e-9 and moved.max() <= 6.0 + 1e-9
    across = way[:, 0] * left[i, 3] - way[:, 1] * left[i, 2]
    assert np.abs(across).max() < 1e-9  # along the street
    # on a car of the left view alone the truth knows no counterpart
    scene = city.scenes[0]
    shown = shown_by(city, "left", 1.0)
    ready = prepare(city, scene)
    xyz = ready.frame.from_geodetic(np.column_stack([shown[n] for n in ("lon", "lat", "height")]))
    on = np.zeros(len(xyz), bool)
    for x, y, ux, uy, a, b, top, _ in left:
        dx, dy = xyz[:, 0] - x, xyz[:, 1] - y
        on |= (
            (np.abs(dx * ux + dy * uy) < a - 0.1)
            & (np.abs(dy * ux - dx * uy) < b - 0.1)
            & (np.abs(xyz[:, 2] - top) < 0.01)
        )
    assert on.sum() > 20
    assert not shown["visible_right"][on].any() and not shown["hidden_right"][on].any()
    assert (shown["changed"][on] == 2).all()
