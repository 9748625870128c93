"""Runs and the jobs that outlive them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from stereotruth.errors import InputError
from stereotruth.products.runs import RUN, Run, begin_run, end_older_jobs, listed

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(RUN, "")
    return tmp_path


def test_a_job_is_refused_when_another_run_has_begun(folder):
    begin_run(folder)
    job = Run(folder)
    job.refuse_older()
    begin_run(folder)
    with pytest.raises(InputError, match="another run has begun"):
        job.refuse_older()
    Run(folder).refuse_older()


def test_a_job_that_starts_late_belongs_to_the_run_that_started_it(folder, monkeypatch):
    begin_run(folder)
    late = os.environ[RUN]
    begin_run(folder)
    monkeypatch.setenv(RUN, late)
    with pytest.raises(InputError):
        Run(folder).refuse_older()


def test_without_a_run_there_is_nothing_to_refuse(folder):
    Run(folder).refuse_older()


CHILD = """
import sys, time
from pathlib import Path
from stereotruth.products.runs import listed
with listed(Path(sys.argv[1])):
    print("at work", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def child(folder):
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(folder)], stdout=subprocess.PIPE, text=True
    )
    process.stdout.readline()
    yield process
    process.kill()
    process.wait()


@linux
@pytest.mark.parametrize("stopped", [False, True])
def test_jobs_of_earlier_runs_are_ended(folder, child, stopped):
    if stopped:
        child.send_signal(signal.SIGSTOP)
    with listed(folder):  # this process stays
        end_older_jobs(folder)
        assert child.wait(10) == -signal.SIGKILL
        assert len(list((folder / "jobs").iterdir())) == 1
    assert list((folder / "jobs").iterdir()) == []


@linux
@pytest.mark.parametrize("other", [{"start": "1"}, {"boot": "x"}, {"pids": "x"}])
def test_other_processes_are_left_alone(folder, child, other):
    """Of another machine, or with the number of one that has ended."""
    (file,) = (folder / "jobs").iterdir()
    file.write_text(json.dumps(json.loads(file.read_text()) | other))
    end_older_jobs(folder)
    time.sleep(0.2)
    assert child.poll() is None
    assert file.exists() == ("start" not in other)


WATCHED = """
import os, sys, time
from pathlib import Path
from stereotruth.products import runs
runs.SECONDS = 0.05
folder = Path(sys.argv[1])
runs.begin_run(folder)
with runs.Run(folder).watched():
    print("at work", flush=True)
    time.sleep(60)
"""


def test_a_job_ends_itself_when_another_run_has_begun(folder):
    child = subprocess.Popen(
        [sys.executable, "-c", WATCHED, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    child.stdout.readline()
    begin_run(folder)
    assert child.wait(20) == 1
    assert "another run has begun here since: this job ends" in child.stderr.read()
