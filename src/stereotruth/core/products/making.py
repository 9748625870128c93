"""A job of the workflow: the only one that makes its products, of inputs that stay as they are.

Checksums of large inputs are kept with a stamp: what the file system says of a file, or of all
files in a folder. Where two stamps are equal nothing was written in between, but for a file written
within the coarsest tick of a file system's clock (two seconds) before: of such ones no checksum is
kept. Locks are `flock` on files: the kernel drops them when a process ends, however it ends. On
file systems without locks work goes on with a warning.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import shutil
import socket
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..job import FAILED, RUN_NOTES, job
from . import remote_files
from .files import files_below
from .provenance import digest, file_sha256

TICK_NS = 2_000_000_000  # of the clocks of file systems, at most
# What runs write in the working directory, which may lie in the folder of a dataset.
WRITTEN_BY_RUNS = ("results", "logs", "benchmark", "audit")

Marks = Mapping[str, tuple[int, ...]]

log = logging.getLogger("stereotruth")

MADE = RUN_NOTES / "made"  # what the jobs of a run have made
_inputs: Marks = {}  # of this process's job


def _files(path: Path) -> Iterator[tuple[str, Path]]:
    """All files in a folder, by name, links followed; or the file itself."""
    if not path.is_dir():
        yield "", path
        return
    here = Path.cwd()
    around = here.is_relative_to(path.absolute())
    written = {here / name for name in WRITTEN_BY_RUNS} if around else set()

    def enter(folder: Path) -> bool:
        return not folder.name.startswith(".") and folder.absolute() not in written

    for file in files_below(path, enter):
        if not file.name.startswith("."):
            yield str(file.relative_to(path)), file


def stamp(path: str | Path) -> tuple[str, bool]:
    """Digest of what the file system says of a file or folder; whether it was written just now."""
    found, newest = hashlib.sha256(), 0
    for name, file in _files(Path(path)):
        if name:
            state = file.stat()
        else:
            with file.open("rb") as stream:  # a network file system then asks its server
                state = os.fstat(stream.fileno())
        times = state.st_mtime_ns, state.st_ctime_ns
        # no number of the device: other machines have others for the same file
        found.update(json.dumps([name, state.st_size, state.st_ino, *times]).encode())
        newest = max(newest, *times)
    return found.hexdigest(), newest > time.time_ns() - TICK_NS


def checksum(path: str | Path) -> str:
    """SHA-256 of a file, or of the names and checksums of all files in a folder."""
    sums = {name: file_sha256(file) for name, file in _files(Path(path))}
    if "" in sums:
        return sums[""]
    lines = (f"{value} {name}\n" for name, value in sums.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


class Checksums:
    """Checksums by path; those of files that were not written just now are kept in a folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def of(self, path: str | Path) -> str:
        """Checksum of a file or folder. Raises InputError if it cannot be read."""
        kept = self.folder / hashlib.sha256(str(Path(path).absolute()).encode()).hexdigest()
        try:
            now = stamp(path)
            before, found = self._read(kept)
            if before != now[0]:
                found = checksum(path)
                if not now[1] and stamp(path) == now:
                    self._write(kept, f"{now[0]} {found}")
        except OSError as error:
            raise InputError(
                f"cannot be read: {error.strerror}",
                file=error.filename or path,
                remedy="see that it is there, and that you may read it",
            ) from None
        return found

    def _read(self, kept: Path) -> tuple[str, str]:
        try:
            before, found = kept.read_text().split()
        except (OSError, ValueError):
            return "", ""
        return before, found

    def _write(self, kept: Path, text: str) -> None:
        scratch = kept.with_name(f"{kept.name}.{os.getpid()}")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            scratch.write_text(text)
            scratch.replace(kept)
        except OSError:  # a full disk, one that is read-only: it will be computed again
            with suppress(OSError):
                scratch.unlink()


def marks(paths: Iterable[str | Path]) -> Marks:
    """What tells at the cost of one call each that files, or whole folders, were replaced."""
    return {str(Path(path).absolute()): _mark(Path(path)) for path in paths}


def refuse_replaced(before: Marks) -> None:
    """Raise InputError if a file was written or replaced, or a folder replaced, since then."""
    for path, mark in before.items():
        if _mark(Path(path)) != mark:
            raise InputError(
                "changed while it was being used; what was made of it is dropped",
                file=path,
                remedy="run again, and leave it alone until the run has ended",
            )


