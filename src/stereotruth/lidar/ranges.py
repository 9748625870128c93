"""Parts of files, from the disk or a web server: several at once, each as long as was asked for.

A server is asked for ranges of bytes. What it answers is held against the range, and against what
it said of the file before (size, ETag, time of the last change). Short answers, wrong ranges, lost
connections and servers that are busy or stall are asked again, in the server's pace (Retry-After),
until :class:`WebRanges` loses its patience. Messages name the URL without query and credentials and
never what a library says, which may hold both. Source: RFC 9110, sections 10.2.3, 14 and 15.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from threading import Lock
from typing import Any

import urllib3

from ..errors import InputError, without_secrets
from ..products.remote_files import size_of
from ..products.web_requests import (
    ABSENT,
    MOST_REDIRECTS,
    REDIRECTS,
    redirected,
    refusal,
    web_parts,
)

Range = tuple[int, int]  # first byte, and the one behind the last

GAP_BYTES = 1 << 12  # between two ranges that one request serves
REQUEST_BYTES = 4 << 20  # of merged ranges; a single one may have more
AT_ONCE = 4  # requests
MOST_BYTES = 256 << 20  # of one range
STALL_SHARE = 0.1  # of the patience: so long without a byte, and the request is made again
FIRST_WAIT_S = 0.5  # before the second try; doubled for each other
MOST_WAIT_S = 30.0  # where the server asks for no certain time
MOST_TRIES = 8
BUSY = (408, 429, 500, 502, 503, 504)
PIECE_BYTES = 1 << 16
_AGAIN = "try again later, or download the file and name the copy"


class _Again(Exception):
    """What went wrong with a request that another one may get right."""

    def __init__(self, problem: str, wait_s: float | None = None) -> None:
        super().__init__(problem)
        self.wait_s = wait_s


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

    def parts(self, ranges: Sequence[Range]) -> Iterator[bytes]:
        """Each of the ranges, in the given order.

        Neighbours are read together. At most :data:`AT_ONCE` requests run or wait to be taken.
        """
        groups = merged(ranges)
        coming: deque = deque()
        pool = ThreadPoolExecutor(AT_ONCE)
        try:
            ahead = iter(groups)
            for group in groups:
                while len(coming) < AT_ONCE and (other := next(ahead, None)) is not None:
                    coming.append(pool.submit(self.get, other[0][0], max(e for _, e in other)))
                content = coming.popleft().result()
                for start, end in group:
                    yield content[start - group[0][0] : end - group[0][0]]
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
    """A file on the disk."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(
                "no such LiDAR file", file=path, remedy="correct the path in scenes.tsv"
            )
        self.name, self.size, self._path = str(path), size_of(path), path

    def _get(self, start: int, end: int) -> bytes:
        with self._path.open("rb") as stream:
            stream.seek(start)
            content = stream.read(end - start)
        if len(content) < end - start:
            raise InputError(
                "became shorter while it was read", file=self._path, remedy="run again"
            )
        return content


