"""Grids in the making, block by block: what a killed job has done, and what an edit leaves valid.

A grid store is made in a folder beside its final place (``.<name>.work``), which is no output of
any rule, so that it outlives jobs, killed or not:

===================  ==============================================================================
``store/``           the arrays, without attributes of the scene
``done/``            record of each block, one shard of each array; see :class:`Ledger`
``layout.json``      shape, arrays and chunks
``lock``             held by the job at work here, shared by the parts of one scene
===================  ==============================================================================

A later job takes over the blocks whose records have the key that it would give them, and makes the
others: after a kill those that were in flight, after one more LiDAR file those that it touches.
:meth:`BlockStore.write_atomically` puts hard links to all files (copies where there are no links)
into the final place, in one step. Whatever was taken over, the bytes are those of a fresh run.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import zarr
from numpy.typing import NDArray

from .files import atomic_file, link
from .grids import Layer, atomic_store, create_grid
from .making import FileLock, Marks, marks_of_inputs, refuse_replaced
from .provenance import digest, file_sha256

log = logging.getLogger("stereotruth")
Block = tuple[slice, slice]


FORMAT = 1  # of the layout


@dataclass(frozen=True)
class BlockStore:
    """The grid in the making at ``folder``; plain values, so that it can go to other processes."""

    folder: Path
    layers: tuple[str, ...]
    shard: int
    inputs: Marks = field(default_factory=marks_of_inputs)

    @property
    def store(self) -> Path:
        """The Zarr store with the arrays."""
        return self.folder / "store"

    @property
    def _done(self) -> Ledger:
        return Ledger(self.folder / "done")

    def _name(self, block: Block) -> str:
        return f"{block[0].start // self.shard}-{block[1].start // self.shard}"

    def _files(self, block: Block) -> dict[str, Path]:
        i, j = self._name(block).split("-")
        return {name: self.store / name / "c" / i / j for name in self.layers}

    def write(
        self, block: Block, key: str, arrays: Mapping[str, NDArray[Any]], result: Any
    ) -> None:
        """Write a block, one value per pixel of its ``arrays``, and its record.

        Arrays that are not given hold their fill values. ``result`` is JSON-ready. Raises
        InputError if what the job reads was replaced meanwhile: the key would be that of others.
        """
        group = zarr.open_group(self.store, mode="r+")
        for name, values in arrays.items():
            group[name][block] = values
        refuse_replaced(self.inputs)
        self._done.put(self._name(block), key, self._files(block), result)

    def has(self, block: Block, key: str) -> bool:
        """Whether a block is there as ``key`` wants it; what else there is of it is removed."""
        return self._done.find(self._name(block), key, self._files(block)) is not None

    def missing(self, blocks: Sequence[Block], keys: Sequence[str], workers: int) -> list[int]:
        """Which of the blocks, by number, are to be made; what is there of them is removed.

        ``keys``: what the content of each block follows from, as given to :meth:`write`.
        """
        with ThreadPoolExecutor(workers) as pool:
            found = list(pool.map(self.has, blocks, keys))
        if any(found):
            log.info("%d of %d blocks are there from before", sum(found), len(found))
        return [number for number, done in enumerate(found) if not done]

    def results(self, blocks: Iterable[Block]) -> list[Any]:
        """What the makers of finished blocks gave as ``result``."""
        return [self._done.get(self._name(block)).result for block in blocks]

    def write_atomically(
        self, path: str | Path, blocks: Iterable[Block], attrs: Mapping[str, Any]
    ) -> None:
        """Put the whole grid to ``path``, with ``attrs`` and the digest ``content`` of its pixels.

        The pixels of two stores are the same if ``content`` is.
        """
        content, files = {}, []
        for block in blocks:
            sums = self._done.get(self._name(block)).sha256
            for name, file in self._files(block).items():
                content[str(file.relative_to(self.store))] = sums.get(name)
                files += [file] if name in sums else []
        layout = json.loads((self.folder / "layout.json").read_text())
        with atomic_store(path) as unfinished:
            grids = {str(self.store / name) for name in self.layers}
            shutil.copytree(
                self.store,
                unfinished,
                ignore=lambda folder, names: ["c"] if folder in grids else [],
                dirs_exist_ok=True,
            )
            for file in files:
                link(file, unfinished / file.relative_to(self.store))
            group = zarr.open_group(unfinished, mode="r+")
            group.attrs.update({**attrs, "content": digest({"layout": layout, "blocks": content})})


@contextmanager
def resumable_grid(
    path: str | Path,
    shape: tuple[int, int],
    layers: Mapping[str, Layer],
    *,
    chunk: int,
    shard: int,
    shared: bool = False,
) -> Iterator[BlockStore]:
    """Work on the grid store that is to be at ``path``; see :func:`.grids.create_grid`.

    Waits while another process works on it. ``shared``: this one makes a part of the blocks only,
    while others may make other parts.
    """
    path = Path(path)
    folder = path.with_name(f".{path.name}.work")
    found = BlockStore(folder, tuple(layers), shard)
    layout = {
        "format": FORMAT,
        "shape": list(shape),
        "chunk": chunk,
        "shard": shard,
        "layers": {name: asdict(layer) for name, layer in layers.items()},
    }
    layout = json.loads(json.dumps(layout, default=str))
    lock = FileLock(folder / "lock")
    try:
        lock.take(path, shared=shared)
        while not _has_layout(folder, layout):
            lock.take(path)
            if not _has_layout(folder, layout):
                _lay_out(found, shape, layers, chunk, layout)
            lock.take(path, shared=shared)
        if not shared:  # what a killed writer left of its last file
            for rest in found.store.rglob("*.partial"):
                rest.unlink()
        yield found
    finally:
        lock.close()


def _has_layout(folder: Path, layout: Mapping[str, Any]) -> bool:
    try:
        return json.loads((folder / "layout.json").read_text()) == layout
    except (FileNotFoundError, json.JSONDecodeError):
        return False


def _lay_out(
    store: BlockStore,
    shape: tuple[int, int],
    layers: Mapping[str, Layer],
    chunk: int,
    layout: Mapping[str, Any],
) -> None:
    """Empty the folder and make empty arrays in it."""
    (store.folder / "layout.json").unlink(missing_ok=True)
    for old in (store.store, store.folder / "done"):
        shutil.rmtree(old, ignore_errors=True)
    create_grid(store.store, shape, layers, chunk=chunk, shard=store.shard, attrs={})
    with atomic_file(store.folder / "layout.json") as scratch:
        scratch.write_text(json.dumps(layout))


@dataclass(frozen=True)
class Piece:
    """A piece that is there: ``sha256`` of those of its files that exist, ``result`` as given."""

    sha256: Mapping[str, str]
    result: Any


@dataclass(frozen=True)
class Ledger:
    """The records in a folder, one file each. Names of pieces are file names."""

    folder: Path

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def put(self, name: str, key: str, files: Mapping[str, Path], result: Any) -> Piece:
        """Record that a piece is done; ``result`` is JSON-ready."""
        sums = {label: file_sha256(path) for label, path in files.items() if path.exists()}
        record = {"format": FORMAT, "key": key, "sha256": sums, "result": result}
        with atomic_file(self._file(name)) as scratch:
            scratch.write_text(json.dumps(record))
        return Piece(sums, result)

    def get(self, name: str) -> Piece:
        """The record of a piece that is known to be there."""
        record = json.loads(self._file(name).read_text())
        return Piece(record["sha256"], record["result"])

    def find(self, name: str, key: str, files: Mapping[str, Path]) -> Piece | None:
        """The piece, if it is there as ``key`` wants it; else what is left of it is removed."""
        try:
            record = json.loads(self._file(name).read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            record = {}
        if record.get("key") == key and record["format"] == FORMAT:
            sums = {label: file_sha256(path) for label, path in files.items() if path.exists()}
            if sums == record["sha256"]:
                return Piece(sums, record["result"])
        self._file(name).unlink(missing_ok=True)
        for path in files.values():
            path.unlink(missing_ok=True)
        return None

    def keep_only(self, names: set[str]) -> None:
        """Forget all other pieces."""
        for file in self.folder.glob("*.json"):
            if file.stem not in names:
                file.unlink()
