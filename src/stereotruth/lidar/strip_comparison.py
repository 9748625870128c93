"""Strips of a site's LiDAR compared where they overlap: what each is off from the others.

A flight measures the ground in strips, and navigation is off by some centimetres in height and some
decimetres in plan, otherwise in each strip. Strips that overlap are compared on planes that both
have measured (:mod:`.strip_planes`), across all files of the site, and one adjustment of all pairs
gives each strip's offset from the one with most ground (:mod:`.strip_network`).

Points are read once, cell by cell: memory is that of a cell of 117 m, and of 128 planes for each
two strips of a cell.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..numerics.degrees import DEGREE_M
from .gps_times import day_of
from .lattice import CELL_BITS, LATTICE_DEG, PER_DEG
from .point_store import SQUARES, Points, PointStore
from .strip_codes import BIN_S, EDGES, SOURCE, runs_of
from .strip_network import Compared, adjusted_offsets
from .strip_offsets import SHARE, StripOffsets
from .strip_planes import (
    LEAST_POINTS,
    Differences,
    compare,
    is_firm,
    metres_in_cell,
    offset_of,
    planes_of,
    squares_along,
)

Codes = NDArray[np.int64]
Key = tuple[str, int, str]  # what tells a strip, its code, and the day or the file besides

LEAST_SHARE = 0.002  # of a cell's points: fewer are compared with nothing


def compare_strips(stores: Sequence[PointStore]) -> StripOffsets:
    """What the strips of some point stores are off; of stores of one strip that alone.

    The order of the stores plays no part. Raises InputError if a store is damaged.
    """
    stores = sorted((s for s in stores if s.count), key=lambda s: s.path.name)
    keys = _Keys(stores)
    parts: dict[tuple[Key, Key], list[Differences]] = {}
    shares: list[tuple[int, int, Key, NDArray[np.int64]]] = []
    cells = sorted({cell for store in stores for cell in _cells(store)})
    for number, (row, col) in enumerate(cells if keys.several else ()):
        held = keys.in_cell(row, col)
        points, which, names = held
        if len(names) == 1:
            squares = np.sum(
                [s.square_counts[k] for s in stores if (k := _cell_of(s, row, col)) is not None],
                axis=0,
                dtype=np.int64,
            )
            shares.append((row, col, names[0], squares))
            continue
        shares += [
            (row, col, name, _squares(points, which == k, row, col)) for k, name in enumerate(names)
        ]
        for pair, found in _compared(points, which, names, row, col, number):
            parts.setdefault(pair, []).append(found)
    named = {key: name for key, name in keys.names.items()}
    ground: Counter[str] = Counter()
    for row, _, key, squares in shares:
        side_m = (1 << CELL_BITS) * LATTICE_DEG / SQUARES * DEGREE_M
        narrow = np.cos(np.radians((row + 0.5) * (1 << CELL_BITS) * LATTICE_DEG))
        ground[named[key]] += int((squares > 0).sum()) * side_m**2 * narrow
    order = sorted(ground, key=lambda name: (-ground[name], name))
    compared = [
        Compared(named[a], named[b], offset)
        for (a, b), found in sorted(parts.items())
        if (offset := offset_of(found)) is not None
    ]
    table = np.zeros(len(shares), SHARE)
    for k, (row, col, key, squares) in enumerate(shares):
        table[k] = row, col, order.index(named[key]), np.minimum(squares, 65535)
    return adjusted_offsets(keys.by, [(name, ground[name]) for name in order], compared, table)


def _cells(store: PointStore) -> Iterator[tuple[int, int]]:
    return zip(store.cell_row.tolist(), store.cell_col.tolist())


def _cell_of(store: PointStore, row: int, col: int) -> int | None:
    """The number of a store's cell at a place of the lattice, if it has one."""
    found = np.flatnonzero((store.cell_row == row) & (store.cell_col == col))
    return int(found[0]) if found.size else None


def points_of_cell(store: PointStore, cell: int) -> Points:
    """All points of a cell, in stored order."""
    low = np.array([store.cell_col[cell], store.cell_row[cell]]) << CELL_BITS
    high = low + (1 << CELL_BITS) - 1
    return store.query(*(low / PER_DEG), *(high / PER_DEG))


def chosen(points: Points, which: NDArray) -> Points:
    """The points of an index or a mask."""
    return Points(*(getattr(points, f.name)[which] for f in fields(points)))


