"""What is due, by the records of jobs: each promise of docs/explanation/reruns.md by itself."""

from __future__ import annotations

import json
import os
import random
import shutil
from pathlib import Path

import pytest

from stereotruth.products import records
from stereotruth.products.inputs import checksum
from stereotruth.products.records import Record, read_record, why_due, write_record

SETTINGS = {"model": "affine", "code": "abc", "tiles": {"size": 128}}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch) -> Path:
    """in.csv -> a/ and a.json -> b.json, all made."""
    monkeypatch.chdir(tmp_path)
    Path("in.csv").write_text("1")
    Path("a").mkdir()
    Path("a/1").write_text("a1")
    for name in ("a.json", "b.json"):
        Path(name).write_text(name)
    record(["in.csv"], ["a.json", "a"])
    record(["a.json", "a"], ["b.json"])
    return tmp_path


def record(inputs: list[str], outputs: list[str], settings=SETTINGS) -> None:
    sums = {path: checksum(path) for path in inputs}
    write_record(Record.of("run", settings, sums, outputs))


def why(outputs=("a.json", "a"), inputs=("in.csv",), settings=SETTINGS) -> str:
    """As a new process plans: nothing remembered."""
    records._checksums.cache_clear()
    records._checksum.cache_clear()
    return why_due(outputs, inputs, settings)


def why_b(inputs=("a.json", "a")) -> str:
    return why(["b.json"], inputs)


def test_nothing_is_due_of_what_is_as_it_was_made(here):
    assert why() == why_b() == ""
    for file in ("in.csv", "a/1", "a.json", "b.json"):
        os.utime(file, (1e9, 1e9))
    assert why() == why_b() == ""
    assert why([here / "a.json", here / "a"], [here / "in.csv"]) == ""  # absolute paths


def test_an_edited_input_is_due_and_named_and_may_be_taken_back():
    then = Path("in.csv").stat()
    Path("in.csv").write_text("2")
    os.utime("in.csv", ns=(then.st_atime_ns, then.st_mtime_ns))
    assert why() == "in.csv changed"
    Path("in.csv").write_text("1")
    assert why() == ""


def test_changed_settings_are_named():
    assert why(settings=SETTINGS | {"tiles": {"size": 96}}) == "changed: tiles.size 128 -> 96"
    assert why(settings=SETTINGS | {"code": "abd"}) == "changed: code"
    swapped = {"model": "abc", "code": "affine", "tiles": {"size": 128}}
    assert why(settings=swapped) == "changed: code, model 'affine' -> 'abc'"


def test_another_set_of_inputs_is_due_but_for_marks_of_strips():
    Path("more.csv").write_text("1")
    assert why(inputs=["in.csv", "more.csv"]) == "other input: more.csv"
    assert why(inputs=["in.csv", "results/x/strips/0-of-2.json"]) == ""
    assert why(inputs=[]) == "other input: in.csv"


@pytest.mark.parametrize("file", ["a.json", "a/1", "a/2"])
def test_a_product_that_is_not_what_was_made_is_due_and_the_file_is_named(file):
    Path(file).write_text("damaged")
    assert why() == f"{file} is not what was made: made again"


def test_a_deleted_file_of_a_folder_is_due():
    Path("a/1").unlink()
    assert why() == "a/1 (missing) is not what was made: made again"


def test_of_many_damaged_files_the_first_are_named():
    for number in range(2, 8):
        Path(f"a/{number}").touch()
    named = "a/2, a/3, a/4 and 3 more files"
    assert why() == f"{named} is not what was made: made again"
    shutil.rmtree("a")
    Path("a").write_text("a file in the folder's place")
    assert why() == "a is not what was made: made again"


def test_hidden_files_are_no_part_of_a_product():
    Path("a/.DS_Store").write_text("of a file manager")
    assert why() == ""


def test_a_job_that_did_not_end_is_due_whether_its_products_are_there_or_not():
    records.mark_begun("a.json")
    assert why() == "the job that makes it did not end"
    Path("a.json").unlink()
    shutil.rmtree("a")
    assert why() == "the job that makes it did not end"
    record_again()
    assert why() == ""


def record_again() -> None:
    Path("a").mkdir()
    Path("a/1").write_text("a1")
    Path("a.json").write_text("a.json")
    record(["in.csv"], ["a.json", "a"])


def test_what_is_absent_is_held_to_its_record():
    """Products in the middle may be deleted for their size; what lies behind them counts."""
    Path("a.json").unlink()
    shutil.rmtree("a")
    assert why() == why_b() == ""
    Path("in.csv").write_text("2")
    assert why() == "in.csv changed"
    record_again()
    Path("a.json").write_text("other")
    record(["in.csv"], ["a.json", "a"])
    Path("a.json").unlink()
    assert why() == "" and why_b() == "a.json changed"


def test_products_without_results_are_still_known():
    shutil.rmtree("results")
    assert why() == why_b() == ""
    Path("in.csv").write_text("2")
    assert why() == "in.csv changed"


def test_a_product_without_a_record_goes_by_times():
    Path("c.json").write_text("by hand")
    os.utime("in.csv", (1e9, 1e9))
    assert why(["c.json"]) == ""
    os.utime("c.json", (1e8, 1e8))
    assert why(["c.json"]) == "no record, and older than in.csv"
    assert why(["never made"]) == ""


def test_a_damaged_record_says_make_it_again_and_is_named():
    """Any byte of it: seeded bits, and what is no JSON, or none of ours."""
    file = records.record_file("a.json")
    whole, rng = file.read_bytes(), random.Random(5)
    for number in range(120):
        damaged = bytearray(whole)
        if number % 3 == 0:
            del damaged[rng.randrange(len(damaged)) :]
        elif number % 3 == 1:
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        else:
            at = rng.randrange(len(damaged))
            damaged[at : at + rng.randrange(40)] = rng.randbytes(rng.randrange(40))
        file.write_bytes(damaged)
        said = why()
        same = _content(bytes(damaged)) == _content(whole)
        assert said == ("" if same else f"damaged record {file}"), bytes(damaged)
    for text in ("", "{", "[]", "3", "null", '{"digest": 1}', "[" * 100_000, "\xff"):
        file.write_text(text)
        assert why() == f"damaged record {file}"
        assert why_b() == ""
    assert [found.outputs for found in records.all_records()] == [{"b.json": checksum("b.json")}]


def _content(data: bytes):
    try:
        return json.loads(data)
    except ValueError:
        return None


def test_records_lie_in_the_results_by_the_name_of_the_product(here):
    record(["in.csv"], ["b.json"])
    assert read_record(here / "b.json").inputs == {"in.csv": checksum("in.csv")}
    assert records.record_file("tiles/A").is_relative_to("results")
    assert read_record("tiles/B") is None
    assert len(list(records.all_records())) == 2
