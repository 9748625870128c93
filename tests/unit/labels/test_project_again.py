"""Stages that are asked again: what they take over, what they make anew, always the same bytes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import dask.threaded
import numpy as np
import pytest
import zarr

from stereotruth.core.errors import InputError
from stereotruth.core.job import dask_scheduler
from stereotruth.core.products.files import sealed
from stereotruth.core.products.grids import Strip, seal
from stereotruth.labels import project as module
from stereotruth.labels import recipe
from stereotruth.lidar.point_store import ATTRIBUTES

from ...synthetic.box_scene import Scene, alignment_of, project_with, write_image, write_points
from ...synthetic.stores import tree


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Scene:
    """Small blocks, so that there are many; stores that say what they are made of."""
    monkeypatch.setattr("stereotruth.labels.project.SHARD", 128)
    monkeypatch.setattr("stereotruth.labels.project.CHUNK", 64)
    monkeypatch.setattr("stereotruth.surface.make_surface.block_side", lambda scale: 256)
    monkeypatch.setattr("stereotruth.surface.make_surface.group_blocks", lambda *_: 1)
    (tmp_path / "scene").mkdir()
    scene = Scene(tmp_path / "scene", box=True)
    name_points(scene.store, {"made of": "points"})
    for path in scene.images:
        name(path, path.stem)
    return scene


def name(store: Path, text: str) -> Path:
    zarr.open_group(store, mode="r+").attrs["provenance"] = {"made of": text}
    seal(store)
    return store


def name_points(store: Path, made_of: dict[str, str]) -> Path:
    file = store / ATTRIBUTES
    values = json.loads(file.read_text()) | {"provenance": made_of}
    values.pop("digest")
    file.write_text(sealed(values))
    return store


def project(scene: Scene, stores: list[Path], out: Path, **options) -> set[str]:
    """Project; names of the blocks that were made."""
    done = out.with_name(f".{out.name}.work") / "done"
    before = {file.name: file.stat().st_mtime_ns for file in done.glob("*.json")}
    project_with(*scene.images, stores, out, **options)
    return {
        file.name
        for file in done.glob("*.json")
        if file.stat().st_mtime_ns != before.get(file.name)
    }


@pytest.mark.slow
def test_one_more_file_has_only_the_blocks_made_that_it_touches(scene, tmp_path):
    """And the bytes are those of a run from scratch with both files."""
    out = tmp_path / "out.zarr"
    everything = project(scene, [scene.store], out)
    assert project(scene, [scene.store], out) == set()
    lon, lat, _ = scene.points.T
    corner = scene.points[(lon < lon.min() + 2e-4) & (lat < lat.min() + 2e-4)] + [0.0, 0.0, 4.0]
    more = write_points(tmp_path / "more", corner, name="more")
    name_points(more, {"made of": "more"})
    touched = project(scene, [scene.store, more], out)
    assert touched and len(touched) < 0.7 * len(everything), (len(touched), len(everything))
    other = tmp_path / "other.zarr"
    assert project(scene, [more, scene.store], other) == everything
    assert tree(out) == tree(other)


@pytest.mark.slow
def test_a_killed_run_is_carried_on(scene, tmp_path, monkeypatch):
    """What the LiDAR has decided is taken over; nothing of it is left in the end."""
    whole, out = tmp_path / "whole.zarr", tmp_path / "out.zarr"
    everything, made = project(scene, [scene.store], whole), []

    def layers_of_some(*arguments):
        made.append(arguments)
        if len(made) > 4:
            raise RuntimeError("killed")
        return recipe.image_layers(*arguments)

    def no_more(scene, rows, cols):
        raise AssertionError(f"asked again: {rows}, {cols}")

    with monkeypatch.context() as killed, pytest.raises(RuntimeError, match="killed"):
        killed.setattr(module, "image_layers", layers_of_some)
        project(scene, [scene.store], out, scheduler="sync")
    work = tmp_path / ".out.zarr.work"
    kept = {file.stem for file in (work / "lidar").rglob("*.labels")}
    assert kept and not out.exists()
    with monkeypatch.context() as complete:
        if len(kept) == len(everything):
            complete.setattr(module, "lidar_labels", no_more)
        assert len(project(scene, [scene.store], out)) == len(everything) - 4
    assert tree(out) == tree(whole) and not (work / "lidar").exists()


@pytest.mark.slow
def test_another_covariance_of_the_alignment_is_another_uncertainty(scene, tmp_path):
    """And what else its file says makes no block anew."""
    out, file = tmp_path / "out.zarr", tmp_path / "alignment.json"
    known = {}
    for factor in (1.0, 3.0):
        alignment = alignment_of(scene.model, factor)
        alignment.save(file)
        assert project(scene, [scene.store], out, alignment=file)
        known[factor] = {name: array[:] for name, array in zarr.open_group(out).arrays()}
        replace(alignment, warnings=("a doubt",)).save(file)
        assert project(scene, [scene.store], out, alignment=file) == set()
    for name, array in known[1.0].items():
        assert np.array_equal(array, known[3.0][name], equal_nan=True) == (name != "uncertainty")
    assert np.nanmin(known[3.0]["uncertainty"] - known[1.0]["uncertainty"]) > 0.01


@pytest.mark.slow
def test_strips_and_the_whole_give_the_same_bytes(scene, tmp_path):
    whole, out = tmp_path / "whole.zarr", tmp_path / "strips.zarr"
    everything = project(scene, [scene.store], whole, view="right")
    parts = [project(scene, [scene.store], out, view="right", strip=Strip(k, 3)) for k in (2, 0, 1)]
    assert not out.exists()
    assert set.union(*parts) == everything and sum(map(len, parts)) == len(everything)
    assert project(scene, [scene.store], out, view="right") == set()
    assert tree(out) == tree(whole)


@pytest.mark.slow
def test_a_store_that_does_not_say_what_it_is_made_of_is_never_taken_over(scene, tmp_path):
    name_points(scene.store, {})
    out = tmp_path / "out.zarr"
    everything = project(scene, [scene.store], out)
    record = json.loads((tmp_path / ".out.zarr.work/done/0-0.json").read_text())
    assert {"key", "sha256", "result", "format"} == set(record)
    assert project(scene, [scene.store], out) >= everything - {"0-0.json"}


@pytest.mark.slow
def test_workers_of_a_dask_cluster_write_the_same_bytes(scene, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    project(scene, [scene.store], tmp_path / "out.zarr")
    options = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with (
        distributed.LocalCluster(processes=False, protocol="tcp", **options) as cluster,
        dask_scheduler(cluster.scheduler_address) as client,
    ):
        project(scene, [scene.store], tmp_path / "other.zarr", scheduler=client)
    assert tree(tmp_path / "out.zarr") == tree(tmp_path / "other.zarr")


def test_a_scheduler_that_is_not_there_is_named():
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with (
        pytest.raises(InputError, match=r"tcp://127.0.0.1:9: no Dask scheduler answers.*start it"),
        dask_scheduler("tcp://127.0.0.1:9", seconds=1),
    ):
        pass
    with dask_scheduler(None) as scheduler:
        assert scheduler is dask.threaded.get


@pytest.mark.slow
def test_other_images_settings_or_code_are_other_labels(scene, tmp_path):
    out = tmp_path / "out.zarr"
    everything = project(scene, [scene.store], out)
    assert project(scene, [scene.store], out, min_points=3) == everything
    left = zarr.open_group(scene.images[0], mode="r")["image"][:]
    shutil.rmtree(scene.images[0])
    name(write_image(scene.images[0], scene.model, np.maximum(left, 2) - 1), "another left image")
    assert project(scene, [scene.store], out, min_points=3) == everything
