"""After a job that failed, however it did, the next plan has it and all that follows from it."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from ..synthetic.hollow_workflow import make_hollow
from ..synthetic.project import Project
from .failing import Failures
from .killing import family, kill, start

ARGUMENTS = ("tiles/Tiny", "--configfile", "tiny.yaml")
FOLLOWS = {"refine", "rectify", "project", "export"}


def raise_heights(project: Project, metres: float = 0.3) -> None:
    """Edit the heights of all control points."""
    file = project.folder / "in/gcps.csv"
    header, *rows = (line.split(",") for line in file.read_text().splitlines())
    at = header.index("height")
    for row in rows:
        row[at] = f"{float(row[at]) + metres:.4f}"
    file.write_text("\n".join(map(",".join, [header, *rows])) + "\n")


def kill_job(project: Project, log: str) -> None:
    """A run whose job that writes ``log`` is killed by itself, as the kernel does."""
    path = project.folder / log
    path.unlink(missing_ok=True)
    run = start(project.folder, *ARGUMENTS)
    try:
        while run.poll() is None:
            for pid in family(run.pid)[0]:
                if writes(pid, path):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.02)
        assert run.returncode != 0
    finally:
        kill(run, "tree")


def writes(pid: int, file: Path) -> bool:
    """Whether a process has a file open (Linux)."""
    try:
        return any(handle.readlink() == file for handle in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        return False


linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


@pytest.mark.slow
@linux
def test_a_job_that_is_killed_after_an_edit_is_due_with_all_that_follows(made, tmp_path):
    other = made.copy(tmp_path / "other")
    raise_heights(other)
    kill_job(other, "logs/refine/Tiny/Tiny-1.log")
    assert not (other.folder / "results/refine/Tiny/Tiny-1/alignment.json").exists()
    assert set(other.plan(*ARGUMENTS)) == FOLLOWS


@linux
@pytest.mark.slow
def test_failures_of_jobs_of_any_rule_leave_nothing_stale(tmp_path):
    """Without the numerics, edits and damage before, between and after; see failing.py."""
    failures = Failures(make_hollow(tmp_path / "project"), seed=10)
    failures.prepare(edits=())
    found = list(failures.rounds(10))
    assert len(found) == 10
    assert [one for one in found if one["wrong"]] == []
