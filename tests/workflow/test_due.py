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
from ..synthetic.project import row_of

pytestmark = pytest.mark.slow
STRIPS = {"rectify": {"rectify_strip"}, "project": {"project_strip", "project_right"}}
OF_TILES = {"evaluate_images", "report_city", "originals", "dataset", "audit", "match", "score"}
OF_TILES |= {"submission", "benchmark_tables", "train"}
OF_TRUTH = {"evaluate_truth", "evaluate_truth_city"}  # only of the synthetic city
OF_IMAGES = {"predict_scene", "dsm", "score_dsm"}
PROJECT = {"project", *STRIPS["project"], "export", *OF_TILES}
RECTIFY = {"rectify", "rectify_strip", *OF_IMAGES, *PROJECT}
GRID_TRUTH = {"grid_truth", *OF_TRUTH}
REFINE = {"refine", "draw_refinement"}
ALIGN = {"align", "draw_residuals", *REFINE}
METHOD = {"match", "score", "submission", "benchmark_tables", *OF_IMAGES}
FILES: list[tuple[str, set[str]]] = [
    ("in/gcps.csv", {*ALIGN, *RECTIFY}),
    ("in/left.tif", {"surface", *ALIGN, *RECTIFY}),
    ("in/left.tif.msk", {"surface", *ALIGN, *RECTIFY}),  # a new one
    ("in/lidar/1.laz", {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY}),
    ("in/lidar/3.laz", {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY}),  # a new one
    ("geoid.tif", {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY}),
    ("mine.py", METHOD),
    ("helper.py", METHOD),  # which mine.py imports
]
KEYS: list[tuple[str, Any, set[str]]] = [
    (
        "ingest.drop_classes",
        [7],
        {"ingest", "compare_strips", "surface", *REFINE, *RECTIFY, *GRID_TRUTH},
    ),
    ("alignment.model", "shift", {*ALIGN, *RECTIFY, *GRID_TRUTH}),
    ("alignment.refine", False, {*RECTIFY, *GRID_TRUTH}),
    ("rectify.panchromatic", 1, {*REFINE, *RECTIFY, *GRID_TRUTH}),
    ("project.edge_margin_px", 1, {*PROJECT, *OF_TRUTH}),
    (
        "tiles.size",
        512,
        {"export", *OF_TILES, *OF_TRUTH, "training_city", "training_cities"},
    ),
    ("quality.max_gcp_rms_px", 2, {"export", *OF_TILES, *OF_TRUTH}),
    ("evaluation.building_share", 0.03, {"export", *OF_TILES, *OF_TRUTH}),
    ("strict", True, {*ALIGN, *RECTIFY, *GRID_TRUTH}),
    ("dataset.catalogs", ["croissant"], OF_TILES - {"evaluate_images", "report_city", "originals"}),
    ("report.sliders", 5, {"report_city"}),
    ("benchmark.bootstrap", 20, {"score", "submission", "benchmark_tables"}),
    ("predict.block_px", 256, OF_IMAGES),
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


def test_an_edited_script(made, rules_after):
    script = "workflow/scripts/report_city.py"
    text = (made.folder / script).read_bytes()
    assert rules_after(script, text + b"# a comment\n") == set()
    assert rules_after(script, text + b"EDITED = 1\n") == {"report_city"}


def test_what_says_nothing_makes_nothing(made):
    """Times of users' files and scripts, absolute paths, an edit that was taken back."""
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


def test_products_in_the_middle_may_be_absent(made, tmp_path):
    """Whoever deletes results for their size keeps tiles that follow the configuration."""
    kept = shutil.move(made.folder / "results/rectify", tmp_path / "rectify")
    try:
        assert made.plan() == set()
        made.edit("geoid.tif")
        assert {"ingest", "rectify", "project", "export"} <= made.plan()
    finally:
        shutil.move(kept, made.folder / "results/rectify")
        (made.folder / "geoid.tif").write_text("geoid\n")


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="no such file here")
def test_an_input_that_cannot_be_read_ends_the_plan_with_one_sentence(made):
    file = made.folder / "in/gcps.csv"
    kept = file.rename(made.folder / "kept")
    try:
        file.symlink_to("/proc/self/mem")  # can be opened, and not be read
        assert made.run("--dry-run")[0] != 0
        said = made.said().rstrip().splitlines()
        assert said[-2] == "Refused:" and said[-1].startswith("in/gcps.csv: cannot be read: ")
    finally:
        kept.rename(file)


