"""Causes in the reasons that Snakemake gives."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.project import status
from stereotruth.project.status import CityStatus, PlannedJob, status_of

SAYS = "Params have changed since last execution:"
UNION = f"{SAYS} Union of exclusive params before and now across all output:"
PARAMS = f"{UNION} before: {{'size': 128, 'of': [1]}} now: {{'size': 96, 'of': [1]}} "
BEFORE = f"{{'gcps': '{12 * '1'}'}},'{16 * 'a'}',0"
DIGESTS = f"{UNION} before: {BEFORE} now: {{'gcps': '{12 * '2'}'}},'{16 * 'b'}',1"
FOLLOWS = "Input files updated by another job: results/align/A/A-1/alignment.json"
JOBS = (
    PlannedJob("align", "A", "A-1", PARAMS),
    PlannedJob("align", "A", "A-2", PARAMS),
    PlannedJob("align", "A", "A-3", PARAMS),
    PlannedJob("refine", "A", "A-1", f"{FOLLOWS}; {DIGESTS}"),
    PlannedJob("project", "A", "A-1", FOLLOWS),
)


def test_causes_are_said_once_and_what_follows_from_them_not_at_all():
    city = CityStatus("A", "4 tiles (4 train)", (), JOBS)
    assert city.state == "out of date"
    assert city.why() == [
        "align 3, refine 1, project 1",
        "align A-1, align A-2 and 1 more: changed: size 128 -> 96",
        "refine A-1: changed: 0 -> 1, code, gcps",
    ]


def test_figures_and_pages_are_listed_and_leave_tiles_up_to_date():
    page = PlannedJob("report_city", "A", "", "Missing output files: results/report/A/index.html")
    truth = PlannedJob("evaluate_truth", "A", "A-1", DIGESTS)
    city = CityStatus("A", "4 tiles", (), (page, truth))
    assert city.state == "up to date"
    assert city.why()[0] == "evaluate_truth 1"  # the page was never made: nothing is due
    assert CityStatus("A", "4 tiles", (), (page, *JOBS)).why()[0] == (
        "align 3, refine 1, project 1, report_city 1"
    )


def test_what_was_never_made_needs_no_cause():
    job = PlannedJob("align", "A", "A-1", "Missing output files: results/align/A/A-1/a.json")
    assert CityStatus("A", "", (), (job,)).state == "not made"
    assert CityStatus("A", "", (), (job,)).why() == ["align 1"]
    assert CityStatus("A", "4 tiles", (), (job,)).why()[1].startswith("align A-1: Missing")
    assert CityStatus("A", "4 tiles", (), ()).state == "up to date"
    assert CityStatus("A", "4 tiles", (), ()).why() == []


def test_what_was_ever_made_is_planned_and_what_is_no_more_is_not(folder, monkeypatch):
    """What is made of one city has its row; what of all, a row of its own."""
    made = ["originals/Good", "dataset", "benchmark/synthetic/sgm", "score_dsm/Good/Good-1/sgm"]
    for path in [*made, "originals/Gone", "score_dsm/Good/Good-1/gone"]:
        Path(path).mkdir(parents=True)
    jobs = [
        PlannedJob("originals", "Good", "", PARAMS),
        PlannedJob("score", "", "synthetic/sgm", PARAMS),
        PlannedJob("evaluate", "", "", "Rules with neither input nor output files"),
    ]
    asked = []
    monkeypatch.setattr(status, "plan", lambda targets, files: asked.extend(targets) or jobs)
    good, together = status_of([], [Path("config.yaml")])
    page = "results/report/Good/index.html"
    assert sorted(asked) == sorted(["tiles/Good", page, "evaluate", *made])
    assert good.why()[0] == "originals 1" and together.why()[0] == "score 1"
    asked.clear()
    assert len(status_of(["Good"], [Path("config.yaml")])) == 1 and "dataset" not in asked


def test_tiles_have_a_status_where_what_else_was_made_has_no_plan(folder, monkeypatch):
    """As a benchmark whose dataset lies on a disk that is not there."""
    Path("benchmark/synthetic/sgm").mkdir(parents=True)

    def plan(targets, files):
        if len(targets) > 3:
            raise InputError("no such folder", remedy="name it")
        return [PlannedJob("align", "Good", "", PARAMS)]

    monkeypatch.setattr(status, "plan", plan)
    good, together = status_of([], [Path("config.yaml")])
    assert good.why()[0] == "align 1" and (good.state, together.state) == ("not made", "no plan")
    assert together.made == "benchmark/synthetic/sgm" and together.why() == ["no such folder"]
    Path("benchmark/synthetic/sgm").rmdir()
    monkeypatch.setattr(status, "plan", lambda targets, files: plan("abcd", files))
    with pytest.raises(InputError):
        status_of([], [Path("config.yaml")])
