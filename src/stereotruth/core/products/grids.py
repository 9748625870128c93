"""Zarr stores that are whole or absent: pixel grids and others.

A store is built as :func:`.files.atomic_folder` writes folders and gets the attribute ``complete``
last, so that a killed run never leaves something that looks finished; the one opener of each kind
of store checks that attribute.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from traceback import format_exception
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import zarr
from zarr.abc.buffer import Buffer
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec
from zarr.storage import LocalStore

from ..errors import InputError
from .files import atomic_file, atomic_folder
from .provenance import digest

if TYPE_CHECKING:
    import xarray as xr

Piece = TypeVar("Piece")
METADATA = "zarr.json"  # of a store: all of its arrays' with its own
SEAL = "metadata_digest"  # attribute of a store
CONVENTIONS = (
    "arrays are [y, x]; pixel (0, 0) is the centre of the upper-left pixel; "
    "disparity = x_left - x_right in px of the epipolar grid"
)


def damaged_store(error: BaseException, inputs: Iterable[str | Path]) -> InputError | None:
    """The damaged Zarr store among a failed job's ``inputs``; None if it failed for another cause.

    Reads all chunks, so it is for a job that has failed anyhow.
    """
    if f"{os.sep}zarr{os.sep}" not in "".join(format_exception(error)):
        return None
    for store in map(Path, inputs):
        if not (store / "zarr.json").is_file():
            continue
        try:
            for _, array in zarr.open_group(store, mode="r").arrays():
                step = (array.shards or array.chunks)[0]
                for first in range(0, array.shape[0], step):
                    array[first : first + step]
        except Exception as refusal:  # decoders fail as they like
            return InputError(
                f"damaged Zarr store ({refusal})",
                file=store,
                remedy="delete it and run the workflow again",
            )
    return None


@dataclass(frozen=True)
class Layer:
    """One array of a grid: its type, what a pixel that was never written holds, and attributes.

    ``attrs`` must hold ``units`` and ``long_name``.
    """

    dtype: str
    fill: float | int
    attrs: Mapping[str, Any] = field(default_factory=dict)


def compressors() -> tuple[BloscCodec, Crc32cCodec]:
    """The lossless codecs of every grid: the same bytes on every machine.

    Ten times as fast as zstd 3 with byte shuffle (0.8-1.2 GB/s), images no larger, floats by a
    quarter. Each chunk carries a checksum: one that is damaged cannot be read.
    """
    return BloscCodec(cname="lz4", clevel=5, shuffle=BloscShuffle.bitshuffle), Crc32cCodec()


class PlainStore(LocalStore):
    """A store in a folder for one writer; makes no hard links, which exFAT does not have."""

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Set a key that is not there yet."""
        if not await self.exists(key):
            await self.set(key, value)


@contextmanager
def atomic_store(path: str | Path) -> Iterator[Path]:
    """An empty scratch folder whose store becomes ``path`` if the block ends well."""
    with atomic_folder(path) as scratch:
        yield scratch
        group = zarr.open_group(scratch, mode="r+")
        group.attrs["complete"] = True
        with warnings.catch_warnings():  # an extension of Zarr v3 that xarray reads by default
            warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
            zarr.consolidate_metadata(group.store)
        seal(scratch)


def seal(path: Path) -> None:
    """Have the consolidated metadata keep a digest of their own."""
    file = path / METADATA
    found = json.loads(file.read_bytes())
    found["attributes"].pop(SEAL, None)
    found["attributes"][SEAL] = digest(found)
    file.write_text(json.dumps(found, indent=2))


def create_grid(
    path: str | Path,
    shape: tuple[int, int],
    layers: Mapping[str, Layer],
    *,
    chunk: int,
    shard: int,
    attrs: Mapping[str, Any],
    of: str = "epipolar grid",
) -> dict[str, zarr.Array]:
    """An empty [y, x] grid store of Zarr v3; returns its arrays by name.

    Arrays are stored in square chunks of ``chunk`` px inside shard files of ``shard`` px (a
    multiple). Writers must write whole shards: two writers in one shard spoil it. Coordinates
    ``x`` and ``y`` hold the pixel's column and row ``of`` the grid. Pixels never written take no
    space.
    """
    if shard % chunk:
        raise ValueError(f"shard of {shard} px is no multiple of the chunk of {chunk} px")
    group = zarr.open_group(PlainStore(path), mode="w", zarr_format=3)
    group.attrs.update({"conventions": CONVENTIONS, **attrs})
    arrays = {}
    for name, layer in layers.items():
        arrays[name] = group.create_array(
            name,
            shape=shape,
            dtype=layer.dtype,
            chunks=(chunk, chunk),
            shards=(shard, shard),
            fill_value=layer.fill,
            compressors=compressors(),
            dimension_names=("y", "x"),
            attributes=dict(layer.attrs),
        )
    for name, size, axis in (("y", shape[0], "row"), ("x", shape[1], "column")):
        coordinate = group.create_array(
            name,
            shape=(size,),
            dtype="int32",
            chunks=(size,),
            compressors=compressors(),
            dimension_names=(name,),
            attributes={"units": "px", "long_name": f"{axis} of the {of}"},
        )
        coordinate[:] = np.arange(size, dtype="int32")
    return arrays


