"""Causes in the reasons that Snakemake gives."""

from __future__ import annotations

from stereotruth.project.status import CityStatus, PlannedJob

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
    status = CityStatus("A", "4 tiles (4 train)", (), JOBS)
    assert status.state == "out of date"
    assert status.why() == [
        "align 3, refine 1, project 1",
        "align A-1, align A-2 and 1 more: changed: size 128 -> 96",
        "refine A-1: changed: 0 -> 1, code, gcps",
    ]


def test_figures_and_pages_are_listed_and_leave_tiles_up_to_date():
    page = PlannedJob("report_city", "A", "", "Missing output files: results/report/A/index.html")
    truth = PlannedJob("evaluate_truth", "A", "A-1", DIGESTS)
    status = CityStatus("A", "4 tiles", (), (page, truth))
    assert status.state == "up to date"
    assert status.why()[0] == "evaluate_truth 1"  # the page was never made: nothing is due
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