class WebRanges(Ranges):
    """A file of a web server, of which the first bytes are asked for at once (``head``).

    ``patience_s`` bounds how long one range is waited for, all tries together.
    """

    def __init__(
        self,
        url: str,
        *,
        allow_hosts: frozenset[str] = frozenset(),
        patience_s: float = 300.0,
        head_bytes: int = 1 << 14,
    ) -> None:
        self.name, self._url = without_secrets(url), url
        self._hosts = allow_hosts
        web_parts(url, url)
        self._patience_s, self._stall_s = patience_s, STALL_SHARE * patience_s
        self._pool = urllib3.PoolManager(maxsize=AT_ONCE, retries=False)
        self._lock, self._not_before = Lock(), 0.0
        self.size = -1
        self._head = self._get(0, head_bytes)

    def _get(self, start: int, end: int) -> bytes:
        if self.size >= 0 and end <= len(self._head):
            return self._head[start:end]
        give_up = time.monotonic() + self._patience_s
        wait_s, problem = FIRST_WAIT_S, ""
        for _ in range(MOST_TRIES):
            if (pause := self._not_before - time.monotonic()) > 0:
                if time.monotonic() + pause > give_up:
                    break
                time.sleep(pause)
            try:
                return self._ask(start, end, give_up)
            except _Again as again:
                problem = str(again)
                pause = wait_s if again.wait_s is None else again.wait_s
            except InputError:  # a ValueError, which asking again does not mend
                raise
            except (urllib3.exceptions.HTTPError, OSError, ValueError) as error:
                problem, pause = f"{type(error).__name__}", wait_s
            wait_s = min(2 * wait_s, MOST_WAIT_S)
            if time.monotonic() + pause > give_up:
                problem += f", and asks to wait {pause:.0f} s" if pause > wait_s else ""
                break
            with self._lock:
                self._not_before = max(self._not_before, time.monotonic() + pause)
        raise InputError(
            f"its server does not answer as it should ({problem or 'it is busy'})",
            file=self.name,
            remedy=_AGAIN,
        )

    def _ask(self, start: int, end: int, give_up: float) -> bytes:
        """One request and what follows from its redirects. Raises _Again, InputError."""
        url = self._url
        for _ in range(MOST_REDIRECTS + 1):
            left = give_up - time.monotonic()
            stall = max(0.05, min(self._stall_s, left))
            answer = self._pool.request(
                "GET",
                url,
                headers={"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"},
                redirect=False,
                preload_content=False,
                decode_content=False,
                timeout=urllib3.Timeout(connect=stall, read=stall),
            )
            try:
                if answer.status not in REDIRECTS:
                    return self._taken(answer, start, end, give_up)
                url = redirected(url, answer.headers.get("Location"), self._url, self._hosts)
            finally:
                answer.close()
        raise self._refusal(f"it redirects more than {MOST_REDIRECTS} times", "check the URL")

    def _taken(self, answer: Any, start: int, end: int, give_up: float) -> bytes:
        """The body of an answer that is what was asked for."""
        status = answer.status
        if status in BUSY:
            raise _Again(f"it answers {status}", _asked_wait(answer.headers.get("Retry-After")))
        if status in ABSENT:
            raise InputError("no such file there", file=self.name, remedy="correct its URL")
        if status in (401, 403):
            raise self._refusal(f"it answers {status}, no permission", "get the right to read it")
        if status == 416:
            if self.size >= 0:
                raise self._changed()
            raise self._refusal("it gives no part of the file, which may be empty", _AGAIN)
        if status == 200:
            raise self._refusal(
                "it gives files as a whole only", "download it, and name the local file"
            )
        if status != 206:
            raise self._refusal(f"it answers {status}", "check the URL")
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            raise self._refusal("it encodes what it sends", "download it, and name the local file")
        first, last, size = _content_range(answer.headers.get("Content-Range"))
        self._same(size, answer.headers)
        end = min(end, size)
        if (first, last + 1) != (start, end):
            raise _Again(f"it sends bytes {first} to {last}, asked for {start} to {end - 1}")
        return self._body(answer, end - start, give_up)

    def _same(self, size: int, headers: Any) -> None:
        """Hold what a server says of the file against what it said first."""
        content = headers.get("ETag") or headers.get("Last-Modified") or ""
        with self._lock:
            if self.size < 0:
                self.size, self.content = size, content
        if (size, content) != (self.size, self.content):
            raise self._changed()

    def _body(self, answer: Any, length: int, give_up: float) -> bytes:
        """So many bytes, and no more."""
        content = bytearray()
        while len(content) <= length:
            piece = answer.read1(min(PIECE_BYTES, length + 1 - len(content)))
            if not piece:
                break
            content += piece
            if time.monotonic() > give_up:
                raise self._refusal("it sends too slowly", _AGAIN)
        if len(content) != length:
            more = "more than" if len(content) > length else f"{len(content)} of"
            raise _Again(f"it sends {more} {length} bytes")
        return bytes(content)

    def _changed(self) -> InputError:
        return InputError(
            "changed on its server since this run began",
            file=self.name,
            remedy="run again, and leave it alone until the run has ended",
        )

    def _refusal(self, problem: str, remedy: str) -> InputError:
        return refusal(self._url, problem, remedy)


def _asked_wait(text: str | None) -> float | None:
    """Seconds of a Retry-After, which has them or a date; None without one that can be read."""
    if text is None:
        return None
    if text.strip().isdigit():
        return float(text)
    try:
        return max(0.0, (parsedate_to_datetime(text) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError):
        return None


def _content_range(text: str | None) -> tuple[int, int, int]:
    """First and last byte and size of a file. Raises _Again for other texts."""
    try:
        unit, _, rest = (text or "").partition(" ")
        span, _, size = rest.partition("/")
        first, _, last = span.partition("-")
        found = int(first), int(last), int(size)
    except ValueError:
        found, unit = (0, 0, 0), ""
    if unit != "bytes" or not 0 <= found[0] <= found[1] < found[2]:
        raise _Again("it does not say which bytes it sends")
    return found
