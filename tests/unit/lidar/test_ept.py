"""Entwine Point Tiles: the points of the whole, or a refusal; never less."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from scipy.spatial import cKDTree

from stereotruth.core.errors import InputError
from stereotruth.lidar.declared_crs import header_crs, interpret
from stereotruth.lidar.ingest import ingest, survey
from stereotruth.lidar.lattice import Footprint
from stereotruth.lidar.point_files import open_octree
from stereotruth.lidar.point_store import PointStore

from ...synthetic.copc_server import CORNER, UTM, serving
from ...synthetic.ept import FAULTS, _about, make_ept, write
from ...synthetic.las import everything, write_gtx


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return make_ept(tmp_path_factory.mktemp("ept") / "set")


@pytest.fixture
def dataset(whole, tmp_path) -> Path:
    shutil.copytree(whole.parent, tmp_path / "set")
    return tmp_path / "set" / "ept.json"


def ground(low=(300.0, 300.0), high=(700.0, 600.0)) -> Footprint:
    change = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    x, y = CORNER[0] + np.array([low[0], high[0]]), CORNER[1] + np.array([low[1], high[1]])
    lon, lat = change.transform(x[[0, 1, 1, 0]], y[[0, 0, 1, 1]])[:2]
    return Footprint.around([np.stack([lon, lat])], 0.0)


def same(one: Path, other: Path) -> bool:
    return all(
        (one / f).read_bytes() == (other / f).read_bytes() for f in ("points.npy", "cells.npy")
    )


def test_the_store_is_that_of_a_file_of_all_points(whole, tmp_path):
    summary = ingest(whole, tmp_path / "ept.points")
    ingest(whole.with_name("all.las"), tmp_path / "las.points")
    assert same(tmp_path / "ept.points", tmp_path / "las.points")
    assert summary["points"]["kept"] == 6000


def test_the_store_of_a_footprint_is_that_of_a_file_of_all_points(whole, tmp_path):
    summary = ingest(whole, tmp_path / "ept.points", footprint=ground())
    ingest(whole.with_name("all.las"), tmp_path / "las.points", footprint=ground())
    assert same(tmp_path / "ept.points", tmp_path / "las.points")
    read, every = summary["nodes"]
    assert read < every / 2
    assert 0 < summary["points"]["kept"] <= summary["points"]["read"] < 3000


def test_the_system_is_that_of_ept_json(dataset):
    for srs, wanted in (
        ({"authority": "EPSG", "horizontal": "32650", "vertical": "5773"}, "EPSG:32650+5773"),
        ({"authority": "EPSG", "horizontal": "3857"}, "EPSG:3857"),
        ({"authority": "EPSG", "horizontal": "9", "wkt": UTM.to_wkt()}, UTM),
    ):
        _about(dataset.parent, srs=srs)
        system, _ = header_crs(open_octree(dataset).header)
        assert system == interpret(pyproj.CRS(wanted))


@pytest.fixture(scope="module")
def good(whole, tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("good") / "good.points"
    ingest(whole, store, footprint=ground())
    return store


@pytest.mark.parametrize("fault", FAULTS)
def test_a_damaged_dataset_is_refused_and_a_footprint_of_it_whole(dataset, tmp_path, good, fault):
    FAULTS[fault](dataset.parent)
    with pytest.raises(InputError):
        ingest(dataset, tmp_path / "all.points")
    assert not (tmp_path / "all.points").exists()
    try:
        ingest(dataset, tmp_path / "s.points", footprint=ground())
    except InputError:
        return
    assert same(tmp_path / "s.points", good)


def test_nodes_of_a_server_are_those_of_the_disk_and_asked_for_once(dataset, monkeypatch):
    monkeypatch.chdir(dataset.parents[1])
    ingest(dataset, "disk.points", footprint=ground())
    with serving(dataset.parent) as server:
        place = server.stand_in("ept.json", "Tue, 24 Nov 2026 10:00:00 GMT")
        with pytest.raises(InputError, match="changed on its server"):
            open_octree(place)
        place = server.stand_in("ept.json")
        server.requests.clear()
        ingest(place, "web.points", footprint=ground())
        nodes = [one for one in server.requests if "ept-data" in one]
        assert len(nodes) == len(set(nodes)) == PointStore("web.points").attrs["nodes"][0]
        server.requests.clear()
        ingest(place, "again.points", footprint=ground())
        assert server.requests == []
    assert same(Path("disk.points"), Path("web.points"))
    assert same(Path("disk.points"), Path("again.points"))


def test_a_node_that_leads_to_another_host_is_refused(dataset, monkeypatch):
    monkeypatch.chdir(dataset.parents[1])
    with serving(dataset.parent, "redirect to another host", when=2) as server:
        with pytest.raises(InputError, match="another host"):
            open_octree(server.stand_in("ept.json"))
        assert len(server.requests) > 2


def test_bytes_are_estimated_before_they_are_read(dataset, tmp_path):
    surveyed = survey(dataset, footprint=ground())
    nodes = list((dataset.parent / "ept-data").glob("*.laz"))
    every = sum(file.stat().st_size for file in nodes)
    assert 0 < surveyed.read[1] < surveyed.bytes
    assert every / 4 < surveyed.bytes < 2 * every  # small nodes have large headers
    summary = ingest(dataset, tmp_path / "a.points", footprint=ground())
    assert summary["bytes"] == [surveyed.read[1], surveyed.bytes]


@pytest.mark.parametrize("vertical", ["", "5773"])
def test_heights_over_a_web_map_are_those_of_the_ground(whole, tmp_path, vertical):
    """Places of EPSG:3857 are stretched by 1 / cos(latitude), heights in metres are not."""
    las = laspy.read(whole.with_name("all.las"))
    change = pyproj.Transformer.from_crs(UTM.to_2d(), 3857, always_xy=True)
    xyz = np.stack([*change.transform(np.array(las.x), np.array(las.y)), np.array(las.z)], axis=1)
    folder = tmp_path / "web"
    (folder / "ept-data").mkdir(parents=True)
    (folder / "ept-hierarchy").mkdir()
    write(folder / "ept-data" / "0-0-0-0.laz", xyz, las.classification)
    (folder / "ept-hierarchy" / "0-0-0-0.json").write_text(json.dumps({"0-0-0-0": len(xyz)}))
    low = xyz.min(axis=0) - 1
    (folder / "ept.json").write_text(whole.read_text())
    _about(
        folder,
        bounds=[*low.tolist(), *(low + 4000.0).tolist()],
        boundsConforming=[*xyz.min(axis=0).tolist(), *xyz.max(axis=0).tolist()],
        srs={"authority": "EPSG", "horizontal": "3857", "vertical": vertical},
    )
    geoid = None
    if vertical:
        with pytest.raises(InputError, match="heights are orthometric"):
            ingest(folder / "ept.json", tmp_path / "web.points")
        geoid = write_gtx(tmp_path / "g.gtx", np.full((3, 3), 12.5), 116.0, 29.0, 1.0)
    ingest(folder / "ept.json", tmp_path / "web.points", geoid=geoid)
    ingest(whole, tmp_path / "utm.points")
    places = []
    for name in ("web", "utm"):
        points = everything(PointStore(tmp_path / f"{name}.points"))
        at = np.stack([points.lon, points.lat, points.height])
        places.append(at)
    got, truth = places
    assert got.shape == truth.shape
    far = cKDTree(got[:2].T).query(truth[:2].T)
    assert far[0].max() < 1.5e-7  # degrees: of coordinates in steps of 1 cm
    off = got[2][far[1]] - truth[2] - (12.5 if vertical else 0.0)
    assert np.abs(off).max() < 0.006
