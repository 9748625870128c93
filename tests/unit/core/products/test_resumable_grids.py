"""Blocks that outlive their job: what is taken over, what is made again, what is published."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import numpy as np
import pytest
import zarr

from stereotruth.core.products.grids import Layer, Strip, blocks, open_grid
from stereotruth.core.products.resumable_grids import resumable_grid

from ....synthetic.stores import Killed, tree

SHAPE = (70, 100)
LAYERS = {
    "disparity": Layer("float32", np.nan, {"units": "px", "long_name": "disparity"}),
    "status": Layer("uint8", 0, {"units": "1", "long_name": "status"}),
}
SIZES = {"chunk": 16, "shard": 32}
BLOCKS = blocks(SHAPE, SIZES["shard"])
ATTRS = {"kind": "disparity", "scene": "test"}


def work(
    path: Path,
    *,
    keys: list[str] | None = None,
    stop_after: int | None = None,
    strip: Strip | None = None,
    attrs: dict = ATTRS,
) -> list[int]:
    """Make what is missing, each block's values by its key; numbers of the blocks made."""
    keys = keys or ["a"] * len(BLOCKS)
    part = BLOCKS if strip is None else strip.of(BLOCKS)
    made = []
    with resumable_grid(path, SHAPE, LAYERS, **SIZES, shared=strip is not None) as store:
        for number in store.missing(part, keys, workers=2):
            if stop_after is not None and len(made) >= stop_after:
                raise Killed
            write(store, part[number], keys[number])
            made.append(BLOCKS.index(part[number]))
        if strip is None:
            store.write_atomically(path, BLOCKS, attrs | {"sum": sum(store.results(BLOCKS))})
    return made


def write(store, block, key: str) -> None:
    """The last block of all holds nothing but fill values: it has no file."""
    rows, cols = block
    if block == BLOCKS[-1] and key == "a":
        store.write(block, key, {}, 0)
        return
    y, x = np.mgrid[rows, cols]
    values = (y * 1000.0 + x + len(key) * 1e6).astype(np.float32)
    store.write(block, key, {"disparity": values, "status": (y % 3).astype(np.uint8)}, values.size)


@pytest.fixture
def fresh(tmp_path) -> dict[str, str]:
    """A store made at once, elsewhere."""
    work(tmp_path / "fresh" / "x.zarr")
    return tree(tmp_path / "fresh" / "x.zarr")


@pytest.mark.parametrize("stop_after", [0, 5, len(BLOCKS) - 1])
def test_a_killed_job_is_carried_on(tmp_path, fresh, stop_after) -> None:
    path = tmp_path / "x.zarr"
    with pytest.raises(Killed):
        work(path, stop_after=stop_after)
    assert not path.exists()
    assert work(path) == list(range(stop_after, len(BLOCKS)))
    assert tree(path) == fresh
    assert work(path) == []  # asked for again, nothing is made
    assert tree(path) == fresh
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    wanted = (y * 1000.0 + x + 1e6).astype(np.float32)
    wanted[BLOCKS[-1]] = np.nan
    grid = open_grid(path)
    assert np.array_equal(grid["disparity"].values, wanted, equal_nan=True)
    assert grid.attrs["sum"] == SHAPE[0] * SHAPE[1] - wanted[BLOCKS[-1]].size


def test_only_blocks_of_other_keys_are_made_again(tmp_path) -> None:
    """The old files of a block go, also where the new ones hold nothing; of another shape all."""
    path = tmp_path / "x.zarr"
    changed = ["a"] * len(BLOCKS)
    changed[3] = changed[-1] = "bb"
    work(path, keys=changed)
    assert work(path) == [3, len(BLOCKS) - 1]
    work(tmp_path / "fresh.zarr")
    assert tree(path) == tree(tmp_path / "fresh.zarr")
    block = (slice(0, 32), slice(0, 32))
    with resumable_grid(path, (32, 32), LAYERS, **SIZES) as store:
        assert store.missing([block], ["a"], 1) == [0]
        write(store, block, "a")
        store.write_atomically(path, [block], ATTRS)
    assert open_grid(path)["disparity"].shape == (32, 32)


def test_what_a_killed_writer_left_counts_for_nothing(tmp_path, fresh) -> None:
    """Files without record, half a record, half a file, changed bytes, a scratch file."""
    path = tmp_path / "x.zarr"
    work(path)
    folder = tmp_path / ".x.zarr.work"
    (folder / "done" / "0-0.json").unlink()
    record = folder / "done" / "0-1.json"
    record.write_text(record.read_text()[:20])
    for number, damage in ((2, lambda b: b[:-7]), (3, lambda b: b[:50] + b"?" + b[51:])):
        file = folder / "store" / "disparity" / "c" / "0" / str(number)
        content = damage(file.read_bytes())
        file.unlink()
        file.write_bytes(content)
    (folder / "store" / "status" / "c" / "1").mkdir(exist_ok=True)
    (folder / "store" / "status" / "c" / "1" / "0.abc.partial").write_bytes(b"1")
    assert work(path) == [0, 1, 2, 3]
    assert tree(path) == fresh
    assert not list(folder.rglob("*.partial"))


def test_content_tells_pixels_apart_and_nothing_else(tmp_path) -> None:
    contents = []
    for number, (keys, attrs) in enumerate(
        [(None, ATTRS), (None, {"kind": "other"}), (["cc"] * len(BLOCKS), ATTRS)]
    ):
        path = tmp_path / f"{number}.zarr"
        work(path, keys=keys, attrs=attrs)
        contents.append(zarr.open_group(path, mode="r").attrs["content"])
    assert contents[0] == contents[1] != contents[2]


@pytest.mark.parametrize("count", [1, 2, 5])
def test_strips_make_each_block_once(tmp_path, fresh, count) -> None:
    """In any order, more strips than rows of blocks included."""
    path = tmp_path / "x.zarr"
    strips = [Strip.parse(f"{k}-of-{count}") for k in reversed(range(count))]
    made = [n for strip in strips for n in work(path, strip=strip)]
    assert sorted(made) == list(range(len(BLOCKS)))
    assert not path.exists()
    assert work(path) == []
    assert tree(path) == fresh


def _hold(path: Path, entered, leave, shared: bool) -> None:
    with resumable_grid(path, SHAPE, LAYERS, **SIZES, shared=shared):
        entered.set()
        leave.wait(20)


@pytest.mark.slow
@pytest.mark.parametrize("others", [True, False])
def test_one_job_at_a_time_but_strips_together(tmp_path, others, caplog) -> None:
    """A job waits for one of a killed run that is still at work, strips do not for each other."""
    spawn = multiprocessing.get_context("spawn")
    path = tmp_path / "x.zarr"
    work(path)
    entered, leave, second = spawn.Event(), spawn.Event(), spawn.Event()
    first = spawn.Process(target=_hold, args=(path, entered, leave, others))
    first.start()
    assert entered.wait(30)
    other = spawn.Process(target=_hold, args=(path, second, leave, others))
    other.start()
    assert second.wait(30 if others else 3) is others
    leave.set()
    assert second.wait(30)
    for process in (first, other):
        process.join(30)
        assert process.exitcode == 0
