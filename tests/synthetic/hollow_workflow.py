"""The workflow with all of its rules and none of its numerics: each job writes what it has read.

Rules, plans and the writing of products are the project's own. The scripts are replaced by
:func:`work`, so that all rules run in seconds, and each product says of which inputs and settings
it was made: whether one is stale can be read from it. A file ``fault.json`` makes a job of a rule
fail in one of :data:`WAYS`.
"""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from stereotruth.core.errors import InputError
from stereotruth.core.job import job
from stereotruth.core.products.files import atomic_file, atomic_folder
from stereotruth.core.products.making import checksum, making

from .forked_snakemake import RUN, runner, start_snakemake
from .project import Project, copy_project, row_of

# A job is killed, or refuses; Snakemake is killed with it, or without it, so that it goes on later;
# its input is edited while it works, for good or for a while.
WAYS = ("kill", "refuse", "node", "orphan", "edit", "revert")
FAULT, STRUCK, GO_ON = Path("fault.json"), Path("fault.struck"), Path("go.on")
SUFFIXES = {".json", ".csv", ".png", ".npz", ".tif", ".laz", ".html", ".md", ".pt", ".tiff"}
SCRIPT = '''"""Stands in for the script {name}."""
from tests.synthetic.hollow_workflow import work

if __name__ == "__main__":
    work(snakemake)
'''
GIVEN = ("left.tif", "right.tif", "left_RPC.TXT", "lidar/1.laz", "lidar/2.laz", "gcps.csv")
TARGETS = (
    *("dataset", "report", "benchmark", "evaluate", "predict", "results/export/Own/summary.json"),
    *("originals/Own", "audit/synthetic", "submission/synthetic/mine", "submission/synthetic/net"),
    *("score_dsm/Own/Own-1/mine", "data/synthetic/Wuhan/Wuhan-1/truth.zarr"),
    "results/train/cities/net/best.pt",
)
WITHOUT_JOB = ("all", "predict", "benchmark", "report", "evaluate")
CONFIG = {
    "seed": 0,
    "strips": {"Own-1": 2},
    "project": {"right_view": True},
    "dataset": {"layouts": ["whu", "kitti"]},
    "report": {"sliders": 3},
    "training": {"device": "cpu"},
    "benchmark": {
        "datasets": {
            "synthetic": {"methods": ["mine", "net"]},
            "cities": {
                "root": "results/training_cities/1",
                "layout": "whu",
                "disparity_range": [-64, 128],
                "methods": ["net"],
            },
        },
        "methods": {
            "mine": {"kind": "function", "function": "mine.py:match"},
            "net": {"kind": "stereonet"},
        },
    },
    "predict": {"methods": ["mine"]},
}


def make_hollow(folder: Path) -> Project:
    """A project with a city of its own and a synthetic one, nothing made yet."""
    project = copy_project(folder)
    for script in (folder / "workflow/scripts").glob("*.py"):
        script.write_text(SCRIPT.format(name=script.stem))
    run = folder / "workflow/rules/run.smk"
    run.write_text(
        run.read_text().replace("    say(made())\n", "").replace("    list_pages()\n", "")
    )
    for name in GIVEN:
        (folder / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "in" / name).write_text(f"{name}\n")
    (folder / "mine.py").write_text("import helper\n\nmatch = helper\n")
    (folder / "helper.py").write_text("")
    (folder / "geoid.tif").write_text("geoid\n")
    synthetic = "data/synthetic/Wuhan/Wuhan-1"
    rows = [
        row_of(Path("in"), scene="Own-1", city="Own", geoid="geoid.tif"),
        row_of(Path(synthetic), scene="Wuhan-1", city="Wuhan", gcps="config/gcps/Wuhan-1.csv"),
    ]
    project.add_scene("my", rows, **CONFIG)
    return project


