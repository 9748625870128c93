"""Runs of the workflow that are killed at random moments and carried on.

A kill takes the worker, snakemake alone, or all processes of the run.
"""

from __future__ import annotations

import hashlib
import os
import random
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ..synthetic.forked_snakemake import runner, start_snakemake
from ..synthetic.forks import Fork

VICTIMS = ("worker", "snakemake", "tree")
PRODUCTS = ("results/rectify", "results/project", "results/export", "tiles")


def family(pid: int) -> tuple[list[int], list[int]]:
    """All processes below one, and those of them that have none below themselves (Linux)."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (FileNotFoundError, ProcessLookupError):
                continue
            parents.setdefault(parent, []).append(int(entry.name))
    found, todo = [], [pid]
    while todo:
        below = parents.get(todo.pop(), [])
        found += below
        todo += below
    return found, [process for process in found if process not in parents]


def start(folder: Path, *arguments: str) -> Fork:
    """Snakemake in a session of its own, whose jobs are forks; what it says goes to run.log."""
    return start_snakemake(runner(), folder, ["--cores", "2", *arguments], "run.log")


def kill(run: Fork, victim: str) -> None:
    """SIGKILL to one of VICTIMS; of a killed worker's run, wait for the end."""
    below, workers = family(run.pid)
    chosen = {"worker": workers[-1:], "snakemake": [run.pid], "tree": [run.pid, *below]}[victim]
    for pid in chosen:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    run.wait()


def hashes(folder: Path) -> dict[str, str]:
    """Checksum of each product's files, without what Snakemake and the blocks' records add."""
    found = {}
    for product in PRODUCTS:
        for file in sorted((folder / product).rglob("*")):
            name = str(file.relative_to(folder))
            hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
            if file.is_file() and not hidden:
                found[name] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


def records(folder: Path) -> dict[Path, tuple[str, int]]:
    """Content and time of writing of the records of all finished blocks."""
    found = {}
    for file in (folder / "results").rglob(".*.work/done/*.json"):
        try:
            found[file] = file.read_text(), file.stat().st_mtime_ns
        except FileNotFoundError:
            continue
    return found


def disturb(
    folder: Path, arguments: list[str], kills: int, seed: int, longest: float
) -> Iterator[str]:
    """Kill runs after random times up to ``longest`` s, then let one end; tells each step.

    Raises AssertionError if a block that was done is made again, or the last run fails.
    """
    rng = random.Random(seed)
    done: dict[Path, tuple[str, int]] = {}
    for number in range(kills):
        run = start(folder, *arguments)
        wait = rng.uniform(0.5, longest)
        victim = rng.choice(VICTIMS)
        time.sleep(wait)
        if run.poll() is None:
            kill(run, victim)
        yield f"kill {number + 1}: {victim} after {wait:.1f} s, {len(records(folder))} blocks"
        now = records(folder)
        for file, (text, written) in done.items():
            if file in now and now[file][0] == text:
                assert now[file][1] == written, f"{file} was made again"
        done = now
    run = start(folder, *arguments)
    assert run.wait() == 0, (folder / "run.log").read_text()[-4000:]
