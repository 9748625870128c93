"""What each strip of a site's LiDAR is off, where its points lie, and points moved by that.

The record of strips is a folder:

==============  ==================================================================================
``strips.json`` strips by name, with ground, offset and covariance, chance, and a digest
``shares.npy``  SHARE[n]: points of a strip by the squares of a cell, of sites of several strips
==============  ==================================================================================
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import exact_metres_per_degree
from ..core.products.files import atomic_folder, read_record, sealed
from .cell_sort import SCRATCH_POINTS, SortedRuns, bounds_of
from .lattice import CELL_BITS, CELL_DEG, PER_DEG, PER_M
from .point_fields import EDGES, NO_LIMITS, SOURCE, day_of
from .point_store import SQUARES, PointStore

log = logging.getLogger("stereotruth")

RECORD, SHARES = "strips.json", "shares.npy"
MOST_TOLD = 8  # strips in a sentence
SHARE = np.dtype(
    [("row", "<i4"), ("col", "<i4"), ("strip", "<u2"), ("points", "<u2", (SQUARES, SQUARES))]
)
UNITS = {
    "offset_m": "east, north, up: m that the strip lies off the strip that it is tied_to",
    "covariance_m2": "of the offset, m²",
    "ground_m2": "ground that the strip's points cover",
    "chance": "probability of so large an offset if there were none, of all strips together",
}


@dataclass(frozen=True, order=True)
class StripKey:
    """What tells the points of a strip: the ``by`` of their store, codes from ``first`` to
    ``last``, and ``more``: the day that they were measured on (ISO), the file that they are of, or
    nothing."""

    by: str
    first: int
    last: int
    more: str = ""


@dataclass(frozen=True)
class Strip:
    """A strip: ``key`` of its points; ``tied_to`` names the strip that its ``offset_m`` (east,
    north, up) counts from, itself for that strip, "" for one that overlaps no other. ``named``:
    beyond noise."""

    name: str
    key: StripKey
    ground_m2: float
    tied_to: str
    offset_m: tuple[float, float, float]
    covariance_m2: tuple[tuple[float, float, float], ...]
    chance: float
    named: bool

    @property
    def sigma_m(self) -> Floats:
        """Standard uncertainty of the offset [3], m."""
        return np.sqrt(np.diagonal(np.array(self.covariance_m2)))

    def __str__(self) -> str:
        east, north, up = self.offset_m
        sigma = self.sigma_m
        return (
            f"strip {self.name} lies {up:+.3f} ± {sigma[2]:.3f} m in height, {east:+.2f} ± "
            f"{sigma[0]:.2f} m east and {north:+.2f} ± {sigma[1]:.2f} m north of strip "
            f"{self.tied_to}"
        )


@dataclass(frozen=True, eq=False)
class StripOffsets:
    """The strips of a site, that with most ground first. ``shares``: of :data:`SHARE`, ``strip``
    being the index into ``strips``. ``taken_out``: points are moved by the offsets."""

    strips: tuple[Strip, ...]
    shares: NDArray[np.void] = field(repr=False)
    taken_out: bool = False

    @property
    def named(self) -> tuple[Strip, ...]:
        """The strips whose offsets are beyond noise."""
        return tuple(strip for strip in self.strips if strip.named)

    @property
    def sentence(self) -> str:
        """What is to be said of the offsets; empty if no strip is named."""
        if not self.named:
            return ""
        some = "; ".join(map(str, self.named[:MOST_TOLD]))
        more = f"; and {len(self.named) - MOST_TOLD} more" if len(self.named) > MOST_TOLD else ""
        end = "; points are moved by that" if self.taken_out else ""
        return f"strips of the LiDAR disagree: {some}{more}{end}"

    @property
    def most_in_plan_m(self) -> float:
        """How far in plan the strip that is farthest off lies from the mean of all by their ground;
        0 if no strip is named, or the offsets are taken out of the points."""
        if not self.named or self.taken_out:
            return 0.0
        plan = np.array([strip.offset_m[:2] for strip in self.strips])
        mean = np.average(plan, axis=0, weights=[strip.ground_m2 for strip in self.strips])
        return float(np.hypot(*(plan - mean).T).max())

    def report(self) -> dict[str, Any] | None:
        """JSON-ready, for people: ``sentence``, and a row for each strip; None of one strip."""
        if len(self.strips) < 2:
            return None
        rows = []
        for strip in self.strips:
            row: dict[str, Any] = {"strip": strip.name, "told_by": strip.key.by}
            row["ground_km2"] = round(strip.ground_m2 / 1e6, 4)
            row["off"] = strip.tied_to
            is_free = strip.tied_to not in ("", strip.name)
            for name, value, sigma in zip(("east", "north", "up"), strip.offset_m, strip.sigma_m):
                row[f"{name}_m"] = round(value, 4) if is_free else None
                row[f"{name}_sigma_m"] = round(float(sigma), 4) if is_free else None
            row["beyond_noise"] = strip.named
            rows.append(row)
        return {"sentence": self.sentence, "taken_out": self.taken_out, "strips": rows}

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, without the shares."""
        strips = [asdict(strip) for strip in self.strips]
        return {"kind": "strips", "units": UNITS, "taken_out": self.taken_out, "strips": strips}

    def write(self, folder: str | Path, provenance: Mapping[str, Any] | None = None) -> None:
        """Write the folder; it appears when it is whole."""
        with atomic_folder(folder) as scratch:
            np.save(scratch / SHARES, self.shares)
            crc32 = zlib.crc32((scratch / SHARES).read_bytes())
            values = {**self.to_dict(), "shares_crc32": crc32, "provenance": dict(provenance or {})}
            (scratch / RECORD).write_text(sealed(values), encoding="utf-8")

    @classmethod
    def read(cls, folder: str | Path) -> StripOffsets:
        """What :meth:`write` wrote. Raises InputError if it is missing or damaged."""
        folder = Path(folder)

        def made(values: Mapping[str, Any]) -> StripOffsets:
            file = folder / SHARES
            data = file.read_bytes()
            if zlib.crc32(data) != values["shares_crc32"]:
                raise InputError(
                    "damaged: it is not what was written",
                    file=file,
                    remedy=f"delete {folder} and run the workflow again",
                )
            strips = tuple(
                Strip(**{
                    **strip,
                    "key": StripKey(**strip["key"]),
                    "offset_m": tuple(strip["offset_m"]),
                    "covariance_m2": tuple(map(tuple, strip["covariance_m2"])),
                })
                for strip in values["strips"]
            )  # fmt: skip
            return cls(strips, np.load(BytesIO(data)), values["taken_out"])

        return read_record(folder / RECORD, made, what="record of strips", stage="strips")


