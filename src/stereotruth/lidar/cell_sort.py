"""Points brought into the order of their cells in bounded memory, and written as a point store."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..core.kernels import kernel
from ..core.numerics.arrays import Ints, Words
from ..core.products.files import sealed
from .lattice import CELL_BITS, PER_DEG, PER_M, cell_key
from .point_store import ATTRIBUTES, CELL, CELLS, POINTS, SQUARES, STRIPS, WORDS

RUN_WORDS = WORDS + 1  # of 32 bits, of a point in the scratch: with the codes of its strip
RUN_BYTES = 4 * RUN_WORDS
SCRATCH_POINTS = (1 << 28) // RUN_BYTES  # kept in memory, 256 MiB


def bounds_of(limits: Ints) -> list[float]:
    """lon_min, lat_min, lon_max, lat_max (degrees), h_min, h_max (m) of lattice limits [2, 3]."""
    low, high = limits
    degrees = (float(value) / PER_DEG for value in (low[0], low[1], high[0], high[1]))
    return [*degrees, float(low[2]) / PER_M, float(high[2]) / PER_M]


@kernel
def _number_cells(lattice: Ints, row: int, col: int, width: int, out: Ints) -> None:
    """Number of the cell of each point in a raster of cells, its first cell at row, col."""
    for i in range(out.size):
        out[i] = ((lattice[1, i] >> CELL_BITS) - row) * width + (lattice[0, i] >> CELL_BITS) - col


@kernel
def _sort(
    lattice: Ints,
    attributes: Words,
    strips: Words,
    cell: Ints,
    end: Ints,
    limits: NDArray[np.int32],
    run: Words,
) -> None:
    """Fill ``run`` [n, 4] with the points as they are stored, by cell, in their order in a cell.

    ``cell`` [n] is the number of each point's cell; ``end`` [m], zeros, gets the end of each cell
    in the run, ``limits`` [m, 2] its lowest and highest height. Neighbours in the file are so in a
    cell mostly, and are moved together.
    """
    i = 0
    while i < cell.size:
        first = i
        while i < cell.size and cell[i] == cell[first]:
            i += 1
        end[cell[first]] += i - first
    total = 0
    for c in range(end.size):
        number = end[c]
        end[c] = total
        total += number
        limits[c, 0], limits[c, 1] = np.iinfo(np.int32).max, np.iinfo(np.int32).min
    inside = (1 << CELL_BITS) - 1
    i = 0
    while i < cell.size:
        c, first = cell[i], i
        while i < cell.size and cell[i] == c:
            i += 1
        at = end[c] - first
        end[c] += i - first
        low, high = np.int64(limits[c, 0]), np.int64(limits[c, 1])
        for k in range(first, i):
            told, height = np.int64(attributes[k]), lattice[2, k]
            run[at + k, 0] = lattice[0, k] & inside | (told & 4095) << CELL_BITS
            run[at + k, 1] = lattice[1, k] & inside | told >> 16 << CELL_BITS
            run[at + k, 2] = height
            run[at + k, 3] = strips[k]
            low, high = min(low, height), max(high, height)
        limits[c, 0], limits[c, 1] = low, high


@kernel
def _count_squares(points: Words, counts: Ints) -> None:
    """Add stored points [n, 3] of a cell to the counts [SQUARES, SQUARES] of its squares."""
    inside, size = (1 << CELL_BITS) - 1, (1 << CELL_BITS) // SQUARES
    for i in range(len(points)):
        counts[(points[i, 1] & inside) // size, (points[i, 0] & inside) // size] += 1


def _cells(lattice: Ints) -> tuple[Ints, Ints]:
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
    its points in the order of the file. Runs are in ``memory`` [k, 4]; those that find no room
    there any more are on ``disk``. ``written``: points so far.
    """

    memory: Words
    disk: BinaryIO
    written: int = 0
    _held: int = 0  # in memory, the first ones
    _segments: list[np.ndarray] = field(default_factory=list)  # int64 [k, 3]: key, start, count
    _limits: list[np.ndarray] = field(default_factory=list)  # int32 [k, 2]: lowest, highest

    @classmethod
    def of(cls, room: int, disk: BinaryIO) -> SortedRuns:
        """Without a point. ``room``: points in memory; ``disk`` is emptied."""
        disk.seek(0)
        disk.truncate()
        return cls(np.empty((room, RUN_WORDS), "<u4"), disk)

    def add(self, lattice: Ints, attributes: Words, strips: Words) -> None:
        """Take in a chunk's points: lattice coordinates [3, n], attributes and codes of strips [n]
        as of :meth:`.point_fields.PointTally.take`."""
        size = attributes.size
        if not size:
            return
        key, cell = _cells(lattice)
        end, limits = np.zeros(key.size, np.int64), np.empty((key.size, 2), np.int32)
        has_room = self._held == self.written and self._held + size <= len(self.memory)
        run = (
            self.memory[self._held : self._held + size]
            if has_room
            else np.empty((size, RUN_WORDS), "<u4")
        )
        _sort(lattice, attributes, strips, cell, end, limits, run)
        if has_room:
            self._held += size
        else:
            self.disk.write(run)  # unlike ndarray.tofile it says why it fails
        count = np.diff(end, prepend=0)
        here = count > 0
        segments = np.stack([key, end - count + self.written, count], axis=1)
        self._segments.append(segments[here])
        self._limits.append(limits[here])
        self.written += size

    def _take(self, segments: Ints) -> Iterator[Words]:
        """The points of segments, each at once."""
        for _, start, count in segments.tolist():
            if start < self._held:
                yield self.memory[start : start + count]
                continue
            points = np.empty((count, RUN_WORDS), "<u4")
            self.disk.seek((start - self._held) * RUN_BYTES)
            if self.disk.readinto(points.data.cast("B")) != points.nbytes:
                raise OSError("the scratch file of the points is cut short")
            yield points

    def write(self, folder: Path, attrs: dict[str, Any], strips_at: int | None) -> None:
        """Write a point store: points and cell table in final order, and the points' strips unless
        ``strips_at`` is None: the bit where their code begins.

        ``attrs`` get the CRC-32 of the table's file, and of the strips of each cell.
        """
        segments = np.concatenate([np.empty((0, 3), np.int64), *self._segments])
        limits = np.concatenate([np.empty((0, 2), np.int32), *self._limits])
        order = np.argsort(segments[:, 0], kind="stable")
        segments, limits = segments[order], limits[order]
        key, first = np.unique(segments[:, 0], return_index=True)
        table = np.empty(key.size, CELL)
        table["row"], table["col"] = key >> 32, (key & 0xFFFFFFFF) - (1 << 30)
        table["first"] = np.cumsum(segments[:, 2])[first] - segments[first, 2]
        if key.size:
            table["lowest"] = np.minimum.reduceat(limits[:, 0], first)
            table["highest"] = np.maximum.reduceat(limits[:, 1], first)
        of_cells = np.split(segments, first[1:]) if key.size else ()
        with _array_file(folder / POINTS, "<u4", (self.written, WORDS)) as file:
            for cell, of in enumerate(of_cells):
                crc32, squares = 0, np.zeros((SQUARES, SQUARES), np.int64)
                for run in self._take(of):
                    points = np.ascontiguousarray(run[:, :WORDS])
                    crc32 = zlib.crc32(points, crc32)
                    _count_squares(points, squares)
                    file.write(points)
                table["crc32"][cell] = crc32
                table["squares"][cell] = np.minimum(squares, 65535)
        np.save(folder / CELLS, table)
        sums: list[int] = []
        if strips_at is not None:
            with _array_file(folder / STRIPS, "<u2", (self.written,)) as file:
                for of in of_cells:
                    sums.append(0)
                    for run in self._take(of):
                        codes = (run[:, WORDS] >> strips_at).astype("<u2")
                        sums[-1] = zlib.crc32(codes, sums[-1])
                        file.write(codes)
        attrs["cells_crc32"] = zlib.crc32((folder / CELLS).read_bytes())
        attrs["strips"] = {**attrs["strips"], "crc32": sums}
        (folder / ATTRIBUTES).write_text(sealed(attrs), encoding="utf-8")


@contextmanager
def _array_file(path: Path, kind: str, shape: tuple[int, ...]) -> Iterator[BinaryIO]:
    """A file of NumPy's for an array that is written bit by bit."""
    with path.open("wb") as file:
        described = {"descr": kind, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, described)
        yield file