class _Keys:
    """The strips of stores: a key for each point, and a name for each key."""

    def __init__(self, stores: Sequence[PointStore]) -> None:
        self.stores = stores
        self.by = sorted({store.strips_by for store in stores})
        told = {store.path: sorted(map(int, store.attrs["strips"]["points"])) for store in stores}
        timed = [s for s in stores if s.strips_by not in (SOURCE, EDGES)]
        steps = np.unique([code for s in timed for code in told[s.path] if code])
        self._first = dict(zip(steps.tolist(), runs_of(steps).tolist()))
        self._found: set[Key] = set()
        self.several = len({(s.strips_by, c) for s in stores for c in told[s.path]}) > 1 or (
            len({day for s in stores for day in s.attrs["days"]}) > 1
        )

    def _of(self, store: PointStore, code: int, day: int) -> Key:
        by = store.strips_by
        if by == EDGES:
            return by, code, store.path.stem
        if by == SOURCE:
            return by, code, day_of(day) if day else ""
        return by, self._first.get(code, 0), ""

    def in_cell(self, row: int, col: int) -> tuple[Points, Codes, list[Key]]:
        """Points of a cell of all stores, the number of each one's strip, and the strips' keys."""
        points: list[Points] = []
        numbers: list[Codes] = []
        names: list[Key] = []
        for store in self.stores:
            cell = _cell_of(store, row, col)
            if cell is None:
                continue
            points.append(points_of_cell(store, cell))
            pairs = store.strips_of(cell).astype(np.int64) << 16 | points[-1].day
            distinct, which = np.unique(pairs, return_inverse=True)
            keys = [self._of(store, int(p >> 16), int(p & 0xFFFF)) for p in distinct]
            names += [key for key in dict.fromkeys(keys) if key not in names]
            numbers.append(np.array([names.index(key) for key in keys])[which])
        self._found.update(names)
        order = sorted(range(len(names)), key=lambda k: names[k])
        rank = np.empty(len(names), np.int64)
        rank[order] = np.arange(len(names))
        together = np.concatenate([np.empty(0, np.int64), *numbers])
        return Points.concatenate(points), rank[together], [names[k] for k in order]

    @property
    def names(self) -> dict[Key, str]:
        """What each strip that was found is called."""
        days: dict[tuple[str, int], set[str]] = {}
        for by, code, more in self._found:
            days.setdefault((by, code), set()).add(more)
        return {key: _name(key, len(days[key[:2]]) > 1) for key in self._found}


def _name(key: Key, on_days: bool) -> str:
    by, code, more = key
    if by == SOURCE:
        return f"{code} of {more}" if on_days and more else str(code)
    if by == EDGES:
        return f"{code + 1} of {more}"
    return f"from {(code - 1) * BIN_S:.0f} s" if code else "without time"


def _squares(points: Points, of: NDArray[np.bool_], row: int, col: int) -> NDArray[np.int64]:
    """Points by the squares of a cell."""
    shift = CELL_BITS - SQUARES.bit_length() + 1
    y, x = (
        (q[of] - (k << CELL_BITS)) >> shift for q, k in ((points.lat_q, row), (points.lon_q, col))
    )
    return np.bincount(y * SQUARES + x, minlength=SQUARES**2).reshape(SQUARES, SQUARES)


def _compared(
    points: Points, which: Codes, names: list[Key], row: int, col: int, number: int
) -> Iterator[tuple[tuple[Key, Key], Differences]]:
    """Every two strips of a cell on the planes that both have there."""
    firm = is_firm(points)
    points, which = chosen(points, firm), which[firm]
    at = metres_in_cell(points, row, col)
    counts = np.bincount(which, minlength=len(names))
    large = np.flatnonzero(counts > max(LEAST_SHARE * counts.sum(), 4 * LEAST_POINTS)).tolist()
    if len(large) < 2:
        return
    squares = squares_along([int(counts[k]) for k in large])
    planes = {}
    for k in large:
        own = which == k
        planes[k] = planes_of(chosen(points, own), at[own], row, col, squares)
    for i, a in enumerate(large):
        for b in large[i + 1 :]:
            found = compare(planes[a], planes[b], squares, number)
            if found.height.size:
                yield (names[a], names[b]), found


def open_for_comparison(paths: Sequence[str | Path]) -> list[PointStore]:
    """Point stores by their paths."""
    return [PointStore(path) for path in paths]
