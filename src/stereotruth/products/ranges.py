"""Parts of files, from the disk or a web server: several at once, each as long as was asked for.

A server is asked for ranges of bytes. What it answers is held against the range, and against what
it said of the file before (size, ETag, time of the last change). Short answers, wrong ranges, lost
connections and servers that are busy or stall are asked again, in the server's pace, until
:class:`WebRanges` loses its patience. Source: RFC 9110, sections 14 and 15.
"""

from __future__ import annotations

import io
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

from ..errors import InputError, without_secrets
from .web_requests import (
    ABSENT,
    AGAIN,
    Again,
    answer_of,
    body_of,
    patiently,
    refusal,
    refuse_busy,
    refuse_encoded,
    web_parts,
)

Item, Result = TypeVar("Item"), TypeVar("Result")
Range = tuple[int, int]  # first byte, and the one behind the last

GAP_BYTES = 1 << 12  # between two ranges that one request serves
REQUEST_BYTES = 4 << 20  # of merged ranges; a single one may have more
AT_ONCE = 4  # requests
MOST_BYTES = 256 << 20  # of one range
PATIENCE_S = 300.0  # with one range, all tries together
STALL_SHARE = 0.1  # of the patience: so long without a byte, and the request is made again
FIRST_WAIT_S = 0.5  # before the second try
MOST_TRIES = 8
BLOCKS_HELD = 3  # of a stream


class Ranges(ABC):
    """A file of which parts are read. ``name``: path or URL without secrets; ``size`` in bytes.

    ``content``: what its server calls its content (ETag, or time of the last change); may be empty.
    """

    name: str
    size: int
    content: str = ""

    def get(self, start: int, end: int) -> bytes:
        """Bytes ``start`` to ``end``, the latter excluded. Raises InputError if there are less."""
        if not 0 <= start <= end <= self.size:
            raise InputError(
                f"truncated or damaged: bytes {start} to {end} of {self.size} are asked for",
                file=self.name,
                remedy="fetch or write the file again",
            )
        if end - start > MOST_BYTES:
            raise InputError(
                f"damaged: a part of {end - start} bytes, more than {MOST_BYTES}",
                file=self.name,
                remedy="fetch or write the file again",
            )
        return self._get(start, end) if end > start else b""

    @abstractmethod
    def _get(self, start: int, end: int) -> bytes: ...

    def peek(self, starts: Sequence[int], length: int) -> list[bytes]:
        """So many bytes at each of many places, where that costs no request; else none."""
        return []

    def parts(self, ranges: Sequence[Range]) -> Iterator[bytes]:
        """Each of the ranges, in the given order.

        Neighbours are read together. At most :data:`AT_ONCE` requests run or wait to be taken.
        """
        groups = merged(ranges)
        contents = in_turn(groups, lambda group: self.get(group[0][0], max(e for _, e in group)))
        for group, content in zip(groups, contents):
            for start, end in group:
                yield content[start - group[0][0] : end - group[0][0]]


def in_turn(items: Sequence[Item], work: Callable[[Item], Result]) -> Iterator[Result]:
    """``work(item)`` of each item, in their order; :data:`AT_ONCE` run or wait to be taken."""
    coming: deque[Future[Result]] = deque()
    pool = ThreadPoolExecutor(AT_ONCE)
    try:
        ahead = iter(items)
        for _ in items:
            coming.extend(pool.submit(work, item) for item in islice(ahead, AT_ONCE - len(coming)))
            yield coming.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def merged(ranges: Sequence[Range]) -> list[list[Range]]:
    """The ranges in their order, parted into groups of one request each."""
    groups: list[list[Range]] = []
    for start, end in ranges:
        if groups:
            group = groups[-1]
            last = group[-1][1]
            near = 0 <= start - last <= GAP_BYTES
            if near and end - group[0][0] <= REQUEST_BYTES:
                group.append((start, end))
                continue
        groups.append([(start, end)])
    return groups


