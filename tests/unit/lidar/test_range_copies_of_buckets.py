"""LiDAR of object storage: the stores of the files on the disk, and copies for a second run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.lidar.footprint import Footprint
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.range_copies import FOLDER
from stereotruth.lidar.survey import survey
from stereotruth.products.remote_files import _file_system, bring_files

from ...synthetic import object_storage
from ...synthetic.copc_server import make_copc
from ...synthetic.ept import make_ept
from ...synthetic.las import write_las
from ...synthetic.stores import content_of
from ...synthetic.surface_rasters import write_raster

s3fs = pytest.importorskip("s3fs")
pytest.importorskip("moto")
GROUND = Footprint.around([np.array([[117.004, 117.007, 117.004], [29.829, 29.829, 29.837]])], 50.0)
KINDS = ("tile.copc.laz", "tile.laz", "tile.tif", "set/ept.json")


@pytest.fixture(scope="module")
def bucket(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bucket")
    with object_storage.serving(folder) as server:
        s3fs.S3FileSystem.clear_instance_cache()
        _file_system.cache_clear()
        files = folder / "files"
        files.mkdir()
        (files / "tile.copc.laz").write_bytes(make_copc(40_000).content)
        write_las(files / "tile.laz", 20_000, side=1500.0)
        heights = np.random.default_rng(0).uniform(20, 60, (400, 500)).astype(np.float32)
        write_raster(files / "tile.tif", heights, 2.0, tiled=True, blockxsize=128, blockysize=128)
        make_ept(files / "set")
        server.put_folder(files, "lidar")
        yield server, files
    _file_system.cache_clear()


@pytest.mark.parametrize("kind", KINDS)
def test_the_store_is_that_of_the_disk_and_asked_for_once(bucket, tmp_path, monkeypatch, kind):
    _, files = bucket
    monkeypatch.chdir(tmp_path)
    place = bring_files(f"s3://bucket/lidar/{kind}", (".laz", ".tif", "ept.json"))
    surveyed = survey(place, footprint=GROUND)
    ingest(place, "there.points", footprint=GROUND)
    ingest(files / kind, "here.points", footprint=GROUND)
    there, here = PointStore("there.points"), PointStore("here.points")
    assert content_of(there) == content_of(here) and here.count > 0
    assert surveyed.read[0] == here.attrs["points"]["read"]
    assert any(FOLDER.glob("*/*"))
    monkeypatch.setattr("stereotruth.lidar.range_copies.bucket", None)  # nobody is asked
    monkeypatch.setattr("stereotruth.lidar.ept.read_bytes", None)
    monkeypatch.setattr("stereotruth.lidar.range_copies.refuse_changed", None)
    ingest(place, "again.points", footprint=GROUND)
    assert content_of(PointStore("again.points")) == content_of(here)


def test_an_object_that_has_changed_is_refused(bucket, tmp_path, monkeypatch):
    server, files = bucket
    monkeypatch.chdir(tmp_path)
    content = (files / "tile.copc.laz").read_bytes()
    server.put("lidar/other.copc.laz", content)
    place = bring_files("s3://bucket/lidar/other.copc.laz", (".laz",))
    server.put("lidar/other.copc.laz", content[:-1] + b"x")
    with pytest.raises(InputError, match="changed on its server"):
        ingest(place, Path("a.points"), footprint=GROUND)
