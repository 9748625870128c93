"""Products in object storage and inputs from there, on a server of this machine's own.

The same files as a local run makes, after kills; a checkout elsewhere that plans nothing, with a
copy of what Snakemake knows; little left behind; images and LiDAR read by their parts.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products import remote_files
from stereotruth.core.products.file_parts import open_stream
from stereotruth.core.products.rasters import open_raster

from ..synthetic.object_storage import BUCKET, Server, serving
from ..synthetic.project import SIZE, Project, copy_project, row_of
from .killing import PRODUCTS, hashes, kill, start

for needed in ("moto", "flask", "s3fs", "snakemake_storage_plugin_s3"):
    pytest.importorskip(needed, reason="needs the extras dev and storage")
pytestmark = pytest.mark.slow

CALL = ["tiles/Tiny", "--configfile", "tiny.yaml"]
STORED = ["--profile", "profiles/s3", "--default-storage-prefix", f"s3://{BUCKET}/tiny"]
# Its lines name where the tiles lie.
NAMES_PLACES = "results/export/Tiny/summary.json"
# Amid the work, and amid the upload of the last product.
KILLED_AT = (
    "project Tiny-1: disparity: ",
    f"Storing in storage: s3://{BUCKET}/tiny/tiles/Tiny",
)
LEFT_BEHIND_BYTES = 1_000_000


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("server")) as server:
        yield server


def checkout(folder: Path, data: Path) -> Project:
    """The workflow and the city's input, nothing made yet."""
    project = copy_project(folder)
    shutil.copytree(data, project.folder / "in")
    project.add_scene("tiny", [row_of(Path("in"))], **SIZE)
    return project


def run_until(folder: Path, said: str) -> None:
    """A run, all of whose processes are killed as soon as it has said something."""
    log = folder / "run.log"
    log.unlink(missing_ok=True)
    run = start(folder, *CALL, *STORED)
    try:
        while not log.exists() or said not in log.read_text():
            assert run.poll() is None, log.read_text()[-4000:]
            time.sleep(0.02)
    finally:
        kill(run, "tree")


@dataclass
class Stored:
    """A project whose products lie in the bucket; the bytes of them by their paths."""

    project: Project
    files: dict[str, bytes]


@pytest.fixture(scope="module")
def stored(server, data, tmp_path_factory) -> Stored:
    """Made by runs that were killed twice, and by one that ended."""
    project = checkout(tmp_path_factory.mktemp("stored") / "project", data)
    for moment in KILLED_AT:
        run_until(project.folder, moment)
    run = project.snakemake(*CALL, *STORED)
    assert run.status == 0, run.text[-4000:]
    assert set(run.jobs) == {"export"}
    return Stored(project, server.contents("tiny/"))


def test_the_bucket_has_the_files_of_a_local_run(made, stored, tmp_path):
    for name, content in stored.files.items():
        file = tmp_path / name
        if name.startswith(PRODUCTS):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
    here, there = hashes(made.folder), hashes(tmp_path)
    assert here.pop(NAMES_PLACES) and there.pop(NAMES_PLACES)
    assert len(here) > 100
    assert there == here
    folder = stored.project.folder  # in which little is left behind
    assert not [f for f in (folder / ".snakemake/storage").rglob("*") if f.is_file()]
    left = sum(f.stat().st_size for f in (folder / ".snakemake").rglob("*") if f.is_file())
    assert left < LEFT_BEHIND_BYTES and not (folder / "tiles").exists()


def test_another_checkout_plans_nothing_and_then_what_an_edit_touches(stored, data, tmp_path):
    """With a copy of what Snakemake has noted."""
    fresh = checkout(tmp_path / "elsewhere", data)
    shutil.copytree(stored.project.folder / ".snakemake", fresh.folder / ".snakemake")
    assert fresh.plan(*CALL, *STORED) == {}
    strips = fresh.snakemake(*CALL, *STORED, "--config", "strips=2", "--dry-run")
    assert strips.status != 0 and "need a file system" in strips.text
    points = fresh.folder / "in/gcps.csv"
    lines = points.read_text().splitlines(keepends=True)
    points.write_text("".join(lines[:-1]))
    due = {"align", "refine", "rectify", "project", "export"}
    assert set(fresh.plan(*CALL, *STORED)) == due