def test_snakemake_says_so_too(made):
    """By --summary and --list-changes; --touch takes what is there for made."""
    before = (made.folder / "geoid.tif").read_text()
    made.edit("geoid.tif")
    made.run("--list-changes", "params")
    changed = set(made.said().split())
    assert "tiles/Own" in changed and "tiles/Wuhan" not in changed
    made.run("--summary")
    (row,) = (line for line in made.said().splitlines() if line.startswith("tiles/Own\t"))
    assert row.endswith("params changed\tupdate pending")
    (made.folder / "geoid.tif").write_text(before)
    assert made.plan() == set()


def test_a_copy_with_its_times_and_snakemakes_own_folder_is_at_rest(made, tmp_path):
    """Elsewhere, also of a folder that is read-only, where Snakemake makes no plan."""
    copy = shutil.copytree(made.folder, tmp_path / "copy", symlinks=True)
    said = subprocess.run(
        ["snakemake", *made.call, "--dry-run"], cwd=copy, capture_output=True, text=True
    )
    assert said.returncode == 0 and "Nothing to be done" in said.stdout, said


EDITS = ("in/gcps.csv", "in/lidar/1.laz", "mine.py")  # they and the seed reach most rules
FAILS = ("kill", "refuse", "disk", "defect", "node")


@pytest.mark.timeout(1800)  # some 15 rounds, as many as the longest chain has links
def test_jobs_that_fail_are_made_again_with_all_that_follows(made):
    """In each rule once, some at a time; the same command again makes what is due."""
    todo = made.run("--forceall", "--dry-run")[1]
    assert len(todo) > 30
    made.set_seed(1)
    for file in EDITS:
        made.edit(file)
    reached = made.make()
    for number in range(2, 100):
        for file in EDITS:
            made.edit(file)
        made.set_seed(number)
        for rule in todo if not todo & reached else ():  # no setting reaches them: scripts do
            made.edit(f"workflow/scripts/{rule}.py")
        failed = made.fail(FAILS[number % len(FAILS)], *sorted(todo & reached or todo)[::2])
        assert failed <= made.make()
        assert made.stale() == []
        todo -= failed
        if not todo:
            break
    assert todo == set() and made.plan() == set()


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


SCENES = ("Own-1", "Own-2", "Own-3")  # two that share an image, and one of images of its own


def test_control_points_make_their_group_again_and_no_other_pair(tmp_path):
    """Labels of a site's pairs: none of them reads LiDAR again."""
    labels = [f"results/project/Own/{scene}.zarr" for scene in SCENES]
    site = Hollow(tmp_path / "project", (*labels, "--configfile", "site.yaml"))
    for name in ("third.tif", "other_left.tif", "other_right.tif", "other.csv"):
        (site.folder / "in" / name).write_text(f"{name}\n")
    first = row_of(Path("in"), scene="Own-1", city="Own")
    second = first | {"scene": "Own-2", "right_image": "in/third.tif"}
    images = {f"{view}_image": f"in/other_{view}.tif" for view in ("left", "right")}
    third = first | images | {"scene": "Own-3", "gcps": "in/other.csv"}
    site.project.add_scene("site", [first, second, third])
    site.make()

    def scenes_of(file: str) -> dict[str, list[str]]:
        site.edit(file)
        site.make()
        said = site.said()
        return {
            stage: [scene for scene in SCENES if f"{words} scene {scene}" in said]
            for stage, words in SAID.items()
        }

    group, alone = ["Own-1", "Own-2"], ["Own-3"]
    assert scenes_of("in/gcps.csv") == {stage: group for stage in SAID} | {"ingest": []}
    assert scenes_of("in/other.csv") == {stage: alone for stage in SAID} | {"ingest": []}


SAID = {
    "ingest": "Reading LiDAR file 1 of",
    "align": "Aligning",
    "refine": "Refining the alignment of",
    "rectify": "Making epipolar images of",
    "project": "Projecting the point cloud of",
}
