"""Points of a file brought into the order of their cells, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import BinaryIO

import numpy as np
import zarr
from numpy.typing import NDArray

from ..kernels import kernel
from .lattice import CELL_BITS, cell_key
from .point_store import CHUNK_POINTS, CODEC, SHARD_POINTS, STORE_ATTRS

Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]


_RECORD_BYTES = 16  # of a point before it has its final place: position and attributes
SCRATCH_POINTS = 1 << 24  # of these kept in memory, 256 MiB


@kernel
def _number_cells(lattice: Integers, row: int, col: int, width: int, out: Integers) -> None:
    """Number of the cell of each point in a raster of cells, its first cell at row, col."""
    for i in range(out.size):
        out[i] = ((lattice[1, i] >> CELL_BITS) - row) * width + (lattice[0, i] >> CELL_BITS) - col


@kernel
def _sort(
    lattice: Integers,
    attributes: NDArray[np.uint32],
    cell: Integers,
    end: Integers,
    limits: NDArray[np.int32],
    run: NDArray[np.int32],
) -> None:
    """Fill ``run`` [n, 4] with the points as scratch records, by cell, in their order in a cell.

    ``cell`` [n] is the number of each point's cell; ``end`` [m], zeros, gets the end of each cell
    in the run, ``limits`` [m, 2] its lowest and highest height.
    """
    for i in range(cell.size):
        end[cell[i]] += 1
    total = 0
    for c in range(end.size):
        number = end[c]
        end[c] = total
        total += number
        limits[c, 0], limits[c, 1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    inside = (1 << CELL_BITS) - 1
    for i in range(cell.size):
        c = cell[i]
        at = end[c]
        end[c] += 1
        height = np.int32(lattice[2, i])
        run[at, 0] = lattice[0, i] & inside
        run[at, 1] = lattice[1, i] & inside
        run[at, 2] = height
        run[at, 3] = attributes[i]
        limits[c, 0], limits[c, 1] = min(limits[c, 0], height), max(limits[c, 1], height)


@kernel
def _gather(
    records: NDArray[np.int32],
    pieces: Integers,
    position: NDArray[np.int32],
    attributes: Bytes,
) -> None:
    """Fill position [3, n] and attributes [3, n] from pieces of scratch records [k, 4].

    ``pieces`` [m, 2]: first record and number of records of each.
    """
    done = 0
    for piece in range(pieces.shape[0]):
        first, number = pieces[piece]
        for k in range(3):
            target, low = position[k, done : done + number], attributes[k, done : done + number]
            for i in range(number):
                target[i] = records[first + i, k]
                low[i] = records[first + i, 3] >> 8 * k & 255
        done += number


def _cells(lattice: Integers) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys of cells [m], sorted, and the number among these of each point's cell [n]."""
    low_col, low_row = lattice[:2].min(axis=1) >> CELL_BITS
    high_col, high_row = lattice[:2].max(axis=1) >> CELL_BITS
    width, height = int(high_col - low_col) + 1, int(high_row - low_row) + 1
    if width * height > 1 << 16:  # far apart
        key = cell_key(lattice[1] >> CELL_BITS, lattice[0] >> CELL_BITS)
        return np.unique(key, return_inverse=True)
    row, col = np.divmod(np.arange(width * height), width)
    cell = np.empty(lattice.shape[1], np.int64)
    _number_cells(lattice, low_row, low_col, width, cell)
    return cell_key(row + low_row, col + low_col), cell


