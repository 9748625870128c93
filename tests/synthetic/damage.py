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


def truncated(data: bytes, random: Random) -> tuple[bytes, str]:
    """Cut short: anywhere, or by a few bytes."""
    near_end = random.random() < 0.3
    left = max(0, len(data) - 1 - int(random.integers(64))) if near_end else None
    left = int(random.integers(len(data))) if left is None else left
    return data[:left], f"truncated to {left} of {len(data)} bytes"


def _place(data: bytes, random: Random) -> int:
    """A byte of the file; of its first 600 bytes as often as of all others."""
    return int(random.integers(min(len(data), 600) if random.random() < 0.5 else len(data)))


def flipped(data: bytes, random: Random) -> tuple[bytes, str]:
    """One to eight bits the other way round."""
    out, places = bytearray(data), []
    for _ in range(int(random.integers(1, 9))):
        at, bit = _place(data, random), int(random.integers(8))
        out[at] ^= 1 << bit
        places.append(at)
    return bytes(out), f"bits flipped in bytes {sorted(places)}"


def extreme(data: bytes, random: Random) -> tuple[bytes, str]:
    """A field of 1 to 8 bytes set to a value that programs forget."""
    width = int(random.choice((1, 2, 4, 8)))
    value = EXTREMES[width][int(random.integers(len(EXTREMES[width])))]
    at = _place(data, random)
    if random.random() < 0.5:
        at -= at % min(width, 2)
    return data[:at] + value + data[at + width :], f"bytes {at} to {at + width - 1}: {value.hex()}"


def _span(data: bytes, random: Random) -> tuple[int, int]:
    return _place(data, random), int(2 ** random.uniform(0, 12))


def inserted(data: bytes, random: Random) -> tuple[bytes, str]:
    """Random bytes put in."""
    at, size = _span(data, random)
    return data[:at] + random.bytes(size) + data[at:], f"{size} bytes inserted at {at}"


def removed(data: bytes, random: Random) -> tuple[bytes, str]:
    """Bytes taken out."""
    at, size = _span(data, random)
    return data[:at] + data[at + size :], f"{size} bytes removed at {at}"


def repeated(data: bytes, random: Random) -> tuple[bytes, str]:
    """A stretch that stands there twice."""
    at, size = _span(data, random)
    return data[: at + size] + data[at:], f"{size} bytes repeated at {at}"


def overwritten(data: bytes, random: Random) -> tuple[bytes, str]:
    """A stretch of zeros, of ones or of noise, as of a bad disk."""
    at, size = _span(data, random)
    size = min(size, len(data) - at)
    fill = (bytes(size), b"\xff" * size, random.bytes(size))[int(random.integers(3))]
    return data[:at] + fill + data[at + size :], f"bytes {at} to {at + size - 1} overwritten"


def exchanged(data: bytes, random: Random) -> tuple[bytes, str]:
    """Two stretches in each other's place."""
    size = int(2 ** random.uniform(2, 10))
    if len(data) < 2 * size:
        return truncated(data, random)
    one = int(random.integers(len(data) - 2 * size + 1))
    other = int(random.integers(one + size, len(data) - size + 1))
    out = bytearray(data)
    out[one : one + size], out[other : other + size] = (
        data[other : other + size],
        data[one : one + size],
    )
    return bytes(out), f"{size} bytes at {one} and at {other} exchanged"


BYTES = (truncated, flipped, flipped, extreme, extreme, inserted, removed, repeated, overwritten)
BYTES = (*BYTES, exchanged)


def _lines(data: bytes) -> list[str]:
    return data.decode("utf-8", "replace").splitlines()


def _joined(lines: list[str], what: str) -> tuple[bytes, str]:
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass"), what


def number_replaced(data: bytes, random: Random) -> tuple[bytes, str]:
    """One of the numbers becomes something else."""
    text = data.decode("utf-8", "replace")
    found = list(re.finditer(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", text))
    if not found:
        return truncated(data, random)
    match, new = (
        found[int(random.integers(len(found)))],
        NUMBERS[int(random.integers(len(NUMBERS)))],
    )
    text = text[: match.start()] + new + text[match.end() :]
    return text.encode(), f"{match[0]!r} at {match.start()} became {new[:30]!r}"


def word_replaced(data: bytes, random: Random) -> tuple[bytes, str]:
    """A name or an id becomes something else."""
    text = data.decode("utf-8", "replace")
    found = list(re.finditer(r"[A-Za-z_]\w*", text))
    if not found:
        return truncated(data, random)
    match, new = found[int(random.integers(len(found)))], WORDS[int(random.integers(len(WORDS)))]
    text = text[: match.start()] + new + text[match.end() :]
    return text.encode(), f"{match[0][:30]!r} at {match.start()} became {new[:30]!r}"


def line_changed(data: bytes, random: Random) -> tuple[bytes, str]:
    """Lines lost, doubled, moved, doubled under another name, or thousands of empty ones."""
    lines = _lines(data) or [""]
    at, to = (int(v) for v in random.integers(len(lines), size=2))
    kind = int(random.integers(7))
    if kind == 0:
        return _joined(lines[:at] + lines[at + 1 :], f"line {at + 1} removed")
    if kind == 1:
        return _joined([*lines[:at], lines[at], *lines[at:]], f"line {at + 1} doubled")
    if kind == 2:
        lines[at], lines[to] = lines[to], lines[at]
        return _joined(lines, f"lines {at + 1} and {to + 1} exchanged")
    if kind == 3:
        again = "N" + lines[at]
        return _joined([*lines, again], f"line {at + 1} again under another name")
    if kind == 4:
        empty = int(10 ** random.uniform(2, 5.3))
        blank = (" ", "", "\t")[int(random.integers(3))]
        return _joined([*lines[:at], *[blank] * empty, *lines[at:]], f"{empty} blank lines")
    if kind == 5:
        long = (" ", "(", "a", ",", "=", "-", "\n ")[int(random.integers(7))]
        size = int(10 ** random.uniform(2, 5.3))
        return _joined([*lines[:at], long * size, *lines[at:]], f"{size} times {long!r}")
    lines[at] = lines[at].swapcase()
    return _joined(lines, f"line {at + 1} in other case")


def recoded(data: bytes, random: Random) -> tuple[bytes, str]:
    """Another encoding, line ends or separators."""
    text = data.decode("utf-8", "replace")
    kind = int(random.integers(6))
    if kind < 3:
        name = ("utf-16", "utf-8-sig", "cp1252")[kind]
        return text.encode(name, "replace"), f"in {name}"
    old, new = ((",", ";"), (".", ","), ("\n", "\r\r\n"))[kind - 3]
    return text.replace(old, new).encode(), f"{old!r} became {new!r}"


TEXT = (number_replaced, number_replaced, number_replaced, word_replaced, line_changed)
TEXT = (*TEXT, line_changed, recoded, truncated, flipped, removed, repeated, exchanged)


def damaged(data: bytes, seed: int, ways: tuple[Callable, ...] = BYTES) -> tuple[bytes, str]:
    """The file with one kind of damage, and what was done; the same for the same seed."""
    random = np.random.default_rng(seed)
    return ways[int(random.integers(len(ways)))](data, random)