def _mark(path: Path) -> tuple[int, ...]:
    try:
        state = path.stat()
    except FileNotFoundError:
        return ()
    if path.is_dir():  # the workflow's own are replaced, never written into
        return (state.st_ino,)
    return state.st_ino, state.st_size, state.st_mtime_ns


class FileLock:
    """A lock on a file, which is made if it is missing: held alone, or shared by several."""

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self._descriptor = os.open(self.file, os.O_RDWR | os.O_CREAT, 0o666)

    def take(self, what: str | Path, *, shared: bool = False, wait: bool = True) -> bool:
        """Take the lock, or change between shared and exclusive; False if it is not free.

        ``what`` names in messages what is guarded. With ``wait`` it is waited for.
        """
        mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(self._descriptor, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                return False
            log.info("%s: waiting for %s, which is at work there", what, self.holder)
            fcntl.flock(self._descriptor, mode)
        except OSError as error:
            log.warning("%s: no file locks here (%s)", what, error.strerror)
        if not shared:
            os.ftruncate(self._descriptor, 0)
            me = f"process {os.getpid()} on {socket.gethostname()}"
            os.pwrite(self._descriptor, me.encode(), 0)
        return True

    @property
    def holder(self) -> str:
        """Who has held the lock alone last."""
        return os.pread(self._descriptor, 200, 0).decode(errors="replace") or "another process"

    @property
    def current(self) -> bool:
        """Whether the file is still the one that was opened."""
        try:
            return self.file.stat().st_ino == os.fstat(self._descriptor).st_ino
        except FileNotFoundError:
            return False

    def close(self) -> None:
        """Give the lock back."""
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)


@contextmanager
def exclusive(path: str | Path) -> Iterator[None]:
    """Be the only process that writes ``path``; wait while another one does.

    The lock file lies beside ``path`` (``.<name>.lock``) for as long as the lock is held.
    """
    path = Path(path)
    while True:
        lock = FileLock(path.with_name(f".{path.name}.lock"))
        lock.take(path)
        if lock.current:
            break
        lock.close()  # the holder before has removed its file: a lock on that one guards nothing
    try:
        yield
    finally:
        lock.file.unlink(missing_ok=True)
        lock.close()


@contextmanager
def making(inputs: Iterable[str | Path], outputs: Sequence[str | Path]) -> Iterator[None]:
    """Make files and folders ``outputs`` of ``inputs``, as the only process that does.

    A job of a run that was killed may still be at work on them: this one waits until it has ended,
    so that what it makes is there last. Raises InputError if an input was written or replaced
    meanwhile, if only for a while; the products are then dropped by Snakemake.
    """
    global _inputs
    inputs = [str(path) for path in inputs]
    with exclusive(outputs[0]):
        _inputs = marks(inputs)
        try:
            yield
            refuse_replaced(_inputs)
            for path in inputs:
                remote_files.refuse_changed(path)
            names = [str(path) for path in outputs]  # one file a job: several nodes may write
            with suppress(FileNotFoundError):  # no run of the workflow
                (MADE / digest(names)).write_text(json.dumps(names))
        except (InputError, OSError):
            raise
        except Exception as error:
            from .grids import damaged_store  # few jobs fail, and not all need Zarr

            if damage := damaged_store(error, inputs):
                raise damage from error
            raise
        finally:
            _inputs = {}


@contextmanager
def rule_job(snakemake: Any, name: str) -> Iterator[logging.Logger]:
    """All that a job of a rule does, in its script: see :func:`..job.job`, and :func:`making`."""
    with job(snakemake.log[0], name) as lines, making(snakemake.input, snakemake.output):
        yield lines


def begin_notes() -> None:
    """Have the jobs of a run that begins note what they make, and why they fail."""
    shutil.rmtree(RUN_NOTES, ignore_errors=True)
    for folder in (MADE, FAILED):
        folder.mkdir(parents=True, exist_ok=True)


def noted() -> list[str]:
    """Files and folders that the jobs of the newest run have made."""
    return [path for file in sorted(MADE.glob("*")) for path in json.loads(file.read_text())]


def marks_of_inputs() -> Marks:
    """What tells cheaply whether the inputs of this process's job were replaced since it began."""
    return _inputs
