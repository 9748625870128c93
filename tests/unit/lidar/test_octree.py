"""Octrees by footprint: all points of it, each server's and file's fault found or overcome."""

from __future__ import annotations

import io
import os
import struct
import time
import zlib
from dataclasses import dataclass

import laspy
import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.lidar.octree import open_octree
from tests.synthetic.copc_server import (
    CORNER,
    ENTRY,
    FILE_FAULTS,
    SERVER_FAULTS,
    damaged,
    make_copc,
    points_of,
    serving,
)
from tests.synthetic.real_data import SHARED

PATIENCE_S = 3.0  # of one range; stalls of 0.3 s are given up


@dataclass(frozen=True)
class Ground:
    """A box of ground in the system of a file."""

    low: np.ndarray
    high: np.ndarray

    def touches(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return ((low[:, :2] <= self.high) & (high[:, :2] >= self.low)).all(axis=1)

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        x = xyz[:2].T
        return ((x >= self.low) & (x <= self.high)).all(axis=1)


GROUND = Ground(CORNER[:2] + np.array([610, 640]), CORNER[:2] + np.array([1180, 1190]))


@pytest.fixture(scope="module")
def made():
    return make_copc()


def cropped(content: bytes, ground: Ground) -> np.ndarray:
    """The same by laspy, of the whole file."""
    las = laspy.read(io.BytesIO(content))
    inside = ground.contains(np.stack([las.x, las.y]))
    return points_of([las.points[inside]])


def read(location: str, ground: Ground | None, patience_s: float = PATIENCE_S) -> np.ndarray:
    """The points of a ground, by the nodes that touch it."""
    octree = open_octree(location, patience_s=patience_s)
    records = list(octree.read(octree.plan(None if ground is None else ground.touches)))
    if not records:
        return np.empty((7, 0))
    scales, offsets = octree.header.scales, octree.header.offsets
    got = points_of(records)
    return got if ground is None else got[:, ground.contains((got[:3].T * scales + offsets).T)]


@pytest.mark.slow
def test_a_footprint_has_the_points_of_the_whole_file(made):
    rng = np.random.default_rng(5)
    with serving(made.content) as server:
        for _ in range(20):
            low = CORNER[:2] + rng.uniform(-300, 2048, 2)
            ground = Ground(low, low + rng.uniform(1, 500, 2))
            truth = cropped(made.content, ground)
            assert np.array_equal(read(server.url, ground), truth)


def test_bytes_are_those_of_the_touched_nodes():
    made = make_copc(400_000, levels=4)
    with serving(made.content) as server:
        octree = open_octree(server.url)
        plan = octree.plan(GROUND.touches)
        assert plan.touched <= len(plan.nodes) <= plan.touched + 2
        points = sum(map(len, octree.read(plan)))
    assert 0 < points == plan.points < 0.4 * octree.points
    assert server.sent <= 1.2 * plan.bytes < 0.5 * len(made.content)


@pytest.mark.slow
@pytest.mark.parametrize("fault", SERVER_FAULTS)
def test_a_server_that_fails_is_overcome_or_named(made, fault):
    truth = cropped(made.content, GROUND)
    when = 1 + zlib.crc32(fault.encode()) % 5
    start = time.monotonic()
    with serving(made.content, fault, when) as server:
        try:
            assert np.array_equal(read(server.url, GROUND), truth)
            assert SERVER_FAULTS[fault]
        except InputError as error:
            assert not SERVER_FAULTS[fault], error
            assert server.url in str(error) and "secret" not in str(error)
    assert time.monotonic() - start < 2 * PATIENCE_S + 1
    assert len(server.requests) > when  # the fault was met


@pytest.mark.parametrize("fault", FILE_FAULTS)
def test_a_damaged_file_loses_nothing_silently(made, fault, tmp_path):
    file = tmp_path / "tile.copc.laz"
    for seed in range(3):
        rng = np.random.default_rng([zlib.crc32(fault.encode()), seed])
        file.write_bytes(damaged(made, fault, rng))
        try:
            got = read(str(file), GROUND)
        except InputError as error:
            assert not FILE_FAULTS[fault] and "tile.copc.laz: " in str(error)
            continue
        assert FILE_FAULTS[fault] is not False
        assert np.array_equal(got, cropped(made.content, GROUND))


def test_a_redirect_is_followed_to_hosts_that_are_allowed(made):
    with serving(made.content) as other, serving(made.content, "redirect to another host") as first:
        first.target = other.url.replace("127.0.0.1", "localhost") + "?sig=secret"
        with pytest.raises(InputError, match="another host, localhost") as refused:
            open_octree(first.url)
        assert "--allow-host localhost" in str(refused.value) and "sig" not in str(refused.value)
        assert not other.requests
        assert open_octree(first.url, allow_hosts=frozenset({"localhost"})).points == 20_000


def test_secrets_of_a_url_are_in_no_message(made):
    for fault in ("forbidden", "503 for ever", "no ranges", "reset"):
        with serving(made.content, fault) as server:
            url = server.url.replace("http://", "http://user:word@") + "?X-Signature=abcdef"
            try:
                read(url, GROUND, patience_s=1.0)
                assert fault == "reset"
            except InputError as error:
                assert "abcdef" not in str(error) and "word" not in str(error)


@pytest.mark.parametrize("name", ["simple_with_page.copc.laz", "autzen.copc.laz"])
def test_files_of_other_software_are_read_whole(name):
    file = SHARED / "lidar" / name
    if not file.is_file():
        pytest.skip("needs ../shared")
    las = laspy.read(file)
    assert np.array_equal(read(str(file), None), points_of([las.points]))
    middle = np.median(np.stack([las.x, las.y]), axis=1)
    ground = Ground(middle - 300, middle + 300)
    truth = cropped(file.read_bytes(), ground)
    assert truth.shape[1] > 0
    assert np.array_equal(read(str(file), ground), truth)


@pytest.mark.parametrize("how", ["replaced", "written over", "cut"])
def test_a_file_on_the_disk_that_changes_while_it_is_read_is_refused(made, tmp_path, how):
    file = tmp_path / "tile.copc.laz"
    file.write_bytes(made.content)
    octree = open_octree(file)
    records = octree.read(octree.plan(GROUND.touches))
    if how == "replaced":
        (tmp_path / "other").write_bytes(made.content)
        (tmp_path / "other").replace(file)
    else:
        content = made.content if how == "written over" else made.content[:-100]
        file.write_bytes(content)
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match="changed while it was read"):
        list(records)


