"""The epoch of a city's places, by its sheets and the deliveries of its images."""

from __future__ import annotations

from dataclasses import replace

import pytest

from stereotruth.core import sheets
from stereotruth.core.errors import InputError
from stereotruth.lidar.frames import DEFAULT_EPOCH
from stereotruth.project.project import epoch_of_city

TOWN = sheets.City("Town", "TN", 6, 1, 3)


def scene(name: str, folder, city: str = "Town") -> sheets.Scene:
    files = [str(folder / f"{name}_{view}.tif") for view in ("left", "right")]
    return sheets.Scene(name, city, *files, "lidar", "", "", "")


def test_the_first_scene_whose_images_tell_their_day(tmp_path):
    scenes = {name: scene(name, tmp_path) for name in ("A", "B", "C")}
    assert epoch_of_city(TOWN, scenes, {}) == DEFAULT_EPOCH
    (tmp_path / "B_right.imd").write_text("firstLineTime = 2019-07-02T03:12:45.000000Z;\n")
    found = epoch_of_city(TOWN, scenes, {})
    assert (found.year, found.by) == (pytest.approx(2019.5, abs=0.002), "the images of scene B")
    rows = {
        view: sheets.Image(view, "Town", getattr(scenes["A"], f"{view}_image"), day)
        for view, day in (("left_image", "2020-07-01"), ("right_image", "2021-07-02"))
        for view in (view.removesuffix("_image"),)
    }
    found = epoch_of_city(TOWN, scenes, rows)
    assert (found.year, found.by) == (pytest.approx(2021.0, abs=0.002), "the images of scene A")
    assert epoch_of_city(replace(TOWN, epoch="2016.4"), scenes, rows).year == 2016.4
    other = {name: replace(one, city="Other") for name, one in scenes.items()}
    assert epoch_of_city(TOWN, other, rows) == DEFAULT_EPOCH


@pytest.mark.parametrize(
    ("column", "cell"),
    [("lidar_epoch", "May 2016"), ("lidar_epoch", "16.4"), ("epoch", "2016-13-01")],
)
def test_cells_that_are_no_epoch_are_refused(tmp_path, column, cell):
    cities = "city\tprefix\ttraining\tvalidation\ttesting\tepoch\nTown\tTN\t6\t1\t3\t{}\n"
    scenes = (
        "scene\tcity\tleft_image\tright_image\tlidar\tlidar_crs\tgeoid\tgcps\tlidar_epoch\n"
        "A\tTown\tl.tif\tr.tif\tlidar\t\t\t\t{}\n"
    )
    here = {column: cell}
    (tmp_path / "cities.tsv").write_text(cities.format(here.get("epoch", "")))
    (tmp_path / "scenes.tsv").write_text(scenes.format(here.get("lidar_epoch", "")))
    with pytest.raises(InputError, match=rf"line 2.*{column} '{cell}'"):
        sheets.read_scenes(tmp_path / "scenes.tsv", sheets.read_cities(tmp_path / "cities.tsv"))
