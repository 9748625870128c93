"""Parts of LiDAR files by path, URL or stand-in; parts that came from afar are kept.

A run that is made again reads nothing from a network: each part that a server or a bucket has sent
is kept in ``results/copies``, by the file's URL, its size and what its server calls its content. A
file that has changed has other parts. Each copy has a checksum behind it; one that does not fit is
fetched again. :func:`prune` keeps the folder within its limit.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO
from urllib.parse import urlsplit

from ..errors import InputError, without_secrets
from ..products.ranges import LocalRanges, Ranges, RangeStream, WebRanges
from ..products.remote_files import (
    answering,
    bucket,
    hosts_of,
    is_remote,
    refuse_changed,
    same_as_stand_in,
    url_of,
)
from ..products.web_requests import WEB

FOLDER = Path("results", "copies")
STREAM_BYTES = 4 << 20  # of a file that is read as a whole, at once
GLANCE_BYTES = 1 << 16  # of one of which the head is read, or some points
CHECK_BYTES = 4  # CRC-32 behind a copy


class StandInRanges(Ranges):
    """What a stand-in stands for: copies of its parts where there are any, else its server.

    ``opened``: asks the server, and gives its ranges; what it says the file is has to be what the
    stand-in says. It is called for the first part that is not there.
    """

    def __init__(self, place: Path, url: str, opened: Callable[[], Ranges]) -> None:
        state = json.loads(place.read_text())
        self.name, self.size = without_secrets(url), int(state["size"])
        self._content, self._opened, self._lock = str(state["content"]), opened, Lock()
        self._source: Ranges | None = None
        self._copies = copies_of(place, url)

    def _get(self, start: int, end: int) -> bytes:
        return kept(
            self._copies, f"{start}-{end}", lambda: self._ask().get(start, end), end - start
        )

    def _ask(self) -> Ranges:
        with self._lock:
            if self._source is None:
                self._source = same_as_stand_in(self._opened(), self.size, self._content)
            return self._source


class BucketRanges(Ranges):
    """A file of object storage, as its stand-in says it is."""

    def __init__(self, place: Path, url: str) -> None:
        refuse_changed(place)
        state = json.loads(place.read_text())
        self.name, self.size, self.content = url, int(state["size"]), str(state["content"])
        self._storage, self._file = bucket(url)

    def _get(self, start: int, end: int) -> bytes:
        with answering(self.name):
            content = self._storage.cat_file(self._file, start=start, end=end)
        if len(content) != end - start:
            raise InputError(
                f"{len(content)} bytes came of {end - start}",
                file=self.name,
                remedy="run again, and leave it alone until the run has ended",
            )
        return content


def open_ranges(location: str | Path, **how: Any) -> Ranges:
    """A path, a URL of a web server, or the stand-in of one or of an object of a bucket.

    ``how``: see :class:`..products.ranges.WebRanges`.
    """
    if is_remote(str(location)):
        return WebRanges(str(location), **how)
    place = Path(location)
    if (url := url_of(place)) is None:
        return LocalRanges(place)
    if urlsplit(url).scheme not in WEB:
        return StandInRanges(place, url, lambda: BucketRanges(place, url))
    hosts = how.pop("allow_hosts", frozenset()) | hosts_of(place)
    return StandInRanges(place, url, lambda: WebRanges(url, allow_hosts=hosts, **how))


def open_stream(path: str | Path, block_bytes: int = STREAM_BYTES) -> BinaryIO:
    """A LiDAR file, or what it stands for, by blocks that are kept."""
    if url_of(path) is None:
        return Path(path).open("rb")
    return io.BufferedReader(RangeStream(open_ranges(path), block_bytes))


def copies_of(place: Path, url: str) -> Path | None:
    """Where copies of what a stand-in stands for are kept; None if its server names no content."""
    state = json.loads(place.read_text())
    if not state["content"]:
        return None
    key = json.dumps([without_secrets(url), int(state["size"]), str(state["content"])])
    return FOLDER / hashlib.sha256(key.encode()).hexdigest()[:32]


def kept(
    folder: Path | None, name: str, fetch: Callable[[], bytes], length: int | None = None
) -> bytes:
    """The copy of that name, if it is whole and of that length; else what is fetched, and kept."""
    if folder is None:
        return fetch()
    copy = folder / name.replace("/", ".")
    if (content := _read(copy, length)) is None:
        content = fetch()
        _keep(copy, content)
    return content


def _read(copy: Path, length: int | None) -> bytes | None:
    """A copy, if it is there and whole."""
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


def _keep(copy: Path, content: bytes) -> None:
    """Write a copy atomically; a disk that does not take it is no harm."""
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
