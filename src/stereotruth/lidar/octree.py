"""Octrees of points (COPC, EPT) of which a footprint is read, with checks that none is missing.

Which nodes (cubes of half the side of their parent's) may hold points of a footprint follows from
the octree's own cube, never from the header's bounds. The counts of all nodes must add up to the
header's, and each node that is read must hold as many points, all within its cube. laspy's reader
of COPC is not asked, as its answer is cut by a box, and cannot tell whether a node keeps to its
cube. See docs/how-to/national_lidar.md. Sources: COPC 1.0 (Hobu), a LAZ file whose chunks are the
nodes; Entwine Point Tile 1.0 (entwine.io), where each node is a LAZ file.
"""

from __future__ import annotations

import io
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.copc import CopcInfoVlr
from laspy.point.record import PackedPointRecord, ScaleAwarePointRecord
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from ..core.errors import InputError, in_number
from ..core.numerics.arrays import Bools, Floats
from ..core.products.file_parts import (
    GLANCE_BYTES,
    LocalParts,
    copies_of,
    kept,
    open_parts,
    open_stream,
)
from ..core.products.remote_files import AT_ONCE, hosts_of, read_bytes, url_of
from .catalogue_list import EPT
from .las_files import FIELDS, LAYERED, Layout, check_layout, decoding, records, require

Numbers = NDArray[np.intp]
Touches = Callable[[Floats, Floats], Bools]
"""Which boxes, by lowest and highest corners [n, 3], may hold points that are wanted."""

NODE = np.dtype([("key", "<i4", 4), ("start", "<i8"), ("bytes", "<i8"), ("points", "<i8")])
"""A node: level, x, y, z; its first byte in the file, the bytes of its compressed points, and how
many these are. In EPT, where a node is a file, the bytes are an estimate."""

MOST_LEVELS = 30  # keys of nodes stay within 32 bits
MOST_NODES = 4_000_000  # of a hierarchy, which is kept in memory
MOST_NODE_POINTS = 5_000_000  # decoded at once
BATCH_BYTES = 16 << 20  # of nodes that are fetched together
STEPS_OUTSIDE = 2  # of the stored coordinates, that a point may lie outside of its node's cube

ENTRY = np.dtype([("key", "<i4", 4), ("start", "<u8"), ("bytes", "<i4"), ("points", "<i4")])
PAGE = -1  # in the place of a node's points: its entry stands in another page
MOST_HEAD_BYTES = 16 << 20  # of header and records
MOST_EVLRS = 1000  # each of which is a request
MOST_RAW_BYTES = 1 << 30  # of the decoded points of a node

MOST_JSON_BYTES = 64 << 20  # of ept.json, and of a file of the hierarchy
MOST_NODE_BYTES = 256 << 20
KEY = re.compile(r"([0-9]{1,2})-([0-9]{1,9})-([0-9]{1,9})-([0-9]{1,9})")
TOP = "0-0-0-0"


def shown(node: np.void) -> str:
    """The key of a node, as EPT names its file."""
    return "-".join(map(str, node["key"]))


