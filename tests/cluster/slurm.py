"""What the tests ask the cluster, and how they take a node from it."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

STATE = Path("/run/stereotruth-slurm")  # see settings.sh
Found = TypeVar("Found")


@dataclass
class Job:
    """What SLURM says about a job."""

    number: int
    state: str
    memory: str
    node: str
    comment: str


def ask(*command: str) -> str:
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=60).stdout


def jobs() -> list[Job]:
    """All jobs that SLURM knows, finished ones too."""
    table = ask("squeue", "--states=all", "--noheader", "--sort=i", "--format=%i|%T|%m|%N|%k")
    lines = (line.split("|") for line in table.splitlines())
    return [Job(int(number), *rest) for number, *rest in lines]


def wait_for(condition: Callable[[], Found], seconds: float) -> Found:
    """What a condition gives when it holds first; its last answer after so many seconds."""
    end = time.monotonic() + seconds
    while not (found := condition()) and time.monotonic() < end:
        time.sleep(0.1)
    return found


def kill_job(number: int) -> None:
    """SIGKILL to all that a job runs: it ends at once, and its node is free."""
    _kill_where(f"SLURM_JOB_ID={number}\0".encode())


def _kill_where(variable: bytes, *names: str) -> None:
    """SIGKILL to what has a variable in its environment, or a name that begins so."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            said = (entry / "cmdline").read_bytes().decode(errors="replace")
            there = variable in (entry / "environ").read_bytes()
        except OSError:  # ended by now
            continue
        if there or said.startswith(names):
            with suppress(ProcessLookupError):
                os.kill(int(entry.name), signal.SIGKILL)


def kill_node(node: str) -> None:
    """SIGKILL to a node's daemon and to all that its jobs run, as if its power failed."""
    daemon = int((STATE / f"{node}.pid").read_text())
    with suppress(ProcessLookupError):
        os.kill(daemon, signal.SIGKILL)
    running = [job.number for job in jobs() if job.node == node and job.state == "RUNNING"]
    _kill_where(
        f"SLURMD_NODENAME={node}\0".encode(), *(f"slurmstepd: [{number}." for number in running)
    )


def start_node(node: str) -> None:
    """Start a node's daemon again and wait until it takes jobs."""
    subprocess.run(["slurmd", "-N", node], check=True, timeout=60)

    def idle() -> bool:
        return ask("sinfo", "--noheader", "--Node", f"--nodes={node}", "--format=%t") == "idle\n"

    assert wait_for(idle, seconds=60.0), f"{node} does not come back"
