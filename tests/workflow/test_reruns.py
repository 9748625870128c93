"""What is there counts by its content: times of files, copies and clones make nothing again."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ..synthetic.forked_snakemake import planner, start_snakemake
from ..synthetic.project import Project, copy_project

ARGUMENTS = ("tiles/Tiny", "--configfile", "tiny.yaml")
OF_THE_USER = ("in", "tiny.yaml", "tiny_scenes.tsv", "tiny_cities.tsv")


def plan(project: Project) -> dict[str, int]:
    return project.plan(*ARGUMENTS)


def mix_times(folder: Path) -> None:
    """Times of files and folders as they come, as a copy leaves them."""
    rng = random.Random(3)
    for path in sorted(folder.rglob("*")):
        if ".snakemake" not in path.relative_to(folder).parts[:1] and not path.is_symlink():
            os.utime(path, (1.7e9 + rng.uniform(0, 1e6),) * 2)


@pytest.fixture(scope="module")
def cloned(made, tmp_path_factory) -> Project:
    """A fresh clone, into which the results were copied, but nothing of Snakemake's."""
    clone = copy_project(tmp_path_factory.mktemp("clone") / "project")
    for name in (*OF_THE_USER, "results", "tiles"):
        source, target = made.folder / name, clone.folder / name
        if source.is_dir():
            shutil.copytree(source, target, copy_function=shutil.copyfile)
        else:
            shutil.copyfile(source, target)
    mix_times(clone.folder)
    return clone


@pytest.mark.slow
def test_a_touched_script_runs_nothing_and_an_edited_one_its_rule(made, tmp_path):
    other = made.copy(tmp_path / "other")
    for script in (other.folder / "workflow/scripts").iterdir():
        os.utime(script)
    assert plan(other) == {}
    other.edit("workflow/scripts/export.py", '"""', '"""Edited: ')
    assert plan(other) == {}
    other.edit("workflow/scripts/export.py", "\nif __name__", "\nADDED = 1\nif __name__")
    assert plan(other) == {"export": 1}


def test_results_copied_into_a_clone_are_taken_as_they_are(cloned):
    assert plan(cloned) == {}


@pytest.mark.slow
def test_files_restored_without_their_times_run_nothing(made, tmp_path):
    other = made.copy(tmp_path / "other")
    mix_times(other.folder)
    assert plan(other) == {}
    other.rest(*ARGUMENTS)


def test_all_times_equal_run_nothing(made, tmp_path):
    other = made.copy(tmp_path / "other")
    for path in other.folder.rglob("*"):
        os.utime(path, (1.7e9, 1.7e9))
    assert plan(other) == {}


@pytest.mark.parametrize(
    ("file", "old", "new", "jobs"),
    [
        ("in/gcps.csv", "1", "2", {"align", "refine", "rectify", "project", "export"}),
        ("tiny.yaml", "size: 128", "size: 96", {"export"}),
    ],
)
def test_what_changed_in_a_clone_runs_what_it_touches(cloned, tmp_path, file, old, new, jobs):
    """Also where the edited file seems to be older than what was made of it."""
    other = cloned.copy(tmp_path / "other")
    other.edit(file, old, new)
    os.utime(other.folder / file, (1e9, 1e9))
    assert set(plan(other)) == jobs


@pytest.mark.slow
def test_deleted_results_are_made_again(cloned, tmp_path):
    other = cloned.copy(tmp_path / "other")
    assert plan(other) == {}
    for name in ("results", "tiles"):
        shutil.rmtree(other.folder / name)
    jobs = plan(other)
    assert jobs["align"] == jobs["export"] == 1 and jobs["ingest"] == 2
    assert not (other.folder / "results").exists()  # a plan makes nothing


