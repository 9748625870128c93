"""Whether files and folders are still what they were: by size, time and inode, then by checksum.

Checksums of large inputs are kept with a stamp: what the file system says of a file, or of all
files in a folder. Where two stamps are equal nothing was written in between, but for a file written
within the coarsest tick of a file system's clock (two seconds) before: of such ones no checksum is
kept.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from ..errors import InputError
from .folders import files_below
from .provenance import file_sha256

TICK_NS = 2_000_000_000  # of the clocks of file systems, at most
# What runs write in the working directory, which may lie in the folder of a dataset.
WRITTEN_BY_RUNS = ("results", "logs", "benchmark", "audit")


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


def _fresh(file: Path) -> os.stat_result:
    """The state of a file that is opened for it: a network file system then asks its server."""
    with file.open("rb") as stream:
        return os.fstat(stream.fileno())


def stamp(path: str | Path) -> tuple[str, bool]:
    """Digest of what the file system says of a file or folder; whether it was written just now."""
    found, newest = hashlib.sha256(), 0
    for name, file in _files(Path(path)):
        state = file.stat() if name else _fresh(file)
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


Marks = Mapping[str, tuple[int, ...]]


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
