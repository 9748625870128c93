"""A tile of a catalogue, and its outline in degrees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import ProjError

from ..numerics.degrees import continuous
from .declared_crs import interpret

Floats = NDArray[np.float64]
Row = tuple[Mapping[str, Any], tuple[Floats, ...]]  # of a tile index: columns, outline

MOST_TILES = 1_000_000
FARTHEST = 1e9  # coordinate, in metres or feet
SIDE_PARTS = 8  # of a side in a projection, which is no straight line in degrees


@dataclass(frozen=True)
class Tile:
    """A tile as a catalogue has it.

    ``href``: location as it stands there; ``rings``: its outline, [2, n] each, lon and lat in
    degrees, a place inside an odd number of them is inside; ``crs``: what the catalogue says of its
    coordinates (WKT or EPSG code), or empty; ``start``, ``end``: dates of its acquisition (ISO), or
    empty; ``points``: how many it has, or None.
    """

    href: str
    rings: tuple[Floats, ...]
    crs: str = ""
    start: str = ""
    end: str = ""
    points: int | None = None

    @property
    def box(self) -> tuple[float, float, float, float]:
        """West, south, east, north in degrees."""
        every = np.hstack(self.rings)
        low, high = every.min(axis=1).tolist(), every.max(axis=1).tolist()
        return low[0], low[1], high[0], high[1]


def in_degrees(rings: list[Floats], crs: CRS | None) -> tuple[Floats, ...]:
    """Rings [2, n] in longitude and latitude; empty if they lie nowhere on Earth, or are none.

    ``crs``: of their coordinates, east first; None: they are degrees. Sides are parted before they
    are bent by a projection.
    """
    if not rings or any(ring.ndim != 2 or ring.shape[1] < 3 for ring in rings):
        return ()
    if not all((np.abs(ring) < FARTHEST).all() for ring in rings):  # nor NaN
        return ()
    change: Callable[..., Any] | None = None
    if crs is not None:
        try:
            system = interpret(crs).horizontal
            pyproj.network.set_network_enabled(False)
            change = pyproj.Transformer.from_crs(system, "EPSG:4326", always_xy=True).transform
        except (ProjError, ValueError):
            return ()
        rings = [_parted(ring) for ring in rings]
    found = tuple(ring if change is None else np.stack(change(*ring)) for ring in rings)
    every = np.hstack(found)
    on_earth = np.isfinite(every).all() and (np.abs(every).max(axis=1) <= [180.0, 90.0]).all()
    return tuple(map(_in_one_piece, found)) if on_earth else ()


def _in_one_piece(ring: Floats) -> Floats:
    """A ring whose longitudes do not jump at the line of 180°, as those of footprints; one around
    the Earth as it is."""
    if {-180.0, 180.0} <= set(ring[0].tolist()):
        return ring
    return np.stack([continuous(ring[0]), ring[1]])


def _parted(ring: Floats) -> Floats:
    """A ring with more corners on straight lines between its own."""
    t = np.arange(SIDE_PARTS) / SIDE_PARTS
    after = np.roll(ring, -1, axis=1)
    return (ring[..., None] + (after - ring)[..., None] * t).reshape(2, -1)
