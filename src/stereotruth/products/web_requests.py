"""Requests to web servers, which lead nowhere but to the hosts that users allow.

A redirect is followed to the host of the asked URL and to allowed hosts, never from https to http
and never to another scheme. What a server sends is bounded before it is read. Messages name hosts
and URLs without queries and credentials, and never what a library says, which may hold both.
Source: RFC 9110, sections 8.6, 14.4 and 15.4.
"""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any
from urllib.parse import SplitResult, urljoin, urlsplit

import urllib3

from ..errors import InputError, without_secrets

WEB = ("http", "https")
ABSENT = (404, 410)  # what web servers answer where there is no file
REDIRECTS = (301, 302, 303, 307, 308)
MOST_REDIRECTS = 5
BUSY = (429, 503)
CONNECT_S, STALL_S = 20.0, 60.0  # without an answer, without a byte
TRIES, WAIT_S = 3, 1.0  # of requests that fail without an answer, or at a busy server
PIECE_BYTES = 1 << 18
_AGAIN = "try again later, or download the file and name the copy"


def web_parts(url: str, asked: str) -> SplitResult:
    """Parts of a URL of a web server. Raises InputError, which names ``asked``, for others."""
    try:
        parts = urlsplit(url)
        good = parts.scheme in WEB and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        good = False
    if not good:
        raise InputError(
            "leads to what is no file of a web server",
            file=asked,
            remedy="name a file by http:// or https://",
        )
    return parts


def redirected(url: str, location: str | None, asked: str, hosts: frozenset[str]) -> str:
    """Where a redirect from ``url`` leads to. Raises InputError if it may not.

    ``asked`` is what the user or a list names, ``hosts`` are names of further hosts that may be
    led to.
    """
    if not location:
        raise refusal(asked, "it redirects to nowhere", "check the URL")
    target = urljoin(url, location)
    old, new = urlsplit(url), web_parts(target, asked)
    if new.scheme not in (old.scheme, "https"):
        raise refusal(asked, "it redirects to another scheme", "name the file's own URL")
    if "@" in new.netloc:
        raise refusal(asked, "it redirects to a URL with a password", "name the file's own URL")
    if new.hostname not in hosts | {urlsplit(asked).hostname}:
        raise refusal(
            asked,
            f"it redirects to another host, {new.hostname}",
            f"if you trust it, name the file's URL there, or, for tiles of a catalogue, list them "
            f"with --allow-host {new.hostname}",
        )
    return target


def refusal(asked: str, problem: str, remedy: str) -> InputError:
    """An error of a server that answers, but not as it should."""
    return InputError(
        f"its server does not answer as it should: {problem}", file=asked, remedy=remedy
    )


@cache
def _pool() -> urllib3.PoolManager:
    return urllib3.PoolManager(maxsize=8, retries=False)


@contextmanager
def answer_of(
    method: str, asked: str, hosts: frozenset[str], headers: dict[str, str] | None = None
) -> Iterator[Any]:
    """The answer (urllib3's, its body not read) to a request, after redirects that may be followed.

    Raises InputError if there is none, or where a redirect may not be followed or they do not end.
    """
    web_parts(asked, asked)
    url = asked
    for _ in range(MOST_REDIRECTS + 1):
        answer = _tried(method, url, asked, {"Accept-Encoding": "identity"} | (headers or {}))
        try:
            if answer.status not in REDIRECTS:
                yield answer
                return
            url = redirected(url, answer.headers.get("Location"), asked, hosts)
        finally:
            answer.close()
    raise refusal(asked, f"it redirects more than {MOST_REDIRECTS} times", "check the URL")


def _tried(method: str, url: str, asked: str, headers: dict[str, str]) -> Any:
    """The answer to one request, which is made again where none comes or the server is busy."""
    for left in reversed(range(TRIES)):
        try:
            answer = _pool().request(
                method,
                url,
                headers=headers,
                redirect=False,
                preload_content=False,
                decode_content=False,
                timeout=urllib3.Timeout(connect=CONNECT_S, read=STALL_S),
            )
            if answer.status not in BUSY or not left:
                return answer
            answer.close()
        except (urllib3.exceptions.HTTPError, OSError, ValueError) as error:
            if not left or isinstance(error, urllib3.exceptions.NameResolutionError):
                raise unreachable(error, asked) from None
        time.sleep(WAIT_S)
    raise AssertionError("the last try returns or raises")


