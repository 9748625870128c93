"""Entwine Point Tiles: ``ept.json``, the hierarchy, and the nodes, each a LAZ file of its own.

What of a footprint is read, and how it is proven complete, is that of all octrees
(:mod:`.octree_nodes`): the counts of the hierarchy must add up to that of ``ept.json``, so that a
part of the hierarchy that lacks is found before a point is read. Nothing but files of the dataset's
own folder is asked for. How many bytes a node has is told by its file alone: until then it is
estimated by the points and bytes of the first one. Source: Entwine Point Tile 1.0 (entwine.io),
"ept.json", "Point data", "Hierarchy".
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.point.record import ScaleAwarePointRecord
from pyproj import CRS
from pyproj.exceptions import CRSError

from ..errors import InputError
from ..products.ranges import AT_ONCE, LocalRanges, Ranges, WebRanges, in_turn
from ..products.remote_files import hosts_of, is_remote, read_bytes, url_of
from ..products.web_requests import WEB
from .copc import FIELDS
from .las_files import _decoding
from .las_layout import _require
from .octree_nodes import MOST_NODE_POINTS, MOST_NODES, Node, Octree, good_key
from .range_copies import copies_of, kept, open_ranges

NAME = "ept.json"
MOST_JSON_BYTES = 64 << 20  # of ept.json, and of a file of the hierarchy
MOST_NODE_BYTES = 256 << 20
HEAD_BYTES = 4 << 20  # that are asked for at once: of most files, all
KEY = re.compile(r"([0-9]{1,2})-([0-9]{1,10})-([0-9]{1,10})-([0-9]{1,10})")
PAGES_AT_ONCE = 64  # of the hierarchy, in memory
Key = tuple[int, int, int, int]
TOP: Key = (0, 0, 0, 0)


class Ept(Octree):
    """A dataset of Entwine Point Tiles; its hierarchy is read here, and proven complete."""

    def __init__(
        self, location: str | Path, *, allow_hosts: frozenset[str], patience_s: float
    ) -> None:
        self.name, self._location = str(location), location
        self._hosts, self._patience_s = allow_hosts, patience_s
        self._copies: Path | None = None
        place = str(location) if is_remote(str(location)) else url_of(location)
        if place is None:
            self._folder: str | Path = Path(location).parent
        else:
            self.name, self._folder = place, place.rpartition("/")[0]
            if not is_remote(str(location)):
                self._hosts |= hosts_of(location)
                self._copies = copies_of(Path(location), place)
        with _decoding(lambda error: self._refusal(f"{type(error).__name__} {error}")):
            about = self._json(NAME)
            bounds = np.array(about["bounds"], np.float64)
            _require(
                bounds.shape == (6,) and np.isfinite(bounds).all() and bounds[3] > bounds[0],
                "its bounds are no cube",
            )
            sides = bounds[3:] - bounds[:3]
            _require(np.ptp(sides) <= 1e-6 * sides.max(), "its bounds are no cube")
            self.low, self.side = bounds[:3], float(sides.max())
            if about["dataType"] != "laszip":
                raise InputError(
                    f"its points are stored as {str(about['dataType'])[:20]!r}, not as LAZ",
                    file=self.name,
                    remedy="have it written again with dataType laszip",
                )
            points = about["points"]
            _require(type(points) is int and points > 0, "it announces no points")
            nodes = self._hierarchy()
            self.header, size = self._reference(about, points, nodes[0])
            share = size / nodes[0].points
            self.nodes = tuple(replace(n, bytes=max(1, round(n.points * share))) for n in nodes)
            self._complete()

    def _read(self, name: str, most: int) -> bytes:
        """A file of the dataset, or its copy."""
        if name == NAME:
            ranges: Ranges = open_ranges(
                self._location, allow_hosts=self._hosts, patience_s=self._patience_s
            )
            _require(ranges.size <= most, f"{name} has {ranges.size} bytes")
            return ranges.get(0, ranges.size)
        return kept(self._copies, name, lambda: self._asked(name, most))

    def _asked(self, name: str, most: int) -> bytes:
        """A file beside ept.json."""
        if isinstance(self._folder, Path):
            ranges: Ranges = LocalRanges(self._folder / name)
        elif self._folder.partition("://")[0] in WEB:
            ranges = WebRanges(
                f"{self._folder}/{name}",
                allow_hosts=self._hosts,
                patience_s=self._patience_s,
                head_bytes=HEAD_BYTES,
            )
        else:
            return read_bytes(f"{self._folder}/{name}", most)
        _require(ranges.size <= most, f"{name} has {ranges.size} bytes")
        return ranges.get(0, ranges.size)

    def _json(self, name: str) -> dict[str, Any]:
        content = json.loads(self._read(name, MOST_JSON_BYTES))
        _require(isinstance(content, dict), f"{name} holds no object")
        return content

    def _hierarchy(self) -> tuple[Node, ...]:
        """The nodes with points of all files of the hierarchy, by level and place."""
        counts: dict[Key, int] = {}
        asked, waiting = {TOP}, [TOP]
        with ThreadPoolExecutor(AT_ONCE) as pool:
            while waiting:
                tops = waiting[:PAGES_AT_ONCE]
                del waiting[:PAGES_AT_ONCE]
                names = [f"ept-hierarchy/{_text(top)}.json" for top in tops]
                for top, page in zip(tops, pool.map(self._json, names)):
                    waiting += self._counted(page, top, counts, asked)
                _require(len(counts) + len(asked) <= MOST_NODES, "its hierarchy is too large")
        nodes = tuple(Node(key, points, 0, 0) for key, points in sorted(counts.items()) if points)
        _require(bool(nodes), "no node of its hierarchy has points")
        return nodes

    def _counted(
        self, page: dict[str, Any], top: Key, counts: dict[Key, int], asked: set[Key]
    ) -> list[Key]:
        """Add the counts of a page, and return the nodes whose own pages are named by it."""
        _require(_text(top) in page, f"its hierarchy lacks node {_text(top)}")
        below = []
        for text, points in page.items():
            parts = KEY.fullmatch(text)
            _require(parts is not None, f"its hierarchy has a node {text[:40]!r}")
            level, x, y, z = map(int, parts.groups())
            key = (level, x, y, z)
            _require(good_key(key), f"its hierarchy has a node {text}")
            if points == -1 and key != top:
                _require(key not in asked, f"two places name the hierarchy of node {text}")
                asked.add(key)
                below.append(key)
                continue
            _require(
                type(points) is int and points >= 0 and key not in counts,
                f"node {text} stands twice in its hierarchy, or has {str(points)[:20]} points",
            )
            counts[key] = points
        return below

    def _reference(
        self, about: dict[str, Any], points: int, first: Node
    ) -> tuple[laspy.LasHeader, int]:
        """The header of the first node, made that of the whole, and the bytes of its file."""
        header, content = self._opened(first)
        bounds = np.array(about.get("boundsConforming", about["bounds"]), np.float64)
        _require(bounds.shape == (6,), "its boundsConforming are no box")
        header.mins, header.maxs = bounds[:3], bounds[3:]
        header.point_count = points
        header.number_of_points_by_return = np.zeros(15, np.uint32)  # of one node
        if system := self._system(about.get("srs")):
            record = laspy.VLR("LASF_Projection", 2112, "", system.to_wkt().encode() + b"\0")
            kept = [vlr for vlr in header.vlrs if vlr.user_id != "LASF_Projection"]
            header.vlrs = [*kept, record]
            header.global_encoding.wkt = True
        return header, len(content)

    def _system(self, srs: Any) -> CRS | None:
        """The coordinate system that ept.json states; None where it states none."""
        srs = srs if isinstance(srs, dict) else {}
        texts = [srs.get("wkt")]
        if srs.get("authority") and srs.get("horizontal"):
            codes = [str(srs[part]) for part in ("horizontal", "vertical") if srs.get(part)]
            texts.insert(0 if len(codes) == 2 else 1, f"{srs['authority']}:{'+'.join(codes)}")
        for text in filter(None, texts):
            try:
                return CRS.from_user_input(text)
            except CRSError:
                continue
        return None

    def _opened(self, node: Node) -> tuple[laspy.LasHeader, bytes]:
        """Header and content of a node's file."""
        content = self._read(f"ept-data/{_text(node.key)}.laz", MOST_NODE_BYTES)
        header = laspy.LasHeader.read_from(io.BytesIO(content), read_evlrs=False)
        _require(
            header.point_count == node.points <= MOST_NODE_POINTS,
            f"node {_text(node.key)} holds {header.point_count} points, the hierarchy says "
            f"{node.points}",
        )
        return header, content

    def _decoded(self, nodes: Sequence[Node]) -> Iterator[ScaleAwarePointRecord]:
        opened = in_turn(nodes, self._opened)
        for node in nodes:
            with _decoding(lambda error, n=node: self._refusal(f"node {_text(n.key)}: {error}")):
                points = self._points(node, *next(opened))
            yield points

    def _points(self, node: Node, header: laspy.LasHeader, content: bytes) -> ScaleAwarePointRecord:
        same = header.point_format.id == self.header.point_format.id
        same &= header.point_format.size == self.header.point_format.size
        same &= np.array_equal(header.scales, self.header.scales)
        same &= np.array_equal(header.offsets, self.header.offsets)
        _require(same, "its points are stored otherwise than those of other nodes")
        with laspy.open(
            io.BytesIO(content),
            laz_backend=laspy.LazBackend.Lazrs,
            read_evlrs=False,
            decompression_selection=FIELDS,
        ) as reader:
            return reader.read_points(node.points)


def _text(key: Key) -> str:
    return "-".join(map(str, key))
