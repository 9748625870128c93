"""What a run shows on the terminal: the logger of Snakemake."""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from snakemake_interface_logger_plugins.common import LogEvent
from snakemake_interface_logger_plugins.tests import MockOutputSettings

from snakemake_logger_plugin_stereotruth import WITHOUT_JOB, LogHandler
from stereotruth.core.errors import InputError
from stereotruth.core.job import job
from stereotruth.core.products.making import begin_notes

from ..synthetic.project import ROOT


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Gives a handler its events; ``said()`` is what it has printed since."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STEREOTRUTH_NEWS_ONLY", "")  # taken back after what the handler sets
    begin_notes()

    def begin(dryrun: bool = False) -> SimpleNamespace:
        settings = MockOutputSettings()
        settings.dryrun = dryrun
        handler = LogHandler(settings, None)

        def tell(event: str | None, level: int = logging.INFO, msg: str = "", **values) -> None:
            record = logging.makeLogRecord({"msg": msg, "levelno": level, **values})
            if event:
                record.event = LogEvent[event]
            handler.emit(record)

        def said() -> list[str]:
            handler.close()
            captured = capsys.readouterr()
            return (captured.out + captured.err).splitlines()

        tell("WORKFLOW_STARTED")
        return SimpleNamespace(tell=tell, said=said)

    return begin


WITHOUT_REASON = {"rule_msg": None}  # as Snakemake has it of a job that has failed


def job_of(number: int, rule: str, **resources: int) -> dict:
    return {
        "jobid": number,
        "rule_name": rule,
        "rule_msg": f"{rule} number {number}",
        "log": [f"logs/{rule}/{number}.log"],
        "threads": number,
        "resources": resources,
    }


def test_one_line_for_each_job_that_is_done_and_none_for_what_snakemake_says_besides(run):
    now = run()
    now.tell(None, msg="Building DAG of jobs...")
    now.tell("RUN_INFO", stats={"align": 3, "report": 1, "total": 4})
    for number in (1, 2):
        now.tell("JOB_INFO", **job_of(number, "align"))
    now.tell("JOB_FINISHED", job_id=1)
    now.tell("JOB_FINISHED", job_id=2)
    now.tell("JOB_INFO", **job_of(3, "report"))
    now.tell("JOB_FINISHED", job_id=3)
    begin, first, second = now.said()
    assert "3 jobs" in begin and "align 3" in begin and "report" not in begin
    assert "align number 1" in first and "1 of 3" in first and "left" in first
    assert "align number 2" in second and "2 of 3" in second


def test_rules_without_a_job_are_known():
    files = [*(ROOT / "workflow/rules").glob("*.smk"), ROOT / "Snakefile"]
    text = "".join(file.read_text(encoding="utf-8") + "\n\n" for file in files)
    rules = re.findall(r"^rule (\w+):\n((?:(?: .*)?\n)+)", text, flags=re.MULTILINE)
    assert {name for name, body in rules if "    script:" not in body} == WITHOUT_JOB


def test_a_dry_run_is_a_table_of_its_rules(run):
    now = run(dryrun=True)
    now.tell("RUN_INFO", stats={"align": 2, "project": 1, "total": 3})
    now.tell("JOB_INFO", **job_of(1, "align", mem_mb=1300, runtime=10))
    now.tell("JOB_INFO", **job_of(2, "align", mem_mb=2600, runtime=20))
    now.tell("JOB_INFO", **job_of(3, "project", mem_mb=4000, runtime=240))
    now.tell("RUN_INFO", stats={"align": 2, "project": 1, "total": 3})
    heads, align, project, total, _ = (line.split() for line in now.said())
    assert heads == ["rule", "jobs", "cores", "MB", "minutes"]
    assert align == ["align", "2", "2", "2600", "20"]
    assert project == ["project", "1", "3", "4000", "240"]
    assert total == ["all", "3"]


def test_nothing_to_do_is_said_unless_there_was_an_error(run):
    assert len(run().said()) == 1
    now = run()
    now.tell(None, logging.ERROR, "no rule makes it")
    assert now.said() == ["no rule makes it"]


def test_a_job_that_dies_without_a_word_is_named_and_one_that_says_why_is_not(run, capsys):
    now = run()
    now.tell("RUN_INFO", stats={"align": 2, "total": 2})
    with pytest.raises(SystemExit), job("logs/align/1.log", "align A"):
        raise InputError("no points", file="a.csv", remedy="give some")
    (told,) = capsys.readouterr().err.splitlines()[1:]
    assert "no points" in told
    now.tell("JOB_ERROR", logging.ERROR, **job_of(1, "align") | WITHOUT_REASON)
    Path("logs/align/2.log").touch()
    now.tell("JOB_ERROR", logging.ERROR, **job_of(2, "align") | WITHOUT_REASON)
    (line,) = now.said()
    assert "logs/align/2.log" in line


def test_the_reason_of_a_cluster_is_told_and_no_log_of_an_earlier_run(run):
    now = run()
    Path("logs/align").mkdir(parents=True)
    Path("logs/align/1.log").touch()
    os.utime("logs/align/1.log", (0, 0))
    now.tell("JOB_ERROR", logging.ERROR, **job_of(1, "align") | WITHOUT_REASON)
    refused = job_of(2, "align") | {"rule_msg": "sbatch: error: invalid partition"}
    now.tell("JOB_ERROR", logging.ERROR, **refused)
    silent, told = now.said()
    assert "logs/align/1.log" not in silent
    assert told == "Failed: align. sbatch: error: invalid partition"


def test_jobs_of_a_run_say_warnings_and_progress_and_one_of_them_that_it_compiles(run, capsys):
    run()
    compiling = logging.getLogger("stereotruth.compiling")
    for name in ("a", "b"):
        with job(f"logs/{name}.log", name) as log:
            log.info("machine room")
            log.info("3 of 10", extra={"news": True})
            compiling.info("compiling")
            log.warning("doubt")
    said = capsys.readouterr().err.splitlines()
    assert said == ["a: 3 of 10", "a: compiling", "a: doubt", "b: 3 of 10", "b: doubt"]
