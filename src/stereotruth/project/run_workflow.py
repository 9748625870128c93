"""The workflow in this folder, by Snakemake, with a line that says how far it is."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from .project import CONFIG, FILES, read_mapping, require_project, require_scenes
from .targets import need_scenes, refuse_unknown

EXAMPLE = "--example"  # the synthetic cities that come with the package
CONFIG_OPTIONS = ("--configfile", "--configfiles")
CORES = re.compile(r"--(cores|jobs|profile|executor)(=|$)|-[cj]")
# Seconds of the jobs of a scene of 1200 x 1200 px with 4 million points, one core: they say what
# share of a run a job is, until its own jobs say how fast this machine is.
SECONDS = {
    "simulate_image": 8,
    "simulate_lidar": 8,
    "ingest": 6,
    "align": 3,
    "refine": 12,
    "rectify": 6,
    "surface": 8,
    "project": 8,
    "export": 15,
    "evaluate_images": 10,
    "report_city": 15,
    "match": 30,
    "train": 3600,
}
USUAL_SECONDS = 5.0
TRUSTED = 20.0  # seconds of jobs by which the table above counts beside the jobs that are done
STATS = re.compile(r"^(\w+) +(\d+)$")
FINISHED = re.compile(r"^Finished jobid: \d+ \(Rule: (\w+)\)")
STEPS = re.compile(r"^(\d+) of (\d+) steps")


def arguments_for(given: Sequence[str]) -> list[str]:
    """Arguments of Snakemake for what stands after ``stereotruth run``."""
    given = [word for word in _with_profiles(given) if word != "--"]
    configured = any(word.split("=")[0] in CONFIG_OPTIONS for word in given)
    if EXAMPLE in given:
        given.remove(EXAMPLE)
    elif not configured:
        require_project()
        given += ["--configfile", CONFIG] if Path(CONFIG).is_file() else []
    arguments = ["--snakefile", str(FILES / "Snakefile"), *given]
    if not any(map(CORES.match, given)):
        arguments += ["--cores", "all"]
    return arguments


def _with_profiles(given: Sequence[str]) -> list[str]:
    """Arguments with the path of a profile that comes with the package in place of its name.

    Raises InputError if the executor or the storage of a profile is not installed.
    """
    words = list(given)
    for k, word in enumerate(words):
        option, equals, value = word.partition("=")
        if option not in ("--profile", "--workflow-profile"):
            continue
        at = k if equals else k + 1
        name = value if equals else words[at] if at < len(words) else ""
        shipped = FILES / "profiles" / name
        of_package = "/" not in name and not Path(name).exists() and shipped.is_dir()
        file = next((shipped if of_package else Path(name)).glob("config*.yaml"), None)
        if not name or file is None:  # left to Snakemake, which has more places for profiles
            continue
        for package in _plugins(read_mapping(file)):
            if find_spec(package.replace("-", "_")) is None:
                raise InputError(
                    f"profile {name!r} needs the package {package}",
                    remedy=f"pip install {package}",
                )
        if of_package:
            words[at] = f"{option}={shipped}" if equals else str(shipped)
    return words


def _plugins(profile: Mapping[str, Any]) -> list[str]:
    """The packages of the executor and the storage that a profile names."""
    executor, storage = profile.get("executor", "local"), profile.get("default-storage-provider")
    named = [] if executor == "local" else [f"snakemake-executor-plugin-{executor}"]
    return named + ([f"snakemake-storage-plugin-{storage}"] if storage else [])


def config_files(arguments: Sequence[str]) -> list[Path]:
    """The files that follow ``--configfile`` or ``--configfiles``, those that are there."""
    found, inside = [], False
    for word in arguments:
        option, _, value = word.partition("=")
        if word.startswith("-"):
            inside = option in CONFIG_OPTIONS
        if inside and (name := value if word.startswith("-") else word):
            found.append(Path(name))
    return [file for file in found if file.is_file()]


@dataclass
class Progress:
    """How far a run is, from the lines that Snakemake prints."""

    begun: float = field(default_factory=time.monotonic)
    planned: dict[str, int] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)
    steps: tuple[int, int] = (0, 0)
    in_table: bool = False

    def read(self, line: str) -> None:
        """Take in one line."""
        if line.startswith("Job stats:"):
            self.in_table, self.planned = True, {}
        elif self.in_table and (found := STATS.match(line)):
            rule, count = found[1], int(found[2])
            if rule == "total":
                self.in_table, self.steps = False, (self.steps[0], count)
            else:
                self.planned[rule] = count
        elif found := FINISHED.match(line):
            self.done[found[1]] = self.done.get(found[1], 0) + 1
        elif found := STEPS.match(line):
            self.steps = int(found[1]), int(found[2])

    @staticmethod
    def _weight(jobs: dict[str, int]) -> float:
        return sum(SECONDS.get(rule, USUAL_SECONDS) * count for rule, count in jobs.items())

    def seconds_left(self, now: float | None = None) -> float:
        """By the jobs that are done, and while these are few by the table of usual seconds."""
        done, planned = self._weight(self.done), self._weight(self.planned)
        elapsed = (time.monotonic() if now is None else now) - self.begun
        return max(planned - done, 0.0) * (elapsed + TRUSTED) / (done + TRUSTED)

    def line(self, now: float | None = None) -> str:
        """The status line."""
        done, total = self.steps
        if not total:
            return "planning"
        left = f", about {duration(self.seconds_left(now))} left" if done < total else ""
        return f"{done} of {total} jobs done{left}"


def duration(seconds: float) -> str:
    """A time span in the words of a person."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def watch(lines: Iterable[str], progress: Progress) -> None:
    """Print the lines of a run, and below them its status line with time left."""
    from rich.console import Console
    from rich.live import Live
    from rich.spinner import Spinner

    console = Console(stderr=True, highlight=False)
    spinner = Spinner("line", progress.line())
    with Live(spinner, console=console, refresh_per_second=4, transient=True):
        for line in lines:
            line = line.rstrip("\n")
            progress.read(line)
            spinner.update(text=progress.line())
            console.print(line, markup=False, soft_wrap=True)


def follow(process: subprocess.Popen[str]) -> int:
    """Watch a run until it ends; returns its exit status.

    After Ctrl-C, which reaches Snakemake too, what its jobs say of their end is not shown.
    """
    is_stopped = False
    while True:
        try:
            if is_stopped:
                for _ in process.stdout or ():
                    pass
            else:
                watch(process.stdout or (), Progress())
            status = process.wait()
            break
        except KeyboardInterrupt:
            if not is_stopped:
                sys.stderr.write("Stopping the jobs that are at work …\n")
            is_stopped = True
    if is_stopped:
        sys.stderr.write("Stopped. The same command carries on.\n")
    return status


def run_workflow(given: Sequence[str]) -> int:
    """Run the workflow; returns Snakemake's exit status.

    On a terminal its lines pass through here, with a status line below them; else this process
    becomes Snakemake's.
    """
    arguments = arguments_for(given)
    files = config_files(arguments)
    for file in files:  # Snakemake names no file that it cannot read
        read_mapping(file)
    if EXAMPLE not in given:
        refuse_unknown(given, files)
        by_option = any(word.startswith("scenes=") for word in given)  # of --config
        if not by_option and need_scenes(given, files):
            require_scenes(files)
    command = [sys.executable, "-m", "snakemake", *arguments]
    if not sys.stderr.isatty() or {"--dry-run", "-n", "--dryrun"} & set(given):
        os.execv(sys.executable, command)
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        command,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    signal.signal(signal.SIGTERM, lambda number, _: process.send_signal(number))
    return follow(process)
