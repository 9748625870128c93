"""A job that reads a damaged chunk names the store and says what to do."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import (
    Layer,
    atomic_store,
    create_grid,
    damaged_store,
    require_complete,
)
from stereotruth.core.products.making import making

LAYERS = {"image": Layer("uint16", 0, {"units": "DN", "long_name": "image"})}


def make(path):
    with atomic_store(path) as scratch:
        arrays = create_grid(scratch, (64, 64), LAYERS, chunk=16, shard=32, attrs={})
        arrays["image"][:] = np.arange(64 * 64).reshape(64, 64)
    return path


@pytest.mark.parametrize("file", ["image/c/1/0", "x/c/0"])
def test_a_flipped_bit_is_refused_and_the_store_named(tmp_path, monkeypatch, file):
    good, bad = make(tmp_path / "a.zarr"), make(tmp_path / "b.zarr")
    data = bytearray((bad / file).read_bytes())
    data[len(data) // 3] ^= 4
    (bad / file).write_bytes(data)
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
