"""What is there counts by its content: times of files, copies and clones make nothing again."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

import pytest

from ..synthetic.project import Project, copy_project

ARGUMENTS = ("tiles/Tiny", "--configfile", "tiny.yaml")
OF_THE_USER = ("in", "tiny.yaml", "tiny_scenes.tsv", "tiny_cities.tsv")


def plan(project: Project) -> dict[str, int]:
    return project.plan(*ARGUMENTS)


def mix_times(folder: Path) -> None:
    """Times of files and folders as they come, as a copy leaves them."""
    rng = random.Random(3)
    for path in sorted(folder.rglob("*")):
        if ".snakemake" not in path.relative_to(folder).parts[:1] and not path.is_symlink():
            os.utime(path, (1.7e9 + rng.uniform(0, 1e6),) * 2)


@pytest.fixture(scope="module")
def cloned(made, tmp_path_factory) -> Project:
    """A fresh clone, into which the results were copied, but nothing of Snakemake's."""
    clone = copy_project(tmp_path_factory.mktemp("clone") / "project")
    for name in (*OF_THE_USER, "results", "tiles"):
        source, target = made.folder / name, clone.folder / name
        if source.is_dir():
            shutil.copytree(source, target, copy_function=shutil.copyfile)
        else:
            shutil.copyfile(source, target)
    mix_times(clone.folder)
    return clone


def test_a_touched_script_runs_nothing_and_an_edited_one_its_rule(made, tmp_path):
    other = made.copy(tmp_path / "other")
    for script in (other.folder / "workflow/scripts").iterdir():
        os.utime(script)
    assert plan(other) == {}
    other.edit("workflow/scripts/export.py", '"""', '"""Edited: ')
    assert plan(other) == {}
    other.edit("workflow/scripts/export.py", "\nif __name__", "\nADDED = 1\nif __name__")
    assert plan(other) == {"export": 1}


def test_results_copied_into_a_clone_are_taken_as_they_are(cloned):
    assert plan(cloned) == {}


def test_files_restored_without_their_times_run_nothing(made, tmp_path):
    other = made.copy(tmp_path / "other")
    mix_times(other.folder)
    assert plan(other) == {}
    run = other.snakemake(*ARGUMENTS)
    assert run.status == 0 and "Nothing to be done" in run.text


def test_all_times_equal_run_nothing(made, tmp_path):
    other = made.copy(tmp_path / "other")
    for path in other.folder.rglob("*"):
        os.utime(path, (1.7e9, 1.7e9))
    assert plan(other) == {}


@pytest.mark.parametrize(
    ("file", "old", "new", "jobs"),
    [
        ("in/gcps.csv", "1", "2", {"align", "refine", "rectify", "project", "export"}),
        ("tiny.yaml", "size: 128", "size: 96", {"export"}),
    ],
)
def test_what_changed_in_a_clone_runs_what_it_touches(cloned, tmp_path, file, old, new, jobs):
    """Also where the edited file seems to be older than what was made of it."""
    other = cloned.copy(tmp_path / "other")
    other.edit(file, old, new)
    os.utime(other.folder / file, (1e9, 1e9))
    assert set(plan(other)) == jobs


def test_a_clone_is_carried_on(cloned, tmp_path):
    """The copied records stay where they are, beside those of the run."""
    other = cloned.copy(tmp_path / "other")
    other.edit("tiny.yaml", "size: 128", "size: 96")
    assert other.snakemake(*ARGUMENTS).status == 0
    assert plan(other) == {}
    assert (
        (other.folder / ".snakemake/metadata")
        .resolve()
        .is_relative_to((other.folder / "results").resolve())
    )


def test_deleted_results_are_made_again(cloned, tmp_path):
    other = cloned.copy(tmp_path / "other")
    assert plan(other) == {}
    for name in ("results", "tiles"):
        shutil.rmtree(other.folder / name)
    jobs = plan(other)
    assert jobs["align"] == jobs["export"] == 1 and jobs["ingest"] == 2
    assert not (other.folder / "results").exists()  # a plan makes nothing


def test_tiles_without_results_are_still_known(made, tmp_path):
    """Whoever deletes the results for their size keeps tiles that follow the configuration."""
    other = made.copy(tmp_path / "other")
    shutil.rmtree(other.folder / "results")
    assert plan(other) == {}
    other.edit("tiny.yaml", "size: 128", "size: 96")
    assert {"ingest", "align", "project", "export"} <= set(plan(other))
