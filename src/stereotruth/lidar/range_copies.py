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
        key = json.dumps([self.name, self.size, self._content])
        self._folder = FOLDER / hashlib.sha256(key.encode()).hexdigest()[:32]

    def _get(self, start: int, end: int) -> bytes:
        kept = self._folder / f"{start}-{end}"
        if self._content and (content := _read(kept, end - start)) is not None:
            return content
        content = self._ask().get(start, end)
        if self._content:
            _keep(kept, content)
        return content

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


def _read(kept: Path, length: int) -> bytes | None:
    """A copy, if it is there and whole."""
    try:
        content = kept.read_bytes()
    except OSError:
        return None
    body = content[:-CHECK_BYTES]
    whole = content[-CHECK_BYTES:] == zlib.crc32(body).to_bytes(CHECK_BYTES, "little")
    if len(body) != length or not whole:
        return None
    with suppress(OSError):
        os.utime(kept)
    return body


def _keep(kept: Path, content: bytes) -> None:
    """Write a copy atomically; a disk that does not take it is no harm."""
    scratch = kept.with_name(f".{kept.name}.{os.getpid()}")
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(content + zlib.crc32(content).to_bytes(CHECK_BYTES, "little"))
        scratch.replace(kept)
    except OSError:
        with suppress(OSError):
            scratch.unlink()


def prune(limit_bytes: float) -> None:
    """Remove the copies that were not used for the longest time, until no more bytes are kept."""
    kept = []
    for file in FOLDER.glob("*/*"):
        with suppress(OSError):  # of another job, which prunes as well
            state = file.stat()
            kept.append((state.st_mtime_ns, state.st_size, file))
    total = sum(size for _, size, _ in kept)
    for _, size, file in sorted(kept):
        if total <= limit_bytes:
            break
        with suppress(OSError):
            file.unlink()
        total -= size
    for folder in FOLDER.glob("*"):
        with suppress(OSError):  # not empty
            folder.rmdir()