@dataclass
class SortedRuns:
    """External sort by cell: each chunk becomes one sorted run, a part of the scratch.

    A segment is what one run holds of one cell; segments of a cell, in the order of the runs, are
    its points in the order of the file. Runs are in ``memory`` [k, 4]; where that is full, it is
    moved to ``disk``.
    """

    memory: NDArray[np.int32]
    disk: BinaryIO
    written: int = 0
    held: int = 0  # in memory
    segments: list[np.ndarray] = field(default_factory=list)  # int64 [k, 3]: key, start, count
    limits: list[np.ndarray] = field(default_factory=list)  # int32 [k, 2]: lowest, highest

    def add(self, lattice: NDArray[np.int64], attributes: NDArray[np.uint32]) -> None:
        """Take in a chunk's points: lattice coordinates [3, n], attributes [n] as of _unpack."""
        size = attributes.size
        if not size:
            return
        if self.held + size > len(self.memory):
            self.spill()
        key, cell = _cells(lattice)
        end, limits = np.zeros(key.size, np.int64), np.empty((key.size, 2), np.int32)
        run = self.memory[self.held : self.held + size]
        _sort(lattice, attributes, cell, end, limits, run)
        count = np.diff(end, prepend=0)
        here = count > 0
        segments = np.stack([key, end - count + self.written, count], axis=1)
        self.segments.append(segments[here])
        self.limits.append(limits[here])
        self.held += size
        self.written += size

    def spill(self) -> None:
        """Write what is held in memory to the scratch file."""
        self.disk.write(self.memory[: self.held])  # unlike ndarray.tofile it says why it fails
        self.held = 0

    def take(self, pieces: list[tuple[int, int]]) -> tuple[NDArray[np.int32], Bytes]:
        """Position [3, n] and attributes [3, n] of pieces of runs: first record, number."""
        where = np.array(pieces, np.int64).reshape(-1, 2)
        total = int(where[:, 1].sum())
        position, attributes = np.empty((3, total), np.int32), np.empty((3, total), np.uint8)
        records = self.memory
        if self.written > self.held:
            # Read by hand: pages of a memory map would count as this process's memory.
            records, done = np.empty((total, 4), np.int32), 0
            for first, number in pieces:
                self.disk.seek(first * _RECORD_BYTES)
                target = memoryview(records[done : done + number]).cast("B")
                if self.disk.readinto(target) != number * _RECORD_BYTES:
                    raise OSError("the scratch file of the points is cut short")
                done += number
            where = np.array([[0, total]])
        _gather(records, where, position, attributes)
        return position, attributes

    def write(self, group: zarr.Group) -> None:
        """Write points and cell table in final order."""
        segments, limits = np.concatenate(self.segments), np.concatenate(self.limits)
        order = np.argsort(segments[:, 0], kind="stable")
        segments, limits = segments[order], limits[order]
        key, first = np.unique(segments[:, 0], return_index=True)
        start_of = np.concatenate([[0], np.cumsum(segments[:, 2])])  # of segments, sorted
        table = {
            "cell_row": (key >> 32).astype("i4"),
            "cell_col": ((key & 0xFFFFFFFF) - (1 << 30)).astype("i4"),
            "cell_start": start_of[first].astype("i8"),
            "cell_min": np.minimum.reduceat(limits[:, 0], first),
            "cell_max": np.maximum.reduceat(limits[:, 1], first),
        }
        for name, values in table.items():
            array = group.create_array(
                name,
                shape=values.shape,
                dtype=values.dtype,
                chunks=values.shape,
                compressors=CODEC,
                dimension_names=("cell",),
                attributes=STORE_ATTRS[name],
            )
            array[:] = values
        arrays = {
            name: group.create_array(
                name,
                shape=(3, self.written),
                dtype=dtype,
                chunks=(3, CHUNK_POINTS),
                shards=(3, SHARD_POINTS),
                compressors=CODEC,
                dimension_names=("component", "point"),
                attributes=STORE_ATTRS[name],
                config={"write_empty_chunks": True},  # does not look whether they are
            )
            for name, dtype in (("position", "i4"), ("attributes", "u1"))
        }
        if self.written > self.held:
            self.spill()
        for begin in range(0, self.written, SHARD_POINTS):
            end = min(begin + SHARD_POINTS, self.written)
            at = int(np.searchsorted(start_of, begin, side="right")) - 1
            pieces, done = [], begin
            while done < end:
                _, start, count = segments[at].tolist()
                skip = done - int(start_of[at])
                pieces.append((start + skip, min(count - skip, end - done)))
                done += pieces[-1][1]
                at += 1
            position, attributes = self.take(pieces)
            arrays["position"][:, begin:end] = position
            arrays["attributes"][:, begin:end] = attributes
