"""Entwine Point Tiles: ``ept.json``, the hierarchy, and the nodes, each a LAZ file of its own.

What of a footprint is read, and how it is proven complete, is that of all octrees
(:mod:`.octree`). Nothing but files of the dataset's own folder is asked for. How many bytes a node
has is told by its file alone: until then it is estimated by the points and bytes of the first one.
Source: Entwine Point Tile 1.0 (entwine.io), "ept.json", "Point data", "Hierarchy".
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.point.record import ScaleAwarePointRecord
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from ..core.errors import InputError
from ..core.products.file_parts import copies_of, kept, open_parts
from ..core.products.remote_files import AT_ONCE, hosts_of, read_bytes, url_of
from .las_files import _decoding
from .las_layout import _require
from .octree import FIELDS, MOST_NODE_POINTS, MOST_NODES, NODE, Octree, shown

MOST_JSON_BYTES = 64 << 20  # of ept.json, and of a file of the hierarchy
MOST_NODE_BYTES = 256 << 20
KEY = re.compile(r"([0-9]{1,2})-([0-9]{1,9})-([0-9]{1,9})-([0-9]{1,9})")
TOP = "0-0-0-0"


class Ept(Octree):
    """A dataset of Entwine Point Tiles; its hierarchy is read here, and proven complete."""

    def __init__(self, path: Path) -> None:
        self._path, self._url = path, url_of(path)
        self.name = self._url or str(path)
        with _decoding(lambda error: self._refusal(f"{type(error).__name__} {error}")):
            about = self._json(path.name)
            bounds = np.array(about["bounds"], np.float64)
            sides = bounds[3:] - bounds[:3]
            good = bounds.shape == (6,) and np.isfinite(bounds).all() and sides.min() > 0
            _require(good and np.ptp(sides) <= 1e-6 * sides.max(), "its bounds are no cube")
            self.low, self.side = bounds[:3], float(sides.max())
            if about["dataType"] != "laszip":
                raise InputError(
                    f"its points are stored as {str(about['dataType'])[:20]!r}, not as LAZ",
                    file=self.name,
                    remedy="have it written again with dataType laszip",
                )
            _require(type(about["points"]) is int, "it does not count its points")
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
            _require(parts.size <= most_bytes, f"{name} has {parts.size} bytes")
            return parts.get([(0, parts.size)])[0]
        url, hosts = f"{self._url.rpartition('/')[0]}/{name}", hosts_of(self._path)
        copies = copies_of(self._path, self._url)
        return kept(copies, name, lambda: read_bytes(url, most_bytes, hosts=hosts))

    def _json(self, name: str) -> dict[str, Any]:
        content = json.loads(self._read(name, MOST_JSON_BYTES))
        _require(isinstance(content, dict), f"{name} holds no object")
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
                    _require(good, f"part {top} of its hierarchy is none, or names a node again")
                    counts |= held
                    asked |= inner
                    waiting += inner
                    _require(len(counts) + len(asked) <= MOST_NODES, "its hierarchy is too large")
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

    def _decoded(self, numbers: NDArray[np.intp]) -> Iterator[ScaleAwarePointRecord]:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            for batch in np.split(numbers, range(AT_ONCE, len(numbers), AT_ONCE)):
                contents = pool.map(self._node_file, self.nodes[batch])
                for node, content in zip(self.nodes[batch], contents):
                    with _decoding(lambda e, n=node: self._refusal(f"node {shown(n)}: {e}")):
                        points = self._points(content)
                    yield points

    def _points(self, content: bytes) -> ScaleAwarePointRecord:
        stream, backend = io.BytesIO(content), laspy.LazBackend.Lazrs
        with laspy.open(stream, laz_backend=backend, decompression_selection=FIELDS) as reader:
            one, whole = reader.header, self.header
            same = one.point_format == whole.point_format
            same &= np.array_equal([one.scales, one.offsets], [whole.scales, whole.offsets])
            _require(same, "its points are stored otherwise than those of other nodes")
            _require(one.point_count <= MOST_NODE_POINTS, f"it has {one.point_count} points")
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
