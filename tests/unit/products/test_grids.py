from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
import zarr

from stereotruth.errors import InputError
from stereotruth.products.files import replacing
from stereotruth.products.grids import Layer, blocks, building, create_grid, open_grid

LAYERS = {"disparity": Layer("float32", float("nan"), {"units": "px", "long_name": "disparity"})}


def make(path, shape=(70, 100)):
    with building(path) as scratch:
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


def test_it_is_zarr_3_and_sharded(tmp_path):
    array = zarr.open_group(make(tmp_path / "d.zarr"), mode="r")["disparity"]
    assert array.metadata.zarr_format == 3
    assert (array.chunks, array.shards) == ((16, 16), (32, 32))


def test_a_failed_build_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), building(tmp_path / "d.zarr") as scratch:
        create_grid(scratch, (8, 8), LAYERS, chunk=8, shard=8, attrs={})
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_half_written_store_is_never_taken_for_a_whole_one(tmp_path):
    create_grid(tmp_path / "d.zarr", (8, 8), LAYERS, chunk=8, shard=8, attrs={})
    with pytest.raises(InputError, match=r"d\.zarr.*half-written"):
        open_grid(tmp_path / "d.zarr")
    with pytest.raises(InputError, match="no such"):
        open_grid(tmp_path / "other.zarr")


def test_blocks_cover_a_grid_once():
    seen = np.zeros((70, 100), int)
    for window in blocks(seen.shape, 32):
        seen[window] += 1
    assert (seen == 1).all()


def test_shards_must_hold_whole_chunks(tmp_path):
    with pytest.raises(ValueError, match="multiple"):
        create_grid(tmp_path / "d.zarr", (8, 8), LAYERS, chunk=5, shard=8, attrs={})


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "a.json"
    with replacing(path) as scratch:
        scratch.write_text("{}")
        assert scratch.suffix == ".json"
        assert not path.exists()
    assert path.read_text() == "{}"
    assert list(path.parent.iterdir()) == [path]


def test_a_failed_write_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as scratch:
        scratch.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
