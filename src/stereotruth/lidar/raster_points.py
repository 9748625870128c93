"""Surface models as rasters (GeoTIFF, COG): each cell that has a height becomes a point.

The point lies in the middle of its cell, has the class 1 (unclassified) and is the only return of
its pulse. A raster cannot tell more: what lies under crowns and roofs, which cells are ground,
trees or water, how many points a cell was made of, and where between two cells a wall stands.

Cells are handed on as points of LAS format 6, so that units, coordinate systems, limits and counts
are held to what they are held to in LAS files. Heights are those of the band, with its scale and
offset; cells are read by the blocks of the file, whose order is that of the points.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import laspy
import numpy as np
import pyproj
import rasterio
from rasterio.errors import RasterioError

from ..core.errors import InputError
from ..core.products.file_parts import open_stream
from ..core.products.rasters import HEIGHT, MOST_CELLS, Fills, Values, open_raster, refuse_bands
from ..core.products.remote_files import url_of
from .height_raster import refuse_grid, system_of

FORMATS = ("GTiff",)
PARTS = 64  # of a cell, that the points' coordinates are stored in: exact, as a power of two
HEIGHT_STEP = 1e-4  # of the unit of the heights
MOST_BLOCK_CELLS = 1 << 26  # of a block, which GDAL reads as a whole
STREAM_BYTES = 1 << 20  # that servers are asked for at once
SAMPLES = 64  # cells along each side that say how high a surface lies
UNCLASSIFIED = 1


@contextmanager
def _opened(file: Path) -> Iterator[rasterio.DatasetReader]:
    """A raster of heights. Raises InputError if it cannot be read or is no such raster.

    Of a stand-in, GDAL is given the parts that servers send to this package: left to itself it
    follows redirects to anywhere.
    """
    with ExitStack() as stack:
        parts = None if url_of(file) is None else stack.enter_context(_Parts(file))
        try:
            if parts is None:
                raster = open_raster(file, formats=FORMATS)
            else:
                alone = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GTIFF_REPORT_COMPD_CS": True}
                stack.enter_context(rasterio.Env(**alone))
                raster = rasterio.open(file.name, driver=FORMATS[0], opener=parts.opened)
            with raster:
                _refuse_other(raster, file)
                yield raster
        except RasterioError as error:
            if parts is not None and parts.failure is not None:
                raise parts.failure from None
            raise InputError(
                f"no GeoTIFF that can be read ({error})",
                file=file,
                remedy="check or replace the file; lidar takes LAS, LAZ, COPC, and GeoTIFFs of "
                "heights",
            ) from None


class _Parts(io.RawIOBase):
    """What a stand-in stands for, as GDAL reads it: an error ends the file, and is kept."""

    def __init__(self, file: Path) -> None:
        self._name, self._stream = file.name, open_stream(file, STREAM_BYTES)
        self.failure: InputError | None = None

    def opened(self, path: str, mode: str = "rb") -> _Parts:
        """Itself by its own name; there is no other file."""
        if path != self._name or mode != "rb":
            raise FileNotFoundError(path)
        return self

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def tell(self) -> int:
        """The place of the next byte."""
        return self._stream.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place, as of any stream."""
        return self._stream.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        """So many bytes; none after an error."""
        try:
            return b"" if self.failure else self._stream.read(size)
        except InputError as error:
            self.failure = error
            return b""


def _refuse_other(raster: rasterio.DatasetReader, file: Path) -> None:
    refuse_bands(raster, file, HEIGHT)
    refuse_grid(raster, file)
    rows, cols = raster.block_shapes[0]
    if rows * cols > MOST_BLOCK_CELLS or max(raster.shape) * PARTS > np.iinfo(np.int32).max:
        raise InputError(
            f"its blocks of {rows} x {cols} cells, or its {raster.height} x {raster.width} cells, "
            "are too many to be read by parts",
            file=file,
            remedy="write it again in tiles (gdal_translate -of COG), or cut it into several files",
        )


