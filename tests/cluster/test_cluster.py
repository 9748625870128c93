"""Two cities through a real SLURM: the same bytes as a local run, and a retry with more memory.

East is higher than a shard, and made in two strips by jobs of their own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from stereotruth.simulate.__main__ import make_scene

from ..synthetic.project import SIZE, TINY, Project, copy_project, hashes, row_of

pytestmark = pytest.mark.skipif(
    "TEST_CLUSTER" not in os.environ, reason="starts a SLURM: run make test-cluster"
)
CITIES = {  # raw columns are epipolar rows
    name: replace(
        TINY,
        name=name,
        world_seed=seed,
        scenes=(replace(TINY.scenes[0], name=f"{name}-1", cols=cols),),
    )
    for name, seed, cols in (("East", 7, 1200), ("West", 8, 560))
}
CALL = [*(f"tiles/{city}" for city in CITIES), "--configfile", "two.yaml"]
# The profile as it is, but for waits that large clusters need.
SLURM = [
    *("--profile", "profiles/slurm", "--latency-wait", "10"),
    *("--slurm-keep-successful-logs", "--slurm-logdir", "logs/slurm"),
    *("--slurm-status-command", "squeue", "--slurm-init-seconds-before-status-checks", "2"),
]
# Less than the first attempt of one job holds from its start to its end, however fast it is: the
# Snakemake that starts it takes 100 MB. (SLURM looks every other second and misses what is short.)
TOO_LITTLE = "50 if wildcards.city == 'West' and attempt < 2 else 4300 * attempt"


@dataclass
class Job:
    """What SLURM says about a job that has ended."""

    number: int
    state: str
    memory: str
    comment: str


@dataclass
class Runs:
    """The same two cities, made here and by SLURM."""

    local: Project
    slurm: Project
    jobs: list[Job]


def project_with_two_cities(folder: Path, data: Path) -> Project:
    project = copy_project(folder)
    shutil.copytree(data, folder / "in")
    rows = [
        row_of(Path("in", name), scene=city.scenes[0].name, city=name)
        for name, city in CITIES.items()
    ]
    project.add_scene("two", rows, **SIZE)
    return project


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    folder = tmp_path_factory.mktemp("cluster")
    for name, city in CITIES.items():
        make_scene(city, city.scenes[0], folder / "data" / name, spacing_m=0.4, seed=1)
    local, slurm = (
        project_with_two_cities(folder / k, folder / "data") for k in ("local", "slurm")
    )
    run = local.snakemake(*CALL)
    assert run.status == 0, run.text[-4000:]

    slurm.edit(
        "profiles/slurm/config.yaml",
        "project:\n    mem_mb: 4300 * attempt",
        f"project:\n    mem_mb: {TOO_LITTLE}",
    )
    config = slurm.folder / "two.yaml"
    config.write_text(config.read_text() + "strips: {East-1: 2}\n")
    run = slurm.snakemake(*CALL, *SLURM)
    assert run.status == 0, run.text[-8000:]
    table = subprocess.run(
        ["squeue", "--states=all", "--noheader", "--sort=i", "--format=%i|%T|%m|%k"],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=60,
    )
    lines = (line.split("|") for line in table.stdout.splitlines())
    return Runs(local, slurm, [Job(int(number), *rest) for number, *rest in lines])


@pytest.mark.parametrize("folder", ["results/project", "tiles"])
def test_slurm_makes_the_same_bytes_as_a_local_run(runs: Runs, folder: str) -> None:
    here, there = (
        {
            file: checksum
            for file, checksum in hashes(project.folder / folder).items()
            if "/." not in file
        }
        for project in (runs.local, runs.slurm)
    )
    assert all(any(city in file for file in here) for city in CITIES)
    assert there == here


def test_a_job_killed_for_its_memory_is_retried_with_more(runs: Runs) -> None:
    project = [job for job in runs.jobs if "rule_project" in job.comment and "West" in job.comment]
    assert [(job.state, job.memory) for job in project] == [
        ("FAILED", "50M"),
        ("COMPLETED", "8600M"),
    ]
    said = runs.slurm.folder / f"logs/slurm/rule_project/West_West-1/{project[0].number}.log"
    assert "exceeded memory limit" in said.read_text()


def test_strips_are_jobs_that_write_whole_shards_of_one_store(runs: Runs) -> None:
    store = runs.slurm.folder / "results/project/East/East-1.zarr"
    assert len(list((store / "disparity/c").glob("[01]/0"))) == 2
    for rule in ("rectify_strip", "project_strip"):
        assert [job.state for job in runs.jobs if f"rule_{rule}" in job.comment] == 2 * [
            "COMPLETED"
        ]


def test_small_jobs_share_one_submission(runs: Runs) -> None:
    """Two scenes with two LiDAR files each: one job of four, one of two."""
    for rule in ("ingest", "align"):
        jobs = [job for job in runs.jobs if f"_{rule}" in job.comment]
        assert [job.state for job in jobs] == ["COMPLETED"]
    assert all(job.state == "COMPLETED" for job in runs.jobs if "project" not in job.comment)