def unreachable(error: BaseException, asked: str) -> InputError:
    """What a request without an answer fails with, without the words of the library."""
    text = f"{type(error).__name__} {error}"
    if "NameResolution" in text or "gaierror" in text:
        return InputError(
            "its host is unknown", file=asked, remedy="correct the URL, and check the network"
        )
    return InputError(
        f"nobody answers there ({type(error).__name__})",
        file=asked,
        remedy="check the URL and the network, or try again later",
    )


def info_of(asked: str, hosts: frozenset[str] = frozenset()) -> dict[str, Any] | None:
    """Size, ETag and Last-Modified of a file, and whether parts are given; None if it is absent.

    Servers that do not answer HEAD are asked for the first byte. Raises InputError if nobody
    answers, or not as it should.
    """
    with answer_of("HEAD", asked, hosts) as answer:
        if answer.status in ABSENT:
            return None
        if answer.status == 200:
            size = answer.headers.get("Content-Length")
            return _info(answer.headers, int(size) if (size or "").isdigit() else None)
    with answer_of("GET", asked, hosts, {"Range": "bytes=0-0"}) as answer:
        if answer.status in ABSENT:
            return None
        if answer.status not in (200, 206):
            raise _status(answer.status, asked)
        size = answer.headers.get("Content-Range", "").rpartition("/")[2]
        info = _info(answer.headers, int(size) if size.isdigit() else None)
        return info | {"partial": answer.status == 206}


def _info(headers: Any, size: int | None) -> dict[str, Any]:
    found = {name: headers[name] for name in ("ETag", "Last-Modified") if name in headers}
    return {"size": size, "partial": headers.get("Accept-Ranges") != "none", **found}


def _status(status: int, asked: str) -> InputError:
    if status in (401, 403):
        return refusal(asked, f"it answers {status}, no permission", "get the right to read it")
    return refusal(asked, f"it answers {status}", _AGAIN)


def read_whole(asked: str, most_bytes: int, hosts: frozenset[str] = frozenset()) -> bytes:
    """A file of a web server, of no more than so many bytes: none beyond these is read.

    Raises InputError: absent, larger, shorter than announced, or what a server fails with.
    """
    with answer_of("GET", asked, hosts) as answer:
        if answer.status in ABSENT:
            raise InputError("no such file there", file=asked, remedy="correct its URL")
        if answer.status != 200:
            raise _status(answer.status, asked)
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            raise refusal(asked, "it encodes what it sends", "download it, and name the local file")
        announced = answer.headers.get("Content-Length", "")
        if announced.isdigit() and int(announced) > most_bytes:
            raise too_large(asked, most_bytes)
        content = _body(answer, most_bytes, asked)
    if announced.isdigit() and len(content) != int(announced):
        raise refusal(asked, f"{len(content)} bytes came of {announced}", _AGAIN)
    return content


def too_large(asked: str, most_bytes: int) -> InputError:
    """The error of a file that is larger than any of its kind."""
    return InputError(
        f"larger than {most_bytes / 1e6:g} MB", file=asked, remedy="is it the right file?"
    )


def _body(answer: Any, most_bytes: int, asked: str) -> bytes:
    content = bytearray()
    try:
        while piece := answer.read1(PIECE_BYTES):
            content += piece
            if len(content) > most_bytes:
                raise too_large(asked, most_bytes)
    except InputError:
        raise
    except (urllib3.exceptions.HTTPError, OSError, ValueError) as error:
        raise unreachable(error, asked) from None
    return bytes(content)


class WebStream(io.RawIOBase):
    """A file of a web server as a stream: each read asks for the bytes that it is to return."""

    def __init__(self, asked: str, size: int, hosts: frozenset[str]) -> None:
        self._asked, self._size, self._hosts, self._at = asked, size, hosts, 0

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
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Bytes from here on. Raises InputError unless all of them come."""
        first, last = self._at, min(self._at + len(buffer), self._size) - 1
        if last < first:
            return 0
        length = last - first + 1
        header = {"Range": f"bytes={first}-{last}"}
        with answer_of("GET", self._asked, self._hosts, header) as answer:
            if answer.status != 206:
                raise _status(answer.status, self._asked)
            span = f"bytes {first}-{last}/{self._size}"
            if answer.headers.get("Content-Range") != span:
                raise refusal(
                    self._asked, "it sends other bytes than those asked for, or has changed", _AGAIN
                )
            content = _body(answer, length, self._asked)
        if len(content) != length:
            raise refusal(self._asked, f"{len(content)} bytes came of {length}", _AGAIN)
        memoryview(buffer)[:length] = content
        self._at += length
        return length


def shown(url: str) -> str:
    """A URL as pages, records and lists may have it: without credentials, query and fragment."""
    return without_secrets(url)
