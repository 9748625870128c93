"""The timeline of a folder's last run: its jobs over time, by rule, and the memory that they took.

Snakemake writes seconds and memory of a job to ``logs/<rule>/….tsv``; the last line of the log
beside it has the time.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from ..pages.figures import Axis
from ..pages.tables import Cell, Column, Table, number

PAUSE_S = 600.0  # without any job: what follows is another run
MOST_BARS = 2000  # the longest jobs; more are not drawn
WIDTH, ROW, MEMORY = 900.0, 22.0, 90.0
STAMP = re.compile(r"^(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d),(\d{3}) ", re.MULTILINE)
TAIL_BYTES = 100_000  # of a log: a traceback may follow the last line with a time


@dataclass(frozen=True)
class Job:
    """A job that ended: its rule, what it was for, seconds since the epoch, memory in MB."""

    rule: str
    of: str
    begin: float
    end: float
    memory_mb: float


@dataclass(frozen=True)
class Bar:
    """A job in the drawing."""

    x: float
    y: float
    width: float
    text: str


@dataclass(frozen=True)
class Timeline:
    """Bars by rule in rows, ticks of time, memory of all jobs at a time as an SVG path."""

    width: float
    height: float
    rows: tuple[tuple[float, str], ...]
    bars: tuple[Bar, ...]
    ticks: tuple[tuple[float, str], ...]
    memory: str
    most_memory: str
    caption: str
    table: Table


def read_jobs(root: Path) -> list[Job]:
    """The jobs of ``root/logs`` that have both a log and its figures, by their begin."""
    jobs = []
    logs = root / "logs"
    for file in sorted(logs.rglob("*.tsv")):
        log = file.with_suffix(".log")
        ended = _last_stamp(log)
        with file.open(encoding="utf-8", newline="") as stream:
            row = next(csv.DictReader(stream, delimiter="\t"), {})
        seconds = number(row.get("s") or "")
        if ended is None or seconds is None:
            continue
        rule, *of = file.relative_to(logs).with_suffix("").parts
        memory = number(row.get("max_rss") or "") or 0.0
        jobs.append(Job(rule, "/".join(of), ended - seconds, ended, memory))
    return sorted(jobs, key=lambda job: (job.begin, job.rule, job.of))


def _last_stamp(log: Path) -> float | None:
    """Time of the last line of a log that has one; None if there is no such line or no log."""
    try:
        with log.open("rb") as stream:
            stream.seek(max(0, log.stat().st_size - TAIL_BYTES))
            stamps = STAMP.findall(stream.read().decode("utf-8", "replace"))
    except FileNotFoundError:  # a job that begins takes its old log away
        return None
    if not stamps:
        return None
    day, milliseconds = stamps[-1]
    return datetime.fromisoformat(day).timestamp() + int(milliseconds) / 1000


def last_run(jobs: Sequence[Job]) -> list[Job]:
    """The jobs after the last pause, in their order."""
    run: list[Job] = []
    busy_to = float("-inf")
    for job in jobs:
        if job.begin - busy_to > PAUSE_S:
            run = []
        run.append(job)
        busy_to = max(busy_to, job.end)
    return run


def timeline(jobs: Sequence[Job]) -> Timeline | None:
    """The drawing of a run's jobs; None of none."""
    if not jobs:
        return None
    start, end = min(job.begin for job in jobs), max(job.end for job in jobs)
    unit, name = (60.0, "min") if end - start > 180 else (1.0, "s")
    x = Axis(0.0, max((end - start) / unit, 1e-3), WIDTH)
    rules = list(dict.fromkeys(job.rule for job in jobs))
    drawn = sorted(jobs, key=lambda job: job.begin - job.end)[:MOST_BARS]
    bars = []
    for job in drawn:
        left, right = (x.at((t - start) / unit) for t in (job.begin, job.end))
        text = f"{job.rule} {job.of}: {job.end - job.begin:.1f} s, {job.memory_mb:.0f} MB"
        y = ROW * rules.index(job.rule)
        bars.append(Bar(left, y, round(max(right - left, 1.0), 1), text))
    below = ROW * len(rules)
    most, path = 0.0, [f"M0 {below + MEMORY:g}"]
    steps = _memory_over_time(jobs)
    most = max(memory for _, memory in steps)
    for time, memory in steps:
        at = x.at((time - start) / unit)
        path.append(f"H{at:g}V{below + MEMORY - (MEMORY - 14) * memory / max(most, 1e-9):.1f}")
    more = f"; the {MOST_BARS} longest are drawn" if len(jobs) > MOST_BARS else ""
    begun = datetime.fromtimestamp(start).strftime("%Y-%m-%d %H:%M")
    return Timeline(
        width=WIDTH,
        height=below + MEMORY,
        rows=tuple((ROW * k, rule) for k, rule in enumerate(rules)),
        bars=tuple(bars),
        ticks=tuple((at, f"{text} {name}") for at, text in x.ticks()),
        memory="".join([*path, f"V{below + MEMORY:g}Z"]),
        most_memory=f"{most:.0f} MB",
        caption=f"{len(jobs)} jobs from {begun}, {(end - start) / unit:.1f} {name}{more}",
        table=_by_rule(rules, jobs),
    )


def _memory_over_time(jobs: Sequence[Job]) -> list[tuple[float, float]]:
    """Times, and from each on the sum of the largest memory of the jobs that run."""
    changes = [(job.begin, job.memory_mb) for job in jobs]
    changes += [(job.end, -job.memory_mb) for job in jobs]
    total, steps = 0.0, []
    for time, change in sorted(changes):
        total += change
        steps.append((time, max(total, 0.0)))
    return steps


def _by_rule(rules: Sequence[str], jobs: Sequence[Job]) -> Table:
    titles = ("rule", "jobs", "seconds in all", "longest, s", "most memory, MB")
    lines = []
    for rule in rules:
        here = [job for job in jobs if job.rule == rule]
        seconds = [job.end - job.begin for job in here]
        values = (len(here), sum(seconds), max(seconds), max(job.memory_mb for job in here))
        cells = [Cell(f"{v:.0f}", f"{v:.6g}") for v in values]
        lines.append((Cell(rule, rule), *cells))
    columns = tuple(Column(title, k > 0) for k, title in enumerate(titles))
    return Table(columns, (("", tuple(lines)),))
