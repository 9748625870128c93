"""Whether files and folders are still what they were: by size, time and inode, then by checksum.

A stamp is what the file system says of a file, or of all files in a folder. Where two stamps are
equal nothing was written in between, but for a file written within the coarsest tick of a file
system's clock (two seconds) before the first: of such ones checksums are compared.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from . import remote_files
from .folders import files_below, is_foreign
from .provenance import file_sha256

TICK_NS = 2_000_000_000  # of the clocks of file systems, at most
# What runs write in the working directory, which may lie in the folder of a dataset.
WRITTEN_BY_RUNS = ("results", "logs", "benchmark", "audit")
MADE = ("results", "tiles", "dataset", "originals", "benchmark", "audit", "submission", "score")


@dataclass(frozen=True)
class Stamp:
    """What the file system says; ``young`` if a write soon after might not show in it.

    ``place`` (names, sizes, times of writing, inodes) changes if a file is written or replaced;
    ``change`` (times of change) with rights and links as well.
    """

    place: str
    change: str
    young: bool


def _is_made(folder: Path) -> bool:
    """Whether a folder is a product: who looks at it leaves files there that are none of it."""
    here = Path.cwd()
    inside = folder.relative_to(here) if folder.is_relative_to(here) else folder
    top = inside.parts[0] if inside.parts else ""
    return top.split("_")[0] in MADE


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

    made = _is_made(path)
    for file in files_below(path, enter):
        if not (file.name.startswith(".") or (made and is_foreign(file.name))):
            yield str(file.relative_to(path)), file


def _fresh(file: Path) -> os.stat_result:
    """The state of a file that is opened for it: a network file system then asks its server."""
    with file.open("rb") as stream:
        return os.fstat(stream.fileno())


def stamp(path: str | Path) -> Stamp:
    """The stamp of a file or folder; of none, if it is missing."""
    place, change, newest = hashlib.sha256(), hashlib.sha256(), 0
    for name, file in _files(Path(path)):
        try:
            state = file.stat() if name else _fresh(file)
        except FileNotFoundError:
            continue
        # no number of the device: other machines have others for the same file
        row = [name, state.st_size, state.st_mtime_ns, state.st_ino]
        place.update(json.dumps(row).encode())
        change.update(f"{state.st_ctime_ns} ".encode())
        newest = max(newest, state.st_mtime_ns, state.st_ctime_ns)
    young = newest > time.time_ns() - TICK_NS
    return Stamp(place.hexdigest(), change.hexdigest(), young)


def file_checksums(path: str | Path) -> dict[str, str]:
    """SHA-256 of all files in a folder by their names in it; of a file itself, under no name."""
    return {name: file_sha256(file) for name, file in _files(Path(path))}


def combined(sums: Mapping[str, str]) -> str:
    """One checksum for a file, or for the names and checksums of all files in a folder."""
    if "" in sums:
        return sums[""]
    lines = (f"{value} {name}\n" for name, value in sums.items())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def checksum(path: str | Path) -> str:
    """SHA-256 of a file, or of the names and checksums of all files in a folder."""
    return combined(file_checksums(path))


class Checksums:
    """Checksums by path; those of files that are no longer young are kept in a folder."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def of(self, path: str | Path) -> tuple[Stamp, str]:
        """Stamp and checksum of a file or folder. Raises InputError if it cannot be read."""
        kept = self.folder / hashlib.sha256(str(Path(path).absolute()).encode()).hexdigest()
        try:
            now = stamp(path)
            place, change, found = self._read(kept)
            if (place, change) != (now.place, now.change):
                found = checksum(path)
                if not now.young and stamp(path) == now:
                    self._write(kept, f"{now.place} {now.change} {found}")
        except OSError as error:
            raise InputError(
                f"cannot be read: {error.strerror}",
                file=error.filename or path,
                remedy="see that it is there, and that you may read it",
            ) from None
        return now, found

    def _read(self, kept: Path) -> tuple[str, str, str]:
        try:
            place, change, found = kept.read_text().split()
        except (OSError, ValueError):
            return "", "", ""
        return place, change, found

    def _write(self, kept: Path, text: str) -> None:
        scratch = kept.with_name(f"{kept.name}.{os.getpid()}")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            scratch.write_text(text)
            scratch.replace(kept)
        except OSError:  # a full disk, one that is read-only: it will be computed again
            with suppress(OSError):
                scratch.unlink()


class Inputs:
    """The files and folders that something is made of, as they were when the making began."""

    def __init__(self, paths: Iterable[str | Path], known: Checksums) -> None:
        self._found = {str(path): known.of(path) for path in paths}

    @property
    def checksums(self) -> Mapping[str, str]:
        """Checksum by path."""
        return {path: found for path, (_, found) in self._found.items()}

    def refuse_changed(self) -> None:
        """Raise InputError if one of them was written or replaced, if only for a while.

        Of files that lie elsewhere, if they are others than when the run began.
        """
        for path, (before, found) in self._found.items():
            now = stamp(path)
            same = now.place == before.place
            if same and (before.young or now.change != before.change):
                same = checksum(path) == found
            if not same:
                raise changed(path)
            remote_files.refuse_changed(path)


def changed(path: str | Path) -> InputError:
    """What to say of a file that was written while something was made of it."""
    return InputError(
        "changed while it was being used; what was made of it is dropped",
        file=path,
        remedy="run again, and leave it alone until the run has ended",
    )


Marks = Mapping[str, tuple[int, ...]]


def marks(paths: Iterable[str | Path]) -> Marks:
    """What tells at the cost of one call each that files, or whole folders, were replaced."""
    return {str(Path(path).absolute()): _mark(Path(path)) for path in paths}


def refuse_replaced(before: Marks) -> None:
    """Raise InputError if a file was written or replaced, or a folder replaced, since then."""
    for path, mark in before.items():
        if _mark(Path(path)) != mark:
            raise changed(path)


def _mark(path: Path) -> tuple[int, ...]:
    try:
        state = path.stat()
    except FileNotFoundError:
        return ()
    if path.is_dir():  # the workflow's own are replaced, never written into
        return (state.st_ino,)
    return state.st_ino, state.st_size, state.st_mtime_ns
