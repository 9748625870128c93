"""Who works on the blocks of a grid: threads of this job, or the workers of a Dask cluster."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .errors import InputError

log = logging.getLogger("stereotruth")


@contextmanager
def dask_scheduler(address: str | None, seconds: float = 30.0) -> Iterator[Any]:
    """What Dask's compute takes as its scheduler; it is waited for so many ``seconds``.

    ``address`` of a running Dask scheduler (``tcp://host:8786``), or None for threads. Its workers
    need this package and must see the files under the same paths.

    Raises InputError if nothing answers there, or if `distributed` is not installed.
    """
    if not address:
        yield "threads"
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            f"dask.scheduler_address is {address}, but distributed is not installed",
            remedy="pip install 'stereotruth[cluster]', or set it to null",
        ) from error
    try:
        client = Client(address, timeout=seconds)
    except OSError as error:
        raise InputError(
            f"no Dask scheduler answers ({error})",
            file=address,
            remedy="start it, correct dask.scheduler_address, or set it to null",
        ) from error
    with client:
        log.info("blocks go to the Dask workers of %s", address)
        yield client
