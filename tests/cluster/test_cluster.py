"""Two cities and a site through a real SLURM of three nodes: the same bytes as a local run.

East is higher than a shard, and made in two strips by jobs of their own, on two nodes; one of these
is lost in the midst. A job that asks for too little memory is tried again with more.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from stereocities.sites import make_scene
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.labels import project
from stereotruth.labels.scene_inputs import SceneInputs

from ..synthetic.project import SIZE, TINY, Project, copy_project, hashes, row_of
from .slurm import Job, jobs, kill_job, kill_node, start_node, wait_for

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
class Runs:
    """The same two cities, made here and by SLURM, and the ``data`` of both."""

    data: Path
    local: Project
    slurm: Project
    jobs: list[Job]
    lost: Job  # the job that ran on the node that was killed, as it ran


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
    slurm.edit(
        "profiles/slurm/config.yaml",
        "project:\n    mem_mb: 4300 * attempt",
        f"project:\n    mem_mb: {TOO_LITTLE}",
    )
    config = slurm.folder / "two.yaml"
    config.write_text(config.read_text() + "strips: {East-1: 2}\n")
    lost: list[Job] = []
    with ThreadPoolExecutor(2) as pool:  # while SLURM waits this machine works
        locally = pool.submit(local.snakemake, *CALL)
        killing = pool.submit(lose_a_node, slurm, lost)
        run = slurm.snakemake(*CALL, *SLURM, as_users_do=True)
        killing.result(60)
        assert locally.result().status == 0, locally.result().text[-4000:]
    assert run.status == 0, run.text[-8000:]
    assert lost, "no strip of project was seen at work"
    start_node(lost[0].node)
    return Runs(folder / "data", local, slurm, jobs(), lost[0])


def lose_a_node(slurm: Project, lost: list[Job]) -> None:
    """Kill the node of a strip that is at work, and all that runs there; tells which job's."""

    def at_work() -> Job | None:
        for job in jobs():
            if "rule_project_strip" in job.comment and job.state == "RUNNING":
                strip = job.comment.rpartition("_")[2]
                if (slurm.folder / f"logs/project_strip/East/East-1_{strip}.log").exists():
                    return job
        return None

    if found := wait_for(at_work, seconds=800.0):
        kill_node(found.node)
        lost.append(found)


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
    logs = runs.slurm.folder / "logs/slurm/rule_project"
    (said,) = logs.glob(f"West_West-1*/{project[0].number}.log")  # named by the job's wildcards
    assert "exceeded memory limit" in said.read_text()


def test_strips_are_jobs_on_several_nodes_that_write_whole_shards_of_one_store(runs: Runs) -> None:
    store = runs.slurm.folder / "results/project/East/East-1.zarr"
    assert len(list((store / "disparity/c").glob("[01]/0"))) == 2
    for rule in ("surface", "rectify"):
        strips = [job for job in runs.jobs if f"rule_{rule}_strip" in job.comment]
        assert [job.state for job in strips] == 2 * ["COMPLETED"]
    assert len({job.node for job in strips}) == 2


def test_jobs_of_a_lost_node_run_on_another(runs: Runs) -> None:
    strips = [job for job in runs.jobs if "rule_project_strip" in job.comment]
    failed = [job for job in strips if job.number == runs.lost.number]
    assert [job.state for job in failed] == ["NODE_FAIL"]
    done = [job for job in strips if job.state == "COMPLETED"]
    assert len(done) == 2 and len(strips) == 3
    (again,) = (job for job in done if job.comment == runs.lost.comment)
    assert again.number > runs.lost.number
    assert again.node != runs.lost.node


def test_small_jobs_share_one_submission(runs: Runs) -> None:
    """Two scenes with two LiDAR files each: one job of four, one of two."""
    for rule in ("ingest", "align"):
        jobs = [job for job in runs.jobs if f"_{rule}" in job.comment]
        assert [job.state for job in jobs] == ["COMPLETED"]
    assert all(job.state == "COMPLETED" for job in runs.jobs if "project" not in job.comment)