class Octree(ABC):
    """An octree of points; made by :func:`open_octree`.

    ``name``: path or URL; ``header``: coordinate system, scales and offsets, point format, count
    and stated bounds of the whole; ``nodes``: all that have points [n] (:data:`NODE`), in the order
    of the file; ``low``, ``side``: lowest corner [3] and side of the octree's cube.
    """

    name: str
    header: laspy.LasHeader
    nodes: np.ndarray
    low: Floats
    side: float

    @abstractmethod
    def _contents(self, numbers: Numbers) -> Iterator[bytes]:
        """The compressed points of each of the nodes."""

    @abstractmethod
    def _points(self, count: int, content: bytes) -> ScaleAwarePointRecord:
        """The points of a node that holds so many. Raises whatever libraries raise."""

    def boxes(self, nodes: np.ndarray) -> tuple[Floats, Floats]:
        """Lowest and highest corners [n, 3] of nodes' cubes, with what rounding may add to them."""
        keys = nodes["key"].astype(np.float64)
        side = self.side / 2.0 ** keys[:, :1]
        low = self.low + keys[:, 1:] * side
        slack = STEPS_OUTSIDE * np.asarray(self.header.scales)
        return low - slack, low + side + slack

    def plan(self, touches: Touches | None) -> Numbers:
        """Which of the nodes, by number, are to be read for a footprint; all of them for None.

        Those that may hold points of it; and, unless there is none, the root and one of the finest,
        which prove the octree's cube.

        Raises InputError if the header's bounds and the octree's cube contradict each other about
        whether there are points in the footprint.
        """
        if touches is None:
            return np.arange(len(self.nodes))
        wanted = np.array(touches(*self.boxes(self.nodes)), bool)
        if not wanted.any():
            bounds = np.array([[self.header.mins], [self.header.maxs]])
            beyond = (bounds[0, 0] < self.low) | (bounds[1, 0] > self.low + self.side)
            if np.isfinite(bounds).all() and beyond.any() and touches(*bounds)[0]:
                raise self._refusal(
                    "the header's bounds reach out of the octree's cube, into the footprint"
                )
            return np.empty(0, np.intp)
        level = self.nodes["key"][:, 0]
        if level[wanted].max() < level.max():
            wanted[np.argmax(level)] = True
        wanted[np.lexsort(self.nodes["key"].T[::-1])[0]] = True  # the root
        return np.flatnonzero(wanted)

    def read(self, numbers: Numbers) -> Iterator[ScaleAwarePointRecord]:
        """All points of the nodes of these numbers, node by node in the order of the file.

        Of each point :data:`.las_files.FIELDS` are decoded.

        Raises InputError: a node of other points than the hierarchy says, or points out of its
        cube; what a server or a damaged file fails with.
        """
        for node, content in zip(self.nodes[numbers], self._contents(numbers), strict=True):
            with decoding(lambda error, n=node: self._refusal(f"node {shown(n)}: {error}")):
                points = self._points(int(node["points"]), content)
            if len(points) != node["points"]:
                raise self._refusal(
                    f"node {shown(node)} holds {len(points)} points, the hierarchy says "
                    f"{node['points']}"
                )
            stored = np.stack([points.array[axis] for axis in "XYZ"], axis=1)
            self._refuse_outside(stored, node.reshape(1))
            yield points

    def _refuse_outside(self, stored: NDArray[np.int32], nodes: np.ndarray) -> None:
        """Raise InputError unless each point [n, 3] lies in the cube of its node, or of the one."""
        xyz = stored * np.asarray(self.header.scales) + np.asarray(self.header.offsets)
        low, high = self.boxes(nodes)
        outside = ((xyz < low) | (xyz > high)).any(axis=1)
        if outside.any():
            node = nodes[int(np.argmax(outside)) % len(nodes)]
            raise self._refusal(
                f"{in_number(int(outside.sum()), 'point')}, as of node {shown(node)}, "
                "outside of its cube: nodes that hold points of the footprint cannot be told"
            )

    def _refuse_incomplete(self) -> None:
        """Raise InputError unless there is an octree of as many points as the header counts."""
        level, *at = self.nodes["key"].T.astype(np.int64)
        good = (level >= 0) & (level <= MOST_LEVELS) & (np.array(at) >= 0).all(axis=0)
        good &= (np.array(at) < 2 ** np.clip(level, 0, MOST_LEVELS)).all(axis=0)
        if not good.all():
            raise self._refusal(f"its hierarchy has a node {shown(self.nodes[np.argmin(good)])}")
        if len(np.unique(self.nodes["key"], axis=0)) < len(self.nodes):
            raise self._refusal("a node stands twice in its hierarchy")
        held, wanted = int(self.nodes["points"].sum()), int(self.header.point_count)
        if held != wanted:
            raise self._refusal(
                f"the header announces {wanted} points, the nodes of its hierarchy hold {held}"
            )
        if (self.nodes["points"] > MOST_NODE_POINTS).any():
            raise self._refusal(f"a node has more than {MOST_NODE_POINTS} points")

    def _refusal(self, problem: object) -> InputError:
        return InputError(
            f"truncated or damaged: {problem}",
            file=self.name,
            remedy="have the file written again, or download it and name the copy to read it whole",
        )


