"""Grid stores that are whole or absent, and whose damage is told."""

from __future__ import annotations

import random
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import xarray as xr
import zarr

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import (
    Layer,
    atomic_store,
    create_grid,
    damaged_store,
    open_grid,
    require_complete,
)
from stereotruth.core.products.making import making
from stereotruth.core.products.resumable_grids import resumable_grid

LAYERS = {"disparity": Layer("float32", float("nan"), {"units": "px", "long_name": "disparity"})}


def make(path, shape=(70, 100)):
    with atomic_store(path) as scratch:
        arrays = create_grid(scratch, shape, LAYERS, chunk=16, shard=32, attrs={"epipolar": {}})
        arrays["disparity"][32:64, 0:32] = 5.0
    return path


def test_a_finished_grid_opens_by_xarray_alone(tmp_path):
    with xr.open_zarr(make(tmp_path / "d.zarr")) as grid:
        assert grid.disparity.dims == ("y", "x")
        assert grid.disparity.attrs["units"] == "px"
        values = grid.disparity.values
    assert np.isnan(values).sum() == 70 * 100 - 32 * 32
    assert (values[32:64, :32] == 5).all()
    array = zarr.open_group(tmp_path / "d.zarr", mode="r")["disparity"]
    assert array.metadata.zarr_format == 3
    assert (array.chunks, array.shards) == ((16, 16), (32, 32))


def test_a_failed_build_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), atomic_store(tmp_path / "d.zarr") as scratch:
        create_grid(scratch, (8, 8), LAYERS, chunk=8, shard=8, attrs={})
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_half_written_store_is_never_taken_for_a_whole_one(tmp_path):
    create_grid(tmp_path / "d.zarr", (8, 8), LAYERS, chunk=8, shard=8, attrs={})
    for name in ("d.zarr", "other.zarr"):
        with pytest.raises(InputError) as refused:
            open_grid(tmp_path / name)
        assert refused.value.file == str(tmp_path / name)


def test_a_grid_is_made_and_published_where_there_are_no_hard_links(tmp_path, monkeypatch):
    """As on exFAT and some network drives."""

    def refused(*_, **__):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("os.link", refused)
    block, path = (slice(0, 64), slice(0, 64)), tmp_path / "grid.zarr"
    with resumable_grid(path, (64, 64), LAYERS, chunk=32, shard=64) as store:
        store.write(block, "key", {"disparity": np.ones((64, 64), "float32")}, None)
        store.write_atomically(path, [block], {"scene": "A-1"})
    assert open_grid(path).disparity.values.sum() == 64 * 64


def test_any_damage_to_the_metadata_is_one_sentence_with_the_store(tmp_path):
    """Seeded bytes of zarr.json: refused, or read as what it says."""
    path = make(tmp_path / "grid.zarr")
    whole, rng = (path / "zarr.json").read_bytes(), random.Random(3)
    refused = 0
    for _ in range(120):
        damaged = bytearray(whole)
        at = rng.randrange(len(damaged))
        damaged[at : at + rng.choice((1, 1, 30))] = rng.randbytes(rng.choice((0, 1, 9)))
        (path / "zarr.json").write_bytes(damaged)
        try:
            open_grid(path).disparity.values  # noqa: B018
        except InputError as error:
            assert "grid.zarr" in str(error)
            refused += 1
    assert refused > 60


def flip(file, bit) -> None:
    data = bytearray(file.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    file.write_bytes(data)


def test_a_flipped_bit_of_a_chunk_is_never_read_as_another_value(tmp_path):
    path, rng = make(tmp_path / "d.zarr"), random.Random(5)
    file = path / "disparity/c/1/0"
    for _ in range(60):
        bit = rng.randrange(file.stat().st_size * 8)
        flip(file, bit)
        with pytest.raises(Exception):  # noqa: B017  the decoder's, or the checksum's
            require_complete(path)["disparity"][:]
        flip(file, bit)
    assert require_complete(path)["disparity"][40, 8] == 5


@pytest.mark.parametrize("file", ["disparity/c/1/0", "x/c/0"])
def test_a_job_that_reads_a_damaged_chunk_names_the_store(tmp_path, monkeypatch, file):
    good, bad = make(tmp_path / "a.zarr"), make(tmp_path / "b.zarr")
    flip(bad / file, (bad / file).stat().st_size * 8 // 3)
    (tmp_path / "gcps.csv").touch()
    inputs = [str(tmp_path / "gcps.csv"), str(good), str(bad)]
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(InputError) as refused,
        making(inputs, ["out.txt"]),
        ThreadPoolExecutor(1) as pool,
    ):
        pool.submit(lambda: require_complete(bad)[file.partition("/")[0]][:]).result()
    assert (refused.value.file, bool(refused.value.remedy)) == (str(bad), True)
    assert damaged_store(refused.value.__cause__, [good]) is None
    assert damaged_store(ValueError("a defect"), [bad]) is None