class Hollow:
    """The workflow in a folder, with a city of its own and a synthetic one; nothing made yet.

    ``call``: the targets and settings of its runs; all that there is, if none are given.
    """

    def __init__(self, folder: Path, call: Sequence[str] = (*TARGETS, "--configfile", "my.yaml")):
        self.project, self.folder = make_hollow(folder), folder
        self.call = (*call, "--cores", "16", "--scheduler", "greedy")
        self.version = 0

    def run(self, *more: str) -> tuple[int, set[str]]:
        """A run's exit status, and the rules that it planned."""
        status = start_snakemake(runner(), self.folder, [*self.call, *more], "run.log").wait()
        return status, self.planned()

    def plan(self) -> set[str]:
        """The rules that a run would have jobs of."""
        status, rules = self.run("--dry-run")
        assert status == 0, self.said()[-4000:]
        return rules

    def make(self) -> set[str]:
        """A run that ends well; the rules that it had jobs of."""
        status, rules = self.run()
        assert status == 0, self.said()[-4000:]
        return rules

    def said(self) -> str:
        return (self.folder / "run.log").read_text()

    def planned(self) -> set[str]:
        tables = self.said().split("Job stats:")
        found = re.findall(r"^(\w+)\s+\d+$", tables[-1], flags=re.MULTILINE)
        return {*found} - {"total", *WITHOUT_JOB} if len(tables) > 1 else set()

    def edit(self, file: str) -> None:
        """Write a file of the user's anew, by a clock that is off."""
        self.version += 1
        place = self.folder / file
        place.write_text(
            f"{place.read_text().partition('#')[0]}# {self.version}\nV = {self.version}"
        )
        os.utime(place, (1e9, 1e9))

    def set_seed(self, seed: int) -> None:
        """Change a setting that is a parameter of many rules."""
        file = self.folder / "my.yaml"
        file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), "seed": seed}))

    def fail(self, way: str, *rules: str, file: str = "") -> set[str]:
        """A run in which a job of each rule fails, or has its input ``file`` edited; which did."""
        struck = self.folder / STRUCK
        struck.unlink(missing_ok=True)
        (self.folder / FAULT).write_text(json.dumps({"rules": rules, "way": way, "file": file}))
        status, _ = self.run("--keep-going")
        (self.folder / FAULT).unlink()
        assert struck.exists() and (status or way == "edit"), (rules, self.said()[-4000:])
        return {*struck.read_text().split()}

    def stale(self) -> list[str]:
        """Products that are not of the inputs that are there."""
        found = []
        tops = "results tiles dataset dataset_kitti originals benchmark audit submission score_dsm"
        for top in (*tops.split(), "data"):
            for file in sorted((self.folder / top).rglob("*")):
                hidden = any(part.startswith(".") for part in file.relative_to(self.folder).parts)
                if hidden or not file.is_file() or file.name == "1":
                    continue
                for path, was in json.loads(file.read_text())["inputs"].items():
                    if checksum(self.folder / path) != was:
                        found.append(f"{file.relative_to(self.folder)} of {path}")
        return found


def work(snakemake: Any) -> None:
    """Write into each product what it is made of; or fail, if that is asked."""
    # what is read of the strips of a grid tells nothing of its pixels
    inputs = [path for path in snakemake.input if Path(path).parent.name != "strips"]
    with job(snakemake.log[0], snakemake.rule), making(snakemake.input, snakemake.output):
        sums = {path: checksum(path) for path in inputs}
        settings = {name: str(value) for name, value in snakemake.params.items()}
        text = json.dumps({"inputs": sums, "settings": settings}, sort_keys=True)
        for path in snakemake.output:
            if Path(path).suffix in SUFFIXES:
                with atomic_file(path) as scratch:
                    scratch.write_text(text)
            else:
                with atomic_folder(path) as scratch:
                    (scratch / "content.json").write_text(text)
                    (scratch / "more").mkdir()
                    (scratch / "more/1").write_text("1")
            fail_perhaps(snakemake.rule)


def fail_perhaps(rule: str) -> None:
    """Fail after the first product if the job's rule is asked to."""
    fault = json.loads(FAULT.read_text()) if FAULT.exists() else {"rules": []}
    if rule not in fault["rules"]:
        return
    with STRUCK.open("a") as stream:
        stream.write(f"{rule}\n")
    match fault["way"]:
        case "refuse":
            raise InputError("asked to refuse", file=FAULT, remedy="none")
        case "edit" | "revert":
            file = Path(fault["file"])
            text = file.read_text()
            file.write_text("edited meanwhile\n")
            if fault["way"] == "revert":
                file.write_text(text)
        case "orphan":
            os.kill(int(os.environ[RUN]), signal.SIGKILL)  # Snakemake, of which this is a job
            while not GO_ON.exists():
                time.sleep(0.05)
        case way:
            if way == "node":
                os.kill(int(os.environ[RUN]), signal.SIGKILL)
            os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(60)
