"""A check finds what a run would fail of, on a good project broken in one way each."""

from __future__ import annotations

import time

import pytest
from rich.console import Console

from stereotruth.command.check import check_project
from stereotruth.command.check_table import show
from stereotruth.command.findings import Level
from stereotruth.errors import InputError

from ...synthetic.broken_scenes import DOUBTS, FAULTS, Fault, write_settings


def texts(level: Level) -> list[str]:
    every = [finding for findings in check_project() for finding in findings]
    return [f"{f.text}. Remedy: {f.remedy}" for f in every if f.level is level]


def test_a_good_project_has_no_errors(folder):
    assert texts(Level.ERROR) == []
    assert texts(Level.DOUBT) == []
    facts = "\n".join(texts(Level.FACT))
    for words in (
        "15 and 15 of 15 used",
        "convergence 31",
        "0.0 M points",
        "EPSG:32650",
        "on the ",
    ):
        assert words in facts


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_what_a_run_would_fail_of_is_an_error(folder, fault: Fault):
    fault.plant(folder)
    begun = time.perf_counter()
    errors = texts(Level.ERROR)
    assert any(fault.words in text for text in errors), errors
    assert all(len(text.split("Remedy: ")[1]) > 5 for text in errors)
    assert time.perf_counter() - begun < 10


@pytest.mark.parametrize("fault", DOUBTS, ids=lambda fault: fault.name)
def test_what_a_run_gets_through_is_a_doubt(folder, fault: Fault):
    fault.plant(folder)
    assert texts(Level.ERROR) == []
    assert any(fault.words in text for text in texts(Level.DOUBT)), texts(Level.DOUBT)


def test_doubts_end_strict_runs(folder):
    DOUBTS[-1].plant(folder)
    write_settings(folder, strict=True)
    assert any("left out" in text for text in texts(Level.ERROR))


def test_one_fault_hides_no_other(folder):
    """A missing RPC and LiDAR without a system are told at once."""
    names = {"no CRS", "GCP column", "RPC cut short"}
    for fault in FAULTS:
        if fault.name in names:
            fault.plant(folder)
    errors = "\n".join(texts(Level.ERROR))
    for fault in FAULTS:
        assert fault.name not in names or fault.words in errors


def test_scenes_and_cities_are_chosen_by_name(folder):
    assert [f.scene for f in check_project(names=["Good"])] == ["project", "Good-1", "run"]
    errors = [f for findings in check_project(names=["Bad"]) for f in findings]
    assert "no scene or city 'Bad'" in errors[-1].text


def test_the_table_has_a_line_a_problem_with_its_remedy(folder, capsys):
    FAULTS[[fault.name for fault in FAULTS].index("no CRS")].plant(folder)
    assert show(check_project(), Console(width=200))
    out = capsys.readouterr().out
    assert "no coordinate reference system" in out
    assert "Remedy: set lidar_crs" in out
    assert "1 error, " in out and "a run would fail" in out


def test_input_errors_name_the_file():
    with pytest.raises(InputError, match=r"none\.yaml: no such file"):
        from stereotruth.project import configured

        configured(["none.yaml"])
