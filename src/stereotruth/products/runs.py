"""Which run of the workflow is the newest in a folder; jobs of older ones write nothing any more.

Jobs may outlive their run: it is killed, the batch system goes on. A run begins by writing its
name where the jobs of all runs see it. A job looks there every few seconds, and before each of its
products takes its place. What slips through in between is not what the newer run's record says, and
made again.
"""

from __future__ import annotations

import logging
import os
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError

log = logging.getLogger("stereotruth")

KEPT = Path(".snakemake", "stereotruth")  # copied and deleted with Snakemake's own records
RUN = "STEREOTRUTH_RUN"  # variable of the environment: the run that a job belongs to
SECONDS = 5.0  # between two looks whether there is a newer run


def _newest(folder: Path) -> str:
    try:
        return (folder / "run").read_text()
    except OSError:  # deleted, or a file server that is away for a moment
        return ""


def begin_run(folder: Path = KEPT) -> None:
    """Make a new run the newest; its jobs get its name by the environment."""
    name = uuid.uuid4().hex
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "run").write_text(name)  # in place: other machines may have it open
    os.environ[RUN] = name


class Run:
    """The run that this job belongs to."""

    def __init__(self, folder: Path = KEPT) -> None:
        self._folder = folder
        self.name = os.environ.get(RUN) or _newest(folder)

    def _is_newest(self) -> bool:
        return _newest(self._folder) in ("", self.name)

    def refuse_older(self) -> None:
        """Raise InputError if another run has begun since."""
        if not self._is_newest():
            raise InputError(
                "another run has begun here since; this job is of an earlier one and writes "
                "nothing",
                file=Path.cwd(),
                remedy="none is needed, the other run makes what it needs",
            )

    @contextmanager
    def watched(self) -> Iterator[None]:
        """End this process soon after another run has begun, which waits for its locks."""
        ended = threading.Event()

        def look() -> None:
            while not ended.wait(SECONDS):
                if not self._is_newest():
                    log.error("error: another run has begun here since: this job ends")
                    os._exit(1)

        threading.Thread(target=look, daemon=True).start()
        try:
            yield
        finally:
            ended.set()
