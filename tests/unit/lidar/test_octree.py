"""Octrees by footprint: all points of it, each server's and file's fault found or overcome."""

from __future__ import annotations

import io
import time
import zlib

import laspy
import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.lidar.footprint import Footprint
from stereotruth.lidar.octree import open_octree
from tests.synthetic.copc_server import (
    CORNER,
    FILE_FAULTS,
    SERVER_FAULTS,
    damaged,
    make_copc,
    serving,
)
from tests.synthetic.real_data import SHARED

PATIENCE_S = 3.0  # of one range; stalls of 0.3 s are given up
RING = CORNER[:2] + np.array([[610, 700], [1100, 640], [1180, 1190], [900, 800], [650, 1100]])
FOOTPRINT = Footprint((RING,))


@pytest.fixture(scope="module")
def made():
    return make_copc()


def points_of(records) -> np.ndarray:
    """What ingest takes of the points, in their order."""
    names = ["X", "Y", "Z", "classification", "return_number", "number_of_returns", "gps_time"]
    return np.array([np.concatenate([np.asarray(r[n]) for r in records]) for n in names])


def cropped(content: bytes, footprint: Footprint) -> np.ndarray:
    """The same by laspy, of the whole file."""
    las = laspy.read(io.BytesIO(content))
    inside = footprint.contains(np.stack([las.x, las.y, las.z]))
    return points_of([las.points[inside]])


def read(location: str, footprint: Footprint | None, patience_s: float = PATIENCE_S) -> np.ndarray:
    octree = open_octree(location, patience_s=patience_s)
    return points_of(list(octree.read(octree.plan(footprint))))


def test_a_footprint_has_the_points_of_the_whole_file(made):
    rng = np.random.default_rng(5)
    with serving(made.content) as server:
        octree = open_octree(server.url)
        for _ in range(20):
            ring = CORNER[:2] + rng.uniform(0, 2048, 2) + rng.uniform(-300, 300, (4, 2))
            footprint = Footprint((ring,), lowest=float(rng.uniform(-60, 20)), highest=50.0)
            plan = octree.plan(footprint)
            truth = cropped(made.content, footprint)
            got = list(octree.read(plan))
            assert sum(map(len, got)) == truth.shape[1]
            if got:
                assert np.array_equal(points_of(got), truth)


def test_bytes_are_those_of_the_touched_nodes():
    made = make_copc(400_000, levels=4)
    with serving(made.content) as server:
        octree = open_octree(server.url)
        plan = octree.plan(FOOTPRINT)
        assert plan.touched <= len(plan.nodes) <= plan.touched + 2
        points = sum(map(len, octree.read(plan)))
    assert 0 < points < plan.points < 0.4 * octree.points
    assert server.sent <= 1.2 * plan.bytes < 0.5 * len(made.content)


@pytest.mark.parametrize("fault", SERVER_FAULTS)
def test_a_server_that_fails_is_overcome_or_named(made, fault):
    truth = cropped(made.content, FOOTPRINT)
    when = 1 + zlib.crc32(fault.encode()) % 5
    start = time.monotonic()
    with serving(made.content, fault, when) as server:
        try:
            assert np.array_equal(read(server.url, FOOTPRINT), truth)
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
            got = read(str(file), FOOTPRINT)
        except InputError as error:
            assert not FILE_FAULTS[fault] and "tile.copc.laz: " in str(error)
            continue
        assert FILE_FAULTS[fault] is not False
        assert np.array_equal(got, cropped(made.content, FOOTPRINT))


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
                read(url, FOOTPRINT, patience_s=1.0)
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
    ring = middle + 300 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    truth = cropped(file.read_bytes(), Footprint((ring,)))
    assert truth.shape[1] > 0
    assert np.array_equal(read(str(file), Footprint((ring,))), truth)


def test_a_footprint_touches_boxes():
    concave = Footprint((np.array([[0, 0], [10, 0], [10, 10], [5, 1], [0, 10.0]]),), -5, 5)
    box = lambda *a: tuple(np.array(a, float).reshape(2, 3))  # noqa: E731
    assert not concave.touches(*box(4.5, 6, 0, 5.5, 9, 1))  # in the notch
    assert concave.touches(*box(4.5, 0.2, 0, 5.5, 0.4, 1))  # inside, holds no corner
    assert concave.touches(*box(-9, -9, 0, 19, 19, 1))  # around it
    assert concave.touches(*box(-1, 4, 0, 11, 5, 1))  # across, no corner in either
    assert not concave.touches(*box(0, 0, 6, 9, 9, 7))  # above


def test_boxes_without_points_in_the_footprint_are_the_only_ones_left_out():
    """A box with a point of the footprint is touched, whatever the polygon."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        footprint = Footprint((rng.uniform(0, 10, (int(rng.integers(3, 9)), 2)),))
        low = np.append(rng.uniform(0, 9, 2), 0.0)
        high = low + np.append(rng.uniform(0.1, 4, 2), 1.0)
        xyz = rng.uniform(low[:, None], high[:, None], (3, 400))
        if footprint.contains(xyz).any():
            assert footprint.touches(low, high)
