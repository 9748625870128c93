"""What is due after edits, failures and kills, with all rules and without their numerics.

The edits are the rows of the table in docs/explanation/reruns.md.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from ..synthetic.hollow_workflow import GO_ON, Hollow

pytestmark = pytest.mark.slow
STRIPS = {"rectify", "surface", "project"}
SHARED = {f"{rule}_strip": rule for rule in STRIPS}  # scripts of several rules
SHARED |= {"evaluate_truth_city": "evaluate_truth"}
OF_TILES = {"evaluate_images", "report_city", "originals", "dataset", "audit", "match", "score"}
OF_TILES |= {"submission", "benchmark_tables", "train"}
OF_TRUTH = {"evaluate_truth", "evaluate_truth_city"}  # only of the synthetic city
OF_IMAGES = {"predict_scene", "dsm", "score_dsm"}
SURFACE = {"surface", "surface_strip"}
PROJECT = {"project", "project_strip", "export", *OF_TILES}
RECTIFY = {"rectify", "rectify_strip", *OF_IMAGES, *PROJECT}
GRID_TRUTH = {"grid_truth", *OF_TRUTH}
REFINE = {"refine", "draw_refinement"}
ALIGN = {"align", "draw_residuals", *REFINE}
METHOD = {"match", "score", "submission", "benchmark_tables", *OF_IMAGES}
FILES: list[tuple[str, set[str]]] = [
    ("in/gcps.csv", {*ALIGN, *RECTIFY}),
    ("in/left.tif", {*SURFACE, *ALIGN, *RECTIFY}),
    ("in/left.tif.msk", {*SURFACE, *ALIGN, *RECTIFY}),  # a new one
    ("in/lidar/1.laz", {"ingest", "compare_strips", *SURFACE, *REFINE, *RECTIFY}),
    ("in/lidar/3.laz", {"ingest", "compare_strips", *SURFACE, *REFINE, *RECTIFY}),  # a new one
    ("geoid.tif", {"ingest", "compare_strips", *SURFACE, *REFINE, *RECTIFY}),
    ("helper.py", METHOD),  # which mine.py imports
]
KEYS: list[tuple[str, Any, set[str]]] = [
    (
        "ingest.drop_classes",
        [7],
        {"ingest", "compare_strips", *SURFACE, *REFINE, *RECTIFY, *GRID_TRUTH},
    ),
    ("alignment.model", "shift", {*ALIGN, *RECTIFY, *GRID_TRUTH}),
    ("project.edge_margin_px", 1, {*PROJECT, *OF_TRUTH}),
    (
        "tiles.size",
        512,
        {"export", *OF_TILES, *OF_TRUTH, "training_city", "training_cities"},
    ),
    ("report.sliders", 5, {"report_city"}),
    ("strips", 1, set()),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Hollow:
    hollow = Hollow(tmp_path_factory.mktemp("hollow") / "project")
    hollow.make()
    return hollow


@pytest.fixture
def rules_after(made) -> Iterator[Callable[[str, bytes], set[str]]]:
    """The rules that are planned after a file has other content, which it then loses again."""
    before: dict[Path, bytes | None] = {}

    def plan(name: str, content: bytes) -> set[str]:
        file = made.folder / name
        before.setdefault(file, file.read_bytes() if file.exists() else None)
        file.write_bytes(content)
        return made.plan()

    yield plan
    for file, content in before.items():
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)


@pytest.mark.parametrize(("file", "rules"), FILES)
def test_an_edited_file(rules_after, file, rules):
    assert rules_after(file, b"import helper\n# edited\nEDITED = 1\n") == rules


@pytest.mark.parametrize(("key", "value", "rules"), KEYS)
def test_an_edited_key(made, rules_after, key, value, rules):
    config = yaml.safe_load((made.folder / "my.yaml").read_text())
    *above, last = key.split(".")
    place = config
    for name in above:
        place = place.setdefault(name, {})
    place[last] = value
    assert rules_after("my.yaml", yaml.safe_dump(config).encode()) == rules


def test_what_says_nothing_makes_nothing(made):
    """Times of users' files and scripts, remarks, absolute paths, an edit that was taken back."""
    script = made.folder / "workflow/scripts/report_city.py"
    text = script.read_text()
    for more, rules in (("# a comment\n", set()), ("EDITED = 1\n", {"report_city"})):
        script.write_text(text + more)
        assert made.plan() == rules
    script.write_text(text)
    for file in (*(made.folder / "in").rglob("*"), *(made.folder / "workflow").rglob("*.*")):
        os.utime(file)
    sheet, gcps = made.folder / "my_scenes.tsv", made.folder / "in/gcps.csv"
    text = sheet.read_text()
    sheet.write_text(text.replace("in/gcps", f"{made.folder}/in/gcps"))
    assert made.plan() == set()
    sheet.write_text(text)
    state, text = gcps.stat(), gcps.read_text()
    gcps.write_text("gcps.tsv\n")  # of the same size, at the same time
    os.utime(gcps, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert "align" in made.plan()
    gcps.write_text(text)
    assert made.plan() == set()


def test_a_copy_with_its_times_and_snakemakes_own_folder_is_at_rest(made, tmp_path):
    """Elsewhere, also of a folder that is read-only, where Snakemake makes no plan."""
    copy = shutil.copytree(made.folder, tmp_path / "copy", symlinks=True)
    said = subprocess.run(
        ["snakemake", *made.call, "--dry-run"], cwd=copy, capture_output=True, text=True
    )
    assert said.returncode == 0 and "Nothing to be done" in said.stdout, said


EDITS = ("in/gcps.csv", "in/lidar/1.laz", "mine.py")  # they and the seed reach most rules
FAILS = ("kill", "refuse", "node")


def test_jobs_that_fail_are_made_again_with_all_that_follows(made):
    """In each way, some rules at a time; the same command again makes what is due."""
    made.set_seed(1)
    for file in EDITS:
        made.edit(file)
    reached = sorted(made.plan())
    assert len(reached) > 20
    failed: set[str] = set()
    for number, way in enumerate(FAILS):
        for file in EDITS:
            made.edit(file)
        made.set_seed(2 + number)
        # a job fails before those that follow from it: of each third of the rules others do
        now = made.fail(way, *reached[number % 3 :: 3])
        assert now <= made.make()
        assert made.stale() == []
        failed |= now
    assert len(failed) >= len(FAILS) and made.plan() == set()


@pytest.mark.parametrize(("rule", "way"), [("align", "revert"), ("rectify", "edit")])
def test_an_input_that_is_edited_during_a_run(made, rule, way):
    """While its job reads it, and taken back before anybody looks; or when that one has ended."""
    made.edit("in/gcps.csv")
    made.fail(way, rule, file="in/gcps.csv")
    assert {"align", "refine"} <= made.make()
    assert made.stale() == []
    assert made.plan() == set()


def test_a_late_job_of_a_killed_run_is_waited_for(made):
    """It was stopped, goes on when the next run is at work, and what that one makes stays."""
    made.edit("in/gcps.csv")
    made.fail("orphan", "align")
    made.edit("in/gcps.csv")
    threading.Timer(5.0, (made.folder / GO_ON).touch).start()
    begin = time.monotonic()
    assert "align" in made.make()
    assert time.monotonic() - begin > 4.0
    assert made.stale() == []
    assert made.plan() == set()
