"""A file of points, whatever its format: LAS, LAZ, COPC, or a surface model as a raster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import laspy

from . import las_files

TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # of TIFF 6.0 and of BigTIFF


class PointFile:
    """A LAS, LAZ or COPC file whose header agrees with what the file holds.

    ``header``: coordinate system, scales, offsets, count and bounds of the points. Raises
    InputError if the file is missing or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header = self._header()

    def _header(self) -> laspy.LasHeader:
        return las_files.read_header(self.path)

    @property
    def remark(self) -> str | None:
        """What users are to know of it, if anything."""
        return las_files.surplus_of(self.header, self.path)

    @property
    def heights(self) -> tuple[float, float] | None:
        """Lowest and highest height that can be told without reading the points."""
        return float(self.header.mins[2]), float(self.header.maxs[2])

    @property
    def cell(self) -> float:
        """Side of the cells that points are the middles of, or 0: the points lie anywhere."""
        return 0.0

    def chunks(self, size: int) -> Iterator[laspy.ScaleAwarePointRecord]:
        """All points in the order of the file, about ``size`` at a time."""
        return las_files.read_chunks(self.path, self.header, size)


class RasterFile(PointFile):
    """A surface model as a raster; see :mod:`.raster_points`."""

    def _header(self) -> laspy.LasHeader:
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


def open_points(path: str | Path) -> PointFile:
    """The file by its first bytes. Raises InputError if it cannot be read."""
    path = Path(path)
    first = b""
    with suppress(OSError), path.open("rb") as stream:  # which the reader names
        first = stream.read(4)
    return (RasterFile if first in TIFF_SIGNATURES else PointFile)(path)
