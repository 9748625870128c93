"""Requests to web servers, which lead nowhere but to the hosts that users allow, and which end.

A redirect is followed to the origin of the asked URL and to allowed hosts, never from https to http
and never to another scheme. What a server sends is bounded before it is read. Servers that are busy
or fail are asked again in their own pace (Retry-After), until the patience with them is at its end;
then the connection is cut, whatever it drips. Messages name hosts and URLs without queries and
credentials, and never what a library says, which may hold both.
Source: RFC 9110, sections 8.6, 10.2.3, 14.4 and 15.4.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from functools import cache, partial
from threading import Event, Lock, Timer
from typing import Any, TypeVar
from urllib.parse import SplitResult, urljoin, urlsplit

import urllib3

from ..errors import InputError, without_secrets

logging.getLogger("urllib3").setLevel(logging.CRITICAL)  # its lines have URLs with signatures
WEB = ("http", "https")
PORTS = {"http": 80, "https": 443}
HOST = re.compile(r"[A-Za-z0-9._:-]+")
ABSENT = (404, 410)  # what web servers answer where there is no file
REDIRECTS = (301, 302, 303, 307, 308)
MOST_REDIRECTS = 5
BUSY = (408, 429, 500, 502, 503, 504)
CONNECT_S, STALL_S = 20.0, 60.0  # without an answer, without a byte
LOOK_S, WHOLE_S = 120.0, 600.0  # patience: with what a file is, with a file that is read whole
TRIES, WAIT_S = 3, 1.0  # of requests, and before the second of them; doubled for each other
MOST_WAIT_S = 30.0  # where the server asks for no certain time
PIECE_BYTES = 1 << 18
AGAIN = "try again later, or download the file and name the copy"

Answer = TypeVar("Answer")


class Again(Exception):
    """What went wrong with a request that another one may get right.

    ``wait_s``: what the server asks to wait, if it does.
    """

    def __init__(self, problem: str, wait_s: float | None = None) -> None:
        super().__init__(problem)
        self.wait_s = wait_s


def web_parts(url: str, asked: str) -> SplitResult:
    """Parts of a URL of a web server. Raises InputError, which names ``asked``, for others."""
    try:
        parts = urlsplit(url)
        good = parts.scheme in WEB and bool(HOST.fullmatch(parts.hostname or ""))
        good &= (parts.port or 1) > 0
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
    try:
        target = urljoin(url, location)
    except ValueError:  # brackets that do not close
        target = ""
    old, new, first = urlsplit(url), web_parts(target, asked), urlsplit(asked)
    if new.scheme not in (old.scheme, "https"):
        raise refusal(asked, "it redirects to another scheme", "name the file's own URL")
    if "@" in new.netloc:
        raise refusal(asked, "it redirects to a URL with a password", "name the file's own URL")
    own = new.hostname == first.hostname and _port(new) in (_port(first), PORTS["https"])
    if not own and new.hostname not in hosts:
        port = "" if new.port is None or new.hostname != first.hostname else f", port {new.port}"
        raise refusal(
            asked,
            f"it redirects to another host, {new.hostname}{port}",
            f"if you trust it, name the file's URL there, or, for tiles of a catalogue, list them "
            f"with --allow-host {new.hostname}",
        )
    return target


def _port(parts: SplitResult) -> int:
    return parts.port or PORTS[parts.scheme]


def refusal(asked: str, problem: str, remedy: str) -> InputError:
    """An error of a server that answers, but not as it should."""
    return InputError(
        f"its server does not answer as it should: {problem}", file=asked, remedy=remedy
    )


class _Connection(urllib3.connection.HTTPConnection):
    """The head of an answer comes within the time-out as a whole: it may not drip."""

    def getresponse(self) -> Any:
        with _cut_after(self.timeout, partial(self.sock.shutdown, socket.SHUT_RD)):
            return super().getresponse()


class _SecureConnection(_Connection, urllib3.connection.HTTPSConnection):
    """The same by TLS."""


class _Connections(urllib3.HTTPConnectionPool):
    ConnectionCls = _Connection


class _SecureConnections(urllib3.HTTPSConnectionPool):
    ConnectionCls = _SecureConnection


@contextmanager
def _cut_after(seconds: float, shutdown: Callable[[], None]) -> Iterator[None]:
    """Cut a connection once so much time has passed, which ends what reads it in the block.

    Raises TimeoutError then: to who reads, a cut head or body may seem to be whole.
    """
    was_cut = Event()

    def cut() -> None:
        was_cut.set()
        with suppress(OSError, ValueError, RuntimeError):  # closed or released by now
            shutdown()

    timer = Timer(max(0.0, seconds), cut)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
    if was_cut.is_set():
        raise TimeoutError


@cache
def _pool(process: int) -> urllib3.PoolManager:
    """The connections of a process: none are shared with one that it was forked from."""
    pool = urllib3.PoolManager(maxsize=8, retries=False)
    pool.pool_classes_by_scheme = {"http": _Connections, "https": _SecureConnections}
    return pool


@contextmanager
def answer_of(
    method: str,
    asked: str,
    hosts: frozenset[str],
    until: float,
    headers: dict[str, str] | None = None,
    stall_s: float | None = None,
) -> Iterator[Any]:
    """The answer (urllib3's, its body not read) to a request, after redirects that may be followed.

    ``until`` (``time.monotonic``) is when its connection is cut; see :func:`body_of`.
    Raises InputError where a redirect may not be followed or they do not end; what urllib3 raises
    where no answer comes.
    """
    web_parts(asked, asked)
    url = asked
    for _ in range(MOST_REDIRECTS + 1):
        wait_s = max(0.05, min(STALL_S if stall_s is None else stall_s, until - time.monotonic()))
        answer = _pool(os.getpid()).request(
            method,
            url,
            headers={"Accept-Encoding": "identity"} | (headers or {}),
            redirect=False,
            preload_content=False,
            decode_content=False,
            timeout=urllib3.Timeout(connect=min(CONNECT_S, wait_s), read=wait_s),
        )
        try:
            if answer.status not in REDIRECTS:
                with _cut_after(until - time.monotonic(), answer.shutdown):
                    yield answer
                return
            url = redirected(url, answer.headers.get("Location"), asked, hosts)
        finally:
            answer.close()
    raise refusal(asked, f"it redirects more than {MOST_REDIRECTS} times", "check the URL")


def body_of(answer: Any, most_bytes: int, until: float, asked: str) -> bytes:
    """The body of an answer, of which no more than one byte beyond ``most_bytes`` is read.

    Raises InputError if it is not there by ``until``.
    """
    content = bytearray()
    while len(content) <= most_bytes:
        piece = answer.read1(min(PIECE_BYTES, most_bytes + 1 - len(content)))
        if time.monotonic() > until:  # the connection was cut, or is as slow
            raise refusal(asked, "it sends too slowly", AGAIN)
        if not piece:
            break
        content += piece
    return bytes(content)


_lock = Lock()
_not_before: dict[str, float] = {}  # by server: when it wants to be asked again


def patiently(
    ask: Callable[[float], Answer],
    asked: str,
    patience_s: float,
    tries: int | None = None,
    wait_s: float | None = None,
) -> Answer:
    """What ``ask(until)`` returns, which is called again where that may help, in the server's pace.

    No call is made, and none may last, beyond the patience. Raises InputError in the end.
    """
    until = time.monotonic() + patience_s
    server, wait_s = urlsplit(asked).netloc, WAIT_S if wait_s is None else wait_s
    failure = refusal(asked, "it is busy", AGAIN)
    for left in reversed(range(TRIES if tries is None else tries)):
        if (pause := _not_before.get(server, 0.0) - time.monotonic()) > 0:
            if time.monotonic() + pause > until:
                break
            time.sleep(pause)
        try:
            return ask(until)
        except InputError:  # a ValueError, which asking again does not mend
            raise
        except Again as again:
            pause = wait_s if again.wait_s is None else again.wait_s
            long = f", and asks to wait {pause:.0f} s" if again.wait_s is not None else ""
            failure = refusal(asked, f"{again}{long}", AGAIN)
        except (urllib3.exceptions.HTTPError, OSError, ValueError) as error:
            pause, failure = wait_s, unreachable(error, asked)
            if isinstance(error, urllib3.exceptions.NameResolutionError):
                break
        wait_s = min(2 * wait_s, MOST_WAIT_S)
        if not left or time.monotonic() + pause > until:
            break
        with _lock:
            _not_before[server] = max(_not_before.get(server, 0.0), time.monotonic() + pause)
    raise failure from None


def refuse_busy(answer: Any, kinds: tuple[int, ...] = BUSY) -> None:
    """Raise Again where a server says that it cannot answer now."""
    if answer.status in kinds:
        wait_s = _asked_wait(answer.headers.get("Retry-After"))
        raise Again(f"it answers {answer.status}", wait_s)


def _asked_wait(text: str | None) -> float | None:
    """Seconds of a Retry-After, which has them or a date; None without one that can be read."""
    if text is None:
        return None
    if re.fullmatch(r"[0-9]{1,15}", text.strip()):
        return float(text)
    try:
        return max(0.0, (parsedate_to_datetime(text) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError, OverflowError):
        return None


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

    def ask(until: float) -> dict[str, Any] | None:
        with answer_of("HEAD", asked, hosts, until) as answer:
            refuse_busy(answer, (429, 503))
            if answer.status in ABSENT:
                return None
            if answer.status == 200:
                return _info(answer.headers, _number(answer.headers.get("Content-Length")))
        with answer_of("GET", asked, hosts, until, {"Range": "bytes=0-0"}) as answer:
            refuse_busy(answer)
            if answer.status in ABSENT:
                return None
            if answer.status not in (200, 206):
                raise _status(answer.status, asked)
            size = _number(answer.headers.get("Content-Range", "").rpartition("/")[2])
            return _info(answer.headers, size) | {"partial": answer.status == 206}

    return patiently(ask, asked, LOOK_S)


def _number(text: str | None) -> int | None:
    """A size that a server tells; None for what is none."""
    return int(text) if text and re.fullmatch(r"[0-9]{1,15}", text) else None


def _info(headers: Any, size: int | None) -> dict[str, Any]:
    found = {name: headers[name] for name in ("ETag", "Last-Modified") if name in headers}
    return {"size": size, "partial": headers.get("Accept-Ranges") != "none", **found}


def _status(status: int, asked: str) -> InputError:
    if status in (401, 403):
        return refusal(asked, f"it answers {status}, no permission", "get the right to read it")
    return refusal(asked, f"it answers {status}", AGAIN)


def read_whole(asked: str, most_bytes: int, hosts: frozenset[str] = frozenset()) -> bytes:
    """A file of a web server, of no more than so many bytes: none beyond these is kept.

    Raises InputError: absent, larger, shorter than announced, or what a server fails with.
    """

    def ask(until: float) -> bytes:
        with answer_of("GET", asked, hosts, until) as answer:
            refuse_busy(answer)
            if answer.status in ABSENT:
                raise InputError("no such file there", file=asked, remedy="correct its URL")
            if answer.status != 200:
                raise _status(answer.status, asked)
            refuse_encoded(answer, asked)
            announced = _number(answer.headers.get("Content-Length"))
            if announced is not None and announced > most_bytes:
                raise too_large(asked, most_bytes)
            content = body_of(answer, most_bytes, until, asked)
        if len(content) > most_bytes:
            raise too_large(asked, most_bytes)
        if announced is not None and len(content) != announced:
            raise Again(f"{len(content)} bytes came of {announced}")
        return content

    return patiently(ask, asked, WHOLE_S)


def refuse_encoded(answer: Any, asked: str) -> None:
    """Raise InputError for an answer that is packed, of which no part stands for one of a file."""
    if answer.headers.get("Content-Encoding", "identity") != "identity":
        raise refusal(asked, "it encodes what it sends", "download it, and name the local file")


def too_large(asked: str, most_bytes: int) -> InputError:
    """The error of a file that is larger than any of its kind."""
    return InputError(
        f"larger than {most_bytes / 1e6:g} MB", file=asked, remedy="is it the right file?"
    )


def shown(url: str) -> str:
    """A URL as pages, records and lists may have it: without credentials, query and fragment."""
    return without_secrets(url)
