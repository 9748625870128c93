"""Arguments of Snakemake, and the status line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.project.new_project import copy_profile
from stereotruth.project.project import FILES, configured
from stereotruth.project.run_workflow import (
    TRUSTED,
    Progress,
    arguments_for,
    config_files,
    duration,
    follow,
    run_workflow,
)

SNAKEFILE = ["--snakefile", str(FILES / "Snakefile")]


@pytest.mark.parametrize(
    ("given", "passed"),
    [
        (["tiles/A"], ["tiles/A", "--configfile", "config.yaml", "--cores", "all"]),
        (["tiles/A", "-c2"], ["tiles/A", "-c2", "--configfile", "config.yaml"]),
        (["--jobs=3"], ["--jobs=3", "--configfile", "config.yaml"]),
        (["--configfile", "b.yaml"], ["--configfile", "b.yaml", "--cores", "all"]),
        (["--configfile=b.yaml"], ["--configfile=b.yaml", "--cores", "all"]),
        (["a", "--", "-k"], ["a", "-k", "--configfile", "config.yaml", "--cores", "all"]),
        (["--profile", "p"], ["--profile", "p", "--configfile", "config.yaml"]),
        (["--config", "seed=1"],
         ["--config", "seed=1", "--configfile", "config.yaml", "--cores", "all"]),
    ],
)  # fmt: skip
def test_options_are_passed_on(tmp_path, monkeypatch, given, passed):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").touch()
    assert arguments_for(given) == [*SNAKEFILE, *passed]


def test_a_profile_of_the_package_is_named_without_its_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").touch()
    shipped = str(FILES / "profiles" / "default")
    assert arguments_for(["--profile", "default"])[2:4] == ["--profile", shipped]
    assert arguments_for(["--profile=default"])[2] == f"--profile={shipped}"
    assert arguments_for(["--profile", "my-site"])[3] == "my-site"
    monkeypatch.setattr("stereotruth.project.run_workflow.find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install snakemake-executor-plugin-slurm"):
        arguments_for(["--profile", "slurm"])
    with pytest.raises(InputError, match="pip install snakemake-storage-plugin-s3"):
        arguments_for(["--profile", "s3"])
    copy_profile("slurm", Path("my-site"))
    with pytest.raises(InputError, match="'my-site' needs the package snakemake-executor-plugin"):
        arguments_for(["--profile", "my-site"])


def test_the_built_in_cities_are_asked_for_by_name(tmp_path, monkeypatch):
    """In a folder of a project the message says where the project is."""
    (tmp_path / "config.yaml").touch()
    inside = tmp_path / "tiles" / "A"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    with pytest.raises(InputError, match=r"no config\.yaml here.*did you mean: cd \.\./\.\."):
        arguments_for(["tiles/A"])
    with pytest.raises(InputError, match=r"no config\.yaml here"):
        configured()
    assert arguments_for(["--example", "tiles/Qichun", "-j1"]) == [
        *SNAKEFILE, "tiles/Qichun", "-j1"
    ]  # fmt: skip


RUN = """\
Job stats:
job        count
-------  -------
align          1
project        3
total          4

Select jobs to execute...
Finished jobid: 3 (Rule: align)
1 of 4 steps (25%) done
Finished jobid: 2 (Rule: project)
2 of 4 steps (50%) done
"""


def test_time_left_follows_from_the_jobs_that_are_done():
    progress = Progress(begun=100.0)
    assert progress.line(100.0) == "planning"
    planned = 3 + 3 * 8  # SECONDS of align and project
    lines = RUN.splitlines()
    for line in lines[:7]:
        progress.read(line)
    assert progress.line(100.0) == f"0 of 4 jobs done, about {planned} s left"
    for line in lines[7:]:
        progress.read(line)
    done = 3 + 8
    left = (planned - done) * (36 + TRUSTED) / (done + TRUSTED)
    assert progress.seconds_left(136.0) == pytest.approx(left)
    assert progress.line(136.0) == f"2 of 4 jobs done, about {left:.0f} s left"
    progress.read("4 of 4 steps (100%) done")
    assert progress.line() == "4 of 4 jobs done"


@pytest.mark.parametrize(("seconds", "words"), [(5, "5 s"), (600, "10 min"), (7200, "2.0 h")])
def test_durations(seconds, words):
    assert duration(seconds) == words


def test_the_files_of_the_configuration_are_found_among_the_arguments(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a.yaml", "b.yaml", "c.yaml"):
        Path(name).touch()
    given = ["--configfile", "a.yaml", "b.yaml", "--cores", "2", "--configfiles=c.yaml", "tiles/X"]
    assert [file.name for file in config_files(given)] == ["a.yaml", "b.yaml", "c.yaml"]
    assert config_files(["--cores", "a.yaml"]) == []


def test_a_configuration_that_is_no_utf_8_is_named_before_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("seed: 1\n", encoding="utf-16")
    with pytest.raises(InputError, match=r"config\.yaml: is no UTF-8"):
        run_workflow(["--dry-run"])


def test_after_ctrl_c_nothing_is_shown_but_how_to_carry_on(monkeypatch, capfd):
    def watch(lines, progress):
        raise KeyboardInterrupt

    monkeypatch.setattr("stereotruth.project.run_workflow.watch", watch)
    program = "import sys; print('Traceback (most recent call last):'); sys.exit(3)"
    run = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert follow(run) == 3
    out, err = capfd.readouterr()
    assert out == "" and err.splitlines() == [
        "Stopping the jobs that are at work …",
        "Stopped. The same command carries on.",
    ]
