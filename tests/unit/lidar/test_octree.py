"""Octrees by footprint: the points of the whole file that lie in it, or a refusal; never less."""

from __future__ import annotations

import io
import os
import shutil
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.file_parts import FOLDER
from stereotruth.core.products.remote_files import bring_files
from stereotruth.lidar.declared_crs import header_crs, interpret
from stereotruth.lidar.ingest import ingest, survey
from stereotruth.lidar.lattice import Footprint
from stereotruth.lidar.octree import open_octree
from stereotruth.lidar.point_store import PointStore

from ...synthetic import object_storage
from ...synthetic.copc_server import (
    CORNER,
    ENTRY,
    FILE_FAULTS,
    UTM,
    damaged,
    make_copc,
    points_of,
    serving,
)
from ...synthetic.ept import FAULTS, _about, make_ept
from ...synthetic.las import write_las
from ...synthetic.real_data import SHARED
from ...synthetic.stores import content_of, part_of
from ...synthetic.surface_rasters import write_raster

AREA = Footprint.around([np.array([[117.006, 117.009, 117.006], [29.836, 29.836, 29.839]])], 50.0)


@dataclass(frozen=True)
class Ground:
    """A box of ground in the system of a file."""

    low: np.ndarray
    high: np.ndarray

    def touches(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return ((low[:, :2] <= self.high) & (high[:, :2] >= self.low)).all(axis=1)

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        return ((self.low <= xyz[:2].T) & (self.high >= xyz[:2].T)).all(axis=1)


GROUND = Ground(CORNER[:2] + np.array([610, 640]), CORNER[:2] + np.array([1180, 1190]))


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def made():
    return make_copc()


def cropped(content: bytes, ground: Ground) -> np.ndarray:
    """The same by laspy, of the whole file."""
    las = laspy.read(io.BytesIO(content))
    return points_of([las.points[ground.contains(np.stack([las.x, las.y]))]])


def read(path: str | Path, ground: Ground | None) -> np.ndarray:
    """The points of a ground, by the nodes that touch it."""
    octree = open_octree(path)
    records = list(octree.read(octree.plan(None if ground is None else ground.touches)))
    if not records:
        return np.empty((7, 0))
    got = points_of(records)
    xyz = got[:3].T * octree.header.scales + octree.header.offsets
    return got if ground is None else got[:, ground.contains(xyz.T)]


# ------------------------------------------------------------------ COPC


@pytest.mark.parametrize("name", ["simple_with_page.copc.laz", "autzen.copc.laz"])
def test_files_of_other_software_are_read_whole(name):
    file = SHARED / "lidar" / name
    if not file.is_file():
        pytest.skip("needs ../shared")
    las = laspy.read(file)
    assert np.array_equal(read(file, None), points_of([las.points]))
    middle = np.median(np.stack([las.x, las.y]), axis=1)
    ground = Ground(middle - 300, middle + 300)
    truth = cropped(file.read_bytes(), ground)
    assert truth.shape[1] > 0 and np.array_equal(read(file, ground), truth)


def test_stores_of_footprints_are_those_of_the_whole_cropped():
    """Of points of format 8; other files here have format 6."""
    file, rng = Path("tile.copc.laz"), np.random.default_rng(8)
    file.write_bytes(make_copc(12_000, form=8).content)
    ingest(file, "whole.points")
    whole = PointStore("whole.points")
    west, south, east, north = whole.bounds[:4]
    for k in range(2):
        corners = rng.uniform([[west], [south]], [[east], [north]], (2, 3))
        footprint = Footprint.around([corners], 20.0)
        ingest(file, f"{k}.points", footprint=footprint, chunk_points=333)
        assert content_of(PointStore(f"{k}.points")) == part_of(whole, footprint)
        assert 0 < PointStore(f"{k}.points").count < whole.count


def test_few_bytes_of_a_server_are_read_and_a_second_run_asks_for_nothing():
    made = make_copc(200_000, levels=4)
    Path("tile.copc.laz").write_bytes(made.content)
    ingest("tile.copc.laz", "disk.points", footprint=AREA)
    with serving(made.content) as server:
        place = server.stand_in()
        ingest(place, "web.points", footprint=AREA)
        nodes, every = PointStore("web.points").attrs["bytes"]
        assert server.sent < 1.1 * nodes + 130_000 < 0.5 * every
        server.requests.clear()
        ingest(place, "again.points", footprint=AREA)
        assert server.requests == []
    disk = content_of(PointStore("disk.points"))
    assert disk == content_of(PointStore("web.points")) == content_of(PointStore("again.points"))
    assert PointStore("disk.points").count > 0


@pytest.mark.parametrize("fault", FILE_FAULTS)
def test_a_damaged_file_loses_nothing_silently(made, fault):
    file, (comes, _) = Path("tile.copc.laz"), FILE_FAULTS[fault]
    file.write_bytes(damaged(made, fault, np.random.default_rng(zlib.crc32(fault.encode()))))
    try:
        got = read(file, GROUND)
    except InputError as error:
        assert not comes and error.file == "tile.copc.laz"
        return
    assert comes is not False
    assert np.array_equal(got, cropped(made.content, GROUND))


def test_a_node_that_stands_elsewhere_is_found_though_it_is_not_read(made):
    """On the disk: a leaf of the ground has the key of a place where no node is."""

    def is_shown(key: tuple[int, ...], of) -> bool:
        side = 2048.0 / 2 ** key[0]
        low = CORNER + np.array([key[1:]]) * side
        return of(GROUND.touches(low, low + side))

    keys = {entry[:4] for entry in made.entries}
    leaf = next(e for e in made.entries if e[0] == 4 and is_shown(e[:4], np.all))
    free = ((4, x, y, z) for x in range(16) for y in range(16) for z in (7, 8))
    key = next(key for key in free if key not in keys and not is_shown(key, np.any))
    content = bytearray(made.content)
    ENTRY.pack_into(content, content.index(ENTRY.pack(*leaf)), *key, *leaf[4:])
    Path("tile.copc.laz").write_bytes(content)
    with pytest.raises(InputError, match="outside of its cube"):
        read("tile.copc.laz", GROUND)


@pytest.mark.parametrize("how", ["written over", "cut"])
def test_a_file_on_the_disk_that_changes_while_it_is_read_is_refused(made, how):
    file = Path("tile.copc.laz")
    file.write_bytes(made.content)
    octree = open_octree(file)
    file.write_bytes(made.content if how == "written over" else made.content[:-100])
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match="changed while it was read"):
        list(octree.read(octree.plan(GROUND.touches)))


