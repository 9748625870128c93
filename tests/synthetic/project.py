"""A copy of the workflow that a test may run and edit, and a small city to feed it with."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from stereocities.cities import SceneSpec
from stereotruth.project.simulated_project import DEMO

from .forked_snakemake import planner, runner, start_snakemake
from .forks import Forker

ROOT = Path(__file__).parents[2]
SHEET_COLUMNS = [
    "scene",
    "city",
    "left_image",
    "right_image",
    "lidar",
    "lidar_crs",
    "geoid",
    "gcps",
]

TINY = replace(
    DEMO,
    name="Tiny",
    scenes=(
        SceneSpec("Tiny-1", (0.0, 0.0), 560, 560, 5, lidar_grid=(2, 1), ragged_m=(20.0, 20.0)),
    ),
)
MADE = ("results", "tiles", "dataset", "logs", ".snakemake")  # of a run
MOST_S = 900.0  # that a run takes
SIZE = {"tiles": {"size": 128, "min_labelled": 0.5}}


@dataclass
class Run:
    """What a call of snakemake said."""

    status: int
    text: str

    @property
    def jobs(self) -> dict[str, int]:
        """Planned jobs by rule, from the last table of job counts."""
        tables = self.text.split("Job stats:")
        if len(tables) == 1:
            return {}
        found = re.findall(r"^(\w+)\s+(\d+)$", tables[-1], flags=re.MULTILINE)
        return {rule: int(n) for rule, n in found if rule != "total"}


@dataclass
class Project:
    """A working directory with the workflow's files, and a source tree of its own.

    ``edited``: use that source tree, instead of the installed package, whose code is compiled.
    """

    folder: Path
    edited: bool = False

    def snakemake(self, *arguments: str, cores: int = 2, as_users_do: bool = False) -> Run:
        """A call of Snakemake, whose jobs are forks.

        ``as_users_do``: a program of its own, and one for each job, in this process' environment.
        """
        call = ["--cores", str(cores), *arguments]
        environment = dict(os.environ)
        if self.edited:
            environment["PYTHONPATH"] = str(self.folder / "src")
            environment.pop("NUMBA_CACHE_DIR", None)
        if {"--dry-run", "--touch"} & set(arguments):
            return self._ask(planner(), call, environment)
        if not (as_users_do or self.edited):
            return self._ask(runner(), call, environment)
        done = subprocess.run(
            [sys.executable, "-m", "snakemake", *call],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=MOST_S,
        )
        return Run(done.returncode, done.stdout)

    def _ask(self, forker: Forker, call: list[str], environment: dict[str, str]) -> Run:
        run = start_snakemake(forker, self.folder, call, "said.log", environment)
        status = run.wait(MOST_S)
        return Run(status, (self.folder / "said.log").read_text())

    def rest(self, *arguments: str) -> Run:
        """A call for what is there already, which ends before any job."""
        run = self._ask(planner(), ["--cores", "2", *arguments], dict(os.environ))
        assert run.status == 0 and "Nothing to be done" in run.text, run.text
        return run

    def refuse(self, *arguments: str) -> Run:
        """A call for work that ends before any job."""
        run = self._ask(planner(), ["--cores", "2", *arguments], dict(os.environ))
        assert run.status != 0 and "Job stats" not in run.text, run.text
        return run

    def plan(self, *arguments: str) -> dict[str, int]:
        """Jobs by rule that a call would run."""
        run = self.snakemake("--dry-run", *arguments)
        assert run.status == 0, run.text
        return run.jobs

    def copy(self, folder: Path, without: tuple[str, ...] = ()) -> Project:
        """The same project in another folder, to be edited there; ``without`` names of files."""
        shutil.copytree(self.folder, folder, ignore=shutil.ignore_patterns(*without))
        return Project(folder)

    def edit(self, file: str, old: str, new: str) -> None:
        path = self.folder / file
        text = path.read_text()
        assert old in text, f"{old!r} is not in {file}"
        path.write_text(text.replace(old, new, 1))

    def add_scene(self, name: str, rows: list[dict[str, str]], **overrides: object) -> str:
        """Write sheets and a config for a city of one's own; returns the config's file name."""
        import yaml

        more = dict.fromkeys(c for row in rows for c in row if c not in SHEET_COLUMNS)
        columns = [*SHEET_COLUMNS, *more]
        lines = ["\t".join(columns)]
        lines += ["\t".join(row.get(c, "") for c in columns) for row in rows]
        (self.folder / f"{name}_scenes.tsv").write_text("\n".join(lines) + "\n")
        cities = ["city\tprefix\ttraining\tvalidation\ttesting"]
        for n, city in enumerate(dict.fromkeys(row["city"] for row in rows)):
            cities.append(f"{city}\tC{n}\t6\t1\t3")
        (self.folder / f"{name}_cities.tsv").write_text("\n".join(cities) + "\n")
        config = {"scenes": f"{name}_scenes.tsv", "cities": f"{name}_cities.tsv", **overrides}
        (self.folder / f"{name}.yaml").write_text(yaml.safe_dump(config))
        return f"{name}.yaml"


def copy_project(folder: Path) -> Project:
    """Copy what a clone holds of the workflow and the package into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / "Snakefile", folder)
    for name in ("workflow", "config", "profiles", "src"):
        ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, folder / name, ignore=ignore)
    return Project(folder)


def row_of(folder: Path, **changes: str) -> dict[str, str]:
    return {
        "scene": "Tiny-1",
        "city": "Tiny",
        "left_image": str(folder / "left.tif"),
        "right_image": str(folder / "right.tif"),
        "lidar": str(folder / "lidar"),
        "gcps": str(folder / "gcps.csv"),
        **changes,
    }


def hashes(folder: Path) -> dict[str, str]:
    """Checksum of each file below, but for Snakemake's own time stamps."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.name != ".snakemake_timestamp"
    }
