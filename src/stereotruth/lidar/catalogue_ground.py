"""Which tiles of a catalogue touch a footprint, and where no tile or more than one covers it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .catalogue_tiles import Tile
from .footprint import CELL_DEG, Footprint

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

PARTS = 16  # of a cell's side: 7 m, by which covered ground is told
MOST_PLACES = 8_000_000  # so many of them in memory; larger footprints have coarser ones
DOUBLED_SHARE = 0.5  # of the smaller one of two tiles that cover the same ground


@dataclass(frozen=True)
class Cover:
    """What a catalogue's tiles are to a footprint.

    ``taken``: indices of the tiles that touch it; ``area_m2`` of the footprint, ``hole_m2`` of it
    in no tile, ``hole_at``: lon and lat in the middle of the cell with most of that, None without a
    hole. ``doubled``: pairs of taken tiles that have most of their ground in common.
    """

    taken: tuple[int, ...]
    area_m2: float
    hole_m2: float
    hole_at: tuple[float, float] | None
    doubled: tuple[tuple[int, int], ...]


def cover_of(tiles: Sequence[Tile], footprint: Footprint) -> Cover:
    """How the tiles cover the footprint; whether they touch it is told in whole cells around."""
    boxes = np.array([tile.box for tile in tiles]).reshape(-1, 4)
    near = np.flatnonzero(footprint.touches(boxes))
    taken = [int(k) for k in near if (_cells(tiles[k].rings, footprint) & footprint.held).any()]
    rows, cols = footprint.held.shape
    parts = int(np.clip(np.sqrt(MOST_PLACES / footprint.held.size), 1, PARTS))
    x = (footprint.col + (np.arange(cols * parts) + 0.5) / parts) * CELL_DEG
    y = (footprint.row + (np.arange(rows * parts) + 0.5) / parts) * CELL_DEG
    held = footprint.held.repeat(parts, axis=0).repeat(parts, axis=1)
    first = np.full(held.shape, -1, np.int32)  # tile that covers a place
    sizes: dict[int, int] = {}
    doubled = []
    for tile in taken:
        window = _window(boxes[tile], x, y)
        inside = _inside(tiles[tile].rings, x[window[1]], y[window[0]]) & held[window]
        before = first[window]  # a view
        counts = np.bincount(before[inside] + 1, minlength=1)
        sizes[tile] = int(inside.sum())
        for other in np.flatnonzero(counts[1:]).tolist():
            if counts[other + 1] >= DOUBLED_SHARE * min(sizes[tile], sizes[other]):
                doubled.append((other, tile))
        before[inside & (before < 0)] = tile
    open_places = ((first < 0) & held).reshape(rows, parts, cols, parts).sum(axis=(1, 3))
    hole_m2 = float((open_places.sum(axis=1) / parts**2) @ footprint.cell_m2)
    hole_at = None
    if hole_m2 > 0:
        row, col = np.unravel_index(np.argmax(open_places), open_places.shape)
        at = np.array([footprint.col + col, footprint.row + row]) + 0.5
        hole_at = float(at[0] * CELL_DEG), float(at[1] * CELL_DEG)
    return Cover(tuple(taken), footprint.area_m2, hole_m2, hole_at, tuple(doubled))


def _window(box: Floats, x: Floats, y: Floats) -> tuple[slice, slice]:
    """Rows and columns of the places in a box."""
    west, south, east, north = box
    return (
        slice(int(np.searchsorted(y, south)), int(np.searchsorted(y, north, "right"))),
        slice(int(np.searchsorted(x, west)), int(np.searchsorted(x, east, "right"))),
    )


def _inside(rings: Sequence[Floats], x: Floats, y: Floats) -> Bools:
    """Which places of a grid [y, x] are inside an odd number of rings, by their crossings east."""
    ax, ay = np.hstack(rings)
    bx, by = np.hstack([np.roll(ring, -1, axis=1) for ring in rings])
    inside = np.zeros((y.size, x.size), np.bool_)
    for row, at in enumerate(y.tolist()):
        meets = (ay > at) != (by > at)
        if meets.any():
            a, b = np.stack([ax[meets], ay[meets]]), np.stack([bx[meets], by[meets]])
            crossings = np.sort(a[0] + (at - a[1]) * (b[0] - a[0]) / (b[1] - a[1]))
            inside[row] = np.searchsorted(crossings, x) % 2 == 1
    return inside


def _cells(rings: Sequence[Floats], footprint: Footprint) -> Bools:
    """Cells of the footprint's frame that an outline touches, and their neighbours."""
    rows, cols = footprint.held.shape
    x = (footprint.col + np.arange(cols) + 0.5) * CELL_DEG
    y = (footprint.row + np.arange(rows) + 0.5) * CELL_DEG
    cells = _inside(rings, x, y)
    corner = np.array([[footprint.col], [footprint.row]]) * CELL_DEG
    size = np.array([[cols], [rows]])
    for ring in rings:
        start, end = ((ends - corner) / CELL_DEG for ends in (ring, np.roll(ring, -1, axis=1)))
        near = (np.maximum(start, end) >= -1).all(axis=0)
        near &= (np.minimum(start, end) <= size + 1).all(axis=0)
        for a, b in zip(start[:, near].T, end[:, near].T):
            at = _along(a, b, size.ravel())
            good = ((at >= 0) & (at < size)).all(axis=0)
            cells[at[1, good], at[0, good]] = True
    wide = np.pad(cells, 1)
    return np.logical_or.reduce(
        [wide[1 + i : 1 + i + rows, 1 + j : 1 + j + cols] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    )


def _along(a: Floats, b: Floats, size: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells [2, n] along a side, as far as it lies near the frame; every one, or its neighbour."""
    low, high = np.full(2, -2.0), size + 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.sort([(low - a) / (b - a), (high - a) / (b - a)], axis=0)
    still = a == b
    first = max(0.0, float(np.where(still, 0.0, t[0]).max()))
    last = min(1.0, float(np.where(still, 1.0, t[1]).min()))
    if first > last:
        return np.zeros((2, 0), np.int64)
    count = 2 + int(4 * np.abs((b - a) * (last - first)).max())
    places = a[:, None] + (b - a)[:, None] * np.linspace(first, last, count)
    return np.floor(places).astype(np.int64)