def test_a_system_behind_the_points_is_read(made):
    """Some software writes the coordinate system into a record behind the points."""
    content = bytearray(made.content)
    at = content.index(b"LASF_Projection")
    content[at : at + 15] = b"some_other_user"
    wkt = content[at + 52 : content.index(b"\0", at + 52) + 1]
    (count,) = struct.unpack_from("<I", content, 243)
    struct.pack_into("<I", content, 243, count + 1)
    content += struct.pack("<H16sHQ32s", 0, b"LASF_Projection", 2112, len(wkt), b"") + wkt
    Path("tile.copc.laz").write_bytes(content)
    record = open_octree("tile.copc.laz").header.vlrs[-1]
    assert (record.record_id, record.record_data_bytes()) == (2112, wkt)


# ------------------------------------------------------------------ files of servers


def test_a_laz_of_a_server_is_surveyed_by_few_of_its_bytes():
    """Of which its header, its chunk table and some points are read, not each chunk's head."""
    write_las(Path("whole.laz"), 400_000, scale=0.01)
    content = Path("whole.laz").read_bytes()
    with serving(content) as server:
        server.url = server.url.replace(".copc.laz", ".laz")
        place = server.stand_in()
        assert survey(place).box == survey("whole.laz").box
        assert server.sent < 0.2 * len(content)
        beside = Footprint.around([np.array([[118, 118.01, 118], [30, 30, 30.01]])], 50.0)
        assert survey(place, footprint=beside).read == (0, 0)


