"""Runs that are killed, run out of disk, or meet another run: the result is as if nothing was."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ..synthetic.project import MADE, Project
from .killing import disturb, hashes, kill, start

pytestmark = pytest.mark.slow
ARGUMENTS = ["tiles/Tiny", "--configfile", "tiny.yaml"]
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


@pytest.fixture
def fresh(made, tmp_path) -> Project:
    """The city's input and workflow, nothing made yet."""
    return made.copy(tmp_path / "fresh", without=MADE)


@pytest.fixture
def run(fresh):
    """A run in ``fresh``, which is not left behind."""
    run = start(fresh.folder, *ARGUMENTS)
    yield run
    kill(run, "tree")


def wait_for(condition, seconds: float = 600.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


@linux
def test_a_run_in_strips_that_is_killed_again_and_again_gives_the_same_bytes(made, fresh):
    """Of a run without strips that nobody has killed."""
    config = fresh.folder / "tiny.yaml"
    config.write_text(config.read_text() + "strips: {Tiny-1: 2}\n")
    plan = fresh.plan(*ARGUMENTS)
    assert plan["rectify_strip"] == plan["surface_strip"] == plan["project_strip"] == 2
    for said in disturb(fresh.folder, ARGUMENTS, kills=3, seed=4, longest=6.0):
        print(said)
    assert hashes(fresh.folder) == hashes(made.folder)
    assert fresh.plan(*ARGUMENTS) == {}


@linux
def test_a_second_run_is_refused_until_the_first_has_ended(made, fresh, run):
    lock = fresh.folder / ".snakemake/run.lock"
    wait_for(lambda: (lock.exists() and lock.read_text()) or run.poll() is not None)
    second = fresh.snakemake(*ARGUMENTS)
    assert second.status != 0
    assert f"another run is at work here (process {run.pid} on" in second.text
    assert "Remedy: wait until it ends, or stop it" in second.text
    assert fresh.snakemake("--dry-run", *ARGUMENTS).status == 0  # plans are free
    kill(run, "snakemake")  # its jobs go on
    third = fresh.snakemake(*ARGUMENTS)
    assert third.status == 0, third.text[-3000:]
    assert hashes(fresh.folder) == hashes(made.folder)


@pytest.fixture
def small_disk(fresh):
    """The project's results on a file system of 96 MiB of their own."""
    folder = fresh.folder / "results"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=96m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("no right to mount a tmpfs")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_disk_is_told_and_space_is_all_it_needs(made, fresh, small_disk):
    """Filled up when ingest and export begin."""
    ballast = small_disk / "ballast"
    for until in ((), ("results/project/Tiny/Tiny-1.zarr",)):
        if until:
            assert fresh.snakemake(*until, *ARGUMENTS[1:]).status == 0
        free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
        ballast.write_bytes(b"\1" * (free - (1 << 18)))
        run = fresh.snakemake(*ARGUMENTS)
        assert run.status != 0
        assert "no space left on the disk. Remedy: make space there, and run again" in run.text
        assert "Traceback" not in run.text, run.text[-3000:]
        ballast.unlink()
    run = fresh.snakemake(*ARGUMENTS)
    assert run.status == 0, run.text[-3000:]
    assert hashes(fresh.folder) == hashes(made.folder)


def test_a_fixed_alignment_keeps_what_one_more_file_does_not_touch(made, tmp_path):
    """With it neither align nor refine run, and a LiDAR file has no say in the images."""
    other = made.copy(tmp_path / "other")
    fixed = Path("Tiny-1.json")
    shutil.copy(other.folder / "results/refine/Tiny/Tiny-1/alignment.json", other.folder / fixed)
    config = other.folder / "tiny.yaml"
    config.write_text(config.read_text() + f"alignment: {{fixed: {{Tiny-1: {fixed}}}}}\n")
    assert other.snakemake(*ARGUMENTS).status == 0
    grid = "results/project/Tiny/Tiny-1.zarr/disparity"
    assert hashes(other.folder / grid) == hashes(made.folder / grid)
    first = sorted((other.folder / "in/lidar").iterdir())[0]
    shutil.copy(first, first.with_name("one-more.laz"))
    plan = other.plan(*ARGUMENTS)
    assert plan == {"ingest": 1, "compare_strips": 1, "surface": 1, "project": 1, "export": 1}
    config.write_text(config.read_text().replace("Tiny-1: Tiny", "Tiny-1: Tony"))
    assert "Tony-1.json: no such file" in other.snakemake("--dry-run", *ARGUMENTS).text
