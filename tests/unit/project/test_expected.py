"""What a run takes."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

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


def test_a_full_disk_is_an_error(monkeypatch):
    for free, level in ((1e9, "error"), (1e12, "ok")):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        assert said("disk").startswith(f"{level}: ")
