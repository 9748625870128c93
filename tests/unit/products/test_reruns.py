"""Times and Snakemake's records, as a plan needs them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from stereotruth.products import records, reruns
from stereotruth.products.inputs import NOT_CONTENT, checksum


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    """in.csv → folder/ → last.json, from newest to oldest; logs/a.tsv older than all."""
    monkeypatch.chdir(tmp_path)
    for function in (records._checksum, records._checksums):
        function.cache_clear()
    for file in ("in.csv", "folder/1", f"folder/{NOT_CONTENT}", "last.json", "logs/a.tsv"):
        Path(file).parent.mkdir(exist_ok=True)
        Path(file).write_text(file)
    for made, of in (("folder", "in.csv"), ("last.json", "folder")):
        records.write_record(made, {"outputs": [made], "inputs": {of: checksum(of)}, "made": ""})
    for file, then in (
        ("in.csv", 400),
        ("folder", 900),
        (f"folder/{NOT_CONTENT}", 300),
        ("last.json", 200),
        ("logs/a.tsv", 100),
    ):
        os.utime(file, (then, then))
    return tmp_path


def time_of(file: str) -> float:
    return Path(file).stat().st_mtime


def test_products_of_what_is_there_get_the_time_of_their_inputs():
    reruns.settle_times()
    assert time_of(f"folder/{NOT_CONTENT}") == time_of("last.json") == 400
    assert time_of("in.csv") == 400 and time_of("folder") == 900
    assert time_of("logs/a.tsv") == 400


def test_newer_products_keep_their_times():
    for file in (f"folder/{NOT_CONTENT}", "last.json"):
        os.utime(file, (500, 500))
    reruns.settle_times()
    assert time_of(f"folder/{NOT_CONTENT}") == time_of("last.json") == 500


def test_a_product_of_something_else_stays_old():
    Path("in.csv").write_text("edited")
    os.utime("in.csv", (400, 400))
    reruns.settle_times()
    assert time_of(f"folder/{NOT_CONTENT}") == 300
    assert time_of("last.json") == 300  # of the folder as it is


def test_a_link_is_as_new_as_itself():
    Path("in.csv").rename("real.csv")
    Path("in.csv").symlink_to("real.csv")
    os.utime("in.csv", (700, 700), follow_symlinks=False)
    reruns.settle_times()
    assert time_of("last.json") == 700


def write_metadata(text: str) -> None:
    file = reruns.METADATA / "@deep" / "record"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def read_metadata() -> str:
    return (reruns.METADATA / "@deep" / "record").read_text()


def test_snakemake_s_records_travel_with_the_results(here, tmp_path_factory, monkeypatch):
    write_metadata("of the first run")
    reruns.keep_metadata(begin=False)
    assert not reruns.METADATA.is_symlink()  # a plan lays nothing
    reruns.keep_metadata(begin=True)
    assert read_metadata() == "of the first run"
    write_metadata("of this run")
    clone = tmp_path_factory.mktemp("clone")
    shutil.copytree(here / "results", clone / "results")
    monkeypatch.chdir(clone)
    reruns.keep_metadata(begin=False)
    assert read_metadata() == "of this run"


def test_records_that_came_with_the_results_win_over_those_that_were_there():
    write_metadata("of another")
    file = reruns.PLACE / "@deep" / "record"
    file.parent.mkdir(parents=True)
    file.write_text("of these results")
    reruns.keep_metadata(begin=False)
    assert read_metadata() == "of these results"


def test_deleted_results_leave_the_records_of_other_products():
    write_metadata("of a run")
    reruns.keep_metadata(begin=True)
    reruns.save_metadata()
    shutil.rmtree("results")
    reruns.keep_metadata(begin=False)
    assert read_metadata() == "of a run" and not Path("results").exists()
    reruns.keep_metadata(begin=True)
    assert read_metadata() == "of a run" and Path("results").is_dir()