def test_two_pairs_of_a_site_run_on_two_nodes_after_one_surface(runs: Runs, tmp_path: Path) -> None:
    """Left with right and right with left: each LiDAR file is read once, too."""
    earlier = {job.number for job in jobs()}
    project = copy_project(tmp_path / "site")
    shutil.copytree(runs.data / "West", project.folder / "in")
    one = row_of(Path("in"), scene="Site-1", city="Site")
    turned = {"left_image": one["right_image"], "right_image": one["left_image"], "gcps": ""}
    project.add_scene("site", [one, one | turned | {"scene": "Site-2"}], **SIZE)
    grids = [f"results/project/Site/Site-{k}.zarr" for k in (1, 2)]
    run = project.snakemake(*grids, "--configfile", "site.yaml", *SLURM, as_users_do=True)
    assert run.status == 0, run.text[-8000:]

    made = [job for job in jobs() if job.number not in earlier]
    assert all(job.state == "COMPLETED" for job in made)
    (surface,) = (job for job in made if "rule_surface" in job.comment)
    labels = [job for job in made if "rule_project" in job.comment]
    assert len({job.node for job in labels}) == len(labels) == 2
    assert all(job.number > surface.number for job in labels)
    assert len([job for job in made if "_ingest" in job.comment]) == 1
    stores = [path.name for path in (project.folder / "results/ingest").rglob("*.points")]
    assert len(stores) == len(set(stores)) == len(list((runs.data / "West/lidar").glob("*.laz")))


SMALL = 128  # px, of the blocks that Dask workers make


@pytest.fixture
def workers(tmp_path: Path) -> Iterator[object]:
    """Three Dask workers, each on a node of its own."""
    jobqueue = pytest.importorskip("dask_jobqueue", reason="needs the extra cluster")
    cluster = jobqueue.SLURMCluster(
        queue="main",
        cores=2,
        processes=1,
        memory="3GB",
        walltime="00:20:00",
        python=sys.executable,
        scheduler_options={"host": "127.0.0.1", "dashboard": False},
        worker_extra_args=["--no-dashboard", "--host", "127.0.0.1"],
        local_directory=str(tmp_path),
        log_directory=str(tmp_path / "dask"),
    )
    try:
        cluster.scale(jobs=3)
        yield cluster
    finally:
        cluster.close()


def test_dask_workers_come_and_go_while_project_runs(
    runs: Runs, workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bytes of threads; no block is made twice but what was in the hands of the one killed."""
    import cloudpickle
    from distributed import Client

    from . import dask_workers

    cloudpickle.register_pickle_by_value(dask_workers)  # the tests are not on the workers' path
    monkeypatch.setattr(project, "SHARD", SMALL)  # 50 blocks instead of two
    monkeypatch.setattr(project, "CHUNK", SMALL)
    made = runs.local.folder / "results"
    images = [made / f"rectify/East/East-1/{view}.zarr" for view in ("left", "right")]
    points = sorted((made / "ingest/East/East-1").glob("*.points"))

    surface = made / "surface/East/East-1.surface"

    def label(out: Path, **how: object) -> None:
        inputs = SceneInputs.of(*images, points, LabelSettings(), surface=surface)
        project.project_scene(inputs, out, code="the same", **how)

    label(tmp_path / "threads.zarr", workers=2)
    telling, out = tmp_path / "told.txt", tmp_path / "dask.zarr"
    with Client(workers) as client, ThreadPoolExecutor(1) as pool:
        client.register_plugin(dask_workers.Telling(telling))
        client.wait_for_workers(3, timeout=300)
        at_first = {job.number: job.node for job in jobs() if job.state == "RUNNING"}
        assert sorted(at_first.values()) == ["n1", "n2", "n3"]
        labelling = pool.submit(label, out, scheduler=client)

        def one_has_made_and_makes() -> int | None:
            """A worker that has ended a block and has begun another."""
            told = dask_workers.read(telling)
            ended = {job for made_by in told.ended.values() for job in made_by}
            going = {told.begun[block][-1] for block in set(told.begun) - set(told.ended)}
            return min(ended & going, default=None)

        victim = wait_for(one_has_made_and_makes, seconds=120.0)
        assert victim in at_first
        kill_job(victim)
        before = dask_workers.read(telling)
        workers.scale(jobs=4)  # what is killed counts among them until its loss is noticed
        labelling.result(timeout=600)
    told = dask_workers.read(telling)
    assert len(before.ended) < len(told.ended)
    assert hashes(out) == hashes(tmp_path / "threads.zarr")

    every = {f"{r.start}-{c.start}" for r, c in project.blocks(shape_of(images[0]), SMALL)}
    assert set(told.ended) == every
    assert all(len(made_by) == 1 for made_by in told.ended.values())  # written once each
    again = {block for block, made_by in told.begun.items() if len(made_by) > 1}
    lost = {block for block, by in before.begun.items() if by[-1] == victim} - set(before.ended)
    assert again == lost
    assert len(lost) in (1, 2)  # two threads
    added = {job for made_by in told.ended.values() for job in made_by} - set(at_first)
    assert len(added) >= 1
    print(f"{len(every)} blocks, {len(before.ended)} before the kill, made again: {sorted(again)}")


def shape_of(store: Path) -> tuple[int, int]:
    return project.require_complete(store)["image"].shape
