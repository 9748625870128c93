"""What a folder is worked with."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.section import merged
from stereotruth.core.errors import InputError
from stereotruth.core.sheets import Image, Scene
from stereotruth.project.project import (
    FILES,
    adjusted_scenes,
    check_fixed,
    configured,
    days_of_pair,
    read_mapping,
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


@pytest.mark.parametrize("text", ["a: [", "- a\n- b\n", "seed: x\n"])
def test_a_wrong_file_is_named(tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(text)
    with pytest.raises(InputError, match=r"config\.yaml"):
        configured()


def test_synthetic_cities_are_known_in_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cities, scenes = read_scenes(Configuration())
    assert "Qichun" in cities
    assert scenes["Qichun-1"].gcps == str(FILES / "config/gcps/Qichun-1.csv")
    with pytest.raises(InputError, match=r"mine\.tsv"):
        read_scenes(Configuration(cities="mine.tsv"))


def test_utf_16_is_named(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("seed: 1\n", encoding="utf-16")
    with pytest.raises(InputError, match=r"c\.yaml: is no UTF-8"):
        read_mapping(file)


@pytest.mark.parametrize(
    "text",
    [
        "".join(
            [
                "a0: &a0 [x, x, x, x, x, x, x, x, x]\n",
                *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12)),
            ]
        ),
        "".join(
            [
                "a0: &a0 {x: 1}\n",
                *(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}\n" for n in range(1, 12)),
            ]
        ),
        "a: &a [1, *a]\n",
        "a: " + "[" * 5000 + "]" * 5000,
        "a: x" + "x" * 1_000_000,
    ],
    ids=["aliases", "merged", "circle", "deep", "large"],
)
def test_what_grows_beyond_measure_is_refused_at_once(tmp_path, text):
    file = tmp_path / "c.yaml"
    file.write_text(text)
    begun = time.process_time()
    with pytest.raises(InputError, match=r"c\.yaml: (more than 200000 values|is nested|.* MB)"):
        read_mapping(file)
    assert time.process_time() - begun < 5


def test_aliases_that_do_not_multiply_are_taken(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("a: &a {b: 1}\nc: *a\nd:\n  <<: *a\n  e: 2\n")
    assert read_mapping(file) == {"a": {"b": 1}, "c": {"b": 1}, "d": {"b": 1, "e": 2}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "tiles: {size: 256}\nseed: 1\ntiles: {stride: 3}\n",
            "'tiles' stands twice, in lines 1 and 3",
        ),
        ("tiles:\n  size: 256\n  size: 512\n", "'size' stands twice, in lines 2 and 3"),
    ],
)
def test_a_key_that_stands_twice_is_refused_with_both_lines(tmp_path, text, words):
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_mapping(tmp_path / "my.yaml")


def test_a_lidar_file_is_read_once_for_the_scenes_that_take_it_alike():
    row = {"left_image": "l.tif", "right_image": "r.tif", "lidar": "lidar", "gcps": ""}
    how = {"lidar_crs": "", "geoid": ""}
    scenes = {
        name: Scene(scene=name, **row | {"city": "A"} | how | changes)
        for name, changes in {
            "A-2": {},
            "A-1": {},
            "A-3": {"geoid": "g.gtx"},
            "A-4": {"lidar_crs": "EPSG:32650"},
            "B-1": {"city": "B"},
        }.items()
    }
    files = {"one": Path("lidar/one.laz"), "two": Path("lidar/two.laz")}
    lidar = {name: dict(files) for name in scenes}
    lidar["A-1"] = {"one-1a2b": Path("lidar/../lidar/one.laz"), "three": Path("three.laz")}
    found = stores_of(scenes, lidar)
    assert found["A-2"] == [("A-2", "one"), ("A-2", "two")]
    assert found["A-1"] == [("A-2", "one"), ("A-1", "three")]
    for name in ("A-3", "A-4", "B-1"):
        assert found[name] == [(name, "one"), (name, "two")]


def scenes_of_town(*pairs: str) -> dict[str, Scene]:
    """Scenes of one city by their images' letters."""
    return {
        pair: Scene(pair, "Town", f"{pair[0]}.tif", f"{pair[1]}.tif", "lidar", "", "", "")
        for pair in pairs
    }


def test_scenes_that_share_an_image_are_adjusted_together():
    scenes = scenes_of_town("AB", "BC", "DE")
    scenes["FB"] = replace(scenes_of_town("FB")["FB"], city="Other")
    nameless = dict.fromkeys(scenes, ("", ""))
    found = adjusted_scenes(Configuration(), scenes, nameless)
    assert found == {"AB": ("A.tif", "B.tif"), "BC": ("B.tif", "C.tif")}
    named = nameless | {"AB": ("one", "two"), "BC": ("two", "")}
    found = adjusted_scenes(Configuration(), scenes, named)
    assert found == {"AB": ("one", "two"), "BC": ("two", "C.tif")}


def test_fixed_alignments_and_images_decide_what_is_adjusted():
    scenes = scenes_of_town("AB", "BC", "DE")
    names = {pair: (pair[0], pair[1]) for pair in scenes}

    def adjusted(**alignment) -> set[str]:
        return set(adjusted_scenes(Configuration.of({"alignment": alignment}), scenes, names))

    assert adjusted() == {"AB", "BC"}
    assert adjusted(fixed={"AB": "a.json"}) == set()
    assert adjusted(fixed={"D": "site.json"}) == {"AB", "BC", "DE"}
    assert adjusted(refine=False) == set()


def test_what_is_fixed_is_a_scene_or_an_image_with_a_file(tmp_path):
    file = tmp_path / "kept.json"
    file.write_text("{}")
    scenes = scenes_of_town("AB")

    def check(name: str, path: str) -> None:
        settings = Configuration.of({"alignment": {"fixed": {name: path}}})
        check_fixed(settings, scenes, {"A": None})

    check("A", str(file))
    check("AB", str(file))
    with pytest.raises(InputError, match="no such scene or image"):
        check("Z", str(file))
    with pytest.raises(InputError, match="no such file"):
        check("A", "nowhere.json")


@pytest.mark.parametrize(
    ("names", "days"),
    [
        (("l", "r"), ("2020-10-25", "2020-10-26")),
        (("r", ""), ("2020-10-26", "")),  # a file that the sheet does not have
        (("n", "l"), ("", "2020-10-25")),
    ],
)
def test_days_of_a_pair_are_those_of_the_images_sheet(names, days):
    """UTC, whatever the zone."""
    acquired = {"l": "2020-10-26T03:12:45+08:00", "r": "2020-10-26", "n": ""}
    images = {
        name: Image(image=name, city="A", file=f"{name}.tif", acquired=cell)
        for name, cell in acquired.items()
    }
    assert days_of_pair(names, images) == days
