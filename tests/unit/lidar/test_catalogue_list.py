"""Lists of tiles: read as written, or refused; known without a network."""

from __future__ import annotations

import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products import remote_files
from stereotruth.core.products.remote_files import hosts_of, url_of
from stereotruth.lidar.catalogue_list import (
    ListedTile,
    TileList,
    files_of_list,
    is_catalogue,
    is_list,
    read_list,
    remarks_on,
    unlisted_m2,
    write_list,
)
from stereotruth.lidar.lattice import Footprint


def made_list(**more):
    tiles = (
        ListedTile("lidar/a.laz", 10, "", 5, "2020-01-01", "2020-01-02"),
        ListedTile("https://host/b.copc.laz", 11, '"tag"', -1, "", ""),
    )
    values = {
        "catalogue": "lidar/tiles.vpc",
        "sha256": "0" * 64,
        "bytes": 3,
        "hosts": ("x.example", "y.example"),
        "ground": ((40950, 4761, 4763), (40951, 4762, 4762)),
        "footprint_m2": 4e6,
        "hole_m2": 5e5,
        "crs": "EPSG:2154+5720",
        "tiles": tiles,
    }
    return TileList(**(values | more))


def test_a_list_is_read_as_it_was_written(tmp_path):
    write_list(made_list(), tmp_path / "a.tsv")
    assert read_list(tmp_path / "a.tsv") == made_list()
    wkt = pyproj.CRS("EPSG:2154").to_wkt(pretty=True)
    write_list(made_list(crs=wkt), tmp_path / "b.tsv")
    assert pyproj.CRS(read_list(tmp_path / "b.tsv").crs) == pyproj.CRS(2154)


def test_the_files_of_a_list_are_known_without_a_network(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(remote_files, "ask_patiently", None)  # nobody is asked
    write_list(made_list(), "a.tsv")
    local, stand_in = files_of_list("a.tsv")
    assert local == "lidar/a.laz"
    assert url_of(stand_in) == "https://host/b.copc.laz"
    assert hosts_of(stand_in) == {"x.example", "y.example"}


@pytest.mark.parametrize(
    "damage",
    [lambda text: text[:200],
     lambda text: "".join(text.splitlines(keepends=True)[:-1]),
     lambda text: text.replace("2020-01-02", "spring 2020"),
     lambda text: text.replace("\t10\t", "\tten\t"),
     lambda text: text.replace("# hosts", "# guests")],
)  # fmt: skip
def test_a_damaged_list_is_refused(tmp_path, damage):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    file.write_text(damage(file.read_text()))
    with pytest.raises(InputError) as error:
        read_list(file)
    assert error.value.file == str(file) and error.value.remedy


def test_holes_and_a_catalogue_that_has_changed_are_told(tmp_path):
    catalogue = tmp_path / "tiles.vpc"
    catalogue.write_text("{}")
    write_list(made_list(catalogue=str(catalogue)), tmp_path / "a.tsv")
    hole, changed = remarks_on(tmp_path / "a.tsv")
    assert "0.5 km² (12 %) of the 4 km²" in hole and "has changed" in changed


def test_ground_that_a_list_was_not_asked_for_is_told(tmp_path):
    file = tmp_path / "a.tsv"
    write_list(made_list(), file)
    asked = Footprint.of_runs(made_list().ground)
    assert unlisted_m2([file], asked) == 0
    wider = Footprint.of_runs([*asked.runs, [40952, 4762, 4763]])
    assert abs(unlisted_m2([file], wider) / (wider.area_m2 - asked.area_m2) - 1) < 1e-6


def test_cells_that_name_lists_and_catalogues():
    assert is_list("lidar/a.tsv") and not is_list("https://host/a.tsv") and not is_list("a.laz")
    assert all(map(is_catalogue, ("a.vpc", "https://host/a.json?sig=x", "a.GPKG")))
    others = "https://host/x/ept.json", "ept.json", "https://host/a.laz?of=a.json", "a.tsv"
    assert not any(map(is_catalogue, others))
