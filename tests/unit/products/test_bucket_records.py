"""Records in a bucket (fsspec's in memory), which any checkout sees, and objects that differ."""

from __future__ import annotations

from pathlib import Path

import fsspec
import pytest

from stereotruth.products.bucket_records import BucketRecords
from stereotruth.products.records import (
    BEGUN,
    Record,
    mark_begun,
    record_file,
    why_due,
    write_record,
)

COPIES = Path(".snakemake/storage/memory")


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """Three products, each made of the one before; what the bucket holds of them is kept."""
    monkeypatch.chdir(tmp_path)
    place = f"bucket/{tmp_path.name}"
    storage = fsspec.filesystem("memory")
    names = ("results/left.zarr", "results/labels.zarr", "tiles/A")
    products = [str(COPIES / place / name) for name in names]
    for before, product, name in zip([None, *products], products, names):
        for chunk in ("a", "b"):
            storage.pipe_file(f"/{place}/{name}/{chunk}", f"{name} {chunk}".encode())
        inputs = {"gcps.csv": "0"} if before is None else {before: "0"}
        write_record(Record("1", {}, inputs, {product: "0"}))
    states = BucketRecords(f"memory://{place}", COPIES)
    states.keep_states("1")
    return states, storage, f"/{place}", products


def marked(products):
    """Which are due as if their jobs had not ended; what follows from them, the plan sees."""
    return [record_file(product).with_suffix(f".json{BEGUN}").exists() for product in products]


def test_what_is_as_it_was_stays(stored):
    states, _, _, products = stored
    assert states.mark_changed() == []
    assert marked(products) == [False, False, False]


@pytest.mark.parametrize("how", ["deleted", "replaced", "added", "emptied"])
def test_what_was_touched_is_made_again(stored, how):
    states, storage, place, products = stored
    folder = f"{place}/results/labels.zarr"
    if how == "deleted":
        storage.rm_file(f"{folder}/a")
    elif how == "emptied":
        storage.rm(folder, recursive=True)
    else:
        storage.pipe_file(f"{folder}/{'a' if how == 'replaced' else 'c'}", b"of somebody else")
    assert states.mark_changed() == [products[1]]
    assert marked(products) == [False, True, False]
    states.keep_states("2")  # of a run that has failed before it made anything
    assert states.mark_changed() == [products[1]]
    for product in products[1:]:  # of one that was killed when it had
        write_record(Record("3", {}, {}, {product: "0"}))
    assert states.mark_changed() == []
    for chunk in "ab":
        storage.pipe_file(f"{folder}/{chunk}", b"made again")
    states.keep_states("3")
    assert states.mark_changed() == []
    assert marked(products) == [False, False, False]
    storage.pipe_file(f"{place}/tiles/A/b", b"of somebody else")
    assert states.mark_changed() == [products[2]]


def test_a_damaged_record_of_the_states_is_as_none(stored):
    states, storage, place, products = stored
    storage.pipe_file(f"{place}/.stored.json", b"{")
    assert states.mark_changed() == []
    storage.rm_file(f"{place}/.stored.json")
    assert states.mark_changed() == []
    assert marked(products) == [False, False, False]


@pytest.fixture
def at(tmp_path, monkeypatch):
    """Goes to a checkout; returns the records that a run there begins with."""

    def go(name: str) -> BucketRecords:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        monkeypatch.chdir(folder)
        records = BucketRecords(f"memory://bucket/{tmp_path.name}", COPIES)
        records.pull()
        return records

    return go


def test_marks_and_records_reach_another_checkout_and_go_again(at, tmp_path):
    product = COPIES / "bucket" / tmp_path.name / "tiles/A"
    first = at("first")
    mark_begun(product)
    first.push()

    at("second")
    assert why_due([product], [], {}) == "the job that makes it did not end"

    at("first")
    write_record(Record("1", {"size": 2}, {}, {str(product): "0"}))
    first.push()
    at("second")
    assert why_due([product], [], {"size": 2}) == ""
    assert why_due([product], [], {"size": 3}) == "changed: size 2 -> 3"


def test_records_of_products_here_and_of_other_prefixes_stay(at):
    records = at("first")
    for product in ("tiles/A", COPIES / "bucket/other/tiles/A"):
        write_record(Record("1", {}, {}, {str(product): "0"}))
    kept = [record_file("tiles/A"), record_file(COPIES / "bucket/other/tiles/A")]
    records.push()
    at("first")
    assert kept[0].exists()
    at("second")
    assert not kept[0].exists()
