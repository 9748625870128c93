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

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import DEGREE_M
from .gps_times import day_of
from .lattice import CELL_BITS, LATTICE_DEG, PER_DEG
from .point_store import SQUARES, Points, PointStore
from .strip_codes import BIN_S, EDGES, SOURCE, TIME, runs_of
from .strip_network import Compared, Flown, adjusted_offsets
from .strip_offsets import SHARE, StripKey, StripOffsets
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

LEAST_SHARE = 0.002  # of a cell's points: fewer are compared with nothing


def compare_strips(stores: Sequence[PointStore]) -> StripOffsets:
    """What the strips of some point stores are off; of stores of one strip that alone.

    The order of the stores plays no part. Raises InputError if a store is damaged.
    """
    stores = sorted((s for s in stores if s.count), key=lambda s: s.path.name)
    keys = _Keys(stores)
    parts: dict[tuple[StripKey, StripKey], list[Differences]] = {}
    shares: list[tuple[int, int, StripKey, NDArray[np.int64]]] = []
    cells = sorted({cell for store in stores for cell in _cells(store)})
    for number, (row, col) in enumerate(cells if keys.several else ()):
        points, which, names = keys.in_cell(row, col)
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
    names, ground = keys.names, Counter[StripKey]()
    for row, _, key, squares in shares:
        side_m = (1 << CELL_BITS) * LATTICE_DEG / SQUARES * DEGREE_M
        narrow = np.cos(np.radians((row + 0.5) * (1 << CELL_BITS) * LATTICE_DEG))
        ground[key] += int((squares > 0).sum()) * side_m**2 * narrow
    flown = [Flown(names[key], key, round(area, 1)) for key, area in ground.items()]
    flown.sort(key=lambda strip: (-strip.ground_m2, strip.name))
    compared = [
        Compared(names[a], names[b], offset)
        for (a, b), found in sorted(parts.items(), key=lambda part: part[0])
        if (offset := offset_of(found)) is not None
    ]
    number_of = {strip.key: k for k, strip in enumerate(flown)}
    table = np.zeros(len(shares), SHARE)
    for k, (row, col, key, squares) in enumerate(shares):
        table[k] = row, col, number_of[key], np.minimum(squares, 65535)
    return adjusted_offsets(flown, compared, table)


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
        codes = {(s.strips_by, c) for s in stores for c in s.strip_counts}
        days = {day for store in stores for day in store.attrs["days"]}
        self.several = len(codes) > 1 or len(days) > 1
        steps = np.array(sorted({c for by, c in codes if by == TIME and c}), np.int64)
        first = runs_of(steps)
        last = {int(f): int(steps[first == f].max()) for f in np.unique(first)}
        self._runs = {int(step): (int(f), last[int(f)]) for step, f in zip(steps, first)}
        self._found: set[StripKey] = set()

    def _of(self, store: PointStore, code: int, day: int) -> StripKey:
        by = store.strips_by
        if by == TIME:
            return StripKey(by, *self._runs.get(code, (code, code)))
        return StripKey(by, code, code, more_of(store, day))

    def in_cell(self, row: int, col: int) -> tuple[Points, Codes, list[StripKey]]:
        """Points of a cell of all stores, the number of each one's strip, and the strips' keys."""
        points: list[Points] = []
        numbers: list[Codes] = []
        names: list[StripKey] = []
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
    def names(self) -> dict[StripKey, str]:
        """What each strip that was found is called."""
        days = Counter((key.by, key.first) for key in self._found)
        return {key: _name(key, days[key.by, key.first] > 1) for key in self._found}


def more_of(store: PointStore, day: int) -> str:
    """What tells the strip of a point besides its code: the file for numbers within it, and the day
    for ``point_source_id``, which each survey counts anew."""
    if store.strips_by == EDGES:
        return store.path.stem
    return day_of(day) if day and store.strips_by == SOURCE else ""


def _name(key: StripKey, on_days: bool) -> str:
    if key.by == SOURCE:
        return f"{key.first} of {key.more or 'no day'}" if on_days else str(key.first)
    if key.by == EDGES:
        return f"{key.first + 1} of {key.more}"
    return f"from {(key.first - 1) * BIN_S:.0f} s on" if key.first else "without time"


def _squares(points: Points, of: NDArray[np.bool_], row: int, col: int) -> NDArray[np.int64]:
    """Points by the squares of a cell."""
    shift = CELL_BITS - SQUARES.bit_length() + 1
    y, x = (
        (q[of] - (k << CELL_BITS)) >> shift for q, k in ((points.lat_q, row), (points.lon_q, col))
    )
    return np.bincount(y * SQUARES + x, minlength=SQUARES**2).reshape(SQUARES, SQUARES)


def _compared(
    points: Points, which: Codes, names: list[StripKey], row: int, col: int, number: int
) -> Iterator[tuple[tuple[StripKey, StripKey], Differences]]:
    """Every two strips of a cell on the planes that both have there."""
    firm = is_firm(points)
    points, which = chosen(points, firm), which[firm]
    at = metres_in_cell(points, row, col)
    counts = np.bincount(which, minlength=len(names))
    large = np.flatnonzero(counts > max(LEAST_SHARE * counts.sum(), 4 * LEAST_POINTS)).tolist()
    if len(large) < 2:
        return
    squares = squares_along([_squares(points, which == k, row, col) for k in large])
    planes = {}
    for k in large:
        own = which == k
        planes[k] = planes_of(chosen(points, own), at[own], row, col, squares)
    for i, a in enumerate(large):
        for b in large[i + 1 :]:
            found = compare(planes[a], planes[b], squares, number)
            if found.height.size:
                yield (names[a], names[b]), found