class LocalRanges(Ranges):
    """A file on the disk, which has to stay the same."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(
                "no such LiDAR file", file=path, remedy="correct the path in scenes.tsv"
            )
        state = path.stat()
        self.name, self.size, self._path = str(path), state.st_size, path
        self._state = _identity(state)

    def _get(self, start: int, end: int) -> bytes:
        with self._path.open("rb") as stream:
            stream.seek(start)
            content = stream.read(end - start)
            same = _identity(os.fstat(stream.fileno())) == self._state
        if not same or len(content) < end - start:
            raise InputError(
                "changed while it was read",
                file=self._path,
                remedy="run again, and leave it alone until the run has ended",
            )
        return content

    def peek(self, starts: Sequence[int], length: int) -> list[bytes]:
        """So many bytes at each of many places; fewer at the end of the file."""
        with self._path.open("rb") as stream:
            return [os.pread(stream.fileno(), length, start) for start in starts]


def _identity(state: os.stat_result) -> tuple[int, int, int]:
    return state.st_ino, state.st_size, state.st_mtime_ns


class WebRanges(Ranges):
    """A file of a web server, of which the first ``head_bytes`` are asked for at once.

    ``patience_s`` bounds how long one range is waited for, all tries together.
    """

    def __init__(
        self,
        url: str,
        *,
        allow_hosts: frozenset[str] = frozenset(),
        patience_s: float = PATIENCE_S,
        head_bytes: int = 1 << 14,
    ) -> None:
        web_parts(url, url)
        self.name, self._url = without_secrets(url), url
        self._hosts, self._patience_s = allow_hosts, patience_s
        self._lock = Lock()
        self.size = -1
        self._head = self._get(0, head_bytes)

    def _get(self, start: int, end: int) -> bytes:
        if self.size >= 0 and end <= len(self._head):
            return self._head[start:end]
        return patiently(
            lambda until: self._ask(start, end, until),
            self._url,
            self._patience_s,
            MOST_TRIES,
            FIRST_WAIT_S,
        )

    def _ask(self, start: int, end: int, until: float) -> bytes:
        """One request and what follows from its redirects. Raises Again, InputError."""
        header = {"Range": f"bytes={start}-{end - 1}"}
        stall_s = STALL_SHARE * self._patience_s
        with answer_of("GET", self._url, self._hosts, until, header, stall_s) as answer:
            self._refuse_other(answer)
            first, last, size = _content_range(answer.headers.get("Content-Range"))
            self._same(size, answer.headers)
            end = min(end, size)
            if (first, last + 1) != (start, end):
                raise Again(f"it sends bytes {first} to {last}, asked for {start} to {end - 1}")
            content = body_of(answer, end - start, until, self._url)
        if len(content) != end - start:
            more = "more than" if len(content) > end - start else f"{len(content)} of"
            raise Again(f"it sends {more} {end - start} bytes")
        return content

    def _refuse_other(self, answer: Any) -> None:
        """Raise Again or InputError for an answer that is no part of a file."""
        refuse_busy(answer)
        status = answer.status
        if status in ABSENT:
            raise InputError("no such file there", file=self.name, remedy="correct its URL")
        if status in (401, 403):
            raise self._refusal(f"it answers {status}, no permission", "get the right to read it")
        if status == 416:
            if self.size >= 0:
                raise changed(self.name)
            raise self._refusal("it gives no part of the file, which may be empty", AGAIN)
        if status == 200:
            raise self._refusal(
                "it gives files as a whole only", "download it, and name the local file"
            )
        if status != 206:
            raise self._refusal(f"it answers {status}", "check the URL")
        refuse_encoded(answer, self._url)

    def _same(self, size: int, headers: Any) -> None:
        """Hold what a server says of the file against what it said first."""
        content = headers.get("ETag") or headers.get("Last-Modified") or ""
        with self._lock:
            if self.size < 0:
                self.size, self.content = size, content
        if (size, content) != (self.size, self.content):
            raise changed(self.name)

    def _refusal(self, problem: str, remedy: str) -> InputError:
        return refusal(self._url, problem, remedy)


def changed(name: str) -> InputError:
    """The error of a file that is another one than it was."""
    return InputError(
        "changed on its server since this run began",
        file=name,
        remedy="run again, and leave it alone until the run has ended",
    )


def _content_range(text: str | None) -> tuple[int, int, int]:
    """First and last byte and size of a file. Raises Again for other texts."""
    try:
        unit, _, rest = (text or "").partition(" ")
        span, _, size = rest.partition("/")
        first, _, last = span.partition("-")
        found = int(first), int(last), int(size)
    except ValueError:
        found, unit = (0, 0, 0), ""
    if unit != "bytes" or not 0 <= found[0] <= found[1] < found[2]:
        raise Again("it does not say which bytes it sends")
    return found


class RangeStream(io.RawIOBase):
    """A file as a stream of blocks."""

    def __init__(self, ranges: Ranges, block_bytes: int) -> None:
        self._ranges, self._block_bytes, self._at = ranges, block_bytes, 0
        self._blocks: dict[int, bytes] = {}  # the last ones, by number

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def tell(self) -> int:
        """The place of the next byte."""
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place, as of any stream."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._ranges.size}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Bytes from here on to the end of the block."""
        if self._at >= self._ranges.size:
            return 0
        number = self._at // self._block_bytes
        if number not in self._blocks:
            start = number * self._block_bytes
            end = min(start + self._block_bytes, self._ranges.size)
            if len(self._blocks) == BLOCKS_HELD:
                del self._blocks[next(iter(self._blocks))]
            self._blocks[number] = self._ranges.get(start, end)
        first = self._at - number * self._block_bytes
        part = self._blocks[number][first : first + len(buffer)]
        memoryview(buffer)[: len(part)] = part
        self._at += len(part)
        return len(part)
