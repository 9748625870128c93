"""COPC files: header, chunk table and hierarchy, each held against the others, and their nodes.

A COPC file is a LAZ file whose chunks are the nodes of an octree. Its chunk table and its hierarchy
tell the same by different ways, so that a node that one of them lacks is found without reading it.
laspy reads the header and the records, lazrs decodes the chunk of a node. ``CopcReader.query`` is
not used: its answer is cut by a box, so that it cannot tell whether a node keeps to its cube, and
comes as one array, whatever its size. Source: COPC 1.0 (Hobu), "info VLR", "hierarchy VLR".
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.copc import CopcInfoVlr
from laspy.point.record import PackedPointRecord, ScaleAwarePointRecord
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.products.file_parts import GLANCE_BYTES, LocalParts, open_parts, open_stream
from .las_files import _decoding
from .las_layout import LAYERED, Layout, Packing, _records, _require, check_layout
from .octree import BATCH_BYTES, FIELDS, MOST_LEVELS, MOST_NODES, NODE, Octree

ENTRY = np.dtype([("key", "<i4", 4), ("start", "<u8"), ("bytes", "<i4"), ("points", "<i4")])
PAGE = -1  # in the place of a node's points: its entry stands in another page
MOST_HEAD_BYTES = 16 << 20  # of header and records
MOST_EVLRS = 1000  # each of which is a request
MOST_RAW_BYTES = 1 << 30  # of the decoded points of a node


class Copc(Octree):
    """A COPC file of which parts are read; its hierarchy is read here, and proven complete."""

    def __init__(self, path: Path) -> None:
        self._parts = open_parts(path)
        self.name = self._parts.name
        layout = check_layout(path, layers=False)
        with _decoding(lambda error: self._refusal(str(error))):
            _require(layout.minor == 4 and layout.format in (6, 7, 8), "COPC is LAS 1.4, 6 to 8")
            packing, chunks = layout.packing, layout.chunks
            if packing is None or chunks is None or packing.kind != LAYERED:
                raise self._refusal("its points are not compressed in layers")
            _require(
                layout.first_point <= MOST_HEAD_BYTES and layout.evlrs <= MOST_EVLRS,
                f"points from byte {layout.first_point} on, {layout.evlrs} records behind them",
            )
            self._packing: Packing = packing
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
            _require(
                bool(np.isfinite([*info.center, info.halfsize]).all() and info.halfsize > 0),
                f"the octree's cube has its centre at {info.center} and half a side of "
                f"{info.halfsize}",
            )
            self.low, self.side = info.center - info.halfsize, 2 * info.halfsize
            root = info.hierarchy_root_offset, info.hierarchy_root_size
            self.nodes = self._hierarchy((root[0], sum(root)))
            by_return = sum(map(int, self.header.number_of_points_by_return))
            _require(by_return <= layout.points, f"its counts by return add up to {by_return}")
            self._refuse_incomplete()
            most = int(self.nodes["points"].max()) * layout.record_bytes
            _require(most <= MOST_RAW_BYTES, f"a node has {most} bytes of points")
            starts = layout.first_point + 8 + np.cumsum(chunks[:, 1]) - chunks[:, 1]
            told = np.column_stack([self.nodes[field] for field in ("points", "bytes", "start")])
            _require(
                np.array_equal(np.column_stack([chunks, starts]), told),
                f"its chunk table has other chunks ({len(chunks)}) than its hierarchy has nodes "
                f"({len(told)})",
            )
            if isinstance(self._parts, LocalParts):  # a server would be asked for each of them
                self._refuse_first_points_outside()

    def _systems_behind(self, stream: BinaryIO, layout: Layout) -> list[laspy.VLR]:
        """The records behind the points that declare a coordinate system."""
        records = _records(stream, layout.first_evlr, layout.size, layout.evlrs, extended=True)
        systems = [record for record in records if record[0] == b"LASF_Projection"]
        _require(sum(s[3] for s in systems) <= MOST_HEAD_BYTES, "a system of too many bytes")
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
            _require(held <= self._parts.size, "pages of its hierarchy overlap")
            _require(depth <= MOST_LEVELS + 1, "pages of its hierarchy are nested without end")
            contents, pages = self._parts.get(sorted(pages)), []
            for content in contents:
                _require(
                    len(content) > 0 and len(content) % ENTRY.itemsize == 0,
                    f"a page of its hierarchy has {len(content)} bytes",
                )
                page = np.frombuffer(content, ENTRY)
                for entry in page[page["points"] == PAGE]:
                    below = (int(entry["start"]), int(entry["start"]) + int(entry["bytes"]))
                    _require(below not in asked, "two places name one page of its hierarchy")
                    _require(below[1] > below[0], "a page of its hierarchy is empty")
                    asked.add(below)
                    pages.append(below)
                found.append(page[page["points"] != PAGE])
                entries += len(page)
            _require(entries <= MOST_NODES, "its hierarchy is too large")
        every = np.concatenate(found)
        _require(len(np.unique(every["key"], axis=0)) == len(every), "a node stands in it twice")
        _require(not every["key"][:, 0].min(), "its hierarchy has no root")
        _require(bool((every["points"] >= 0).all()), "a node has less than no points")
        nodes = every[every["points"] > 0].astype(NODE)
        return nodes[np.argsort(nodes["start"], kind="stable")]

    def _refuse_first_points_outside(self) -> None:
        """The first point of each node, which a chunk begins with, lies in its cube.

        So that a node whose key is another one's is found though it is not read.
        """
        first = self._parts.get([(at, at + 12) for at in self.nodes["start"].tolist()])
        stored = np.frombuffer(b"".join(first), "<i4").reshape(-1, 3)
        xyz = stored * np.asarray(self.header.scales) + np.asarray(self.header.offsets)
        low, high = self.boxes(self.nodes)
        outside = ((xyz < low) | (xyz > high)).any(axis=1)
        if outside.any():
            raise self._outside(int(outside.sum()), self.nodes[int(np.argmax(outside))])

    def _decoded(self, numbers: NDArray[np.intp]) -> Iterator[ScaleAwarePointRecord]:
        ends = np.cumsum(self.nodes["bytes"][numbers])
        for batch in np.split(numbers, np.flatnonzero(np.diff(ends // BATCH_BYTES)) + 1):
            nodes = self.nodes[batch]
            ranges = list(zip(nodes["start"].tolist(), (nodes["start"] + nodes["bytes"]).tolist()))
            for node, content in zip(nodes, self._parts.get(ranges)):
                with _decoding(lambda error, n=node: self._refusal(f"node {n['key']}: {error}")):
                    points = self._points(int(node["points"]), content)
                yield points

    def _points(self, count: int, content: bytes) -> ScaleAwarePointRecord:
        """The points of a chunk, whose layers are held against its bytes first."""
        form = self.header.point_format
        layers = np.frombuffer(content, "<u4", 1 + self._packing.layers, form.size).astype(np.int64)
        head = form.size + 4 * layers.size
        _require(head + int(layers[1:].sum()) == len(content), "its layers do not fill it")
        _require(int(layers[0]) == count, f"it holds {layers[0]} points, not {count}")
        raw = np.zeros(count * form.size, np.uint8)
        lazrs.decompress_points_with_chunk_table(
            content, self._packing.record, raw, [(count, len(content))], FIELDS.to_lazrs()
        )
        array = PackedPointRecord.from_buffer(raw, form).array
        return ScaleAwarePointRecord(array, form, self.header.scales, self.header.offsets)
