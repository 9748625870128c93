"""Points moved by what their strips are off: a point store made of another one."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from ..core.numerics.geometry import exact_metres_per_degree
from ..core.products.files import atomic_folder, sealed
from .cell_sort import RUN_WORDS, SCRATCH_POINTS, SortedRuns
from .ingest import _bounds
from .las_files import _no_limits
from .lattice import CELL_BITS, LATTICE_DEG, PER_DEG, PER_M
from .point_store import ATTRIBUTES, PointStore
from .strip_comparison import more_of, points_of_cell
from .strip_offsets import StripOffsets

log = logging.getLogger("stereotruth")


def move_strips(
    store: str | Path,
    strips: StripOffsets,
    out: str | Path,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a point store whose points are those of ``store`` less the offsets of their strips.

    Strips that are not named stay where they are. Raises InputError if the store is damaged.
    """
    source = PointStore(store)
    limits = _no_limits()
    with atomic_folder(out) as unfinished, TemporaryFile(dir=unfinished.parent) as disk:
        room = min(SCRATCH_POINTS, source.count)
        runs = SortedRuns(np.empty((room, RUN_WORDS), "<u4"), disk)
        moved = 0
        for cell in range(source.cell_row.size):
            words, points = source.words_of(cell), points_of_cell(source, cell)
            codes = source.strips_of(cell)
            pairs = codes.astype(np.int64) << 16 | points.day
            distinct, which = np.unique(pairs, return_inverse=True)
            offsets = np.array(
                [_offset(source, strips, int(p >> 16), int(p & 0xFFFF)) for p in distinct]
            )
            moved += int(offsets.any(axis=1)[which].sum())
            lattice = np.stack([points.lon_q, points.lat_q, points.h_q])
            lattice -= _steps(offsets, source, cell)[:, which]
            limits[0] = np.minimum(limits[0], lattice.min(axis=1))
            limits[1] = np.maximum(limits[1], lattice.max(axis=1))
            attributes = words[:, 0] >> CELL_BITS | words[:, 1] >> CELL_BITS << 16
            runs.add(lattice, attributes, codes.astype(np.uint32))
        told = dict(source.attrs["strips"])
        several = len(source.strip_counts) > 1
        cells_crc32, told["crc32"] = runs.write(unfinished, 0 if several else None)
        bounds = _bounds(*limits) if source.count else list(source.bounds)
        attrs = {
            **source.attrs,
            "cells_crc32": cells_crc32,
            "bounds": bounds,
            "strips": told,
            "provenance": dict(provenance or {}),
        }
        (unfinished / ATTRIBUTES).write_text(sealed(attrs), encoding="utf-8")
    log.info("%s: %d of %d points moved", source.path.name, moved, source.count)


def _offset(
    store: PointStore, strips: StripOffsets, code: int, day: int
) -> tuple[float, float, float]:
    """What the strip of a store's points of a code and a day is off, m; 0 if it is not named."""
    more = more_of(store, day)
    for strip in strips.named:
        key = strip.key
        if key.by == store.strips_by and key.first <= code <= key.last and key.more == more:
            return strip.offset_m
    return 0.0, 0.0, 0.0


def _steps(offsets: np.ndarray, store: PointStore, cell: int) -> np.ndarray:
    """Offsets [n, 3] (m) at a cell in steps of the lattice [3, n]."""
    lat = (store.cell_row[cell] + 0.5) * (1 << CELL_BITS) * LATTICE_DEG
    low, high = store.cell_heights[cell] / PER_M
    per_degree = exact_metres_per_degree(float(lat), float(low + high) / 2)
    steps = (
        offsets.T / np.array([*per_degree, 1.0])[:, None] * np.array([[PER_DEG]] * 2 + [[PER_M]])
    )
    return np.rint(steps).astype(np.int64)
