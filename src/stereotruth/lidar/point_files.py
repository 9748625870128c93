"""A file of points, whatever its format: LAS, LAZ, COPC, EPT, or a surface model as a raster.

A format is a class here, with the header that a LAS file of its points would have and with its
points as records of LAS. Of an octree, the nodes that may hold points of a footprint are read; of
other files all or nothing: nothing where the header's bounds miss the footprint, and some points
all over the file do not contradict these.
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
from .catalogue_list import EPT
from .declared_crs import LidarCRS
from .octree import Touches, open_octree

OCTREE = ".copc.laz"
FIRST_BYTES = 1 << 14  # that servers are asked for at once
TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # of TIFF 6.0 and of BigTIFF
Records = Iterator[laspy.ScaleAwarePointRecord]


@dataclass(frozen=True)
class Part:
    """What is read of a file: ``points``, and their ``bytes`` in the file, by ``chunks``.

    ``chunks(size)``: the points in the order of the file, about ``size`` at a time. ``nodes``: how
    many of an octree's nodes are read, and how many there are. ``remark`` for the user.
    """

    points: int
    bytes: int
    chunks: Callable[[int], Records]
    nodes: tuple[int, int] | None = None
    remark: str | None = None


class PointFile:
    """A LAS, LAZ or COPC file whose header agrees with what the file holds.

    ``header``: coordinate system, scales, offsets, count and bounds of the points; ``bytes``: all
    that there is to read; ``remark``: what users are to know of it; ``cell``: side of the cells
    that points are the middles of, 0 of points that lie anywhere; ``declared``: coordinate system
    of formats that have it elsewhere than in a LAS header. ``layers``: see
    :func:`.las_files.check_layout`. Raises InputError if the file is missing or cannot be read.
    """

    cell = 0.0
    remark: str | None = None
    declared: LidarCRS | None = None

    def __init__(self, path: Path, layers: bool = True) -> None:
        self.path = path
        self.header = las_files.read_header(path, layers)
        self.bytes = size_of(path)
        self.remark = las_files.surplus_of(self.header, path)

    @property
    def heights(self) -> tuple[float, float] | None:
        """Lowest and highest height that can be told without reading the points."""
        return float(self.header.mins[2]), float(self.header.maxs[2])

    def _chunks(self, size: int) -> Records:
        """All points in the order of the file, about ``size`` at a time."""
        return las_files.read_chunks(self.path, self.header, size)

    def part(self, touches: Touches | None) -> Part:
        """What is to be read for a footprint; all of it for None."""
        count, remark = int(self.header.point_count), None
        if touches is not None and self._lies_elsewhere(touches):
            if not self._contradicts_bounds():
                return Part(0, 0, lambda _: iter(()))
            remark = (
                "points lie outside of its header's bounds, which count for nothing: all are read"
            )
        return Part(count, self.bytes, self._chunks, remark=remark)

    def _lies_elsewhere(self, touches: Touches) -> bool:
        """Whether the header's bounds, if they were filled in, miss a footprint."""
        bounds = np.array([[self.header.mins], [self.header.maxs]], np.float64)
        bounds[np.isnan(bounds)] = 0.0  # heights of rasters, which only cells tell
        if not np.isfinite(bounds).all() or not np.ptp(bounds[:, 0, :2], axis=0).any():
            return False
        return bool((bounds[1, 0] >= bounds[0, 0]).all()) and not touches(*bounds)[0]

    def _contradicts_bounds(self) -> bool:
        """Whether points lie outside of the header's bounds."""
        return las_files.is_outside_sampled(self.path, self.header)


class OctreeFile(PointFile):
    """A COPC file, or EPT, of which nodes are read; see :mod:`.octree`."""

    def __init__(self, path: Path) -> None:
        self.path, self.octree = path, open_octree(path)
        self.header = self.octree.header
        self.bytes = max(int(self.octree.nodes["bytes"].sum()), size_of(path))

    def part(self, touches: Touches | None) -> Part:
        """The nodes that touch a footprint, one by one whatever the size."""
        plan = self.octree.plan(touches)
        nodes = self.octree.nodes[plan]
        points, size = int(nodes["points"].sum()), int(nodes["bytes"].sum())
        counts = len(plan), len(self.octree.nodes)
        return Part(points, size, lambda _: self.octree.read(plan), counts)


class RasterFile(PointFile):
    """A surface model as a raster, by its own blocks; see :mod:`.height_raster`."""

    def __init__(self, path: Path) -> None:
        from . import height_raster  # GDAL, which few scenes need

        self._rasters = height_raster
        self.path = path
        self.header, self.declared = height_raster.raster_header(path)
        self.bytes = size_of(path)
        self.cell = float(max(self.header.scales[:2])) * height_raster.PARTS
        self.remark = (
            f"a surface model of cells of {self.header.scales[0] * height_raster.PARTS:g}: its "
            "points have no class and no returns; nothing is known of what lies under crowns"
        )

    @property
    def heights(self) -> tuple[float, float] | None:
        """Of some cells all over the raster."""
        return self._rasters.sampled_heights(self.path)

    def _chunks(self, size: int) -> Records:
        """The points by the raster's own blocks, whatever the size."""
        return self._rasters.read_cells(self.path, self.header)

    def _contradicts_bounds(self) -> bool:
        """No: they follow from the places of the cells."""
        return False


def open_points(path: str | Path, *, by_nodes: bool = False, layers: bool = True) -> PointFile:
    """The file by its first bytes. Raises InputError if it cannot be read.

    ``by_nodes``: a file that is named ``.copc.laz`` is opened as an octree; else as any LAZ, whole.
    ``ept.json`` always is one. ``layers``: see :func:`.las_files.check_layout`.
    """
    path = Path(path)
    name = path.name.lower()
    if name == EPT or (by_nodes and name.endswith(OCTREE)):
        return OctreeFile(path)
    first = b""
    with suppress(OSError), open_stream(path, FIRST_BYTES) as stream:  # which the reader names
        first = stream.read(4)
    return RasterFile(path) if first in TIFF_SIGNATURES else PointFile(path, layers)
