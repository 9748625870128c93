"""Damage done to good files: bytes of any format, cells and numbers of text, by a seed."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

import numpy as np

Random = np.random.Generator
# What fields of headers are set to, by their width in bytes: little-endian.
EXTREMES: dict[int, tuple[bytes, ...]] = {
    1: (b"\0", b"\1", b"\x7f", b"\x80", b"\xff"),
    2: tuple(struct.pack("<H", v) for v in (0, 1, 0x7FFF, 0x8000, 0xFFFF)),
    4: tuple(struct.pack("<I", v) for v in (0, 1, 1 << 16, (1 << 31) - 1, 1 << 31, (1 << 32) - 1))
    + tuple(struct.pack("<f", v) for v in (np.nan, np.inf, -1e30)),
    8: tuple(struct.pack("<Q", v) for v in (0, 1, 1 << 32, (1 << 63) - 1, 1 << 63, (1 << 64) - 1))
    + tuple(struct.pack("<d", v) for v in (np.nan, np.inf, -1e300, 1e-300, 1.0, 500e3)),
}
NUMBERS = (
    *("", "nan", "inf", "-inf", "-1e30", "1e30", "1e-320", "0", "-0", "1e999", "1_000", "0x10"),
    *("１２３", "1,5", "12.5.1", "1e", "+", "--1", "1" * 5000, "٣", "1 000", "½", "True", "null"),
    *("NaN", "1d3", "−5", "1e5", "-1", "1e9"),
)
WORDS = (
    *(r"$\frac$", "$", "x" * 100_000, "é" * 300, "\x00", "\x1b[31m", "a\nb", '"', "'", "=1+1"),
    *("<script>", "../../etc", "%s%n", "{0}", "\u202e", "\ud7ff", " ", "G01", "#", "\\"),
)


def truncated(data: bytes, random: Random) -> bytes:
    """Cut short: anywhere, or by a few bytes."""
    if random.random() < 0.3:
        return data[: max(0, len(data) - 1 - int(random.integers(64)))]
    return data[: int(random.integers(len(data)))]


def _place(data: bytes, random: Random) -> int:
    """A byte of the file; of its first 600 bytes as often as of all others."""
    return int(random.integers(min(len(data), 600) if random.random() < 0.5 else len(data)))


def _span(data: bytes, random: Random) -> tuple[int, int]:
    start = _place(data, random)
    return start, start + int(2 ** random.uniform(0, 12))


def flipped(data: bytes, random: Random) -> bytes:
    """One to eight bits the other way round."""
    out = bytearray(data)
    for _ in range(int(random.integers(1, 9))):
        out[_place(data, random)] ^= 1 << int(random.integers(8))
    return bytes(out)


def extreme(data: bytes, random: Random) -> bytes:
    """A field of 1 to 8 bytes set to a value that programs forget."""
    width = int(random.choice((1, 2, 4, 8)))
    value = EXTREMES[width][int(random.integers(len(EXTREMES[width])))]
    at = _place(data, random)
    if random.random() < 0.5:
        at -= at % min(width, 2)
    return data[:at] + value + data[at + width :]


def inserted(data: bytes, random: Random) -> bytes:
    """Random bytes put in."""
    start, end = _span(data, random)
    return data[:start] + random.bytes(end - start) + data[start:]


def removed(data: bytes, random: Random) -> bytes:
    """Bytes taken out."""
    start, end = _span(data, random)
    return data[:start] + data[end:]


def repeated(data: bytes, random: Random) -> bytes:
    """A stretch that stands there twice."""
    start, end = _span(data, random)
    return data[:end] + data[start:]


def overwritten(data: bytes, random: Random) -> bytes:
    """A stretch of zeros, of ones or of noise, as of a bad disk."""
    start, end = _span(data, random)
    size = min(end, len(data)) - start
    fill = (bytes(size), b"\xff" * size, random.bytes(size))[int(random.integers(3))]
    return data[:start] + fill + data[start + size :]


def exchanged(data: bytes, random: Random) -> bytes:
    """Two stretches in each other's place."""
    size = int(2 ** random.uniform(2, 10))
    if len(data) < 2 * size:
        return truncated(data, random)
    one = int(random.integers(len(data) - 2 * size + 1))
    other = int(random.integers(one + size, len(data) - size + 1))
    parts = data[:one], data[other : other + size], data[one + size : other]
    return b"".join((*parts, data[one : one + size], data[other + size :]))


BYTES = (truncated, flipped, flipped, extreme, extreme, inserted, removed, repeated, overwritten)
BYTES = (*BYTES, exchanged)


def _replaced(pattern: str, others: tuple[str, ...]) -> Callable[[bytes, Random], bytes]:
    """What puts something else in the place of one match of a pattern."""

    def replaced(data: bytes, random: Random) -> bytes:
        text = data.decode("utf-8", "replace")
        found = list(re.finditer(pattern, text))
        if not found:
            return truncated(data, random)
        match = found[int(random.integers(len(found)))]
        new = others[int(random.integers(len(others)))]
        return (text[: match.start()] + new + text[match.end() :]).encode("utf-8", "surrogatepass")

    return replaced


number_replaced = _replaced(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", NUMBERS)
word_replaced = _replaced(r"[A-Za-z_]\w*", WORDS)


def line_changed(data: bytes, random: Random) -> bytes:
    """Lines lost, doubled, moved, under another name, endless, or thousands of empty ones."""
    lines = data.decode("utf-8", "replace").splitlines() or [""]
    at, to = (int(v) for v in random.integers(len(lines), size=2))
    many = int(10 ** random.uniform(2, 5.3))
    match int(random.integers(7)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[at])
        case 2:
            lines[at], lines[to] = lines[to], lines[at]
        case 3:
            lines.append("N" + lines[at])
        case 4:
            lines[at:at] = [(" ", "", "\t")[int(random.integers(3))]] * many
        case 5:
            lines.insert(at, (" ", "(", "a", ",", "=", "-", "\n ")[int(random.integers(7))] * many)
        case _:
            lines[at] = lines[at].swapcase()
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


def recoded(data: bytes, random: Random) -> bytes:
    """Another encoding, line ends or separators."""
    text = data.decode("utf-8", "replace")
    kind = int(random.integers(6))
    if kind < 3:
        return text.encode(("utf-16", "utf-8-sig", "cp1252")[kind], "replace")
    return text.replace(*((",", ";"), (".", ","), ("\n", "\r\r\n"))[kind - 3]).encode()


TEXT = (number_replaced, number_replaced, number_replaced, word_replaced, line_changed)
TEXT = (*TEXT, line_changed, recoded, truncated, flipped, removed, repeated, exchanged)


def damaged(data: bytes, seed: int, ways: tuple[Callable, ...] = BYTES) -> bytes:
    """The file with one kind of damage; the same for the same seed."""
    random = np.random.default_rng(seed)
    return ways[int(random.integers(len(ways)))](data, random)
