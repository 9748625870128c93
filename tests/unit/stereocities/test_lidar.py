"""Simulated LiDAR."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from stereocities.camera import project
from stereocities.cities import FlightStrip, lidar_files
from stereocities.lidar import TURN_S, flown_strips, simulate_lidar_tile
from stereocities.render import prepare, simulate_image
from stereocities.truth import open_truth
from stereotruth.core.errors import InputError

from ...synthetic.small_cities import GROUND, ROOF, TOWN


def test_lidar_lies_on_the_surfaces_that_the_truth_shows(town: Path) -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    truth = open_truth(town / "truth.zarr")
    height, surface = truth.height.values, truth.surface.values
    usable = (truth.changed.values == 0) & (truth.covered.values == 1)
    to_wgs = pyproj.Transformer.from_crs(32650, 4326, always_xy=True)
    count = np.zeros(height.shape, int)
    misses = {2: [], 6: []}
    classes: set[int] = set()
    for name in lidar_files(TOWN, TOWN.scenes[0]):
        las = laspy.read(town / "lidar" / name)
        assert (str(las.header.version), las.header.point_format.id) == ("1.4", 6)
        crs = las.header.parse_crs()
        assert crs.to_2d().to_epsg() == 32650 and len(crs.axis_info) == 3
        assert (np.asarray(las.number_of_returns) >= np.asarray(las.return_number)).all()
        label = np.asarray(las.classification)
        classes |= set(np.unique(label).tolist())
        lon, lat = to_wgs.transform(las.x, las.y)
        xyz = ready.frame.from_geodetic(np.column_stack([lon, lat, las.z]))
        col, row = np.rint(project(ready.left.cam, xyz)).astype(int).T
        inside = (col > 0) & (row > 0) & (col < 619) & (row < 639)
        for value in (2, 6):
            use = inside & (label == value)
            c, r, z = col[use], row[use], np.asarray(las.z)[use]
            flat = np.ptp(
                [height[r + i, c + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0
            ) < (0.3 if value == 2 else 0.001)
            flat &= usable[r, c] & (surface[r, c] == (GROUND if value == 2 else ROOF))
            misses[value].append((z - height[r, c])[flat])
        np.add.at(count, (row[inside], col[inside]), 1)
    assert classes == {2, 5, 6, 7, 9, 18}
    roof, ground = np.concatenate(misses[6]), np.concatenate(misses[2])
    # points below a roof's rim are on its walls: take the upper side of the distribution
    on_top = roof[roof > -0.5]
    assert len(on_top) > 2000 and np.median(on_top) == pytest.approx(0, abs=0.005)
    assert np.std(on_top) == pytest.approx(0.03, abs=0.008)
    assert abs(np.median(ground)) < 0.01 and np.quantile(np.abs(ground), 0.95) < 0.2
    covered = (truth.covered.values == 1) & (surface == GROUND)
    assert (count[covered] > 0).mean() > 0.97
    assert (count[(truth.covered.values == 0) & (surface == GROUND)] > 0).mean() < 0.02
    las = laspy.read(town / "lidar" / lidar_files(TOWN, TOWN.scenes[0])[0])
    second = np.asarray(las.return_number) == 2  # ground below crowns
    assert second.sum() > 50 and (np.asarray(las.classification)[second] == 2).mean() > 0.7
    # a ragged edge along the first rows and last columns, and a gap in the corner between them
    uncovered = truth.covered.values == 0
    assert uncovered[:105, -120:].all() and not uncovered[150:, :450].any()
    assert 0.06 < uncovered.mean() < 0.25


def test_old_las_format_and_refusals(tmp_path: Path) -> None:
    city = replace(TOWN, las_format="las-1.2-1")
    scene = city.scenes[0]
    name = lidar_files(city, scene)[0]
    assert name.endswith(".las")
    simulate_lidar_tile(city, scene, name, tmp_path / name, spacing_m=2.0, seed=1)
    las = laspy.read(tmp_path / name)
    assert (str(las.header.version), las.header.point_format.id) == ("1.2", 1)
    assert las.header.parse_crs().to_epsg() == 32650
    with pytest.raises(InputError):
        simulate_lidar_tile(city, scene, "nowhere.las", tmp_path / "x.las", seed=1)
    with pytest.raises(InputError):
        simulate_image(city, scene, "nadir", tmp_path / "x.tif", seed=1)
    assert [p.name for p in tmp_path.iterdir()] == [name]


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
