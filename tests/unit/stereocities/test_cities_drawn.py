"""Cities to train on: any number, drawn by seed, none that a test shows."""

from __future__ import annotations

from stereocities.cities import APART_DEG, CITIES, cities_for, training_city


def test_the_same_numbers_give_the_same_city_and_others_another():
    assert training_city(3, 7, 900) == training_city(3, 7, 900)
    assert training_city(3, 7, 900) != training_city(4, 7, 900)
    assert training_city(3, 7, 900) != training_city(3, 8, 900)


def test_no_test_shows_one_of_them():
    shown = {city.world_seed for city in CITIES.values()}
    poses = {scene.pose_seed for city in CITIES.values() for scene in city.scenes}
    drawn = [training_city(number, 1, 900) for number in range(300)]
    assert len({city.world_seed for city in drawn}) == 300
    for city in drawn:
        assert city.world_seed not in shown and city.scenes[0].pose_seed not in poses
        for other in CITIES.values():
            assert max(abs(city.lon - other.lon), abs(city.lat - other.lat)) > APART_DEG


def test_they_differ_in_what_they_are_to_differ_in():
    drawn = [training_city(number, 1, 900) for number in range(100)]
    reliefs = [city.character.relief_m for city in drawn]
    assert min(reliefs) < 10 and max(reliefs) > 200
    assert 30 < sum(city.scenes[0].ascending for city in drawn) < 70
    elevations = [city.sun_elevation_deg for city in drawn]
    assert max(elevations) - min(elevations) > 25
    for city in drawn:
        low, high = city.character.towers_m
        assert low < high and 0 <= city.epsg - 32601 < 60


def test_cities_that_validate_do_not_train_and_larger_sets_hold_smaller_ones():
    sets = {count: cities_for(count) for count in (5, 19, 76, 300)}
    for count, (training, validation) in sets.items():
        assert 4 * len(training) >= count > 4 * (len(training) - 1)
        assert len(validation) == max(1, round(count / 40))
        for other, _ in sets.values():
            assert not set(validation) & set(other)
    assert sets[300][0][:5] == sets[19][0]
