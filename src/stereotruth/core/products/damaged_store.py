"""Which store a job failed on: Zarr refuses a damaged chunk without a word on where it lies."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from traceback import format_exception

import zarr

from ..errors import InputError


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
