"""Entwine Point Tiles: the points of the whole, or a refusal; never less."""

from __future__ import annotations

import json
import shutil
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.errors import InputError
from stereotruth.lidar.declared_crs import header_crs, interpret
from stereotruth.lidar.footprint import Footprint
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.octree import open_octree
from stereotruth.lidar.survey import survey

from ...synthetic.copc_server import CORNER, UTM
from ...synthetic.ept import FAULTS, _about, make_ept


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


@pytest.mark.parametrize("fault", FAULTS)
def test_a_damaged_dataset_is_refused(dataset, tmp_path, fault):
    FAULTS[fault](dataset.parent)
    with pytest.raises(InputError):
        ingest(dataset, tmp_path / "s.points")
    assert not (tmp_path / "s.points").exists()


@pytest.fixture(scope="module")
def good(whole, tmp_path_factory) -> Path:
    store = tmp_path_factory.mktemp("good") / "good.points"
    ingest(whole, store, footprint=ground())
    return store


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_footprint_of_a_damaged_dataset_is_whole_or_refused(dataset, tmp_path, good, fault):
    FAULTS[fault](dataset.parent)
    try:
        ingest(dataset, tmp_path / "s.points", footprint=ground())
    except InputError:
        return
    assert same(tmp_path / "s.points", good)


@contextmanager
def serving(folder: Path):
    """A server of a folder, whose ranges are those of one request; what it was asked for."""
    asked = []

    class Answer(SimpleHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            file = Path(self.translate_path(self.path))
            if "away" in self.path or not file.is_file():
                self.send_response(302 if "away" in self.path else 404)
                self.send_header("Location", "http://localhost:1/x")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            content = file.read_bytes()
            first, last = map(int, self.headers["Range"].removeprefix("bytes=").split("-"))
            last = min(last, len(content) - 1)
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(content)}")
            self.send_header("Content-Length", str(last + 1 - first))
            self.end_headers()
            self.wfile.write(content[first : last + 1])

        def log_message(self, *_):
            pass

    handler = partial(Answer, directory=str(folder))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        server.shutdown()
        server.server_close()


def test_nodes_of_a_server_are_those_of_the_disk_and_asked_for_once(dataset):
    with serving(dataset.parent) as (url, asked):
        there, here = open_octree(f"{url}/ept.json"), open_octree(dataset)
        assert there.nodes == here.nodes

        def touches(low, high):
            return (low[:, 0] <= CORNER[0] + 400) & (low[:, 1] <= CORNER[1] + 400)

        asked.clear()
        plan = there.plan(touches)
        points = [part.array["X"].copy() for part in there.read(plan)]
        wanted = [part.array["X"].copy() for part in here.read(here.plan(touches))]
        assert all(map(np.array_equal, points, wanted)) and len(points) == len(wanted)
        assert len(asked) == len(set(asked)) == len(plan.nodes) < len(there.nodes)


def test_a_node_that_leads_to_another_host_is_refused(dataset):
    dataset.parent.joinpath("away").mkdir()
    with serving(dataset.parent) as (url, _), pytest.raises(InputError, match="another host"):
        open_octree(f"{url}/away/ept.json")


def test_nodes_have_the_scales_of_all(whole):
    about = json.loads(whole.read_text())
    header = open_octree(whole).header
    assert header.point_count == about["points"]
    assert np.allclose(header.mins, about["boundsConforming"][:3])
    assert isinstance(header, laspy.LasHeader) and header.scales[0] == 0.01


def stand_in(url: str, file: Path, content: str) -> Path:
    place = Path("results", "remote", *url.replace("://", "/").split("/"))
    place.parent.mkdir(parents=True)
    place.write_text(json.dumps({"size": file.stat().st_size, "content": content}) + "\n")
    return place


def test_a_second_run_asks_for_nothing(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with serving(dataset.parent) as (url, asked):
        place = stand_in(f"{url}/ept.json", dataset, "Tue, 24 Nov 2026 10:00:00 GMT")
        ingest(place, tmp_path / "a.points", footprint=ground())
        assert asked
        asked.clear()
        ingest(place, tmp_path / "b.points", footprint=ground())
        assert asked == []
    ingest(dataset, tmp_path / "c.points", footprint=ground())
    assert same(tmp_path / "a.points", tmp_path / "b.points")
    assert same(tmp_path / "a.points", tmp_path / "c.points")


def test_bytes_are_estimated_before_they_are_read(dataset, tmp_path):
    surveyed = survey(dataset, footprint=ground())
    nodes = list((dataset.parent / "ept-data").glob("*.laz"))
    every = sum(file.stat().st_size for file in nodes)
    assert 0 < surveyed.read[1] < surveyed.bytes
    assert every / 4 < surveyed.bytes < 2 * every  # small nodes have large headers
    summary = ingest(dataset, tmp_path / "a.points", footprint=ground())
    assert summary["bytes"] == [surveyed.read[1], surveyed.bytes]