def test_nodes_that_are_exchanged_are_never_taken_for_each_other(made, tmp_path):
    """A hierarchy with two nodes of one line of descent exchanged: refused, or nothing is lost."""
    file, nodes = tmp_path / "tile.copc.laz", made.entries
    content = bytearray(made.content)
    places = {}
    for at in range(made.hierarchy_at, len(content) - ENTRY.size + 1, ENTRY.size):
        *key, _, _, n = ENTRY.unpack_from(content, at)
        if n > 0:
            places[tuple(key)] = at
    by_key = {entry[:4]: entry[4:] for entry in nodes}
    assert by_key.keys() == places.keys()
    lines = [
        (above, below)
        for above in by_key
        for below in by_key
        if above[0] < below[0]
        and tuple(v >> (below[0] - above[0]) for v in below[1:]) == above[1:]
        and not GROUND.touches(*boxes_of(below)).any()
        and GROUND.touches(*boxes_of(above)).all()
    ]
    assert len(lines) > 20
    truth, refused = cropped(made.content, GROUND), 0
    for above, below in lines[:: max(len(lines) // 40, 1)]:
        changed = bytearray(content)
        ENTRY.pack_into(changed, places[above], *above, *by_key[below])
        ENTRY.pack_into(changed, places[below], *below, *by_key[above])
        file.write_bytes(changed)
        try:
            assert np.array_equal(read(str(file), GROUND), truth)
        except InputError as error:
            assert "outside of its cube" in str(error)
            refused += 1
    assert refused > 10


def test_a_node_that_stands_elsewhere_in_the_hierarchy_is_found_though_it_is_not_read(
    made, tmp_path
):
    """On the disk: a leaf of the ground has the key of a place where no node is."""
    file, keys = tmp_path / "tile.copc.laz", {entry[:4] for entry in made.entries}
    leaves = [e for e in made.entries if e[0] == 4 and GROUND.touches(*boxes_of(e[:4])).all()]
    free = [(4, x, y, z) for x in range(16) for y in range(16) for z in (7, 8)]
    free = [key for key in free if key not in keys and not GROUND.touches(*boxes_of(key)).any()]
    assert len(leaves) > 5 and len(free) > 100
    for leaf, key in zip(leaves, free):
        content = bytearray(made.content)
        at = content.index(ENTRY.pack(*leaf), made.hierarchy_at)
        ENTRY.pack_into(content, at, *key, *leaf[4:])
        file.write_bytes(content)
        with pytest.raises(InputError, match="outside of its cube"):
            read(str(file), GROUND)


def boxes_of(key: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Corners [1, 3] of a node's cube."""
    side = 2048.0 / 2 ** key[0]
    low = CORNER + np.array([key[1:]]) * side
    return low, low + side


def test_a_system_behind_the_points_is_read(made, tmp_path):
    """Some software writes the coordinate system into a record behind the points."""
    content = bytearray(made.content)
    at = content.index(b"LASF_Projection")
    content[at : at + 15] = b"some_other_user"
    wkt = content[at + 52 : content.index(b"\0", at + 52) + 1]
    count = struct.unpack_from("<I", content, 243)[0]
    struct.pack_into("<I", content, 243, count + 1)
    content += struct.pack("<H16sHQ32s", 0, b"LASF_Projection", 2112, len(wkt), b"") + wkt
    file = tmp_path / "tile.copc.laz"
    file.write_bytes(content)
    record = open_octree(file).header.vlrs[-1]
    assert (record.record_id, record.record_data_bytes()) == (2112, wkt)
