"""COPC files made here, and a web server on the loopback that counts what it sends and fails."""

from __future__ import annotations

import io
import json
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from threading import Lock, Thread

import laspy
import lazrs
import numpy as np
import pyproj
from laspy.vlrs.known import LasZipVlr

UTM = pyproj.CRS("EPSG:32650").to_3d()
CORNER = np.array([500_000.0, 3_300_000.0, -900.0])
ENTRY = struct.Struct("<4iQii")
INFO_AT = 375 + 54


@dataclass
class MadeCopc:
    """A COPC file in memory; ``entries`` of its hierarchy: (level, x, y, z, start, bytes, n)."""

    content: bytes
    entries: list[tuple[int, ...]]
    hierarchy_at: int


def thinned_surface(
    rng: np.random.Generator, points: int, side: float, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (level, x, y, z) [points, 4] of random points on a surface in a cube of that ``side``
    (m), and their coordinates [points, 3] (m) from its corner, both in the order of the nodes.

    A point stays at a level with a probability of 4**level, as in a thinned surface.
    """
    xyz = rng.uniform(0, side, (points, 3))
    xyz[:, 2] = 900 + 40 * np.sin(xyz[:, 0] / 90) + 30 * np.cos(xyz[:, 1] / 70)
    xyz[:, 2] *= min(1.0, side / 1000)  # inside of the cube
    xyz = np.round(xyz, 2)
    shares = 4.0 ** np.arange(levels)
    level = rng.choice(levels, points, p=shares / shares.sum())
    place = xyz / (side / 2.0**level)[:, None]
    place = np.minimum(place, (2.0**level - 1)[:, None], out=place).astype(np.int16)
    key = np.column_stack([level.astype(np.int16), place])
    del level, place  # of files of many points
    order = np.lexsort(key.T[::-1])
    return key[order], xyz[order]


def make_copc(
    points: int = 20_000, side: float = 2048.0, levels: int = 5, seed: int = 0, form: int = 6
) -> MadeCopc:
    """A :func:`thinned_surface` in an octree of so many levels, with pages below level 1.

    ``form``: of its points, 6 to 8. A node without points is in the hierarchy, too.
    """
    rng = np.random.default_rng(seed)
    key, xyz = thinned_surface(rng, points, side, levels)
    header = laspy.LasHeader(point_format=form, version="1.4")
    header.scales, header.offsets = [0.01] * 3, CORNER
    header.are_points_compressed, header.point_count = True, points
    header.mins, header.maxs = CORNER + xyz.min(axis=0), CORNER + xyz.max(axis=0)
    header.global_encoding.wkt = True
    header.number_of_points_by_return = np.array([points, *[0] * 14], np.uint32)
    packing = lazrs.LazVlr.new_for_compression(form, 0, True)
    wkt = UTM.to_wkt().encode() + b"\0"
    header.vlrs = [
        laspy.VLR("copc", 1, "", bytes(160)),
        LasZipVlr(packing.record_data()),
        laspy.VLR("LASF_Projection", 2112, "", wkt),
    ]
    record = laspy.ScaleAwarePointRecord.zeros(points, header=header)
    for axis, values in zip("XYZ", xyz.T):
        record.array[axis] = np.round(values * 100)
    one = np.ones(points, np.uint8)
    record["classification"], record["return_number"] = rng.integers(2, 7, points), one
    record["number_of_returns"], record["gps_time"] = one, np.arange(points, dtype=float)
    stream = io.BytesIO()
    header.write_to(stream)
    entries = _compressed(stream, packing, record.array, key)
    hierarchy_at = stream.seek(0, 2) + 60
    pages = _pages(entries, hierarchy_at)
    stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(pages[0]), b"") + pages[0])
    content = bytearray(stream.getvalue())
    struct.pack_into("<QI", content, 235, hierarchy_at - 60, 1)
    middle = CORNER + side / 2
    info = struct.pack("<5d2Q2d", *middle, side / 2, 10.0, hierarchy_at, pages[1], 0, points)
    content[INFO_AT : INFO_AT + len(info)] = info
    return MadeCopc(bytes(content), entries, hierarchy_at)


def points_of(records) -> np.ndarray:
    """What ingest takes of the points, in their order."""
    names = ["X", "Y", "Z", "classification", "return_number", "number_of_returns", "gps_time"]
    return np.array([np.concatenate([np.asarray(r[n]) for r in records]) for n in names])


def _compressed(stream, packing, array, key) -> list[tuple[int, ...]]:
    """Write each node as a chunk; the entries of the hierarchy."""
    bounds = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1), True])
    compressor = lazrs.LasZipCompressor(stream, packing)
    first = stream.tell()
    for start, end in pairwise(bounds):
        compressor.compress_many(np.frombuffer(array[start:end].tobytes(), np.uint8))
        if end < len(array):  # the last is finished by done()
            compressor.finish_current_chunk()
    compressor.done()
    stream.seek(first)
    sizes = lazrs.read_chunk_table(stream, packing)
    entries, at = [], first + 8
    for start, (n, size) in zip(bounds, sizes):
        entries.append((*map(int, key[start]), at, int(size), int(n)))
        at += size
    return entries


def _pages(entries, at) -> tuple[bytes, int]:
    """The hierarchy, and the bytes of its first page."""
    root = [e for e in entries if e[0] < 2]
    root.append((9, 0, 0, 0, 0, 0, 0))
    below: dict[tuple, list] = {}
    for e in entries:
        if e[0] >= 2:
            up = e[0] - 2
            below.setdefault((2, *(v >> up for v in e[1:4])), []).append(e)
    start, later = at + ENTRY.size * (len(root) + len(below)), b""
    for key, held in below.items():
        page = b"".join(ENTRY.pack(*e) for e in held)
        root.append((*key, start + len(later), len(page), -1))
        later += page
    first = b"".join(ENTRY.pack(*e) for e in root)
    return first + later, len(first)


def _status(status: int, **headers: str) -> Callable[[Server], tuple[int, dict[str, str]]]:
    return lambda server: (status, {n.replace("_", "-"): v for n, v in headers.items()})


# What a server does wrong, at one request or from then on: whether a client gets over it, and the
# status and headers of the answer. Those without are parts of a file that Answer spoils.
SERVER_FAULTS: dict[str, tuple[bool, Callable[[Server], tuple[int, dict[str, str]]] | None]] = {
    "429 with seconds": (True, _status(429, Retry_After="1")),
    "429 with a date": (True, lambda s: (429, {"Retry-After": formatdate(time.time() + 1)})),
    "redirect to itself once": (True, lambda s: (302, {"Location": s.url})),
    "reset": (True, None),
    "short body": (True, None),
    "no Content-Range": (True, None),
    "shifted range": (True, None),
    "stall": (True, None),
    "503 for ever": (False, _status(503)),
    "429 for an hour": (False, _status(429, Retry_After="3600")),
    "gone": (False, _status(410)),
    "forbidden": (False, _status(403)),
    "redirect loop": (False, lambda s: (302, {"Location": s.url + "?signature=verysecret"})),
    "redirect to file:": (False, _status(302, Location="file:///etc/passwd")),
    "redirect to another host": (False, lambda s: (302, {"Location": s.target})),
    "redirect to another port": (False, _status(302, Location="http://127.0.0.1:9/x?sig=secret")),
    "drip": (False, None),
    "no ranges": (False, None),
    "encoded": (False, None),
    "replaced: size": (False, None),
    "replaced: ETag": (False, None),
}


@dataclass
class Server:
    """A server of a file at ``url``, or of a folder's files; ``requests`` and bytes ``sent``.

    It does wrong by ``fault`` at request ``when`` (from 0), or from then on.
    """

    content: bytes | Path
    fault: str = ""
    when: int = 0
    sent: int = 0
    requests: list[str] = field(default_factory=list)
    url: str = ""
    target: str = "http://other.invalid/x?sig=secret"  # of redirects to another host
    lock: Lock = field(default_factory=Lock)

    def stand_in(self, name: str = "", content: str = '"one"', hosts: Sequence[str] = ()) -> Path:
        """What a plan writes in the place of the file, or of one of the folder's."""
        held = (
            self.content if isinstance(self.content, bytes) else (self.content / name).read_bytes()
        )
        url = f"{self.url}{name}"
        place = Path("results", "remote", *url.replace("://", "/").split("/"))
        place.parent.mkdir(parents=True, exist_ok=True)
        state = {"size": len(held), "content": content, "hosts": list(hosts)}
        place.write_text(json.dumps(state) + "\n")
        return place


class Answer(BaseHTTPRequestHandler):
    """Answers of a :class:`Server`, the ``state`` of the class."""

    protocol_version = "HTTP/1.1"
    state: Server

    def do_GET(self) -> None:
        state = self.state
        with state.lock:
            number = len(state.requests)
            state.requests.append(f"{self.path} {self.headers.get('Range')}")
        lasting = not SERVER_FAULTS.get(state.fault, (True, None))[0]
        faulty = number >= state.when if lasting else number == state.when
        with suppress(OSError):  # a client that has lost its patience
            self.answer(state.fault if faulty else "")

    do_HEAD = do_GET

    def answer(self, fault: str) -> None:
        content, span, wanted = self.state.content, {}, self.headers.get("Range")
        if isinstance(content, Path):
            file = content / self.path.strip("/")
            if not file.is_file():
                return self.send(404, {})
            content = file.read_bytes()
        if fault and (status := SERVER_FAULTS[fault][1]):
            return self.send(*status(self.state))
        if fault == "reset":
            self.close_connection = True
            return None
        if fault == "stall":
            time.sleep(1.0)
        tag = '"two"' if fault == "replaced: ETag" else '"one"'
        if wanted is None or fault == "no ranges":
            return self.send(200, {"ETag": tag}, content)
        first, last = map(int, wanted.removeprefix("bytes=").split("-"))
        last = min(last, len(content) - 1)
        shift = int(fault == "shifted range" and first > 0)
        if fault != "no Content-Range":
            size = len(content) + (fault == "replaced: size")
            span = {"Content-Range": f"bytes {first - shift}-{last - shift}/{size}"}
        if fault == "encoded":
            span["Content-Encoding"] = "gzip"
        body = content[first - shift : last + 1 - shift]
        self.send(206, span | {"ETag": tag}, body, fault)

    def send(self, status: int, headers: dict, body: bytes = b"", fault: str = "") -> None:
        self.send_response(status)
        for name, value in (headers | {"Content-Length": str(len(body))}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "HEAD":
            return
        if fault == "drip":
            return self.drip(body[:1])
        body = body[: len(body) // 2] if fault == "short body" else body
        self.close_connection = self.close_connection or fault == "short body"
        self.wfile.write(body)
        with self.state.lock:
            self.state.sent += len(body)

    def drip(self, first: bytes) -> None:
        """A byte each tenth of a second, a minute at most."""
        self.wfile.write(first)
        for _ in range(600):
            self.wfile.write(b"x")
            time.sleep(0.1)

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving(content: bytes | Path, fault: str = "", when: int = 0) -> Iterator[Server]:
    """A server on the loopback."""
    state = Server(content, fault, when)
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Answers", (Answer,), {"state": state}))
    server.daemon_threads, server.block_on_close = True, False
    name = "tile.copc.laz" if isinstance(content, bytes) else ""
    state.url = f"http://127.0.0.1:{server.server_port}/{name}"
    Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()


@dataclass
class Damaged:
    """A copy of a made file to be damaged; ``info``: cube's centre and half side, spacing, place
    and bytes of the first page."""

    made: MadeCopc
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.content = bytearray(self.made.content)
        self.info = list(struct.unpack_from("<5d2Q", self.content, INFO_AT))

    def entry(self, but: Sequence[int] = ()) -> tuple[int, list]:
        """Place and values of a random node's entry, of another one than ``but``."""
        at, values = 0, list(but)
        while values == list(but) or values[6] <= 0:
            span = (len(self.made.content) - self.made.hierarchy_at) // ENTRY.size
            at = self.made.hierarchy_at + ENTRY.size * int(self.rng.integers(span))
            values = list(ENTRY.unpack_from(self.content, at))
        return at, values

    def change_entry(self, change: Callable[[list], list]) -> None:
        at, values = self.entry()
        ENTRY.pack_into(self.content, at, *change(values))

    def set_info(self, which: int, value: float) -> None:
        self.info[which] = value

    def pack(self, form: str, at: int, *values: float) -> None:
        struct.pack_into(form, self.content, at, *values)

    def copy_entry(self, swap: bool) -> None:
        """One node in the place of another one, or two nodes swapped."""
        at, one = self.entry()
        other_at, other = self.entry(but=one)
        ENTRY.pack_into(self.content, at, *(one[:4] + other[4:] if swap else other))
        if swap:
            ENTRY.pack_into(self.content, other_at, *other[:4], *one[4:])

    def add_pages(self) -> None:
        """A root of many pages, each most of the file."""
        start, size = len(self.content), ENTRY.size
        for k in range(5000):
            self.content += ENTRY.pack(1, 0, 0, 0, start, size * (5000 - k), -1)
        self.info[5:] = start, size * 5000


# What is wrong with a file, whether all points come all the same (None: they do, or it is refused),
# and how it is planted.
FILE_FAULTS: dict[str, tuple[bool | None, Callable[[Damaged], object]]] = {
    "header bounds": (True, lambda f: f.pack("<4d", 179, *f.rng.uniform(4e5, 5e5, 4))),
    "header bounds not filled in": (True, lambda f: f.pack("<6d", 179, *[0.0] * 6)),
    "header count": (False, lambda f: f.pack("<Q", 247, int(f.rng.integers(1, 10**6)))),
    "count of a node": (False, lambda f: f.change_entry(lambda e: [*e[:6], e[6] + 3])),
    "key of a node": (False, lambda f: f.change_entry(lambda e: [e[0], 2 ** e[0] + 1, *e[2:]])),
    "node left out": (False, lambda f: f.change_entry(lambda e: [3, 0, 0, 7, 0, 0, 0])),
    "node doubled": (False, lambda f: f.copy_entry(swap=False)),
    "two nodes swapped": (None, lambda f: f.copy_entry(swap=True)),
    "page loop": (False, lambda f: f.change_entry(lambda e: [*e[:4], *f.info[5:], -1])),
    "pages that overlap": (False, lambda f: f.add_pages()),
    "records without end": (False, lambda f: f.pack("<I", 243, 4_000_000_000)),
    "hierarchy out of the file": (False, lambda f: f.set_info(5, len(f.content) - 20)),
    "cube too small": (False, lambda f: f.set_info(3, f.info[3] * f.rng.uniform(0.3, 0.9))),
    "cube shifted": (False, lambda f: f.set_info(0, f.info[0] + f.rng.uniform(50, 900))),
    "cube not a number": (False, lambda f: f.set_info(3, np.nan)),
    "file cut": (False, lambda f: f.content.__delitem__(slice(len(f.content) // 2, None))),
    "chunk table": (False, lambda f: f.content.__setitem__(f.made.hierarchy_at - 70, 0xA5)),
    "layers of a chunk": (False, lambda f: f.pack("<I", f.made.entries[0][4] + 34, 2**30)),
    "no info record": (False, lambda f: f.pack("<4s", INFO_AT - 52, b"none")),
}


def damaged(made: MadeCopc, fault: str, rng: np.random.Generator) -> bytes:
    """The content of a file with a fault."""
    file = Damaged(made, rng)
    FILE_FAULTS[fault][1](file)
    if fault != "file cut":
        file.pack("<5d2Q", INFO_AT, *file.info)
    return bytes(file.content)