@pytest.fixture(scope="module")
def from_urls(server, data, tmp_path_factory) -> Project:
    """Labels whose inputs lie in the bucket, the right image on a web server."""
    server.put_folder(data, "in")
    project = copy_project(tmp_path_factory.mktemp("urls") / "project")
    there = f"s3://{BUCKET}/in"
    row = row_of(Path("in")) | {
        "left_image": f"{there}/left.tif",
        "right_image": f"{server.endpoint}/{BUCKET}/in/right.tif",
        "lidar": f"{there}/lidar/*.laz",
        "gcps": f"{there}/gcps.csv",
    }
    project.add_scene("tiny", [row], **SIZE)
    run = project.snakemake("results/project/Tiny/Tiny-1.zarr", "--configfile", "tiny.yaml")
    assert run.status == 0, run.text[-4000:]
    return project


def test_inputs_by_url_give_the_same_bytes(made, from_urls):
    """All chunks; the attributes say that the inputs were others, in name and checksum."""
    there, here = (
        {
            name: checksum
            for name, checksum in hashes(project.folder).items()
            if "/c/" in name and name.startswith(("results/project", "results/rectify"))
        }
        for project in (from_urls, made)
    )
    assert len(here) > 10
    assert there == here
    assert not list(from_urls.folder.rglob("*.laz.partial"))
    stand_ins = [f for f in (from_urls.folder / "results/remote").rglob("*") if f.is_file()]
    assert len(stand_ins) == 5
    assert sum(f.stat().st_size for f in stand_ins if f.suffix != ".csv") < 1000


def test_an_input_replaced_on_its_server_is_seen(server, data, from_urls):
    call = ["results/project/Tiny/Tiny-1.zarr", "--configfile", "tiny.yaml"]
    file = data / "lidar/Tiny-1_0_0.laz"
    server.put("in/lidar/Tiny-1_0_0.laz", file.read_bytes())
    assert from_urls.plan(*call) == {}  # the same content
    server.put("in/lidar/Tiny-1_0_0.laz", file.read_bytes() + b"\0")
    assert from_urls.plan(*call) == {
        "ingest": 1,
        "compare_strips": 1,
        "surface": 1,
        "refine": 1,
        "rectify": 1,
        "project": 1,
    }
    server.put("in/lidar/Tiny-1_0_0.laz", file.read_bytes())


def test_only_what_the_sheet_names_is_read(server, data, tmp_path, monkeypatch):
    """Parts of the image alone travel, and a raster that names another file gets nothing."""
    monkeypatch.chdir(tmp_path)
    server.put_folder(data, "in")
    image = remote_files.bring_image(f"s3://{BUCKET}/in/left.tif")
    with open_raster(image) as there, open_raster(data / "left.tif") as here:
        window = ((100, 130), (200, 250))
        assert np.array_equal(there.read(1, window=window), here.read(1, window=window))
    elsewhere = tmp_path / "left.tif"
    elsewhere.write_bytes(image.read_bytes())  # a stand-in's content makes no stand-in
    with pytest.raises(Exception, match="not recognized"):
        open_raster(elsewhere)
    with pytest.raises(Exception, match="does not exist"):
        open_raster(f"/vsis3/{BUCKET}/in/left.tif")
    lidar = remote_files.bring_files(f"s3://{BUCKET}/in/lidar", (".laz",))
    file = lidar / "Tiny-1_0_1.laz"
    with open_stream(file) as stream:
        assert stream.read(4) == b"LASF"
    server.put("in/lidar/Tiny-1_0_1.laz", b"LASF another")
    with pytest.raises(InputError, match="changed on its server"):
        open_stream(file, keep=False).read(4)
