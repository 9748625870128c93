"""COPC files: header, chunk table and hierarchy, each held against the others, and their nodes.

A COPC file is a LAZ file whose chunks are the nodes of an octree. Its chunk table and its hierarchy
tell the same by different ways, so that a node that one of them lacks is found without reading it.
Source: COPC 1.0 (Hobu), "info VLR", "hierarchy VLR"; LAZ specification 1.4 R1, "Chunk Table".
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Sequence

import laspy
import lazrs
import numpy as np
from laspy.compression import DecompressionSelection
from laspy.point.record import PackedPointRecord, ScaleAwarePointRecord

from ..errors import InputError
from ..products.ranges import Range, Ranges
from .las_files import _decoding
from .las_layout import LASZIP, LAYERED, Layout, _Packing, _records, _require
from .octree_nodes import MOST_LEVELS, MOST_NODES, Node, Octree, good_key

INFO = (b"copc", 1)
INFO_PLACE = 375 + 54  # right behind the header of LAS 1.4, and its own
ENTRY = struct.Struct("<4iQii")
EVLR = struct.Struct("<H16sHQ32s")
MOST_HEAD_BYTES = 16 << 20  # of header and VLRs
MOST_EVLRS = 1000  # each of which is a request
MOST_RAW_BYTES = 1 << 30  # of the decoded points of a node
FIELDS = (
    DecompressionSelection.XY_RETURNS_CHANNEL
    | DecompressionSelection.Z
    | DecompressionSelection.CLASSIFICATION
    | DecompressionSelection.FLAGS
    | DecompressionSelection.POINT_SOURCE_ID
    | DecompressionSelection.GPS_TIME
)


class Copc(Octree):
    """A COPC file of which parts are read; its hierarchy is read here, and proven complete."""

    def __init__(self, ranges: Ranges) -> None:
        self.name, self._ranges = ranges.name, ranges
        with _decoding(lambda error: self._refusal(str(error))):
            layout, head = self._layout()
            records = _records(
                io.BytesIO(head), layout.header_bytes, layout.first_point, layout.vlrs, False
            )
            packings = [r for r in records if r[:2] == LASZIP]
            _require(len(packings) == 1, f"it has {len(packings)} LASzip records instead of one")
            _, _, at, length = packings[0]
            self._packing = _Packing.of(head[at : at + length], layout.record_bytes)
            _require(self._packing.kind == LAYERED, "its points are not compressed in layers")
            self.header = laspy.LasHeader.read_from(io.BytesIO(head), read_evlrs=False)
            self.header.vlrs.extend(self._systems_behind(layout))
            first = next((r for r in records if r[2] == INFO_PLACE), None)
            if first is None or first[:2] != INFO or first[3] < 160:
                raise InputError(
                    "no COPC: its first record is another one",
                    file=self.name,
                    remedy="name it .laz without .copc, to read it whole",
                )
            *middle, half, _ = struct.unpack_from("<5d", head, INFO_PLACE)
            start, length = struct.unpack_from("<2Q", head, INFO_PLACE + 40)
            _require(
                bool(np.isfinite(middle).all() and np.isfinite(half) and half > 0),
                f"the octree's cube has its centre at {middle} and half a side of {half}",
            )
            self.low, self.side = np.array(middle) - half, 2 * half
            self.nodes = self._hierarchy((start, start + length))
            by_return = sum(map(int, self.header.number_of_points_by_return))
            _require(by_return <= self.points, f"its counts by return add up to {by_return}")
            self._complete()
            most = max(node.points for node in self.nodes) * layout.record_bytes
            _require(most <= MOST_RAW_BYTES, f"a node has {most} bytes of points")
            self._compare_chunks(layout)
            self._look_at_first_points()

    def _layout(self) -> tuple[Layout, bytes]:
        """What the header says, and the bytes before the first point."""
        size = self._ranges.size
        layout = Layout.of(io.BytesIO(self._ranges.get(0, min(size, 393))), size)
        _require(layout.minor == 4 and layout.format in (6, 7, 8), "COPC is LAS 1.4, formats 6-8")
        _require(layout.compressed and layout.points > 0, "it has no compressed points")
        _require(
            layout.first_point <= MOST_HEAD_BYTES, f"points begin at byte {layout.first_point}"
        )
        return layout, self._ranges.get(0, layout.first_point)

    def _systems_behind(self, layout: Layout) -> list[laspy.VLR]:
        """The records behind the points that declare a coordinate system."""
        found, at = [], layout.first_evlr
        _require(layout.evlrs <= MOST_EVLRS, f"it has {layout.evlrs} records behind its points")
        for _ in range(layout.evlrs):
            head = self._ranges.get(at, at + EVLR.size)
            _, user, number, length, _ = EVLR.unpack(head)
            if user.rstrip(b"\0") == b"LASF_Projection":
                _require(length <= MOST_HEAD_BYTES, f"a record of {length} bytes behind its points")
                content = self._ranges.get(at + EVLR.size, at + EVLR.size + length)
                found.append(laspy.VLR("LASF_Projection", number, "", content))
            at += EVLR.size + length
        return found

    def _hierarchy(self, root: Range) -> tuple[Node, ...]:
        """The nodes with points of all pages, in the order of the file."""
        nodes: dict[tuple[int, int, int, int], Node] = {}
        empty, asked, pages = set(), {root}, [root]
        depth = 0
        while pages:
            depth += 1
            held = sum(end - start for start, end in asked)
            _require(held <= self._ranges.size, "pages of its hierarchy overlap")
            _require(depth <= MOST_LEVELS + 1, "pages of its hierarchy are nested without end")
            contents, pages = list(self._ranges.parts(sorted(pages))), []
            for content in contents:
                _require(
                    len(content) > 0 and len(content) % ENTRY.size == 0,
                    f"a page of its hierarchy has {len(content)} bytes",
                )
                for *place, start, size, points in ENTRY.iter_unpack(content):
                    key = tuple(place)
                    _require(good_key(key), f"its hierarchy has a node {key}")
                    if points == -1:
                        page = (start, start + size)
                        _require(size > 0, f"a page of its hierarchy has {size} bytes")
                        _require(page not in asked, "two places name one page of its hierarchy")
                        asked.add(page)
                        pages.append(page)
                        continue
                    _require(
                        points >= 0 and size >= 0 and key not in nodes and key not in empty,
                        f"node {key} stands twice in its hierarchy, or has {points} points",
                    )
                    if points == 0:
                        empty.add(key)
                    else:
                        nodes[key] = Node(key, points, start, size)
                held = len(nodes) + len(empty) + len(asked)
                _require(held <= MOST_NODES, "its hierarchy is too large")
        _require((0, 0, 0, 0) in nodes.keys() | empty, "its hierarchy has no root")
        _require(bool(nodes), "no node of its hierarchy has points")
        return tuple(sorted(nodes.values(), key=lambda node: node.start))

    def _compare_chunks(self, layout: Layout) -> None:
        """The chunks of the file, in their order, are the nodes of the hierarchy: none is missing.

        One for one, by place, bytes and points.
        """
        first = layout.first_point + 8
        (table,) = struct.unpack("<q", self._ranges.get(layout.first_point, first))
        ends = [e for e in (layout.first_evlr, layout.size) if e > table]
        _require(first <= table <= layout.size - 8, f"its chunk table is at byte {table}")
        content = self._ranges.get(table, min(ends))
        version, count = struct.unpack_from("<II", content)
        _require(
            version == 0 and count == len(self.nodes),
            f"its chunk table has {count} chunks, its hierarchy {len(self.nodes)} nodes",
        )
        stream = io.BytesIO(content)
        chunks = lazrs.read_chunk_table_only(stream, lazrs.LazVlr(self._packing.record))
        held = np.array(chunks, np.int64).reshape(-1, 2)
        starts = first + np.cumsum(held[:, 1]) - held[:, 1]
        told = np.array([(n.points, n.bytes, n.start) for n in self.nodes])
        _require(
            np.array_equal(np.column_stack([held, starts]), told),
            "its chunk table has other chunks than its hierarchy has nodes",
        )
        _require(first + int(held[:, 1].sum()) == table, "chunks do not end at their table")

    def _look_at_first_points(self) -> None:
        """The first point of each node, which a chunk begins with, lies in its cube.

        So that a node whose key is another one's is found though it is not read. Of a file on the
        disk; a server would be asked for each of them.
        """
        first = self._ranges.peek([node.start for node in self.nodes], 12)
        if not first:
            return
        stored = np.frombuffer(b"".join(first), "<i4").reshape(-1, 3)
        xyz = stored * np.asarray(self.header.scales) + np.asarray(self.header.offsets)
        low, high = self.boxes(self.nodes)
        outside = ((xyz < low) | (xyz > high)).any(axis=1)
        if outside.any():
            raise self._outside(int(outside.sum()), self.nodes[int(np.argmax(outside))])

    def _decoded(self, nodes: Sequence[Node]) -> Iterator[ScaleAwarePointRecord]:
        ranges = [(node.start, node.start + node.bytes) for node in nodes]
        for node, content in zip(nodes, self._ranges.parts(ranges), strict=True):
            with _decoding(lambda error, n=node: self._refusal(f"node {n.key}: {error}")):
                points = self._points(node, content)
            yield points

    def _points(self, node: Node, content: bytes) -> ScaleAwarePointRecord:
        form = self.header.point_format
        layers = np.frombuffer(content, "<u4", 1 + self._packing.layers, form.size).astype(np.int64)
        head = form.size + 4 * layers.size
        _require(head + int(layers[1:].sum()) == len(content), "its layers do not fill it")
        _require(int(layers[0]) == node.points, f"it holds {layers[0]} points, not {node.points}")
        raw = np.zeros(node.points * form.size, np.uint8)
        lazrs.decompress_points_with_chunk_table(
            content, self._packing.record, raw, [(node.points, len(content))], FIELDS.to_lazrs()
        )
        array = PackedPointRecord.from_buffer(raw, form).array
        return ScaleAwarePointRecord(array, form, self.header.scales, self.header.offsets)
