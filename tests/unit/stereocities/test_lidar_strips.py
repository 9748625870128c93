"""Simulated strips of a LiDAR, each with an error and a density of its own."""

from __future__ import annotations

from dataclasses import replace

import laspy
import numpy as np
import pytest

from stereocities.cities import FlightStrip, lidar_files
from stereocities.lidar import TURN_S, flown_strips, simulate_lidar_tile

from ...synthetic.small_cities import TOWN

STRIPS = (
    FlightStrip((0.3, -0.2, 0.08), spacing_m=1.0),
    FlightStrip((-0.1, 0.25, -0.06), spacing_m=2.0),
)
EXACT = tuple(replace(strip, offset_m=(0.0, 0.0, 0.0)) for strip in STRIPS)


def flown(folder, strips) -> laspy.LasData:
    city = replace(TOWN, strips=strips)
    name = lidar_files(city, city.scenes[0])[0]
    simulate_lidar_tile(city, city.scenes[0], name, folder / name, seed=3)
    return laspy.read(folder / name)


def test_strips_are_off_overlap_and_tell_themselves(tmp_path):
    off, exact = (flown(tmp_path / k, s) for k, s in (("off", STRIPS), ("exact", EXACT)))
    source = np.asarray(off.point_source_id)
    assert np.array_equal(source, exact.point_source_id) and set(source.tolist()) == {1, 2}
    for number, strip in enumerate(STRIPS, 1):
        of = source == number
        apart = np.asarray(off.xyz)[of] - np.asarray(exact.xyz)[of]
        assert apart.mean(axis=0) == pytest.approx(strip.offset_m, abs=0.01)  # north of the grid
        assert np.ptp(apart, axis=0).max() < 0.01
    first, second = (np.asarray(off.gps_time)[source == k] for k in (1, 2))
    assert second.min() - first.max() >= TURN_S
    scene = replace(TOWN, strips=STRIPS).scenes[0]
    west, east = flown_strips(replace(TOWN, strips=STRIPS), scene)
    shared = (west.east - east.west) / (west.east - west.west)
    assert shared == pytest.approx(0.3)
    edges = np.asarray(off.edge_of_flight_line) == 1
    assert 0 < edges.mean() < 0.05


def test_a_city_without_strips_has_none():
    assert flown_strips(TOWN, TOWN.scenes[0]) == []
