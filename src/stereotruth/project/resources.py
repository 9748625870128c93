"""Time, disk and memory of a run, by rates that were measured."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.config.configuration import Configuration
from .estimates import estimates
from .findings import Findings, Level
from .run_workflow import duration

if TYPE_CHECKING:
    from .check_scene import SceneFacts

SPARE = 1.2  # of the disk: logs, records, blocks in the making
MEMORY = 4.0e9  # that rules of the way to tiles ask for


def check_resources(facts: Sequence[SceneFacts], settings: Configuration, found: Findings) -> None:
    """Say what a run from nothing takes, and refuse a disk that is too small for it."""
    if not facts:
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    points, pixels = (sum(getattr(f, name) for f in facts) for name in ("points", "pixels"))
    covered = sum(fact.pixels * fact.covered for fact in facts)
    rates, sizes = estimates()["seconds"], estimates()["bytes"]
    seconds = (
        (rates["ingest_point"] + rates["project_point"]) * points
        + (rates["rectify_px"] + rates["scan_px"]) * pixels
        + (rates["project_px"] + rates["tile_px"]) * covered
        + rates["scene"] * len(facts)
        + rates["job"] * sum(5 + fact.lidar_files for fact in facts)
    )
    needed = SPARE * (sizes["point"] * points + sizes["px"] * pixels)
    free = shutil.disk_usage(Path.cwd()).free
    found.say(
        "time",
        Level.FACT,
        f"about {duration(seconds / max(cores or 1, 1))} on the {cores} cores of this machine, "
        "from nothing to tiles",
    )
    if needed > free:
        found.say(
            "disk",
            Level.ERROR,
            f"{_gb(needed)} are needed in {Path.cwd()}, {_gb(free)} are free",
            "make space, or work in a folder on a larger disk",
        )
    else:
        found.say("disk", Level.FACT, f"{_gb(needed)} of the {_gb(free)} that are free")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if memory < MEMORY:
        found.say(
            "memory",
            Level.DOUBT,
            f"{_gb(memory)} in all, jobs ask for up to {_gb(MEMORY)}",
            "run with --cores 1",
        )
    else:
        found.say("memory", Level.FACT, f"up to {_gb(MEMORY)} a job, of {_gb(memory)}")


def _gb(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 5e7 else "less than 0.1 GB"
