"""Dask workers that tell which blocks they make, and take their time."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from distributed import WorkerPlugin

SECONDS = 1.5  # that a block takes at least: workers come and go meanwhile


@dataclass
class Told:
    """Of each block, the jobs of SLURM that have begun and ended to make it, in their order."""

    begun: dict[str, list[int]]
    ended: dict[str, list[int]]


def read(file: Path) -> Told:
    told = Told(defaultdict(list), defaultdict(list))
    for line in file.read_text().splitlines() if file.exists() else ():
        what, job, block = line.split()
        getattr(told, what)[block].append(int(job))
    return told


class Telling(WorkerPlugin):
    """Writes a line for each block that a worker begins and ends to make."""

    name = "telling"

    def __init__(self, file: Path) -> None:
        self.file = file

    def setup(self, worker: object) -> None:
        from stereotruth.core.products.resumable_grids import BlockStore

        job, file = os.environ["SLURM_JOB_ID"], self.file
        has, write = BlockStore.has, BlockStore.write

        def tell(what: str, block: tuple) -> None:
            with file.open("a") as stream:
                stream.write(f"{what} {job} {block[0].start}-{block[1].start}\n")

        def has_and_tell(self: BlockStore, block: tuple, key: str) -> bool:
            if found := has(self, block, key):
                return found
            tell("begun", block)
            time.sleep(SECONDS)
            return found

        def write_and_tell(self: BlockStore, block: tuple, *values: object) -> None:
            write(self, block, *values)
            tell("ended", block)

        BlockStore.has, BlockStore.write = has_and_tell, write_and_tell
