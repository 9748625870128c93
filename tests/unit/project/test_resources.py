"""What a run takes."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

from stereotruth.core.config.configuration import Configuration
from stereotruth.project.check_scene import SceneFacts
from stereotruth.project.expected import check_resources
from stereotruth.project.findings import Findings, Level

# As it was measured: 34000 x 30000 px, 80 M points in 20 files, a twentieth with LiDAR
LARGE = SceneFacts("Large-1", pixels=1_020_000_000, points=80_000_000, lidar_files=20, covered=0.05)


def said(about: str) -> str:
    found = Findings("run")
    check_resources([LARGE], Configuration(), found)
    return next(f"{f.level.value}: {f.text}" for f in found if f.about == about)


def test_a_large_scene_takes_what_it_took_when_it_was_measured(monkeypatch):
    """21 minutes on two cores."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    minutes = int(said("time").split("about ")[1].split(" min")[0])
    assert 21 / 1.7 < minutes < 21 * 1.7


def test_a_full_disk_is_an_error(monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e9))
    assert said("disk").startswith("error: ")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e12))
    assert said("disk").startswith("ok: ")


def test_nothing_is_said_of_nothing():
    found = Findings("run")
    check_resources([], Configuration(), found)
    assert found == [] and Level.FACT.value == "ok"