def blocks(shape: tuple[int, int], size: int) -> list[tuple[slice, slice]]:
    """[row, col] windows of at most ``size`` px that cover a grid, in row-major order."""
    return [
        (slice(r, min(r + size, shape[0])), slice(c, min(c + size, shape[1])))
        for r in range(0, shape[0], size)
        for c in range(0, shape[1], size)
    ]


@dataclass(frozen=True)
class Strip:
    """What one of several jobs makes of a product: part ``number`` (from 0 on) of ``count``."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Strip:
        """From ``3-of-8``."""
        number, _, count = text.partition("-of-")
        return cls(int(number), int(count))

    @classmethod
    def of_wildcards(cls, wildcards: Any) -> Strip | None:
        """That of a job of the workflow; None for one that makes a whole grid."""
        text = wildcards.get("strip")
        return cls.parse(text) if text else None

    def __str__(self) -> str:
        return f"{self.number}-of-{self.count}"

    def of(self, windows: list[tuple[slice, slice]]) -> list[tuple[slice, slice]]:
        """The windows in the strip's rows: equal numbers of rows of windows."""
        starts = sorted({rows.start for rows, _ in windows})
        own = self.share(starts, [1] * len(starts))
        return [window for window in windows if window[0].start in own]

    def share(self, pieces: Sequence[Piece], weights: Sequence[int]) -> list[Piece]:
        """The strip's pieces of all, one after the other: equal sums of weights, nearly."""
        total = max(sum(weights), 1)
        middles = [2 * end - weight for end, weight in zip(accumulate(weights), weights)]
        strips = (middle * self.count // (2 * total) for middle in middles)
        return [piece for piece, strip in zip(pieces, strips) if strip == self.number]

    def tell(self, path: str | Path) -> None:
        """Write the file that tells that the strip is made."""
        with atomic_file(path) as scratch:
            scratch.write_text(f'{{"strip": "{self}"}}\n')


def _damaged(path: str | Path, why: str) -> InputError:
    return InputError(
        f"damaged Zarr store ({why})",
        file=path,
        remedy="delete it and run the workflow again",
    )


def require_complete(path: str | Path) -> zarr.Group:
    """Open a store's group for reading.

    Raises InputError if it is missing or was not finished.
    """
    try:
        group = zarr.open_group(path, mode="r")
        complete = group.attrs.get("complete", False)
        found = json.loads(Path(path, METADATA).read_bytes())
        whole = not complete or found["attributes"].pop(SEAL, None) == digest(found)
    except FileNotFoundError as error:
        raise InputError(
            "no such Zarr store", file=path, remedy="run the stage that makes it"
        ) from error
    except Exception as error:  # whatever a damaged zarr.json makes of Zarr
        raise _damaged(path, type(error).__name__) from error
    if not whole:
        raise _damaged(path, f"{METADATA} is not what was written")
    if not complete:
        raise InputError(
            "half-written Zarr store", file=path, remedy="delete it and run the workflow again"
        )
    return group


def open_grid(path: str | Path) -> xr.Dataset:
    """A finished grid store as a lazy xarray Dataset, whose windows are read straight from Zarr.

    Coordinates ``x`` and ``y`` are the pixels' columns and rows, whole numbers at their centres.
    Each array has its ``units`` and ``long_name``, the dataset the epipolar model (``epipolar``)
    and what it was made of. A pixel without a value holds NaN or what ``nodata`` says. Raises
    InputError if the store is missing, was not finished or is damaged.
    """
    import xarray as xr  # a quarter of a job's start-up, and most jobs need none

    require_complete(path)
    try:
        return xr.open_zarr(path, consolidated=True, mask_and_scale=False, chunks=None)
    except Exception as error:
        raise _damaged(path, type(error).__name__) from error
