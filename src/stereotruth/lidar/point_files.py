"""A file of points, whatever its format: LAS, LAZ, COPC, or a surface model as a raster.

Of a file, that part is read which may hold points of a footprint. Of an octree, these are nodes. Of
other files it is all or nothing: nothing where the header's bounds miss the footprint. LAS headers
are written by software that errs, so that they are held against some points all over the file: if
one of these lies outside, the header counts for nothing, and the file is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np

from ..core.products.file_parts import open_stream
from ..core.products.remote_files import size_of
from . import las_files
from .copc import Copc
from .octree import Octree, Touches

OCTREE, EPT = ".copc.laz", "ept.json"
FIRST_BYTES = 1 << 14  # that servers are asked for at once
TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # of TIFF 6.0 and of BigTIFF


@dataclass(frozen=True)
class Part:
    """What is read of a file: ``points``, and their ``bytes`` in the file, by ``chunks``.

    ``chunks(size)``: the points in the order of the file, about ``size`` at a time. ``nodes``: how
    many of an octree's nodes are read, and how many there are. ``remark`` for the user.
    """

    points: int
    bytes: int
    chunks: Callable[[int], Iterator[laspy.ScaleAwarePointRecord]]
    nodes: tuple[int, int] | None = None
    remark: str | None = None


class PointFile:
    """A LAS, LAZ or COPC file whose header agrees with what the file holds.

    ``header``: coordinate system, scales, offsets, count and bounds of the points. ``layers``: see
    :func:`.las_layout.check_layout`. Raises InputError if the file is missing or cannot be read.
    """

    def __init__(self, path: Path, layers: bool = True) -> None:
        self.path = path
        self.header = self._header(layers)

    def _header(self, layers: bool) -> laspy.LasHeader:
        return las_files.read_header(self.path, layers)

    @property
    def remark(self) -> str | None:
        """What users are to know of it, if anything."""
        return las_files.surplus_of(self.header, self.path)

    @property
    def heights(self) -> tuple[float, float] | None:
        """Lowest and highest height that can be told without reading the points."""
        return float(self.header.mins[2]), float(self.header.maxs[2])

    @property
    def bytes(self) -> int:
        """All that there is to read."""
        return size_of(self.path)

    @property
    def cell(self) -> float:
        """Side of the cells that points are the middles of, or 0: the points lie anywhere."""
        return 0.0

    def chunks(self, size: int) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points in the order of the file, about ``size`` at a time."""
        return las_files.read_chunks(self.path, self.header, size)

    def part(self, touches: Touches | None) -> Part:
        """What is to be read for a footprint; all of it for None."""
        whole = Part(int(self.header.point_count), self.bytes, self.chunks)
        if touches is None:
            return whole
        bounds = np.array([[self.header.mins], [self.header.maxs]], np.float64)
        bounds = np.where(
            np.isnan(bounds), 0.0, bounds
        )  # heights of rasters, which only cells tell
        if not np.isfinite(bounds).all() or not np.ptp(bounds[:, 0, :2], axis=0).any():
            return whole  # never filled in
        if (bounds[1, 0] < bounds[0, 0]).any() or touches(*bounds)[0]:
            return whole
        if self._contradicts_bounds():
            remark = (
                "points lie outside of its header's bounds, which count for nothing: all are read"
            )
            return Part(whole.points, whole.bytes, whole.chunks, remark=remark)
        return Part(0, 0, lambda _: iter(()))

    def _contradicts_bounds(self) -> bool:
        """Whether points lie outside of the header's bounds."""
        return las_files.is_outside_sampled(self.path, self.header)


class OctreeFile(PointFile):
    """A COPC file, or EPT, of which nodes are read; see :mod:`.octree`."""

    def _header(self, layers: bool) -> laspy.LasHeader:
        self.octree = open_octree(self.path)
        return self.octree.header

    @property
    def remark(self) -> None:
        """Nothing."""

    @property
    def bytes(self) -> int:
        """Of the file, or of all nodes of EPT."""
        return max(int(self.octree.nodes["bytes"].sum()), size_of(self.path))

    def chunks(self, size: int) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points node by node, whatever the size."""
        return self.octree.read(self.octree.plan(None))

    def part(self, touches: Touches | None) -> Part:
        """The nodes that touch a footprint."""
        plan = self.octree.plan(touches)
        nodes = self.octree.nodes[plan]
        points, size = int(nodes["points"].sum()), int(nodes["bytes"].sum())
        counts = len(plan), len(self.octree.nodes)
        return Part(points, size, lambda _: self.octree.read(plan), counts)


def open_octree(path: str | Path) -> Octree:
    """A COPC file (``.copc.laz``) or EPT (``ept.json``), by path or stand-in.

    Raises InputError: missing, neither of both, damaged, or of a hierarchy that is not complete;
    what a server fails with.
    """
    if Path(path).name.lower() == EPT:
        from .ept import Ept  # which few scenes have

        return Ept(Path(path))
    return Copc(Path(path))


class RasterFile(PointFile):
    """A surface model as a raster; see :mod:`.raster_points`."""

    def _header(self, layers: bool) -> laspy.LasHeader:
        from .raster_points import raster_header  # GDAL, which few scenes need

        return raster_header(self.path)

    @property
    def remark(self) -> str:
        """What a raster cannot tell."""
        from .raster_points import remark_on

        return remark_on(self.header)

    @property
    def heights(self) -> tuple[float, float] | None:
        """Of some cells all over the raster."""
        from .raster_points import sampled_heights

        return sampled_heights(self.path)

    @property
    def cell(self) -> float:
        """The larger side of a cell, in the unit of the plane."""
        from .raster_points import PARTS

        return float(max(self.header.scales[:2])) * PARTS

    def chunks(self, size: int) -> Iterator[laspy.ScaleAwarePointRecord]:
        """The points by the raster's own blocks, whatever the size."""
        from .raster_points import read_cells

        return read_cells(self.path, self.header)

    def _contradicts_bounds(self) -> bool:
        """No: they follow from the places of the cells."""
        return False


def open_points(path: str | Path, *, by_nodes: bool = False, layers: bool = True) -> PointFile:
    """The file by its first bytes. Raises InputError if it cannot be read.

    ``by_nodes``: a file that is named ``.copc.laz`` is opened as an octree; else as any LAZ, whole.
    ``ept.json`` always is one. ``layers``: see :func:`.las_layout.check_layout`.
    """
    path = Path(path)
    name = path.name.lower()
    if name == EPT or (by_nodes and name.endswith(OCTREE)):
        return OctreeFile(path)
    first = b""
    with suppress(OSError), open_stream(path, FIRST_BYTES) as stream:  # which the reader names
        first = stream.read(4)
    return (RasterFile if first in TIFF_SIGNATURES else PointFile)(path, layers)
