"""Products appear only while what they were made of still stands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import zarr

from stereotruth.errors import InputError
from stereotruth.products import publication as module
from stereotruth.products import records
from stereotruth.products.files import replacing, whole_folder
from stereotruth.products.publication import made_of, publication
from stereotruth.products.resumable_grids import BlockStore
from stereotruth.products.runs import RUN, begin_run


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(RUN, "")
    begin_run()
    Path("in.csv").write_text("1")
    return tmp_path


@pytest.fixture(autouse=True)
def plan():
    """As a new process plans: nothing remembered."""

    def forget():
        for function in (made_of, records._checksum, records._checksums):
            function.cache_clear()
        return made_of("a.json")

    forget()
    return forget


def write(name: str = "a.json", text: str = "new") -> None:
    with replacing(name) as scratch:
        scratch.write_text(text)


def make(made: str = "", text: str = "new") -> None:
    with publication(["in.csv"], ["a.json"], made):
        write(text=text)


def test_a_product_of_what_is_there_is_published_and_recorded(plan):
    make()
    assert Path("a.json").read_text() == "new"
    assert plan() == ""


def test_nothing_is_published_of_an_input_that_changes(plan):
    make(text="old")
    with (
        pytest.raises(InputError, match=r"in\.csv: changed"),
        publication(["in.csv"], ["a.json"], ""),
    ):
        Path("in.csv").write_text("22")
        write()
    assert Path("a.json").read_text() == "old"


def test_nothing_is_published_by_a_job_of_an_earlier_run():
    make(text="old")
    with (
        pytest.raises(InputError, match="another run has begun"),
        publication(["in.csv"], ["a.json", "b"], ""),
    ):
        begin_run()
        with whole_folder("b") as scratch:
            (scratch / "1").write_text("1")
    assert Path("a.json").read_text() == "old" and not Path("b").exists()


def test_a_job_of_an_earlier_run_leaves_the_records_alone(monkeypatch):
    late = os.environ[RUN]
    begin_run()
    make()
    record = records.record_file("a.json").read_text()
    monkeypatch.setenv(RUN, late)
    with pytest.raises(InputError), publication(["in.csv"], ["a.json"], ""):
        pytest.fail("was let in")
    assert records.record_file("a.json").read_text() == record


def test_an_input_that_changes_after_all_is_written_fails_the_job(plan):
    with pytest.raises(InputError), publication(["in.csv"], ["a.json"], ""):
        write()
        Path("in.csv").write_text("22")
    assert "inputs" not in json.loads(records.record_file("a.json").read_text())


def test_a_change_that_snakemake_cannot_see_makes_the_product_again_once(plan):
    make()
    times = Path("in.csv").stat()
    Path("in.csv").write_text("2")
    os.utime("in.csv", ns=(times.st_atime_ns, times.st_mtime_ns))
    other = plan()
    assert other != ""
    make(made=other)
    assert plan() == other  # what Snakemake has recorded, too
    Path("in.csv").write_text("1")
    assert plan() not in ("", other)


def test_a_product_of_a_job_that_did_not_end_is_made_again(plan):
    with pytest.raises(ZeroDivisionError), publication(["in.csv"], ["a.json"], "x"):
        write()
        raise ZeroDivisionError
    assert plan() == "x"  # by a retry of the same run
    begin_run()
    other = plan()
    assert other != "x"
    make(made=other)
    assert plan() == other


def test_a_job_that_failed_without_a_product_has_no_say(plan):
    with pytest.raises(ZeroDivisionError), publication(["in.csv"], ["a.json"], "y"):
        raise ZeroDivisionError
    begin_run()
    assert plan() == "y"


@pytest.mark.parametrize("gone", ["in.csv", "a.json"])
def test_what_is_not_there_has_no_say(plan, gone):
    make()
    Path("in.csv").write_text("22")
    Path(gone).unlink()
    assert plan() == ""


def test_a_record_that_cannot_be_read_has_no_say(plan):
    make()
    records.record_file("a.json").write_text("{")
    assert plan() == ""


def test_a_product_that_is_written_past_this_is_a_defect():
    with (
        pytest.raises(RuntimeError, match=r"past products\.publication: .*b\.json"),
        publication(["in.csv"], ["a.json", "b.json"], ""),
    ):
        write()
        Path("b.json").write_text("1")


def test_a_product_that_another_writes_meanwhile_fails_the_job():
    """As a job of an earlier run on a file system whose locks do nothing."""
    with pytest.raises(InputError, match=r"a\.json: changed"), publication([], ["a.json"], ""):
        write()
        Path("other").write_text("stale")
        Path("other").replace("a.json")


def test_what_slips_in_where_locks_do_nothing_is_made_again(plan):
    make()
    kept = module.KEPT / "run"
    with (
        pytest.raises(InputError),
        publication(["in.csv"], ["a.json"], ""),
        module.publishing("a.json"),
    ):
        kept.write_text("another run")
    assert plan() != ""


def test_a_block_of_an_input_that_was_replaced_has_no_record(here):
    """Else it would be taken over when the old input is back."""
    zarr.open_group(here / "work/store", mode="w", zarr_format=3)
    with pytest.raises(InputError), publication(["in.csv"], ["a.json"], ""):
        store = BlockStore(here / "work", (), 1024)
        Path("in.csv").unlink()
        store.write((slice(0, 1), slice(0, 1)), "key", {}, None)
    assert not (here / "work/done").exists()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_a_job_that_is_disturbed_at_random_moments_leaves_nothing_stale(here):
    root = Path(__file__).parents[3]
    rounds = subprocess.run(
        [
            sys.executable,
            "-m",
            "tests.synthetic.disturbed_job",
            "--rounds",
            "60",
            str(here / "work"),
        ],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "60 rounds, 0 stale" in rounds.stdout, rounds.stderr
