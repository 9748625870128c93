"""Products appear only while what they were made of still stands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import zarr

from stereotruth.errors import InputError
from stereotruth.products import records
from stereotruth.products.atomic_outputs import atomic_outputs, atomically
from stereotruth.products.files import atomic_file, atomic_folder
from stereotruth.products.records import why_due
from stereotruth.products.resumable_grids import BlockStore
from stereotruth.products.runs import KEPT, RUN, begin_run

SETTINGS = {"code": "1"}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(RUN, "")
    begin_run()
    Path("in.csv").write_text("1")
    return tmp_path


@pytest.fixture
def plan():
    """As a new process plans: nothing remembered."""

    def why(outputs=("a.json",), settings=SETTINGS) -> str:
        records._checksums.cache_clear()
        records._checksum.cache_clear()
        return why_due(outputs, ["in.csv"], settings)

    return why


def write(name: str = "a.json", text: str = "new") -> None:
    with atomic_file(name) as scratch:
        scratch.write_text(text)


def fail() -> None:
    """As a run does: the mark is laid before the job starts."""
    records.mark_begun("a.json")
    with pytest.raises(ZeroDivisionError), atomic_outputs(["in.csv"], ["a.json"], SETTINGS):
        raise ZeroDivisionError


def make(text: str = "new", settings=SETTINGS) -> None:
    with atomic_outputs(["in.csv"], ["a.json"], settings):
        write(text=text)


def test_a_product_of_what_is_there_is_published_and_recorded(plan):
    make()
    assert Path("a.json").read_text() == "new"
    assert plan() == ""


def test_nothing_is_published_of_an_input_that_changes(plan):
    make(text="old")
    with (
        pytest.raises(InputError, match=r"in\.csv: changed"),
        atomic_outputs(["in.csv"], ["a.json"], SETTINGS),
    ):
        Path("in.csv").write_text("22")
        write()
    assert Path("a.json").read_text() == "old"


def test_nothing_is_published_by_a_job_of_an_earlier_run():
    make(text="old")
    with (
        pytest.raises(InputError, match="another run has begun"),
        atomic_outputs(["in.csv"], ["a.json", "b"], SETTINGS),
    ):
        begin_run()
        with atomic_folder("b") as scratch:
            (scratch / "1").write_text("1")
    assert Path("a.json").read_text() == "old" and not Path("b").exists()


def test_a_job_of_an_earlier_run_leaves_the_records_alone(monkeypatch):
    late = os.environ[RUN]
    begin_run()
    make()
    record = records.record_file("a.json").read_text()
    monkeypatch.setenv(RUN, late)
    with pytest.raises(InputError), atomic_outputs(["in.csv"], ["a.json"], SETTINGS):
        pytest.fail("was let in")
    assert records.record_file("a.json").read_text() == record


def test_an_input_that_changes_after_all_is_written_fails_the_job(plan):
    records.mark_begun("a.json")
    with pytest.raises(InputError), atomic_outputs(["in.csv"], ["a.json"], SETTINGS):
        write()
        Path("in.csv").write_text("22")
    assert plan() == "the job that makes it did not end"


def test_a_job_that_failed_is_due_whatever_it_left(plan):
    make()
    fail()
    assert plan() == "the job that makes it did not end"
    Path("a.json").unlink()
    assert plan() == "the job that makes it did not end"
    make()
    assert plan() == ""


def test_nothing_is_made_of_what_a_job_has_not_made():
    make()
    Path("a.json").write_text("damaged since the run was planned")
    with (
        pytest.raises(InputError, match=r"a\.json: not what was made.*run again"),
        atomic_outputs(["a.json"], ["b.json"], SETTINGS),
    ):
        pytest.fail("was let in")


def test_an_input_that_cannot_be_read_is_named():
    Path("folder").mkdir()
    Path("folder/gone").symlink_to("nowhere/at/all")
    with (
        pytest.raises(InputError, match=r"gone: cannot be read"),
        atomic_outputs(["folder"], ["b.json"], SETTINGS),
    ):
        pytest.fail("was let in")


def test_a_product_that_is_written_past_this_is_a_defect():
    with (
        pytest.raises(RuntimeError, match=r"past products\.atomic_outputs: .*b\.json"),
        atomic_outputs(["in.csv"], ["a.json", "b.json"], SETTINGS),
    ):
        write()
        Path("b.json").write_text("1")


def test_a_product_that_another_writes_meanwhile_fails_the_job():
    """As a job of an earlier run on a file system whose locks do nothing."""
    with (
        pytest.raises(InputError, match=r"a\.json: changed"),
        atomic_outputs([], ["a.json"], SETTINGS),
    ):
        write()
        Path("other").write_text("stale")
        Path("other").replace("a.json")


def test_what_a_late_job_slips_in_is_made_again(plan):
    """Another run begins in the moment between looking and taking its place."""
    make()
    with (
        pytest.raises(InputError, match="another run has begun"),
        atomic_outputs(["in.csv"], ["a.json"], SETTINGS),
        atomically("a.json"),
    ):
        Path("a.json").write_text("stale")
        (KEPT / "run").write_text("another run")
    assert plan() == "a.json is not what was made: made again"


def test_a_block_of_an_input_that_was_replaced_has_no_record(here):
    """Else it would be taken over when the old input is back."""
    zarr.open_group(here / "work/store", mode="w", zarr_format=3)
    with pytest.raises(InputError), atomic_outputs(["in.csv"], ["a.json"], SETTINGS):
        store = BlockStore(here / "work", (), 1024)
        Path("in.csv").unlink()
        store.write((slice(0, 1), slice(0, 1)), "key", {}, None)
    assert not (here / "work/done").exists()


@pytest.mark.slow
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
