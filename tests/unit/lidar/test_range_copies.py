"""Copies of what servers have sent: a second reading asks for nothing."""

from __future__ import annotations

import io
import json
from pathlib import Path
from urllib.parse import urlsplit

import laspy
import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.lidar import range_copies
from stereotruth.lidar.footprint import Footprint
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.range_copies import FOLDER, open_ranges, open_stream, prune
from stereotruth.lidar.survey import survey

from ...synthetic.copc_server import CORNER, UTM, make_copc, serving
from ...synthetic.stores import tree_digest

LON, LAT = 117.006, 29.836
GROUND = Footprint.around([np.array([[LON, LON + 3e-3, LON], [LAT, LAT, LAT + 3e-3]])], 50.0)


@pytest.fixture(scope="module")
def made():
    return make_copc(40_000)


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def stand_in(url: str, size: int, content: str = '"one"') -> Path:
    parts = urlsplit(url)
    place = Path("results", "remote", parts.scheme, parts.netloc, parts.path.lstrip("/"))
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps({"size": size, "content": content}) + "\n")
    return place


def test_a_second_run_asks_for_nothing(made):
    with serving(made.content) as server:
        place = stand_in(server.url, len(made.content))
        ingest(place, "a.points", footprint=GROUND)
        assert server.requests
        server.requests.clear()
        ingest(place, "b.points", footprint=GROUND)
        assert server.requests == []
    assert tree_digest(Path("a.points")) == tree_digest(Path("b.points"))
    local = Path("tile.copc.laz")
    local.write_bytes(made.content)
    ingest(local, "c.points", footprint=GROUND)
    assert (
        PointStore("a.points").attrs["cells_crc32"] == PointStore("c.points").attrs["cells_crc32"]
    )
    assert PointStore("a.points").count > 0


def test_a_file_that_is_another_one_by_now_is_refused(made):
    with serving(made.content) as server:
        for size, content in ((len(made.content), '"two"'), (len(made.content) + 1, '"one"')):
            place = stand_in(server.url, size, content)
            with pytest.raises(InputError, match="changed on its server"):
                open_ranges(place).get(0, 10)
    assert not FOLDER.exists()


def test_copies_of_other_content_are_other_copies(made):
    with serving(made.content) as server:
        place = stand_in(server.url, len(made.content))
        assert open_ranges(place).get(5, 90) == made.content[5:90]
    with serving(b"x" * len(made.content)) as other:  # a place of its own: another port
        place = stand_in(other.url, len(made.content))
        assert open_ranges(place).get(5, 90) == b"x" * 85


@pytest.mark.parametrize("fault", ["cut", "bit", "empty"])
def test_a_damaged_copy_is_fetched_again(made, fault):
    with serving(made.content) as server:
        place = stand_in(server.url, len(made.content))
        open_ranges(place).get(100, 900)
        (kept,) = FOLDER.glob("*/*")
        held = bytearray(kept.read_bytes())
        if fault == "bit":
            held[7] ^= 4
        kept.write_bytes({"cut": held[:-9], "bit": held, "empty": b""}[fault])
        assert open_ranges(place).get(100, 900) == made.content[100:900]


def test_what_no_server_names_is_not_kept(made):
    """Without an ETag or a time nobody can tell whether a copy is still that of the file."""
    with serving(made.content) as server:
        place = stand_in(server.url, len(made.content), "")
        assert open_ranges(place).get(0, 9) == made.content[:9]
    assert not FOLDER.exists()


def test_the_folder_keeps_its_limit(made):
    with serving(made.content) as server:
        ranges = open_ranges(stand_in(server.url, len(made.content)))
        for k in range(10):
            ranges.get(1000 * k, 1000 * (k + 1))
        ranges.get(0, 1000)  # used again: it stays
        prune(3 * 1004)
        assert len(list(FOLDER.glob("*/*"))) == 3
        assert list(FOLDER.glob("*/0-1000"))
        prune(0)
        assert not list(FOLDER.glob("*"))


def test_a_laz_of_a_server_is_read_by_blocks_that_are_kept(made, monkeypatch):
    monkeypatch.setattr(range_copies, "STREAM_BYTES", 1 << 15)
    with serving(made.content) as server:
        place = stand_in(server.url, len(made.content))
        for _ in range(2):
            with open_stream(place, 1 << 15) as stream:
                assert stream.read() == made.content
                stream.seek(-100, io.SEEK_END)
                assert stream.read(40) == made.content[-100:-60]
            with open_stream(place, 1 << 15) as stream, laspy.open(stream, closefd=False) as reader:
                assert reader.header.point_count == 40_000
        blocks = -(-len(made.content) // (1 << 15))
        assert len(server.requests) <= blocks + 1  # and the first look at the file


def test_a_laz_of_a_server_is_surveyed_by_few_of_its_bytes(tmp_path):
    """Of which its header, its chunk table and some points are read, not each chunk's head."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [0.01] * 3
    header.add_crs(UTM)
    las = laspy.LasData(header)
    las.x, las.y = CORNER[:2, None] + np.random.default_rng(0).uniform(0, 900, (2, 400_000))
    las.z = np.full(400_000, 40.0)
    las.return_number = las.number_of_returns = np.ones(400_000, np.uint8)
    las.write("whole.laz")
    content = Path("whole.laz").read_bytes()
    with serving(content) as server:
        server.url = server.url.replace(".copc.laz", ".laz")
        place = stand_in(server.url, len(content))
        assert survey(place).points == 400_000
        assert server.sent < 0.2 * len(content)
        assert survey(place).box == survey("whole.laz").box
        beside = Footprint.around([np.array([[118, 118.01, 118], [30, 30, 30.01]])], 50.0)
        assert survey(place, footprint=beside).read == (0, 0)
