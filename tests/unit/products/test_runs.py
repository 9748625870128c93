"""Runs and the jobs that outlive them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from stereotruth.errors import InputError
from stereotruth.products.runs import RUN, Run, begin_run


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