@pytest.fixture(scope="module")
def bucket(tmp_path_factory):
    s3fs = pytest.importorskip("s3fs")
    pytest.importorskip("moto")
    folder = tmp_path_factory.mktemp("bucket")
    with object_storage.serving(folder) as server:
        s3fs.S3FileSystem.clear_instance_cache()
        files = folder / "files"
        files.mkdir()
        (files / "tile.copc.laz").write_bytes(make_copc(40_000).content)
        write_las(files / "tile.laz", 20_000, side=1500.0)
        heights = np.random.default_rng(0).uniform(20, 60, (400, 500)).astype(np.float32)
        write_raster(files / "tile.tif", heights, 2.0, tiled=True, blockxsize=128, blockysize=128)
        make_ept(files / "set")
        server.put_folder(files, "lidar")
        yield server, files


@pytest.mark.parametrize("kind", ["tile.copc.laz", "tile.laz", "tile.tif", "set/ept.json"])
def test_the_store_of_a_bucket_is_that_of_the_disk_and_asked_for_once(bucket, monkeypatch, kind):
    _, files = bucket
    corners = np.array([[117.004, 117.007, 117.004], [29.829, 29.829, 29.837]])
    ground = Footprint.around([corners], 50.0)
    place = bring_files(f"s3://bucket/lidar/{kind}", (".laz", ".tif", "ept.json"))
    surveyed = survey(place, footprint=ground)
    ingest(place, "there.points", footprint=ground)
    ingest(files / kind, "here.points", footprint=ground)
    there, disk = PointStore("there.points"), PointStore("here.points")
    assert content_of(there) == content_of(disk) and disk.count > 0
    assert surveyed.read[0] == disk.attrs["points"]["read"]
    assert any(FOLDER.glob("*/*"))
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")  # nobody is asked
    monkeypatch.setattr("stereotruth.core.products.remote_files.bucket", None)
    ingest(place, "again.points", footprint=ground)
    assert content_of(PointStore("again.points")) == content_of(disk)


# ------------------------------------------------------------------ Entwine Point Tiles


@pytest.fixture(scope="module")
def tiles(tmp_path_factory) -> Path:
    return make_ept(tmp_path_factory.mktemp("ept") / "set")


@pytest.fixture
def dataset(tiles, tmp_path) -> Path:
    shutil.copytree(tiles.parent, tmp_path / "set")
    return tmp_path / "set" / "ept.json"


def ground() -> Footprint:
    change = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    x, y = CORNER[0] + np.array([300.0, 700.0]), CORNER[1] + np.array([300.0, 600.0])
    return Footprint.around([np.stack(change.transform(x[[0, 1, 1, 0]], y[[0, 0, 1, 1]])[:2])], 0.0)


@pytest.fixture(scope="module")
def good(tiles, tmp_path_factory) -> dict[str, tuple[bytes, bytes]]:
    """What a LAS file of all points gives, of all ground and of a footprint."""
    folder, stores = tmp_path_factory.mktemp("good"), {}
    for name, footprint in (("all", None), ("part", ground())):
        ingest(tiles.with_name("all.las"), folder / name, footprint=footprint)
        stores[name] = content_of(PointStore(folder / name))
    return stores


def test_the_store_is_that_of_a_file_of_all_points(tiles, good):
    ingest(tiles, "all.points")
    assert content_of(PointStore("all.points")) == good["all"]
    surveyed, summary = survey(tiles, footprint=ground()), ingest(
        tiles, "part.points", footprint=ground()
    )  # fmt: skip
    assert content_of(PointStore("part.points")) == good["part"]
    read, every = summary["nodes"]
    assert read < every / 2
    assert 0 < summary["points"]["kept"] <= summary["points"]["read"] < 3000
    # bytes are estimated before they are read: small nodes have large headers
    size = sum(file.stat().st_size for file in (tiles.parent / "ept-data").glob("*.laz"))
    assert 0 < surveyed.read[1] < surveyed.bytes and size / 4 < surveyed.bytes < 2 * size
    assert summary["bytes"] == [surveyed.read[1], surveyed.bytes]


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
def test_a_damaged_dataset_is_refused_and_a_footprint_of_it_whole(dataset, good, fault):
    FAULTS[fault](dataset.parent)
    with pytest.raises(InputError):
        ingest(dataset, "all.points")
    assert not Path("all.points").exists()
    try:
        ingest(dataset, "part.points", footprint=ground())
    except InputError:
        return
    assert content_of(PointStore("part.points")) == good["part"]