def more_of(store: PointStore, day: int) -> str:
    """What tells the strip of a point besides its code: the file for numbers within it, and the day
    for ``point_source_id``, which each survey counts anew."""
    if store.strips_by == EDGES:
        return store.path.stem
    return day_of(day) if day and store.strips_by == SOURCE else ""


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

    def offset_m(code: int, day: int) -> tuple[float, float, float]:
        more = more_of(source, day)
        for strip in strips.named:
            key = strip.key
            if key.by == source.strips_by and key.first <= code <= key.last and key.more == more:
                return strip.offset_m
        return 0.0, 0.0, 0.0

    limits, moved = NO_LIMITS.copy(), 0
    with atomic_folder(out) as unfinished, TemporaryFile(dir=unfinished.parent) as disk:
        runs = SortedRuns.of(min(SCRATCH_POINTS, source.count), disk)
        for cell in range(source.cell_row.size):
            words, points = source.words_of(cell), source.points_of(cell)
            codes = source.strips_of(cell)
            pairs = codes.astype(np.int64) << 16 | points.day
            distinct, which = np.unique(pairs, return_inverse=True)
            offsets = np.array([offset_m(int(p >> 16), int(p & 0xFFFF)) for p in distinct])
            moved += int(offsets.any(axis=1)[which].sum())
            low, high = source.cell_heights[cell] / PER_M
            lat = float(source.cell_row[cell] + 0.5) * CELL_DEG
            metres = np.array([*exact_metres_per_degree(lat, float(low + high) / 2), 1.0])
            steps = offsets.T / metres[:, None] * np.array([[PER_DEG], [PER_DEG], [PER_M]])
            lattice = np.stack([points.lon_q, points.lat_q, points.h_q])
            lattice -= np.rint(steps).astype(np.int64)[:, which]
            limits[0] = np.minimum(limits[0], lattice.min(axis=1))
            limits[1] = np.maximum(limits[1], lattice.max(axis=1))
            attributes = words[:, 0] >> CELL_BITS | words[:, 1] >> CELL_BITS << 16
            runs.add(lattice, attributes, codes.astype(np.uint32))
        attrs = dict(source.attrs)
        attrs["bounds"] = bounds_of(limits) if source.count else list(source.bounds)
        attrs["provenance"] = dict(provenance or {})
        runs.write(unfinished, attrs, 0 if len(source.strip_counts) > 1 else None)
    log.info("%s: %d of %d points moved", source.path.name, moved, source.count)
