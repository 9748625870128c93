"""Which run of the workflow is the newest in a folder; older ones publish nothing any more.

Jobs may outlive their run: it is killed, the batch system goes on. A run begins by writing its
name where the jobs of all runs see it, and a job looks there before each of its products takes its
place. What slips through in between is not what the newer run's record says, and made again.
"""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import threading
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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

    def is_newest(self) -> bool:
        """Whether no other run has begun since."""
        return _newest(self._folder) in ("", self.name)

    def refuse_older(self) -> None:
        """Raise InputError if another run has begun since."""
        if not self.is_newest():
            raise InputError(
                "another run has begun here since; this job is of an earlier one and publishes "
                "nothing",
                file=Path.cwd(),
                remedy="none is needed, the other run makes what it needs",
            )

    @contextmanager
    def watched(self) -> Iterator[None]:
        """End this process soon after another run has begun."""
        ended = threading.Event()

        def look() -> None:
            while not ended.wait(SECONDS):
                if not self.is_newest():
                    log.error("error: another run has begun here since: this job ends")
                    os._exit(1)

        threading.Thread(target=look, daemon=True).start()
        try:
            yield
        finally:
            ended.set()


def _process(pid: int) -> dict[str, Any]:
    """What tells a process from all others, of other machines and times too (Linux)."""
    return {
        "boot": Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
        "pids": str(Path("/proc/self/ns/pid").readlink()),
        "pid": pid,
        "start": Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19],
    }


@contextmanager
def listed(folder: Path = KEPT) -> Iterator[None]:
    """This process is among those that :func:`end_older_jobs` ends, if its run has been killed."""
    file = folder / "jobs" / f"{uuid.uuid4().hex}.json"
    try:
        me = _process(os.getpid())
    except OSError:  # no Linux
        yield
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(me))
    try:
        yield
    finally:
        file.unlink(missing_ok=True)


def end_older_jobs(folder: Path = KEPT) -> None:
    """Kill what is left on this machine of earlier runs that were killed.

    They could publish nothing, and one that is stopped would keep its locks.
    """
    for file in (folder / "jobs").glob("*.json"):
        try:
            known = json.loads(file.read_text())
            here = _process(os.getpid())
        except (OSError, json.JSONDecodeError):
            continue
        if any(known.get(key) != here[key] for key in ("boot", "pids")) or known == here:
            continue
        if _end(known):
            log.warning("process %d of an earlier run was still at work: ended", known["pid"])
        file.unlink(missing_ok=True)


def _end(known: Mapping[str, Any]) -> bool:
    """Kill a process, if it is that one still."""
    try:
        handle = os.pidfd_open(known["pid"])  # never that of a later process of the same number
    except OSError:
        return False
    try:
        if _process(known["pid"]) != known:
            return False
        signal.pidfd_send_signal(handle, signal.SIGKILL)
        select.select([handle], [], [], 30.0)
        return True
    except OSError:
        return False
    finally:
        os.close(handle)
