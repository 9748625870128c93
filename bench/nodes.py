"""How long the paper's data take on how many nodes: the plan's jobs, timed here, put on nodes.

The jobs of a run of scale.py give their times; see README.md beside this file.
"""

from __future__ import annotations

import argparse
import csv
import heapq
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from stereotruth.lidar.point_store import PointStore
from stereotruth.products.grids import require_complete

# Li et al. 2023: 11 pairs of such images, so many points. Which pairs are of which city is assumed.
SCENES = {"Shaoguan": 2, "Kunming": 2, "Yingde": 2, "Qichun": 2, "Wuhan": 2, "Hengyang": 1}
PIXELS = 34000 * 30000  # of a scene
POINTS = 14.4e9  # of all
RULES = (
    "ingest",
    "align",
    "refine",
    "rectify_strip",
    "project_strip",
    "rectify",
    "project",
    "export",
)
THREADS = {"rectify_strip": 2, "project_strip": 2, "rectify": 2, "project": 2, "export": 2}
CORES = 2  # of a node


@dataclass
class Job:
    """Seconds of work with all its threads, and the jobs that it waits for."""

    name: str
    seconds: float
    threads: int = 1
    after: list[int] = field(default_factory=list)


def timed(logs: Path, rule: str) -> list[float]:
    """Seconds of processor time by job; where a job was too short to be watched, its seconds."""
    found = []
    for file in sorted((logs / rule).rglob("*.tsv")):
        with file.open() as stream:
            for row in csv.DictReader(stream, delimiter="\t"):
                cpu = row["cpu_time"]
                found.append(float(row["s"] if cpu == "NA" else cpu))
    return found


def rates(work: Path) -> dict[str, float]:
    """Processor time of each rule in the run, s a point, a pixel or a scene.

    Without what each job takes to begin: the time of the shortest.
    """
    logs, results = work / "logs", work / "results"
    points = sum(
        PointStore(store).attrs["points"]["read"]
        for store in (results / "ingest").rglob("*.points")
    )
    (store,) = (results / "project").glob("*/*.zarr")
    rows, cols = require_complete(store)["disparity"].shape
    took = {rule: timed(logs, rule) for rule in RULES}
    start = min(min(jobs) for jobs in took.values())
    spent = {rule: sum(seconds - start for seconds in jobs) for rule, jobs in took.items()}
    of = {rule: spent[rule] / (rows * cols) for rule in RULES[3:]}
    scene = {rule: spent[rule] for rule in ("align", "refine")}
    return {
        "ingest": spent["ingest"] / points,
        **scene,
        **of,
        "start": start,
        "points_per_px": points / (rows * cols),
    }


def plan(of: dict[str, float], strips: int, file_points: float, start_s: float) -> list[Job]:
    """The jobs of the paper's six cities; ``start_s``: what each takes before it begins."""
    jobs: list[Job] = []

    def add(rule: str, seconds: float, after: Sequence[int] = ()) -> int:
        threads = THREADS.get(rule, 1)
        jobs.append(Job(rule, start_s + seconds / threads, threads, list(after)))
        return len(jobs) - 1

    count = sum(SCENES.values())
    files = max(1, round(POINTS / count / file_points))
    for scenes in SCENES.values():
        labels = []
        for _ in range(scenes):
            points = [add("ingest", of["ingest"] * POINTS / count / files) for _ in range(files)]
            refined = add("refine", of["refine"], [*points, add("align", of["align"])])

            def strip(rule: str, after: list[int]) -> int:
                share = of[f"{rule}_strip"] * PIXELS / strips
                parts = [add(f"{rule}_strip", share, after) for _ in range(strips)]
                return add(rule, of[rule] * PIXELS, parts)

            labels.append(strip("project", [strip("rectify", [refined])]))
        add("export", of["export"] * PIXELS * scenes, labels)
    return jobs


def longest_chains(jobs: list[Job]) -> list[float]:
    """Seconds from the beginning of each job to the end of all that waits for it."""
    chain = [job.seconds for job in jobs]
    for k in range(len(jobs) - 1, -1, -1):  # a job stands behind those that it waits for
        for before in jobs[k].after:
            chain[before] = max(chain[before], jobs[before].seconds + chain[k])
    return chain


def makespan(jobs: list[Job], nodes: int) -> float:
    """Seconds until all are done: a free node takes the waiting job with the longest chain."""
    chain = longest_chains(jobs)
    waits = [len(job.after) for job in jobs]
    followers: list[list[int]] = [[] for _ in jobs]
    for k, job in enumerate(jobs):
        for before in job.after:
            followers[before].append(k)
    ready = [(-chain[k], k) for k, n in enumerate(waits) if n == 0]
    heapq.heapify(ready)
    free = [CORES] * nodes
    running: list[tuple[float, int, int]] = []
    now = 0.0
    while ready or running:
        held = []
        while ready:
            entry = heapq.heappop(ready)
            threads = jobs[entry[1]].threads
            # the fullest node that has room
            room = (n for n in range(nodes) if free[n] >= threads)
            node = min(room, key=free.__getitem__, default=None)
            if node is None:
                held.append(entry)
                if max(free) == 0:
                    break
                continue
            free[node] -= threads
            heapq.heappush(running, (now + jobs[entry[1]].seconds, entry[1], node))
        for entry in held:
            heapq.heappush(ready, entry)
        now, done, node = heapq.heappop(running)
        free[node] += jobs[done].threads
        for follower in followers[done]:
            waits[follower] -= 1
            if waits[follower] == 0:
                heapq.heappush(ready, (-chain[follower], follower))
    return now


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("work", type=Path, help="folder work/ of a run of scale.py with strips")
    parser.add_argument("--strips", type=int, nargs="+", default=[1, 8, 30])
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 2, 4, 10, 40, 100, 400])
    parser.add_argument("--file-points", type=float, default=16e6, help="of a LiDAR file")
    parser.add_argument("--start", type=float, default=20.0, help="s of a submission's start-ups")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    of = rates(given.work)
    print(json.dumps(of, indent=1))
    table = {}
    for strips in given.strips:
        jobs = plan(of, strips, given.file_points, given.start)
        work = sum(job.seconds * job.threads for job in jobs) / 3600
        bound = max(longest_chains(jobs))
        took = {nodes: makespan(jobs, nodes) for nodes in given.nodes}
        table[strips] = {"jobs": len(jobs), "core_hours": work, "chain_s": bound, "s": took}
        shown = "  ".join(f"{nodes}: {s / 60:.0f}" for nodes, s in took.items())
        print(
            f"{strips} strips: {len(jobs)} jobs, {work:.1f} core-hours, longest chain "
            f"{bound / 60:.0f} min; min by nodes: {shown}"
        )
    if given.json:
        given.json.write_text(json.dumps({"rates": of, "strips": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
