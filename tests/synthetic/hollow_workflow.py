"""The workflow with all of its rules and none of its numerics: each job writes what it has read.

Rules, plans, records and the writing of products are the project's own. The scripts are replaced by
:func:`work`, so that all rules run in seconds, and each product says of which inputs and settings
it was made: whether one is stale can be read from it. A file ``fault.json`` makes jobs of some
rules fail, each in its way (:data:`WAYS`) and at a moment of its work (:data:`MOMENTS`).
"""

from __future__ import annotations

import errno
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from stereotruth.errors import InputError
from stereotruth.job import job
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.products.files import atomic_file, atomic_folder
from stereotruth.products.inputs import checksum
from stereotruth.products.records import contents_of, plain, read_record

from .forked_snakemake import RUN
from .project import Project, copy_project, row_of

WAYS = ("kill", "refuse", "disk", "defect", "node")
MOMENTS = ("start", "begun", "half", "written", "recorded")
FAULT, STRUCK = Path("fault.json"), Path("fault.struck")
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
    (folder / "mine.py").write_text("import helper\n")
    (folder / "helper.py").write_text("")
    (folder / "geoid.tif").write_text("geoid\n")
    synthetic = "data/synthetic/Wuhan/Wuhan-1"
    rows = [
        row_of(Path("in"), scene="Own-1", city="Own", geoid="geoid.tif"),
        row_of(Path(synthetic), scene="Wuhan-1", city="Wuhan", gcps="config/gcps/Wuhan-1.csv"),
    ]
    project.add_scene("my", rows, **CONFIG)
    return project


def set_seed(project: Project, seed: int) -> None:
    """Change a setting that is a parameter of many rules."""
    file = project.folder / "my.yaml"
    file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), "seed": seed}))


def work(snakemake: Any) -> None:
    """Write into each product what it is made of; or fail, if that is asked."""
    fail_at = fault_of(snakemake.rule)
    with job(snakemake.log[0], snakemake.rule):
        fail_at("start")
        with atomic_outputs(snakemake.input, snakemake.output, snakemake.params):
            fail_at("begun")
            inputs = {path: checksum(path) for path in contents_of(snakemake.input)}
            settings = plain(snakemake.params)
            text = json.dumps({"inputs": inputs, "settings": settings}, sort_keys=True)
            for path in snakemake.output:
                if Path(path).suffix in SUFFIXES:
                    with atomic_file(path) as scratch:
                        scratch.write_text(text)
                else:
                    with atomic_folder(path) as scratch:
                        (scratch / "content.json").write_text(text)
                        (scratch / "more").mkdir()
                        (scratch / "more/1").write_text("1")
                fail_at("half")
            fail_at("written")
        fail_at("recorded")


def fault_of(rule: str) -> Callable[[str], None]:
    """Fails the job of a rule at the moment that is asked for, if one is."""
    try:
        fault = json.loads(FAULT.read_text()).get(rule, {})
    except FileNotFoundError:
        fault = {}

    def fail_at(moment: str) -> None:
        if fault.get("moment") != moment:
            return
        with STRUCK.open("a") as stream:
            stream.write(f"{rule}\n")
        if fault["way"] == "refuse":
            raise InputError("asked to refuse", file=FAULT, remedy="none")
        if fault["way"] == "disk":
            raise OSError(errno.ENOSPC, "No space left on device", "product")
        if fault["way"] == "defect":
            raise RuntimeError("asked to fail")
        if fault["way"] == "node":
            os.kill(int(os.environ[RUN]), signal.SIGKILL)  # Snakemake, of which this is a job
        os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60)

    return fail_at


def contents(folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """All hollow products that are there, and what they say of themselves."""
    tops = "results tiles dataset dataset_kitti originals benchmark audit submission score_dsm data"
    for top in tops.split():
        for file in sorted((folder / top).rglob("*")):
            hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
            if not hidden and file.is_file() and file.name != "1":
                product = file.parent if file.name == "content.json" else file
                yield str(product.relative_to(folder)), json.loads(file.read_text())


def stale(folder: Path, seed: int) -> list[str]:
    """Products that are not of the inputs and settings that are there, or are not whole.

    A product in the middle that was deleted stands for what its record says, if that is of what is
    there.
    """
    found, here = [], Path.cwd()
    os.chdir(folder)

    @cache
    def now(path: str) -> str:
        if Path(path).exists():
            return checksum(path)
        record = read_record(path)
        if record is None or record.settings.get("seed", seed) != seed:
            return ""
        if any(now(name) != was for name, was in record.inputs.items()):
            return ""
        return record.outputs[path]

    try:
        for product, content in contents(folder):
            wrong = [path for path, was in content["inputs"].items() if now(path) != was]
            found += [f"{product} of {path}" for path in wrong]
            if seed not in (content["settings"].get("seed", seed),):
                found.append(f"{product}: seed")
    finally:
        os.chdir(here)
    return found
