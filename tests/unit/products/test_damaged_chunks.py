"""A damaged chunk of a store is told by the name of its file."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stereotruth.errors import InputError
from stereotruth.products.damaged_chunks import damage_behind, damaged_chunk
from stereotruth.products.grids import Layer, atomic_store, create_grid, require_complete
from stereotruth.products.making import making

LAYERS = {"image": Layer("uint16", 0, {"units": "DN", "long_name": "image"})}


@pytest.fixture
def store(tmp_path):
    path = tmp_path / "left.zarr"
    values = np.random.default_rng(0).integers(0, 900, (64, 64)).astype(np.uint16)
    with atomic_store(path) as scratch:
        create_grid(scratch, (64, 64), LAYERS, chunk=16, shard=32, attrs={})["image"][:] = values
    return path


@pytest.fixture
def damaged(store):
    file = store / "image/c/1/0"
    data = bytearray(file.read_bytes())
    data[: len(data) // 2] = bytes(len(data) // 2)
    file.write_bytes(data)
    return store


def test_a_good_store_has_no_damaged_chunk(store):
    assert damaged_chunk(store) is None


def test_the_damaged_chunk_is_named(damaged, tmp_path):
    with pytest.raises(Exception) as failed, ThreadPoolExecutor(1) as pool:
        pool.submit(lambda: require_complete(damaged)["image"][:]).result()
    told = damage_behind(failed.value, [tmp_path / "gcps.csv", damaged])
    assert told.file == str(damaged / "image/c/1/0")
    assert damage_behind(ValueError("a defect"), [damaged]) is None


def test_a_job_that_reads_it_says_so(damaged, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(InputError, match=r"left\.zarr/image/c/1/0: damaged"),
        making([str(damaged)], ["out.txt"]),
    ):
        require_complete(damaged)["image"][:]


def test_damaged_metadata_are_named(store):
    (store / "zarr.json").write_text("{")
    assert damaged_chunk(store) == store / "zarr.json"
