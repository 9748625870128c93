"""Parts of a file by path or stand-in; parts that came from afar are kept.

A run that is made again reads nothing from a network: each part that a server or a bucket has sent
is kept in ``results/copies``, by the file's URL, its size and what its server calls its content. A
file that has changed has other parts. Each copy has a checksum behind it; one that does not fit is
fetched again. :func:`prune` keeps the folder within its limit.

fsspec's own cache on the disk (``blockcache``) is not used: it notes blocks as held before they
have come, so that after a failed request it gives zeros in their place.
"""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, cast

from ..errors import InputError, without_secrets
from .remote_files import Ranges, State, ranges_reader, url_of

FOLDER = Path("results", "copies")
STREAM_BYTES = 4 << 20  # of a file that is read as a whole, at once
GLANCE_BYTES = 1 << 16  # of one of which the head is read, or some points
BLOCKS_HELD = 3  # of a stream, in memory
GAP_BYTES = 1 << 12  # between two ranges that one request serves
REQUEST_BYTES = 4 << 20  # of merged ranges; a single one may have more
MOST_BYTES = 256 << 20  # of one range
CHECK_BYTES = 4  # CRC-32 behind a copy


class FileParts(ABC):
    """A file of which parts are read. ``name``: path or URL; ``size`` in bytes."""

    name: str
    size: int

    def get(self, ranges: Ranges) -> list[bytes]:
        """The bytes of each range; in memory all at once. Raises InputError if there are less."""
        for start, end in ranges:
            if not 0 <= start <= end <= self.size or end - start > MOST_BYTES:
                raise InputError(
                    f"truncated or damaged: bytes {start} to {end} of {self.size} are asked for",
                    file=self.name,
                    remedy="fetch or write the file again",
                )
        return self._get(ranges)

    @abstractmethod
    def _get(self, ranges: Ranges) -> list[bytes]: ...


class LocalParts(FileParts):
    """A file on the disk, which has to stay the same."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(
                "no such LiDAR file", file=path, remedy="correct the path in scenes.tsv"
            )
        state = path.stat()
        self.name, self.size, self._path = str(path), state.st_size, path
        self._state = _identity(state)

    def _get(self, ranges: Ranges) -> list[bytes]:
        with self._path.open("rb") as stream:
            contents = [os.pread(stream.fileno(), end - start, start) for start, end in ranges]
            same = _identity(os.fstat(stream.fileno())) == self._state
        if not same or sum(map(len, contents)) != sum(end - start for start, end in ranges):
            raise InputError(
                "changed while it was read",
                file=self._path,
                remedy="run again, and leave it alone until the run has ended",
            )
        return contents


def _identity(state: os.stat_result) -> tuple[int, int, int]:
    return state.st_ino, state.st_size, state.st_mtime_ns


class RemoteParts(FileParts):
    """What a stand-in stands for: copies of its parts where there are any, else its server.

    Ranges that are near to each other are asked for, and kept, as one.
    """

    def __init__(self, place: Path, url: str, keep: bool) -> None:
        self.name, self._place = without_secrets(url), place
        self.size = State.held(place).size
        self._copies = copies_of(place, url) if keep else None
        self._read: Callable[[Ranges], list[bytes]] | None = None  # for what is not held

    def _get(self, ranges: Ranges) -> list[bytes]:
        from fsspec.utils import merge_offset_ranges

        paths = [self.name] * len(ranges)
        _, starts, ends = merge_offset_ranges(
            paths, [s for s, _ in ranges], [e for _, e in ranges], GAP_BYTES, REQUEST_BYTES
        )
        merged = list(zip(starts, ends))
        held = {part: read_copy(self._copies, _name(part), part[1] - part[0]) for part in merged}
        missing = [part for part, content in held.items() if content is None]
        if missing:
            self._read = self._read or ranges_reader(self._place)
            for part, content in zip(missing, self._read(missing)):
                keep_copy(self._copies, _name(part), content)
                held[part] = content
        contents = []
        for start, end in ranges:
            at = bisect_right(starts, start) - 1
            contents.append((held[merged[at]] or b"")[start - starts[at] : end - starts[at]])
        return contents


def _name(part: tuple[int, int]) -> str:
    return f"{part[0]}-{part[1]}"


def open_parts(path: str | Path, *, keep: bool = True) -> FileParts:
    """A path, or the stand-in of a file of a web server or of an object of a bucket.

    Not to ``keep`` copies of what comes is for files that are read once.
    """
    place, url = Path(path), url_of(path)
    return LocalParts(place) if url is None else RemoteParts(place, url, keep)


def open_stream(
    path: str | Path, block_bytes: int = STREAM_BYTES, *, keep: bool = True
) -> BinaryIO:
    """A file, or what it stands for by blocks that are kept, as a stream."""
    if url_of(path) is None:
        return Path(path).open("rb")
    from fsspec.spec import AbstractBufferedFile

    parts = open_parts(path, keep=keep)

    class Stream(AbstractBufferedFile):
        def _fetch_range(self, start: int, end: int) -> bytes:
            return parts.get([(start, min(end, parts.size))])[0]

    how = {"cache_type": "blockcache", "cache_options": {"maxblocks": BLOCKS_HELD}}
    stream = Stream(None, parts.name, block_size=block_bytes, size=parts.size, **how)
    return cast(BinaryIO, stream)


def copies_of(place: Path, url: str) -> Path | None:
    """Where copies of what a stand-in stands for are kept; None if its server names no content."""
    size, content, _ = State.held(place)
    if not content:
        return None
    key = json.dumps([without_secrets(url), size, content])
    return FOLDER / hashlib.sha256(key.encode()).hexdigest()[:32]


def kept(folder: Path | None, name: str, fetch: Callable[[], bytes]) -> bytes:
    """The copy of that name, if it is whole; else what is fetched, and kept."""
    if (content := read_copy(folder, name)) is None:
        content = fetch()
        keep_copy(folder, name, content)
    return content


def read_copy(folder: Path | None, name: str, length: int | None = None) -> bytes | None:
    """The copy of that name, if it is there, whole and of that length."""
    if folder is None:
        return None
    copy = folder / name.replace("/", ".")
    try:
        content = copy.read_bytes()
    except OSError:
        return None
    body = content[:-CHECK_BYTES]
    whole = content[-CHECK_BYTES:] == zlib.crc32(body).to_bytes(CHECK_BYTES, "little")
    if length not in (None, len(body)) or not whole:
        return None
    with suppress(OSError):
        os.utime(copy)
    return body


def keep_copy(folder: Path | None, name: str, content: bytes) -> None:
    """Write a copy atomically; a disk that does not take it is no harm."""
    if folder is None:
        return
    copy = folder / name.replace("/", ".")
    scratch = copy.with_name(f".{copy.name}.{os.getpid()}")
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(content + zlib.crc32(content).to_bytes(CHECK_BYTES, "little"))
        scratch.replace(copy)
    except OSError:
        with suppress(OSError):
            scratch.unlink()


def prune(limit_bytes: float) -> None:
    """Remove the copies that were not used for the longest time, until no more bytes are kept."""
    copies = []
    for file in FOLDER.glob("*/*"):
        with suppress(OSError):  # of another job, which prunes as well
            state = file.stat()
            copies.append((state.st_mtime_ns, state.st_size, file))
    total = sum(size for _, size, _ in copies)
    for _, size, file in sorted(copies):
        if total <= limit_bytes:
            break
        with suppress(OSError):
            file.unlink()
        total -= size
    for folder in FOLDER.glob("*"):
        with suppress(OSError):  # not empty
            folder.rmdir()
