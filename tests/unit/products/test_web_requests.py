"""Requests to web servers that drip, stall, are busy or answer what no server should."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.utils import formatdate
from threading import Thread

import pytest

from stereotruth.errors import InputError
from stereotruth.products import web_requests
from stereotruth.products.ranges import RangeStream, WebRanges
from stereotruth.products.web_requests import info_of, read_whole, redirected, web_parts

PATIENCE_S = 1.0
BODY = b'{"type": "FeatureCollection"}'


@contextmanager
def speaking(*answers: Callable[[socket.socket], None]) -> Iterator[tuple[str, list[float]]]:
    """A server whose n-th answer is the n-th, the last one again; its URL, when it was asked."""
    listener = socket.create_server(("127.0.0.1", 0))
    asked: list[float] = []

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            Thread(target=answer, args=(connection,), daemon=True).start()

    def answer(connection: socket.socket) -> None:
        with connection:
            try:
                if connection.recv(4096):
                    asked.append(time.monotonic())
                    answers[min(len(asked), len(answers)) - 1](connection)
            except OSError:
                return  # a client that has lost its patience

    Thread(target=serve, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/tiles.json", asked
    finally:
        listener.close()


def head(status: str, *lines: str) -> bytes:
    return "\r\n".join([f"HTTP/1.1 {status}", "Connection: close", *lines, "", ""]).encode()


def sending(content: bytes) -> Callable[[socket.socket], None]:
    return lambda connection: connection.sendall(content)


def dripping(first: bytes, drop: bytes) -> Callable[[socket.socket], None]:
    """A minute of drops, each sooner than any stall is given up."""

    def drip(connection: socket.socket) -> None:
        connection.sendall(first)
        for _ in range(600):
            connection.sendall(drop)
            time.sleep(0.1)

    return drip


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    for name in ("LOOK_S", "WHOLE_S"):
        monkeypatch.setattr(web_requests, name, PATIENCE_S)
    monkeypatch.setattr(web_requests, "WAIT_S", 0.05)


DRIPS = {
    "the first line": dripping(b"HTTP/1.1 ", b"2"),
    "a line of the head": dripping(b"HTTP/1.1 200 OK\r\nX: ", b"x"),
    "lines of the head": dripping(b"HTTP/1.1 200 OK\r\n", b"X: y\r\n"),
    "a body": dripping(head("200 OK", "Content-Length: 9999"), b"x"),
    "a body without end": dripping(head("200 OK"), b"x"),
    "the size of a chunk": dripping(head("200 OK", "Transfer-Encoding: chunked"), b"0"),
    "an extension of a chunk": dripping(head("200 OK", "Transfer-Encoding: chunked") + b"1;", b"x"),
    "chunks": dripping(head("200 OK", "Transfer-Encoding: chunked"), b"1\r\nx\r\n"),
    "nothing": dripping(b"", b""),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", DRIPS)
def test_a_server_that_drips_is_left(kind):
    """What comes drop by drop keeps each reading below its time-out."""
    start = time.monotonic()
    with speaking(DRIPS[kind]) as (url, _), pytest.raises(InputError):
        read_whole(url, 10_000)
    assert time.monotonic() - start < 2 * PATIENCE_S + 1


@pytest.mark.parametrize("kind", ["the first line", "a line of the head", "nothing"])
def test_a_question_about_a_file_ends(kind):
    start = time.monotonic()
    with speaking(DRIPS[kind]) as (url, _), pytest.raises(InputError):
        info_of(url)
    assert time.monotonic() - start < 2 * PATIENCE_S + 1


def whole(content: bytes = BODY) -> Callable[[socket.socket], None]:
    return sending(head("200 OK", f"Content-Length: {len(content)}") + content)


@pytest.mark.parametrize("asks", ["0.4 s", "a date", "an hour", "no time"])
def test_a_busy_server_is_asked_in_its_own_pace(asks, monkeypatch):
    monkeypatch.setattr(web_requests, "WHOLE_S", 5.0)
    monkeypatch.setattr(web_requests, "WAIT_S", 0.3)
    wait = {"0.4 s": "1", "a date": formatdate(time.time() + 2, usegmt=True), "an hour": "3600"}
    line = f"Retry-After: {wait.get(asks, 'soon')}"
    busy = sending(head("429 Too Many Requests", line, "Content-Length: 0"))
    with speaking(busy, whole()) as (url, asked):
        if asks == "an hour":
            with pytest.raises(InputError, match="it answers 429, and asks to wait 3600 s"):
                read_whole(url, 100)
            assert len(asked) == 1
            return
        assert read_whole(url, 100) == BODY
        assert asked[1] - asked[0] >= (0.25 if asks == "no time" else 0.9)


def test_a_short_answer_is_asked_for_again():
    short = sending(head("200 OK", "Content-Length: 29") + BODY[:9])
    with speaking(short, whole()) as (url, asked):
        assert read_whole(url, 100) == BODY and len(asked) == 2
    with speaking(short) as (url, asked), pytest.raises(InputError):
        read_whole(url, 100)
    assert len(asked) == web_requests.TRIES


def test_no_more_than_the_limit_is_read():
    """Of a body without end, as of one that announces less than it has."""
    sent = []

    def endless(connection: socket.socket) -> None:
        connection.sendall(head("200 OK"))
        for _ in range(2000):
            connection.sendall(bytes(1 << 20))
            sent.append(1)

    with speaking(endless) as (url, _), pytest.raises(InputError, match="larger than"):
        read_whole(url, 1000)
    assert len(sent) < 100  # MB, in the buffers of both ends


@pytest.mark.parametrize("size", ["²", "1" * 5000, "-1", "0x10", "1_0", ""])
def test_a_size_that_is_no_number_is_no_size(size):
    with speaking(sending(head("200 OK", f"Content-Length: {size}"))) as (url, _):
        try:
            info = info_of(url)
        except InputError:
            return
    assert info is None or info["size"] is None


@pytest.mark.parametrize("text", ["²", "9" * 400, "-1", "Tue, 99 Foo 2026", ""])
def test_a_pause_that_cannot_be_read_is_no_pause(text):
    assert web_requests._asked_wait(text) is None
    busy = sending(head("503 Busy", f"Retry-After: {text}", "Content-Length: 0"))
    with speaking(busy, whole()) as (url, _):
        assert read_whole(url, 100) == BODY


def test_what_is_packed_is_refused():
    packed = sending(head("200 OK", "Content-Encoding: gzip", "Content-Length: 3") + b"abc")
    with speaking(packed) as (url, _), pytest.raises(InputError, match="it encodes what it sends"):
        read_whole(url, 100)


GARBAGE = {
    "no HTTP": b"SSH-2.0-OpenSSH_9\r\n\r\n",
    "no status": b"HTTP/1.1 abc\r\n\r\n",
    "too many lines": b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 500 + b"\r\n",
    "a long line": b"HTTP/1.1 200 OK\r\nX: " + b"y" * 100_000 + b"\r\n\r\n",
    "chunks of no size": head("200 OK", "Transfer-Encoding: chunked") + b"zz\r\nabc",
    "a negative chunk": head("200 OK", "Transfer-Encoding: chunked") + b"-5\r\nabc\r\n",
    "status 100 for ever": b"HTTP/1.1 100 Continue\r\n\r\n" * 3000,
    "two lengths": head("200 OK", "Content-Length: 3", "Content-Length: 900") + b"abc",
    "hung up": b"",
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_what_no_server_should_answer_is_refused(kind):
    with speaking(sending(GARBAGE[kind])) as (url, _):
        for ask in (info_of, lambda url: read_whole(url, 100), WebRanges):
            how = {"patience_s": 1.0} if ask is WebRanges else {}
            try:
                assert ask(url, **how) in (None, {"size": None, "partial": True})
            except InputError as error:
                assert url in str(error)


@pytest.mark.parametrize(
    ("url", "location", "allowed"),
    [
        ("http://host/a", "/b", True),
        ("http://host/a", "https://host/b", True),
        ("http://host:8080/a", "https://host/b", True),
        ("http://host/a", "http://host:22/b", False),
        ("https://host/a", "https://host:8443/b", False),
        ("https://host/a", "http://host/b", False),
        ("https://host/a", "https://other/b", True),  # which is allowed
        ("https://host/a", "https://other:8443/b", True),
        ("https://host/a", "http://other/b", False),
        ("https://host/a", "https://third/b", False),
        ("https://host/a", "//third/b", False),
        ("https://host/a", "https://host@third/b", False),
        ("https://host/a", "file:///etc/passwd", False),
        ("https://host/a", "gopher://host/b", False),
        ("https://host/a", "https://ho\x1b[31mst/b", False),
        ("https://host/a", "https://h;reboot/b", False),
    ],
)
def test_where_a_redirect_may_lead(url, location, allowed):
    hosts = frozenset({"other"})
    if allowed:
        assert redirected(url, location, url, hosts).partition("//")[0] in ("http:", "https:")
        return
    with pytest.raises(InputError) as refused:
        redirected(url, location + "?token=verysecret", url, hosts)
    text = str(refused.value)
    assert "verysecret" not in text and "\x1b" not in text and "reboot" not in text


def test_urls_that_are_none_are_refused():
    for url in ("ftp://h/a", "file:///a", "http:///a", "http://h:99999/a", "http://[::1/a", "x"):
        with pytest.raises(InputError, match="no file of a web server"):
            web_parts(url, url)
    assert web_parts("http://[::1]:80/a", "").hostname == "::1"


def test_messages_have_no_secrets():
    for answer in (sending(head("403 No", "Content-Length: 0")), sending(b"")):
        with speaking(answer) as (url, _):
            secret = url.replace("//", "//user:verysecret@") + "?X-Amz-Signature=verysecret"
            for ask in (info_of, lambda url: read_whole(url, 9), WebRanges):
                how = {"patience_s": 0.5} if ask is WebRanges else {}
                with pytest.raises(InputError) as refused:
                    ask(secret, **how)
                chain, error = [], refused.value
                while error is not None:
                    chain.append(f"{error} {error.args} {error.file if chain == [] else ''}")
                    error = error.__cause__
                assert "verysecret" not in " ".join(chain)


def test_a_file_that_is_replaced_while_a_stream_reads_it_is_refused():
    """Of the same size and another ETag."""

    def part(tag: str) -> Callable[[socket.socket], None]:
        lines = "Content-Range: bytes {}/200000", f"ETag: {tag}"

        def answer(connection: socket.socket) -> None:
            span = spans.pop(0)
            first, last = map(int, span.split("-"))
            told = lines[0].format(span)
            body = bytes(last + 1 - first)
            length = f"Content-Length: {len(body)}"
            connection.sendall(head("206 Partial", told, lines[1], length) + body)

        return answer

    spans = ["0-16383", "100000-149999", "150000-199999"]
    with speaking(part('"one"'), part('"one"'), part('"two"')) as (url, _):
        stream = RangeStream(WebRanges(url, patience_s=2.0), 50_000)
        stream.seek(100_000)
        assert len(stream.read(50_000)) == 50_000
        with pytest.raises(InputError, match="changed on its server"):
            stream.read(1)
