"""What each of the six cities must have."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereocities import layout
from stereocities.cities import (
    APART_DEG,
    CITIES,
    CitySpec,
    cities_for,
    lidar_files,
    training_city,
)
from stereocities.control_points import make_points
from stereocities.surfaces import IN_IMAGES, IN_LIDAR
from stereocities.world import surfaces_of

from ...synthetic.small_cities import ROOT, read_points


@pytest.mark.slow
@pytest.mark.parametrize("city", CITIES.values(), ids=list(CITIES))
def test_committed_gcps_and_what_each_city_must_have(city: CitySpec) -> None:
    surfaces = surfaces_of(city)
    slope = np.hypot(*np.gradient(surfaces.terrain, surfaces.step))
    assert math.degrees(math.atan(slope.max())) < 51
    relief = np.ptp(surfaces.terrain)
    if city.name in ("Shaoguan", "Yingde"):
        assert 250 < relief < 600
    for scene in city.scenes:
        names = lidar_files(city, scene)
        assert 4 <= len(names) <= 9 and len(set(names)) == len(names)
        local = np.abs(layout.scene_coordinates(city, scene, surfaces.boxes[:, :2]))
        inside = (local < layout.half_size(scene)).all(axis=1)
        for view in (IN_IMAGES, IN_LIDAR):
            assert ((surfaces.box_view == view) & inside).sum() >= 3
        measured, exact, checks = make_points(city, scene, seed=1)
        assert 18 <= len(measured) <= 20 and len(checks) >= 50
        committed = read_points(ROOT / "config" / "gcps" / f"{scene.name}.csv")
        made = np.array([[float(v) for v in list(row.values())[1:]] for row in measured])
        np.testing.assert_allclose(committed[:, :2], made[:, :2], atol=5e-10, rtol=0)
        np.testing.assert_allclose(committed[:, 2:], made[:, 2:], atol=0.005, rtol=0)
        at = np.array([[float(row["left_col"]), float(row["left_row"])] for row in exact])
        at /= [scene.cols, scene.rows]
        # spread over the scene: a point in each quarter, and none bunched
        assert len({(c > 0.5, r > 0.5) for c, r in at}) == 4
        assert np.linalg.norm(np.ptp(at, axis=0)) > 1.1


def test_no_test_shows_one_of_them():
    assert training_city(3, 7, 900) == training_city(3, 7, 900) != training_city(3, 8, 900)
    shown = {city.world_seed for city in CITIES.values()}
    poses = {scene.pose_seed for city in CITIES.values() for scene in city.scenes}
    drawn = [training_city(number, 1, 900) for number in range(300)]
    assert len({city.world_seed for city in drawn}) == 300
    for city in drawn:
        assert city.world_seed not in shown and city.scenes[0].pose_seed not in poses
        for other in CITIES.values():
            assert max(abs(city.lon - other.lon), abs(city.lat - other.lat)) > APART_DEG


def test_cities_that_validate_do_not_train_and_larger_sets_hold_smaller_ones():
    sets = {count: cities_for(count) for count in (5, 19, 76, 300)}
    for count, (training, validation) in sets.items():
        assert 4 * len(training) >= count > 4 * (len(training) - 1)
        assert len(validation) == max(1, round(count / 40))
        for other, _ in sets.values():
            assert not set(validation) & set(other)
    assert sets[300][0][:5] == sets[19][0]
