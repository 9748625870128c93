"""What a folder is worked with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.section import merged
from stereotruth.core.errors import InputError
from stereotruth.core.sheets import City, Image, Scene
from stereotruth.lidar.frames import DEFAULT_EPOCH
from stereotruth.project.project import (
    FILES,
    adjusted_scenes,
    check_fixed,
    configured,
    days_of_pair,
    epoch_of_city,
    read_scenes,
    stores_of,
)


def test_a_mapping_is_laid_over_another():
    below = {"a": {"b": 1, "c": {"d": 2}}, "e": [1], "f": {"g": 1}}
    above = {"a": {"c": {"d": 3}, "h": 4}, "e": [2], "f": None}
    assert merged(below, above) == {"a": {"b": 1, "c": {"d": 3}, "h": 4}, "e": [2], "f": None}
    assert below["a"]["c"]["d"] == 2


def test_files_of_the_folder_lie_over_the_defaults(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config").mkdir()
    Path("config/config.yaml").write_text("seed: 1\nstrict: true\n")
    Path("config.yaml").write_text("seed: 2\ntiles: {size: 512}\n")
    settings, files = configured()
    assert (settings.seed, settings.strict, settings.tiles.size) == (2, True, 512)
    assert files == "config/config.yaml, config.yaml"
    Path("other.yaml").write_text("seed: 3\n")
    settings, _ = configured(["other.yaml"])
    assert (settings.seed, settings.strict, settings.tiles.size) == (3, True, 1024)


def test_synthetic_cities_are_known_in_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cities, scenes = read_scenes(Configuration())
    assert "Qichun" in cities
    assert scenes["Qichun-1"].gcps == str(FILES / "config/gcps/Qichun-1.csv")


def scenes_of_town(*pairs: str) -> dict[str, Scene]:
    """Scenes of one city by their images' letters."""
    return {
        pair: Scene(pair, "Town", f"{pair[0]}.tif", f"{pair[1]}.tif", "lidar", "", "", "")
        for pair in pairs
    }


def test_a_lidar_file_is_read_once_for_the_scenes_that_take_it_alike():
    scenes = scenes_of_town("AB", "CD", "EF", "GH", "IJ")
    scenes["EF"] = replace(scenes["EF"], geoid="g.gtx")
    scenes["GH"] = replace(scenes["GH"], lidar_crs="EPSG:32650")
    scenes["IJ"] = replace(scenes["IJ"], city="Other")
    files = {"one": Path("lidar/one.laz"), "two": Path("lidar/two.laz")}
    lidar = {name: dict(files) for name in scenes}
    lidar["CD"] = {"one-1a2b": Path("lidar/../lidar/one.laz"), "three": Path("three.laz")}
    found = stores_of(scenes, lidar)
    assert found["AB"] == [("AB", "one"), ("AB", "two")]
    assert found["CD"] == [("AB", "one"), ("CD", "three")]
    for name in ("EF", "GH", "IJ"):
        assert found[name] == [(name, "one"), (name, "two")]


def test_scenes_that_share_an_image_are_adjusted_together():
    scenes = scenes_of_town("AB", "BC", "DE")
    scenes["FB"] = replace(scenes_of_town("FB")["FB"], city="Other")
    nameless = dict.fromkeys(scenes, ("", ""))
    found = adjusted_scenes(Configuration(), scenes, nameless)
    assert found == {"AB": ("A.tif", "B.tif"), "BC": ("B.tif", "C.tif")}
    named = nameless | {"AB": ("one", "two"), "BC": ("two", "")}
    found = adjusted_scenes(Configuration(), scenes, named)
    assert found == {"AB": ("one", "two"), "BC": ("two", "C.tif")}


def test_fixed_alignments_and_images_decide_what_is_adjusted(tmp_path):
    scenes = scenes_of_town("AB", "BC", "DE")
    names = {pair: (pair[0], pair[1]) for pair in scenes}

    def adjusted(**alignment) -> set[str]:
        return set(adjusted_scenes(Configuration.of({"alignment": alignment}), scenes, names))

    assert adjusted() == {"AB", "BC"}
    assert adjusted(fixed={"AB": "a.json"}) == set()
    assert adjusted(fixed={"D": "site.json"}) == {"AB", "BC", "DE"}
    assert adjusted(refine=False) == set()

    (tmp_path / "kept.json").write_text("{}")
    for name, file, good in (
        ("A", "kept.json", True),
        ("AB", "kept.json", True),
        ("Z", "kept.json", False),
        ("A", "nowhere.json", False),
    ):
        settings = Configuration.of({"alignment": {"fixed": {name: str(tmp_path / file)}}})
        if good:
            check_fixed(settings, scenes, {"A": None})
        else:
            with pytest.raises(InputError):
                check_fixed(settings, scenes, {"A": None})


def test_days_of_a_pair_are_those_of_the_images_sheet():
    """UTC, whatever the zone."""
    acquired = {"l": "2020-10-26T03:12:45+08:00", "r": "2020-10-26", "n": ""}
    images = {
        name: Image(image=name, city="A", file=f"{name}.tif", acquired=cell)
        for name, cell in acquired.items()
    }
    assert days_of_pair(("l", "r"), images) == ("2020-10-25", "2020-10-26")
    assert days_of_pair(("r", ""), images) == ("2020-10-26", "")  # one that the sheet has not
    assert days_of_pair(("n", "l"), images) == ("", "2020-10-25")


def test_the_epoch_of_a_city_is_that_of_the_first_images_that_tell_their_day(tmp_path):
    town = City("Town", "TN", 6, 1, 3)
    scenes = {
        name: replace(scene, left_image=str(tmp_path / "l.tif"), right_image=str(tmp_path / file))
        for (name, scene), file in zip(scenes_of_town("AB", "CD").items(), ("r.tif", "B.tif"))
    }
    assert epoch_of_city(town, scenes, {}) == DEFAULT_EPOCH
    (tmp_path / "B.imd").write_text("firstLineTime = 2019-07-02T03:12:45.000000Z;\n")
    found = epoch_of_city(town, scenes, {})
    assert (found.year, found.by) == (pytest.approx(2019.5, abs=0.002), "the images of scene CD")
    days = {"l": "2020-07-01", "r": "2021-07-02"}
    rows = {
        name: Image(name, "Town", str(tmp_path / f"{name}.tif"), day) for name, day in days.items()
    }
    found = epoch_of_city(town, scenes, rows)
    assert (found.year, found.by) == (pytest.approx(2021.0, abs=0.002), "the images of scene AB")
    assert epoch_of_city(replace(town, epoch="2016.4"), scenes, rows).year == 2016.4
    other = {name: replace(one, city="Other") for name, one in scenes.items()}
    assert epoch_of_city(town, other, rows) == DEFAULT_EPOCH