@pytest.mark.slow
def test_tiles_without_results_are_still_known(made, tmp_path):
    """Whoever deletes the results for their size keeps tiles that follow the configuration."""
    other = made.copy(tmp_path / "other")
    shutil.rmtree(other.folder / "results")
    assert plan(other) == {}
    other.edit("tiny.yaml", "size: 128", "size: 96")
    assert {"ingest", "align", "project", "export"} <= set(plan(other))
    other.edit("tiny.yaml", "size: 96", "size: 128")
    assert plan(other) == {}
    other.edit("in/gcps.csv", "1", "2")
    assert {"align", "refine", "rectify", "project", "export"} <= set(plan(other))


FROM = {
    "align": ["align", "refine", "rectify", "project", "export"],
    "refine": ["refine", "rectify", "project", "export"],
    "rectify": ["rectify", "project", "export"],
    "surface": ["surface", "project", "export"],
    "project": ["project", "export"],
    "compare_strips": ["compare_strips", "project", "export"],
    "ingest": ["ingest", "compare_strips", "surface", "refine", "rectify", "project", "export"],
    "export": ["export"],
}
DAMAGE = [
    ("results/align/Tiny/Tiny-1/alignment.json", "align"),
    ("results/refine/Tiny/Tiny-1/observations.csv", "refine"),
    ("results/rectify/Tiny/Tiny-1/left.zarr/*/c/*/*", "rectify"),
    ("results/rectify/Tiny/Tiny-1/right.zarr/zarr.json", "rectify"),
    ("results/rectify/Tiny/Tiny-1/epipolar.json", "rectify"),
    ("results/project/Tiny/Tiny-1.zarr/disparity/c/*/*", "project"),
    ("results/surface/Tiny/Tiny-1.surface/blocks/*", "surface"),
    ("results/surface/Tiny/Tiny-1.surface/surface.json", "surface"),
    ("results/strips/Tiny/Tiny-1.strips/strips.json", "compare_strips"),
    ("results/ingest/Tiny/Tiny-1/Tiny-1_0_0.points/store.json", "ingest"),
    ("results/ingest/Tiny/Tiny-1/Tiny-1_0_0.points/points.npy", "ingest"),
    ("tiles/Tiny/disp/*", "export"),
    ("tiles/Tiny/manifest.csv", "export"),
    ("tiles/Tiny/export.json", "export"),
    ("results/export/Tiny/summary.json", "export"),
]
ALONE = [
    file for file, _ in DAMAGE if not re.search(r"\*|\.(zarr|points|strips|surface)/|^tiles/", file)
]


@pytest.mark.slow
@pytest.mark.parametrize(("file", "rule"), DAMAGE)
def test_a_product_that_is_damaged_is_made_again_and_the_file_is_named(cloned, file, rule):
    """By a bit, or by a file that is gone from a folder; nobody takes it for an edit."""
    place = sorted(cloned.folder.glob(file))[0]
    whole = place.read_bytes()
    try:
        place.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        run = cloned.snakemake("--dry-run", *ARGUMENTS)
        assert sorted(run.jobs) == sorted(FROM[rule])
        assert f"{place.relative_to(cloned.folder)} is not what was made: made again" in run.text
        if file not in ALONE:
            place.unlink()
            assert sorted(plan(cloned)) == sorted(FROM[rule])
    finally:
        place.write_bytes(whole)


def test_products_of_one_file_that_are_gone_are_not_damaged(cloned):
    """They are made again where something asks for them."""
    kept = {cloned.folder / file: (cloned.folder / file).read_bytes() for file in ALONE}
    try:
        for file in kept:
            file.unlink()
        assert plan(cloned) == {}
    finally:
        for file, content in kept.items():
            file.write_bytes(content)


