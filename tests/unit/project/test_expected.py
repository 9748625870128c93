"""What a run takes."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path
from types import SimpleNamespace

from stereotruth.core import kernels
from stereotruth.project import expected
from stereotruth.project.expected import SceneFacts, check_resources
from stereotruth.project.findings import Findings

# As it was measured: 34000 x 30000 px, 80 M points in 20 files, a twentieth with LiDAR
LARGE = SceneFacts("Large-1", pixels=1_020_000_000, points=80_000_000, lidar_files=20, covered=0.05)


def said(about: str) -> str:
    found = Findings("run")
    check_resources([LARGE], found)
    return next(f"{f.level.value}: {f.text}" for f in found if f.about == about)


def test_a_large_scene_takes_what_it_took_when_it_was_measured(monkeypatch):
    """21 minutes on two cores."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    minutes = int(said("time").split("about ")[1].split(" min")[0])
    assert 21 / 1.7 < minutes < 21 * 1.7


def test_compiling_is_in_the_time_of_a_first_run_alone(monkeypatch, tmp_path):
    importlib.import_module(expected.COMPILED_LAST)
    monkeypatch.setattr(expected, "folder", lambda: tmp_path)
    assert " s compiling, once" in said("time")
    place = tmp_path / kernels.sources_digest(expected.COMPILED_LAST) / "labels"
    place.mkdir(parents=True)
    (place / "a.nbc").touch()
    assert "compiling" not in said("time")


def test_folders_that_a_run_cannot_write_to_are_errors(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert expected.locked_folders() == []
    for name in ("results/align/City", "results/project", "tiles/City"):
        Path(name).mkdir(parents=True)
    locked = {"results/align/City", "tiles"}
    monkeypatch.setattr("os.access", lambda path, mode: str(path) not in locked)
    assert expected.locked_folders() == [Path("results/align/City"), Path("tiles")]
    assert expected.locked_folders({"City"}) == [Path("tiles")]
    assert said("disk").startswith("error: results/align/City")
    monkeypatch.setattr("os.access", lambda path, mode: str(path) != ".")
    assert expected.locked_folders() == [Path()]  # where logs and .snakemake would be made


def test_a_full_disk_is_an_error(monkeypatch):
    for free, level in ((1e9, "error"), (1e12, "ok")):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        assert said("disk").startswith(f"{level}: ")