class Copc(Octree):
    """A COPC file of which parts are read; its hierarchy is read here, and proven complete."""

    def __init__(self, path: Path) -> None:
        self._parts = open_parts(path)
        self.name = self._parts.name
        layout = check_layout(path, layers=False)
        with decoding(self._refusal):
            require(layout.minor == 4 and layout.format in (6, 7, 8), "COPC is LAS 1.4, 6 to 8")
            packing, chunks = layout.packing, layout.chunks
            if packing is None or chunks is None or packing.kind != LAYERED:
                raise self._refusal("its points are not compressed in layers")
            require(
                layout.first_point <= MOST_HEAD_BYTES and layout.evlrs <= MOST_EVLRS,
                f"points from byte {layout.first_point} on, {layout.evlrs} records behind them",
            )
            self._packing = packing
            with open_stream(path, GLANCE_BYTES) as stream:
                self.header = laspy.LasHeader.read_from(stream)
                self.header.vlrs.extend(self._systems_behind(stream, layout))
            info = self.header.vlrs[0]
            if not isinstance(info, CopcInfoVlr):
                raise InputError(
                    "no COPC: its first record is another one",
                    file=self.name,
                    remedy="name it .laz without .copc, to read it whole",
                )
            require(
                bool(np.isfinite([*info.center, info.halfsize]).all() and info.halfsize > 0),
                f"the octree's cube has its centre at {info.center} and half a side of "
                f"{info.halfsize}",
            )
            self.low, self.side = info.center - info.halfsize, 2 * info.halfsize
            root = info.hierarchy_root_offset, info.hierarchy_root_size
            self.nodes = self._hierarchy((root[0], sum(root)))
            by_return = sum(map(int, self.header.number_of_points_by_return))
            require(by_return <= layout.points, f"its counts by return add up to {by_return}")
            self._refuse_incomplete()
            most = int(self.nodes["points"].max()) * layout.record_bytes
            require(most <= MOST_RAW_BYTES, f"a node has {most} bytes of points")
            starts = layout.first_point + 8 + np.cumsum(chunks[:, 1]) - chunks[:, 1]
            told = np.column_stack([self.nodes[field] for field in ("points", "bytes", "start")])
            require(
                np.array_equal(np.column_stack([chunks, starts]), told),
                f"its chunk table has other chunks ({len(chunks)}) than its hierarchy has nodes "
                f"({len(told)})",
            )
            if isinstance(self._parts, LocalParts):  # a server would be asked for each of them
                # A chunk begins with its first point: a node whose key is another one's is found
                # though it is not read.
                first = self._parts.get([(at, at + 12) for at in self.nodes["start"].tolist()])
                stored = np.frombuffer(b"".join(first), "<i4").reshape(-1, 3)
                self._refuse_outside(stored, self.nodes)

    def _systems_behind(self, stream: BinaryIO, layout: Layout) -> list[laspy.VLR]:
        """The records behind the points that declare a coordinate system."""
        evlrs = records(stream, layout.first_evlr, layout.size, layout.evlrs, extended=True)
        systems = [record for record in evlrs if record[0] == b"LASF_Projection"]
        require(sum(s[3] for s in systems) <= MOST_HEAD_BYTES, "a system of too many bytes")
        contents = self._parts.get([(at, at + length) for _, _, at, length in systems])
        return [
            laspy.VLR("LASF_Projection", number, "", content)
            for (_, number, _, _), content in zip(systems, contents)
        ]

    def _hierarchy(self, root: tuple[int, int]) -> np.ndarray:
        """The nodes with points of all pages, in the order of the file."""
        found, entries, asked, pages, depth = [], 0, {root}, [root], 0
        while pages:
            depth += 1
            held = sum(end - start for start, end in asked)
            require(held <= self._parts.size, "pages of its hierarchy overlap")
            require(depth <= MOST_LEVELS + 1, "pages of its hierarchy are nested without end")
            contents, pages = self._parts.get(sorted(pages)), []
            for content in contents:
                require(
                    len(content) > 0 and len(content) % ENTRY.itemsize == 0,
                    f"a page of its hierarchy has {len(content)} bytes",
                )
                page = np.frombuffer(content, ENTRY)
                for entry in page[page["points"] == PAGE]:
                    below = (int(entry["start"]), int(entry["start"]) + int(entry["bytes"]))
                    require(below not in asked, "two places name one page of its hierarchy")
                    require(below[1] > below[0], "a page of its hierarchy is empty")
                    asked.add(below)
                    pages.append(below)
                found.append(page[page["points"] != PAGE])
                entries += len(page)
            require(entries <= MOST_NODES, "its hierarchy is too large")
        every = np.concatenate(found)
        require(not every["key"][:, 0].min(), "its hierarchy has no root")
        require(bool((every["points"] >= 0).all()), "a node has less than no points")
        nodes = every[every["points"] > 0].astype(NODE)
        return nodes[np.argsort(nodes["start"], kind="stable")]

    def _contents(self, numbers: Numbers) -> Iterator[bytes]:
        ends = np.cumsum(self.nodes["bytes"][numbers])
        for batch in np.split(numbers, np.flatnonzero(np.diff(ends // BATCH_BYTES)) + 1):
            start = self.nodes["start"][batch]
            end = start + self.nodes["bytes"][batch]
            yield from self._parts.get(list(zip(start.tolist(), end.tolist())))

    def _points(self, count: int, content: bytes) -> ScaleAwarePointRecord:
        form = self.header.point_format  # layers are held against the bytes first
        layers = np.frombuffer(content, "<u4", 1 + self._packing.layers, form.size).astype(np.int64)
        head = form.size + 4 * layers.size
        require(head + int(layers[1:].sum()) == len(content), "its layers do not fill it")
        require(int(layers[0]) == count, f"it holds {layers[0]} points, not {count}")
        raw = np.zeros(count * form.size, np.uint8)
        lazrs.decompress_points_with_chunk_table(
            content, self._packing.record, raw, [(count, len(content))], FIELDS.to_lazrs()
        )
        array = PackedPointRecord.from_buffer(raw, form).array
        return ScaleAwarePointRecord(array, form, self.header.scales, self.header.offsets)


class Ept(Octree):
    """A dataset of Entwine Point Tiles; its hierarchy is read here, and proven complete.

    How many bytes a node has is told by its file alone: until then it is estimated by the points
    and bytes of the first one.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._url = path, url_of(path)
        self.name = self._url or str(path)
        with decoding(lambda error: self._refusal(f"{type(error).__name__} {error}")):
            about = self._json(path.name)
            bounds = np.array(about["bounds"], np.float64)
            sides = bounds[3:] - bounds[:3]
            good = bounds.shape == (6,) and np.isfinite(bounds).all() and sides.min() > 0
            require(good and np.ptp(sides) <= 1e-6 * sides.max(), "its bounds are no cube")
            self.low, self.side = bounds[:3], float(sides.max())
            if about["dataType"] != "laszip":
                raise InputError(
                    f"its points are stored as {str(about['dataType'])[:20]!r}, not as LAZ",
                    file=self.name,
                    remedy="have it written again with dataType laszip",
                )
            require(type(about["points"]) is int, "it does not count its points")
            counts = self._hierarchy()
            rows = [(tuple(map(int, key.split("-"))), 0, 0, n) for key, n in counts.items() if n]
            self.nodes = np.sort(np.array(rows, NODE), order="key")
            content = self._node_file(self.nodes[0])
            self.header = self._header_of_all(about, content)
            share = len(content) / self.nodes["points"][0]
            self.nodes["bytes"] = np.maximum(1, np.round(self.nodes["points"] * share))
            self._refuse_incomplete()

    def _read(self, name: str, most_bytes: int) -> bytes:
        """A file of the dataset, or its copy."""
        if self._url is None or name == self._path.name:
            parts = open_parts(self._path.parent / name)
            require(parts.size <= most_bytes, f"{name} has {parts.size} bytes")
            return parts.get([(0, parts.size)])[0]
        url, hosts = f"{self._url.rpartition('/')[0]}/{name}", hosts_of(self._path)
        copies = copies_of(self._path, self._url)
        return kept(copies, name, lambda: read_bytes(url, most_bytes, hosts=hosts))

    def _json(self, name: str) -> dict[str, Any]:
        content = json.loads(self._read(name, MOST_JSON_BYTES))
        require(isinstance(content, dict), f"{name} holds no object")
        return content

    def _hierarchy(self) -> dict[str, int]:
        """Points of each node by its key, of all files of the hierarchy."""
        counts: dict[str, int] = {}
        asked, waiting = {TOP}, [TOP]
        with ThreadPoolExecutor(AT_ONCE) as pool:
            while waiting:
                names = [f"ept-hierarchy/{key}.json" for key in waiting]
                pages, tops, waiting = pool.map(self._json, names), waiting, []
                for top, page in zip(tops, pages):
                    inner = {key for key, n in page.items() if n == -1 and key != top}
                    held = {key: n for key, n in page.items() if key not in inner}
                    good = top in held and all(map(KEY.fullmatch, page))
                    good &= all(type(n) is int and n >= 0 for n in held.values())
                    good &= inner.isdisjoint(asked) and counts.keys().isdisjoint(held)
                    require(good, f"part {top} of its hierarchy is none, or names a node again")
                    counts |= held
                    asked |= inner
                    waiting += inner
                    require(len(counts) + len(asked) <= MOST_NODES, "its hierarchy is too large")
        return counts

    def _header_of_all(self, about: dict[str, Any], content: bytes) -> laspy.LasHeader:
        """The header of a node, made that of the whole."""
        header = laspy.LasHeader.read_from(io.BytesIO(content))
        bounds = np.array(about.get("boundsConforming", about["bounds"]), np.float64)
        header.mins, header.maxs = bounds.reshape(2, 3)
        header.point_count = about["points"]
        header.number_of_points_by_return = np.zeros(15, np.uint32)  # of one node
        if system := _system(about.get("srs")):
            record = laspy.VLR("LASF_Projection", 2112, "", system.to_wkt().encode() + b"\0")
            others = [vlr for vlr in header.vlrs if vlr.user_id != "LASF_Projection"]
            header.vlrs = [*others, record]
            header.global_encoding.wkt = True
        return header

    def _node_file(self, node: np.void) -> bytes:
        return self._read(f"ept-data/{shown(node)}.laz", MOST_NODE_BYTES)

    def _contents(self, numbers: Numbers) -> Iterator[bytes]:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            for batch in np.split(numbers, range(AT_ONCE, len(numbers), AT_ONCE)):
                yield from pool.map(self._node_file, self.nodes[batch])

    def _points(self, count: int, content: bytes) -> ScaleAwarePointRecord:
        stream, backend = io.BytesIO(content), laspy.LazBackend.Lazrs
        with laspy.open(stream, laz_backend=backend, decompression_selection=FIELDS) as reader:
            one, whole = reader.header, self.header
            same = one.point_format == whole.point_format
            same &= np.array_equal([one.scales, one.offsets], [whole.scales, whole.offsets])
            require(same, "its points are stored otherwise than those of other nodes")
            require(one.point_count <= MOST_NODE_POINTS, f"it has {one.point_count} points")
            return reader.read_points(one.point_count)


def _system(srs: Any) -> CRS | None:
    """The coordinate system that ept.json states; None where it states none that can be read."""
    srs = srs if isinstance(srs, dict) else {}
    codes = [str(srs[part]) for part in ("horizontal", "vertical") if srs.get(part)]
    code = f"{srs.get('authority')}:{'+'.join(codes)}" if srs.get("horizontal") else None
    texts = [code, srs.get("wkt")] if len(codes) == 2 else [srs.get("wkt"), code]
    for text in filter(None, texts):
        with suppress(CRSError):
            return CRS.from_user_input(text)
    return None


def open_octree(path: str | Path) -> Octree:
    """A COPC file (``.copc.laz``) or EPT (``ept.json``), by path or stand-in.

    Raises InputError: missing, neither of both, damaged, or of a hierarchy that is not complete;
    what a server fails with.
    """
    return (Ept if Path(path).name.lower() == EPT else Copc)(Path(path))