def _system(raster: rasterio.DatasetReader, file: Path) -> str:
    """WKT of the file's system, with the epoch, and the unit of its heights that its band tells."""
    if (system := system_of(raster, file)) is None:
        return ""
    wkt = pyproj.CRS.from_wkt(raster.crs.to_wkt()).to_wkt()
    if not system.has_vertical and system.vertical_unit_m is not None:
        wkt = (
            f'COMPOUNDCRS["unknown",{wkt},VERTCRS["unknown",VDATUM["unknown"],CS[vertical,1],'
            f'AXIS["up",up],LENGTHUNIT["{system.vertical_unit}",{system.vertical_unit_m!r}]]]'
        )
    return wkt if system.epoch is None else f"COORDINATEMETADATA[{wkt},EPOCH[{system.epoch!r}]]"


def _values(raster: rasterio.DatasetReader, file: Path) -> Values:
    system = system_of(raster, file)
    return Values(raster, file, HEIGHT, 1.0 if system is None else system.height_unit_m)


def raster_header(file: Path) -> laspy.LasHeader:
    """The header that a LAS file of the cells would have.

    ``point_count`` is the number of all cells; the lowest and highest height are NaN, since only
    the cells tell them. Raises InputError: missing, unreadable, no raster of heights.
    """
    if not file.is_file():
        raise InputError("no such LiDAR file", file=file, remedy="correct the path in scenes.tsv")
    with _opened(file) as raster:
        at, (rows, cols) = raster.transform, raster.shape
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales = np.array([at.a / PARTS, -at.e / PARTS, HEIGHT_STEP])
        header.offsets = np.array([at.c, at.f + rows * at.e, 0.0])
        half = np.array([at.a, -at.e]) / 2
        size = np.array([cols * at.a, rows * -at.e])
        header.mins = np.array([*(header.offsets[:2] + half), np.nan])
        header.maxs = np.array([*(header.offsets[:2] + size - half), np.nan])
        header.point_count = rows * cols
        if wkt := _system(raster, file):
            record = laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0")
            header.vlrs.append(record)
            header.global_encoding.wkt = True
    return header


def remark_on(header: laspy.LasHeader) -> str:
    """What users are to know of a raster's points."""
    return (
        f"a surface model of cells of {header.scales[0] * PARTS:g}: its points have no class and "
        "no returns; nothing is known of what lies under crowns"
    )


def sampled_heights(file: Path) -> tuple[float, float] | None:
    """Lowest and highest of some cells all over the raster, in its unit; None where all lack.

    Of a raster of :data:`.raster_values.MOST_CELLS` at most, of all. Raises InputError for values
    that are no heights.
    """
    with _opened(file) as raster:
        values = _values(raster, file)
        shape = min(raster.height, SAMPLES), min(raster.width, SAMPLES)
        if raster.width * raster.height <= MOST_CELLS and url_of(file) is None:
            values.refuse_fills()
        heights = values.read(out_shape=shape)
    held = heights[np.isfinite(heights)]
    return (float(held.min()), float(held.max())) if held.size else None


def read_cells(file: Path, header: laspy.LasHeader) -> Iterator[laspy.ScaleAwarePointRecord]:
    """The points of all cells that have a height, window by window of the file's blocks.

    Raises InputError for values that are no heights, and for a raster that became unreadable.
    """
    with _opened(file) as raster:
        fills = Fills(_values(raster, file))
        for window in fills.values.windows():
            heights = fills.add(*fills.values.raw(window=window))
            row, col = np.nonzero(np.isfinite(heights))
            points = laspy.ScaleAwarePointRecord.zeros(row.size, header=header)
            points.array["X"] = (2 * (col + int(window.col_off)) + 1) * (PARTS // 2)
            up = raster.height - 1 - (row + int(window.row_off))
            points.array["Y"] = (2 * up + 1) * (PARTS // 2)
            points.array["Z"] = np.rint(heights[row, col] / HEIGHT_STEP)
            points["return_number"] = points["number_of_returns"] = np.ones(row.size, np.uint8)
            points["classification"] = np.full(row.size, UNCLASSIFIED, np.uint8)
            if row.size:
                yield points
        fills.refuse()