@pytest.mark.parametrize("rule", ["align", "project", "export"])
def test_a_damaged_record_means_make_it_again(cloned, rule):
    product = {"align": "results/align/Tiny/Tiny-1/alignment.json", "export": "tiles/Tiny"}
    name = product.get(rule, "results/project/Tiny/Tiny-1.zarr")
    record = cloned.folder / f"results/.records/made/{name}.json"
    whole = record.read_bytes()
    try:
        record.write_bytes(whole.replace(b"1", b"2", 1))
        run = cloned.snakemake("--dry-run", *ARGUMENTS)
        assert sorted(run.jobs) == sorted(FROM[rule])
        assert f"damaged record results/.records/made/{name}.json" in run.text
    finally:
        record.write_bytes(whole)


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="no such file here")
@pytest.mark.parametrize("file", ["left.tif", "gcps.csv", "lidar/Tiny-1_0_0.laz"])
def test_an_input_that_cannot_be_read_ends_the_plan_with_one_sentence(cloned, file):
    place = cloned.folder / "in" / file
    kept = place.rename(cloned.folder / "kept")
    try:
        place.symlink_to("/proc/self/mem")  # can be opened, and not be read
        said = cloned.refuse("--dry-run", *ARGUMENTS).text.rstrip().splitlines()
        assert said[-2:] == [
            "Refused:",
            f"in/{file}: cannot be read: Input/output error. Remedy: see that it is there, and "
            "that you may read it",
        ]
    finally:
        kept.rename(place)


@pytest.mark.slow
def test_a_file_beside_an_image_that_comes_later_is_an_input(cloned):
    for name in ("left.tif.msk", "left_Rpc.Txt", "right.TIF.aux.xml", "left.tfw"):
        (cloned.folder / "in" / name).write_bytes(b"1")
        run = cloned.snakemake("--dry-run", *ARGUMENTS)
        # an RPC that cannot be read tells no ground: all points are wanted, too
        points = {"ingest", "compare_strips"} if name == "left_Rpc.Txt" else set()
        rules = [rule for rule in run.jobs if rule not in points]
        assert sorted(rules) == sorted(["surface", *FROM["align"]])
        assert f"other input: in/{name}" in run.text
        (cloned.folder / "in" / name).unlink()
    assert plan(cloned) == {}


@pytest.mark.slow
def test_what_costs_nothing_makes_nothing_again(cloned, tmp_path):
    """Absolute paths for relative ones, an order that says nothing, files of other programs."""
    other = cloned.copy(tmp_path / "other")
    sheet = other.folder / "tiny_scenes.tsv"
    sheet.write_text(sheet.read_text().replace("in/gcps", f"{other.folder}/in/gcps"))
    (other.folder / "tiles/Tiny/left/1.tiff.aux.xml").write_text("of QGIS")
    config = other.folder / "tiny.yaml"
    config.write_text(config.read_text() + "ingest: {drop_classes: [18, 7]}\nstrips: 2\n")
    shutil.rmtree(other.folder / "logs", ignore_errors=True)
    assert plan(other) == {}


@pytest.mark.slow
def test_a_plan_writes_nothing(cloned):
    """But what Snakemake keeps of it, and checksums, in .snakemake."""

    def state():
        return {
            path: (path.lstat().st_mtime_ns, path.lstat().st_size)
            for path in cloned.folder.rglob("*")
            if ".snakemake" not in path.parts and path.name != "said.log"
        }

    before = state()
    assert plan(cloned) == {}
    cloned.snakemake("--summary", *ARGUMENTS)
    assert state() == before


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="mounts the folder again")
def test_a_finished_project_that_is_read_only_is_planned(made, tmp_path):
    other = made.copy(tmp_path / "other")
    assert plan(other) == {}
    folder = str(other.folder)
    mounts = (["mount", "--bind", folder, folder], ["mount", "-o", "remount,ro,bind", folder])
    if any(subprocess.run(mount, capture_output=True).returncode for mount in mounts):
        pytest.skip("no right to mount")
    try:
        with pytest.raises(OSError):
            (other.folder / "x").touch()
        log = tmp_path / "plan.log"  # the project takes none
        arguments = ["--dry-run", "--cores", "1", *ARGUMENTS]
        status = start_snakemake(planner(), other.folder, arguments, str(log)).wait()
        assert status == 0 and "Nothing to be done" in log.read_text(), log.read_text()[-3000:]
    finally:
        subprocess.run(["umount", "-l", folder], check=True)
