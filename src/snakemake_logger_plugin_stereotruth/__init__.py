"""What ``stereotruth run`` shows of a run, by Snakemake's interface for loggers: `--logger
stereotruth`. One line for each job that is done, with the time that the others will take; of a dry
run a table of its rules. All else is in the logs: of Snakemake (.snakemake/log) and of the jobs.

Every Snakemake of the environment imports its plug-ins when it starts: this one imports nothing of
the package before a run asks for it.
"""

from __future__ import annotations

import logging
import os
import statistics
import sys
import time
from pathlib import Path

from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent

COLUMNS = "rule", "jobs", "cores", "MB", "minutes"
MOST_OF_REASON = 500  # characters
RESOURCES = "mem_mb", "runtime"
# Rules that name the products of others, and take no time.
WITHOUT_JOB = {"all", "benchmark", "closure", "evaluate", "heights", "index", "predict", "report"}


class LogHandler(LogHandlerBase):
    """Hears of a run what Snakemake says to its loggers, and prints what users want to know."""

    writes_to_stream, writes_to_file, needs_rulegraph = True, False, False
    has_filter, has_formatter = True, True

    def __post_init__(self) -> None:
        from stereotruth.core.job import NEWS_ONLY

        dry = self.common_settings.dryrun
        self.stream = sys.stdout if dry or self.common_settings.stdout else sys.stderr
        self.counts: dict[str, int] = {}  # jobs of the run by rule
        self.asked = self.failed = False
        self.done = 0
        self.jobs: dict[int, tuple[logging.LogRecord, float]] = {}  # with the time of their start
        self.took: dict[str, list[float]] = {}  # s, of finished jobs by rule
        self.began = time.monotonic()
        os.environ[NEWS_ONLY] = "1"  # for the jobs

    def emit(self, record: logging.LogRecord) -> None:
        """Print what a record means, if it is news."""
        event = getattr(record, "event", None)
        if event == LogEvent.WORKFLOW_STARTED:
            self.asked = True
        elif event == LogEvent.RUN_INFO:
            known = dict(getattr(record, "stats", None) or {})
            self._begin({r: n for r, n in known.items() if r not in WITHOUT_JOB | {"total"}})
        elif event == LogEvent.JOB_INFO:
            if record.rule_name not in WITHOUT_JOB:
                self.jobs[record.jobid] = record, time.monotonic()
        elif event == LogEvent.JOB_FINISHED:
            self._finished(record.job_id)
        elif event == LogEvent.JOB_ERROR:
            self._failed_job(record)
        elif record.levelno >= logging.WARNING and record.getMessage().strip():
            of_job = getattr(record, "exception", "") == "RuleException" or self.failed
            if of_job and record.levelno >= logging.ERROR:
                return  # Snakemake's words for a job that has failed, which has told why
            self.failed = self.failed or record.levelno >= logging.ERROR
            self._say(record.getMessage())

    def close(self) -> None:
        """At the end of a run: the table of a dry one, or that there was nothing to do."""
        if self.asked and not self.failed:
            if not self.counts:
                self._say("Nothing to do: all is there and up to date")
            elif self.common_settings.dryrun:
                self._show_table()
        self.asked = False
        super().close()

    def _say(self, text: str) -> None:
        print(text, file=self.stream, flush=True)

    def _begin(self, counts: dict[str, int]) -> None:
        if not self.common_settings.dryrun and not self.counts:
            rules = ", ".join(f"{rule} {n}" for rule, n in counts.items())
            self._say(f"{sum(counts.values())} jobs: {rules}")
        self.counts = counts

    def _finished(self, number: int) -> None:
        record, start = self.jobs.pop(number, (None, 0.0))
        if record is None or self.common_settings.quiet:
            return
        from stereotruth.core.job import in_time

        self.done += 1
        seconds = time.monotonic() - start
        self.took.setdefault(record.rule_name, []).append(seconds)
        parts = [f"{self.done} of {sum(self.counts.values())}", in_time(seconds)]
        if left := self._seconds_left():
            parts.append(f"about {in_time(left)} left")
        self._say(f"Done: {_name(record)} ({'; '.join(parts)})")

    def _seconds_left(self) -> float:
        """By the mean time of each rule's jobs, of other rules the mean of all, at the pace of the
        run so far; 0 if nothing is left."""
        every = [s for of in self.took.values() for s in of]
        usual = statistics.fmean(every)
        left = sum(
            (n - len(self.took.get(rule, ()))) * statistics.fmean(self.took.get(rule, [usual]))
            for rule, n in self.counts.items()
        )
        return left * (time.monotonic() - self.began) / max(sum(every), 1e-9)

    def _failed_job(self, record: logging.LogRecord) -> None:
        from stereotruth.core.job import failure_file

        self.failed = True
        if any(failure_file(log).exists() for log in record.log):
            return
        begun, _ = self.jobs.get(record.jobid, (record, 0.0))
        name = record.rule_name if begun is record else _name(begun)
        if reason := record.rule_msg:  # of what runs the job, such as SLURM
            self._say(f"Failed: {name}. {reason.strip()[:MOST_OF_REASON]}")
        elif logs := [log for log in map(Path, record.log) if _is_of(log, begun)]:
            self._say(
                f"Failed: {name}, and does not say why, as a job that is killed for its memory or "
                f"its time. Look at {', '.join(map(str, logs))}"
            )
        else:
            self._say(
                f"Failed: {name}, without a log of its own, as a job that a cluster refuses for "
                "its partition, account, memory or time: sbatch by hand, with the resources of the "
                "profile, says why"
            )

    def _show_table(self) -> None:
        """What a dry run would do: of each rule its jobs, and the most that one job may take."""
        from rich.console import Console

        from stereotruth.project.findings import plain_table, wide

        rules: dict[str, list[float]] = {}
        for record, _ in self.jobs.values():
            row = rules.setdefault(record.rule_name, [0, 0, 0, 0])
            of = dict(record.resources.items())
            most = [record.threads, *(of.get(name) for name in RESOURCES)]
            known = [value if isinstance(value, int | float) else 0 for value in most]
            row[:] = [row[0] + 1, *map(max, row[1:], known)]
        table = plain_table(COLUMNS)
        for rule, numbers in rules.items():
            table.add_row(rule, *map(str, numbers))
        table.add_row("all", str(sum(row[0] for row in rules.values())))
        wide(Console(file=self.stream, highlight=False)).print(table)
        self._say("Cores, MB and minutes: of one job, at most. This was a dry run")


def _is_of(log: Path, begun: logging.LogRecord) -> bool:
    """Whether a job's log was written since the job began."""
    return log.is_file() and log.stat().st_mtime >= begun.created - 1.0


def _name(record: logging.LogRecord) -> str:
    return record.rule_msg or record.rule_name
