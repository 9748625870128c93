"""Which file of a Zarr store is damaged, for the decoders do not say."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import zarr

from ..errors import InputError

DECODERS = ("zarr", "numcodecs")  # packages whose frames stand in the traceback of a bad chunk


def damage_behind(error: BaseException, inputs: Iterable[str | Path]) -> InputError | None:
    """The damaged chunk of the ``inputs`` that made an error; None if the error has another cause.

    Reads the stores among the inputs, so it is for a job that has failed anyhow.
    """
    if not any(_decoding(one) for one in _chain(error)):
        return None
    for path in map(Path, inputs):
        if (path / "zarr.json").is_file() and (file := damaged_chunk(path)):
            return InputError(
                "damaged: it cannot be decoded",
                file=file,
                remedy=f"delete {path} and run the workflow again",
            )
    return None


def damaged_chunk(store: Path) -> Path | None:
    """The first file of a store, or of its metadata, that cannot be read; None if all can."""
    try:
        arrays = [array for _, array in zarr.open_group(store, mode="r").arrays()]
    except Exception:  # decoders fail as they like
        return store / "zarr.json"
    for array in arrays:
        size = array.shards or array.chunks
        for at in np.ndindex(*(-(-n // step) for n, step in zip(array.shape, size))):
            window = tuple(slice(k * step, (k + 1) * step) for k, step in zip(at, size))
            try:
                array[window]
            except Exception:
                return store.joinpath(array.basename, "c", *map(str, at))
    return None


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        if isinstance(error, BaseExceptionGroup):
            for one in error.exceptions:
                yield from _chain(one)
        error = error.__cause__ or error.__context__


def _decoding(error: BaseException) -> bool:
    frames = traceback.extract_tb(error.__traceback__)
    return any(set(Path(frame.filename).parts) & set(DECODERS) for frame in frames)
