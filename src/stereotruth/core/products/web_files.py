"""Files of web servers through fsspec, which lead nowhere but to the hosts that users allow.

fsspec (aiohttp) connects, asks for ranges of bytes and follows redirects. A middleware holds each
answer against rules before its body is read: a redirect leads to the origin of the asked URL or to
allowed hosts, never from https to http; a part is the one that was asked for; size, ETag or time of
the last change are those that are known of the file. Messages name URLs without queries and
credentials, and never what a library says, which may hold both.
Sources: RFC 9110, sections 10.2.3, 14.4 and 15; aiohttp, "Client Middleware".
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any
from urllib.parse import SplitResult, urljoin, urlsplit

from ..errors import InputError

WEB = ("http", "https")
PORTS = {"http": 80, "https": 443}
HOST = re.compile(r"[A-Za-z0-9._:-]+")
SPAN = re.compile(r"bytes ([0-9]{1,15})-([0-9]{1,15})/([0-9]{1,15})")
ABSENT = (404, 410)  # what web servers answer where there is no file
REDIRECTS = (301, 302, 303, 307, 308)
MOST_REDIRECTS = 5
BUSY = (408, 429, 500, 502, 503, 504)
CONNECT_S, STALL_S = 20.0, 60.0  # without an answer, without a byte
REQUEST_S = 300.0  # for one request, whatever drips
PIECE_BYTES = 1 << 18  # that a file which is read whole comes by
AGAIN = "try again later, or download the file and name the copy"


class Again(Exception):
    """What went wrong with a request that another one may get right.

    ``wait_s``: what the server asks to wait, if it does.
    """

    def __init__(self, problem: str, wait_s: float | None = None) -> None:
        super().__init__(problem)
        self.wait_s = wait_s


class Absent(Exception):
    """A server says that there is no such file."""


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


def refuse_redirect(url: str, location: str | None, asked: str, hosts: frozenset[str]) -> None:
    """Raise InputError if a redirect from ``url`` may not be followed.

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


def _port(parts: SplitResult) -> int:
    return parts.port or PORTS[parts.scheme]


def refusal(asked: str, problem: str, remedy: str) -> InputError:
    """An error of a server that answers, but not as it should."""
    return InputError(
        f"its server does not answer as it should: {problem}", file=asked, remedy=remedy
    )


def changed(name: str) -> InputError:
    """The error of a file that is another one than it was."""
    return InputError(
        "changed on its server since this run began",
        file=name,
        remedy="run again, and leave it alone until the run has ended",
    )


def too_large(asked: str, most_bytes: int) -> InputError:
    """The error of a file that is larger than any of its kind."""
    return InputError(
        f"larger than {most_bytes / 1e6:g} MB", file=asked, remedy="is it the right file?"
    )


def web_files(
    asked: str,
    hosts: frozenset[str],
    size: int | None = None,
    content: str = "",
    most_bytes: int | None = None,
) -> Any:
    """fsspec's file system of web servers, for the file ``asked`` and those beside it.

    ``size`` and ``content`` (ETag, else time of the last change) are what is known of the file.
    Answers that announce more than ``most_bytes`` are refused.
    Its calls raise InputError, Again or Absent, if as the cause of what fsspec raises.
    """
    import aiohttp
    from fsspec.implementations.http import HTTPFileSystem

    web_parts(asked, asked)

    async def rules(request: Any, handler: Callable[..., Any]) -> Any:
        answer = await handler(request)
        try:
            if answer.status in REDIRECTS:
                refuse_redirect(str(answer.url), answer.headers.get("Location"), asked, hosts)
            else:
                _refuse(answer, request.headers.get("Range"), asked)
                _refuse_other_file(answer.headers, asked, size, content)
                if most_bytes is not None and (answer.content_length or 0) > most_bytes:
                    raise too_large(asked, most_bytes)
        except BaseException:
            answer.close()
            raise
        return answer

    async def session(**how: Any) -> Any:
        return aiohttp.ClientSession(middlewares=(rules,), timeout=limits, **how)

    limits = aiohttp.ClientTimeout(
        total=REQUEST_S, sock_connect=min(CONNECT_S, REQUEST_S), sock_read=STALL_S
    )
    return HTTPFileSystem(
        get_client=session,
        headers={"Accept-Encoding": "identity"},
        max_redirects=MOST_REDIRECTS,
        skip_instance_cache=True,
    )


def _refuse(answer: Any, wanted: str | None, asked: str) -> None:
    """Raise Absent, Again or InputError for an answer that is not the ``wanted`` range or file."""
    status = answer.status
    if status in BUSY:
        wait_s = _asked_wait(answer.headers.get("Retry-After"))
        pause = "" if wait_s is None else f", and asks to wait {wait_s:.0f} s"
        raise Again(f"it answers {status}{pause}", wait_s)
    if status in ABSENT:
        raise Absent
    if status in (401, 403):
        raise refusal(asked, f"it answers {status}, no permission", "get the right to read it")
    if wanted is not None and status == 416:
        raise refusal(asked, "it gives no part of the file, which may be empty", AGAIN)
    if wanted is not None and status == 200:
        raise refusal(
            asked, "it gives files as a whole only", "download it, and name the local file"
        )
    if status != (200 if wanted is None else 206):
        raise refusal(asked, f"it answers {status}", AGAIN)
    if answer.headers.get("Content-Encoding", "identity") != "identity":
        raise refusal(asked, "it encodes what it sends", "download it, and name the local file")
    if wanted is not None:
        first, last = map(int, wanted.removeprefix("bytes=").split("-"))
        span = SPAN.fullmatch(answer.headers.get("Content-Range", ""))
        if span is None:
            raise Again("it does not say which bytes it sends")
        if (int(span[1]), int(span[2])) != (first, last):
            raise Again(f"it sends bytes {span[1]} to {span[2]}, asked for {first} to {last}")
        if answer.content_length != last + 1 - first:
            raise Again(f"it sends other than {last + 1 - first} bytes")


def _refuse_other_file(headers: Any, asked: str, size: int | None, content: str) -> None:
    """Raise InputError if a server tells another size, or another content, than is known.

    Some servers name no content, or not with every answer.
    """
    now = headers.get("ETag") or headers.get("Last-Modified")
    told = headers.get("Content-Range", "").rpartition("/")[2]
    if (content and now and now != content) or (size is not None and told not in ("", str(size))):
        raise changed(asked)


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


def read_whole(asked: str, most_bytes: int, hosts: frozenset[str]) -> bytes:
    """A file by one request. Raises InputError if it has more than so many bytes, and likewise."""
    content = bytearray()
    files = web_files(asked, hosts, most_bytes=most_bytes)
    # without blocks, as it comes; fsspec would ask for the size, were it not given any
    with files.open(asked, block_size=0, size=1) as stream:
        while piece := stream.read(PIECE_BYTES):
            content += piece
            if len(content) > most_bytes:
                raise too_large(asked, most_bytes)
    return bytes(content)
