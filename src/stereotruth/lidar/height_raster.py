"""Rasters of heights on the ground: where their cells lie, and what their heights count from.

The one reader of surface and elevation models, for LiDAR, scores and control points. Pixels that
are points (AREA_OR_POINT) are the middles of their cells. Places are metres on the ground from the
centre of the upper-left cell, (x, y) = (column · dx, −row · dy), by what a cell measures on the
ellipsoid in the raster's middle: so any north-up grid serves, in degrees, feet or a
projection. As LiDAR, each cell that has a height becomes a point in its middle, of LAS format 6 and
class 1 (unclassified), the only return of its pulse.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.windows import Window as RasterWindow

from ..core.errors import InputError
from ..core.numerics.arrays import Floats, Singles
from ..core.numerics.geometry import exact_metres_per_degree, turn
from ..core.numerics.interpolation import bilinear
from ..core.products.file_parts import open_stream
from ..core.products.rasters import (
    HEIGHT,
    MOST_CELLS,
    Fills,
    Quantity,
    Values,
    open_raster,
    refuse_bands,
)
from ..core.products.remote_files import url_of
from .declared_crs import LidarCRS, epoch_of, of_raster
from .frames import Epochs
from .to_wgs84 import ToWGS84, transformation

log = logging.getLogger("stereotruth")
WIDEST_M = 1e5  # metres along the cells are those of the raster's middle
BASE = 16.0  # cells over which a cell is measured
CLASSES = Quantity(
    "class of LAS", "raster of classes", 0.0, 255.0, "give a raster of one band of LAS classes"
)
AROUND = 32  # cells around a point that are held against the rules on fill values

FORMATS = ("GTiff",)  # of LiDAR
PARTS = 64  # of a cell, that the points' coordinates are stored in: exact, as a power of two
HEIGHT_STEP = 1e-4  # of the unit of the heights
MOST_BLOCK_CELLS = 1 << 26  # of a block, which GDAL reads as a whole
STREAM_BYTES = 1 << 20  # that servers are asked for at once
SAMPLES = 64  # cells along each side that say how high a surface lies
UNCLASSIFIED = 1


def _refuse_grid(raster: Any, file: Path) -> None:
    """Raise InputError unless rows run from north to south and columns from west to east."""
    at = raster.transform
    if at.b or at.d or not (at.a > 0 > at.e) or at == rasterio.Affine.identity():
        raise InputError(
            "the grid is not north-up, or has no place on the ground: cells have to lie on a grid "
            "with north up",
            file=file,
            remedy="gdalwarp it to its own coordinate system, or give its world file's content "
            "with gdal_translate -a_ullr",
        )


def _system_of(raster: Any, file: Path) -> LidarCRS | None:
    """What the system, the epoch and the band's unit of an open raster say; None without one."""
    if raster.crs is None:
        return None
    system = of_raster(raster.crs.to_wkt(), (raster.units[0] or "").strip(), file)
    return replace(system, epoch=epoch_of(raster))


@dataclass(frozen=True)
class HeightRaster:
    """A raster of heights on disk. ``shape`` rows, columns; ``to_wgs84``: of its coordinates.

    Made by :meth:`open`. ``quantity``: what it is a raster of.
    """

    path: Path
    to_wgs84: ToWGS84
    transform: rasterio.Affine
    shape: tuple[int, int]
    quantity: Quantity

    @classmethod
    def open(
        cls,
        path: str | Path,
        geoid: str | Path | None = None,
        *,
        epochs: Epochs | None = None,
        quantity: Quantity = HEIGHT,
        whole: bool = True,
    ) -> HeightRaster:
        """The raster of a file.

        ``geoid``: a grid of undulations, where the heights count from the geoid and not from the
        WGS 84 ellipsoid. ``epochs``: see :func:`.to_wgs84.transformation`. ``whole``: read once,
        for fill values that are not declared.

        Raises InputError: no raster of one band, no place on a north-up grid, no coordinate system;
        values that are no heights; declared orthometric heights without a geoid.
        """
        path = Path(path)
        try:
            with open_raster(path) as source:
                transform, shape = source.transform, source.shape
                system = _system_of(source, path)
                if system is None:
                    raise InputError(
                        "no coordinate system", file=path, remedy="set it by gdal_edit.py -a_srs"
                    )
                _refuse_grid(source, path)
                if quantity is not HEIGHT:
                    system = LidarCRS(system.horizontal, ellipsoidal=True)
                values = Values(source, path, quantity, system.height_unit_m)
                ends = np.array([transform * (0, shape[0]), transform * (shape[1], 0)])
                to_wgs84 = transformation(system, path, ends, geoid=geoid, epochs=epochs)
                if whole and quantity is HEIGHT:
                    values.refuse_fills()
        except RasterioError as error:
            raise InputError(
                f"no raster that can be read ({error})", file=path, remedy="give a GeoTIFF"
            ) from None
        for note in to_wgs84.notes:
            log.warning("%s: %s", path.name, note)
        return cls(path, to_wgs84, transform, shape, quantity)

    @cached_property
    def _cell(self) -> Floats:
        """Metres [2, 2] east and north (rows) of one column and one row (columns) in the middle."""
        row, col = (n / 2 for n in self.shape)
        half = BASE / 2 * np.array([[-1, 1, 0, 0], [0, 0, -1, 1]])
        x, y = self.transform * (col + half[0], row + half[1])
        lon, lat, _ = self.to_wgs84.exact(np.asarray(x), np.asarray(y), np.zeros(4))
        if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
            raise InputError(
                f"its middle has no place on Earth in '{self.to_wgs84.system.name}'",
                file=self.path,
                remedy="correct its coordinate system (gdal_edit.py -a_srs)",
            )
        steps = np.array([turn(np.diff(lon)[::2]), np.diff(lat)[::2]]) / BASE
        return steps * exact_metres_per_degree(float(lat.mean()), 0.0)[:, None]

    @cached_property
    def cell_m(self) -> tuple[float, float]:
        """Size of a cell in metres on the ground (along columns, rows), in the raster's middle."""
        dx, dy = map(float, np.hypot(*self._cell))
        if (widest := max(self.shape[1] * dx, self.shape[0] * dy)) > WIDEST_M:
            raise InputError(
                f"{widest / 1000:.0f} km wide",
                file=self.path,
                remedy=f"cut it into parts of at most {WIDEST_M / 1000:.0f} km",
            )
        return dx, dy

    @cached_property
    def to_enu(self) -> Floats:
        """[2, 2] that takes vectors of places (x, y) to metres east and north on the ground."""
        return self._cell / self.cell_m * [1.0, -1.0]

    def places(self, lon: Floats, lat: Floats) -> tuple[Floats, Floats]:
        """(x, y) in metres of WGS 84 longitudes and latitudes, degrees [n]."""
        return self.places_of(*self.to_wgs84.inverse(lon, lat))

    def places_of(self, east: Floats, north: Floats) -> tuple[Floats, Floats]:
        """(x, y) in metres of coordinates in the raster's own system [n]."""
        t, (dx, dy) = self.transform, self.cell_m
        col = (np.asarray(east) - t.c) / t.a - 0.5
        row = (np.asarray(north) - t.f) / t.e - 0.5
        return col * dx, -row * dy

    def coordinates(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """The inverse of :meth:`places_of`."""
        t, (dx, dy) = self.transform, self.cell_m
        return t.c + (np.asarray(x) / dx + 0.5) * t.a, t.f + (0.5 - np.asarray(y) / dy) * t.e

    def bounds_wgs84(self, rows: slice, cols: slice) -> tuple[float, float, float, float]:
        """West, south, east, north in degrees around a window; it may reach over the edges."""
        west, north = self.transform * (cols.start, rows.start)
        east, south = self.transform * (cols.stop, rows.stop)
        box = self.to_wgs84.ground_boxes(np.array([[west, south]]), np.array([[east, north]]))
        return tuple(map(float, box[0]))

    def window(self, rows: slice, cols: slice) -> Singles:
        """Heights in m of a window that may reach over the edges; NaN where there are none."""
        out = np.full((rows.stop - rows.start, cols.stop - cols.start), np.nan, np.float32)
        top, left = max(rows.start, 0), max(cols.start, 0)
        bottom, right = min(rows.stop, self.shape[0]), min(cols.stop, self.shape[1])
        if top >= bottom or left >= right:
            return out
        inside = slice(top - rows.start, bottom - rows.start)
        window = RasterWindow(left, top, right - left, bottom - top)
        out[inside, left - cols.start : right - cols.start] = self._read(window=window)
        return out

    def _read(self, **how: Any) -> Floats:
        """Heights in m by rasterio's ``window`` or ``out_shape``; NaN where there are none."""
        unit = self.to_wgs84.system.height_unit_m
        with open_raster(self.path) as source:
            return unit * Values(source, self.path, self.quantity, unit).read(**how)

    def decimated(self, most: int) -> tuple[Floats, float]:
        """Heights in m at ``most`` cells along the longer side, and how many cells are one."""
        times = max(max(self.shape) / most, 1.0)
        shape = tuple(max(2, round(side / times)) for side in self.shape)
        return self._read(out_shape=shape), times

    def heights_at(self, lon: Floats, lat: Floats) -> Floats:
        """Heights over the WGS 84 ellipsoid, m [n], bilinear; NaN where there is none.

        Raises InputError for fill values around the places.
        """
        x, y = self.to_wgs84.inverse(lon, lat)
        col, row = ~self.transform * (np.asarray(x), np.asarray(y))
        found = np.full(len(col), np.nan)
        unit = self.to_wgs84.system.height_unit_m
        with open_raster(self.path) as source:
            fills = Fills(Values(source, self.path, self.quantity, unit))
            for k, (i, j) in enumerate(zip(row, col)):
                if not (0 <= i <= self.shape[0] and 0 <= j <= self.shape[1]):
                    continue
                top, left = max(int(i) - AROUND, 0), max(int(j) - AROUND, 0)
                size = (
                    min(int(n) + AROUND + 1, side) - first
                    for n, side, first in zip((j, i), self.shape[::-1], (left, top))
                )
                values = fills.add(*fills.values.raw(window=RasterWindow(left, top, *size)))
                found[k] = unit * bilinear(values, j - 0.5 - left, i - 0.5 - top)
            fills.refuse()
        known = np.isfinite(found)
        place = np.asarray(lon)[known], np.asarray(lat)[known]
        found[known] += self.to_wgs84.height_shift_m(*place)
        return found


@dataclass(frozen=True)
class Window:
    """Heights of a part of a raster, and how they are taken at any place.

    ``heights`` [h, w] begin with the cell ``first`` (row, column).
    """

    heights: Singles
    first: tuple[int, int]
    cell_m: tuple[float, float]

    def cells(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """(column, row) in ``heights`` of places in m; whole numbers are centres of cells."""
        col = np.asarray(x) / self.cell_m[0] - self.first[1]
        return col, -np.asarray(y) / self.cell_m[1] - self.first[0]

    def at(self, x: Floats, y: Floats) -> Floats:
        """Heights at places, of any shape, bilinear; NaN where one of the four cells lacks."""
        return bilinear(self.heights, *self.cells(x, y))


# ------------------------------------------------------------------ as LiDAR


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


@contextmanager
def _opened(file: Path) -> Iterator[tuple[Values, LidarCRS | None]]:
    """The values and the system of a raster of heights. Raises InputError if it is no such raster.

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
                refuse_bands(raster, file, HEIGHT)
                _refuse_grid(raster, file)
                rows, cols = raster.block_shapes[0]
                most = max(raster.shape) * PARTS
                if rows * cols > MOST_BLOCK_CELLS or most > np.iinfo(np.int32).max:
                    raise InputError(
                        f"its blocks of {rows} x {cols} cells, or its {raster.height} x "
                        f"{raster.width} cells, are too many to be read by parts",
                        file=file,
                        remedy="write it again in tiles (gdal_translate -of COG), or cut it into "
                        "several files",
                    )
                system = _system_of(raster, file)
                unit_m = 1.0 if system is None else system.height_unit_m
                yield Values(raster, file, HEIGHT, unit_m), system
        except RasterioError as error:
            if parts is not None and parts.failure is not None:
                raise parts.failure from None
            raise InputError(
                f"no GeoTIFF that can be read ({error})",
                file=file,
                remedy="check or replace the file; lidar takes LAS, LAZ, COPC, and GeoTIFFs of "
                "heights",
            ) from None


def raster_header(file: Path) -> tuple[laspy.LasHeader, LidarCRS | None]:
    """The header that a LAS file of the cells would have, and the system that the raster declares.

    ``point_count`` is the number of all cells; the lowest and highest height are NaN, since only
    the cells tell them. Raises InputError: missing, unreadable, no raster of heights.
    """
    if not file.is_file():
        raise InputError("no such LiDAR file", file=file, remedy="correct the path in scenes.tsv")
    with _opened(file) as (values, system):
        raster = values.dataset
        at, (rows, cols) = raster.transform, raster.shape
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales = np.array([at.a / PARTS, -at.e / PARTS, HEIGHT_STEP])
        header.offsets = np.array([at.c, at.f + rows * at.e, 0.0])
        half = np.array([at.a, -at.e]) / 2
        size = np.array([cols * at.a, rows * -at.e])
        header.mins = np.array([*(header.offsets[:2] + half), np.nan])
        header.maxs = np.array([*(header.offsets[:2] + size - half), np.nan])
        header.point_count = rows * cols
    return header, system


def sampled_heights(file: Path) -> tuple[float, float] | None:
    """Lowest and highest of some cells all over the raster, in its unit; None where all lack.

    Of a raster of :data:`..core.products.rasters.MOST_CELLS` at most, of all. Raises InputError for
    values that are no heights.
    """
    with _opened(file) as (values, _):
        height, width = values.dataset.shape
        if width * height <= MOST_CELLS and url_of(file) is None:
            values.refuse_fills()
        heights = values.read(out_shape=(min(height, SAMPLES), min(width, SAMPLES)))
    held = heights[np.isfinite(heights)]
    return (float(held.min()), float(held.max())) if held.size else None


def read_cells(file: Path, header: laspy.LasHeader) -> Iterator[laspy.ScaleAwarePointRecord]:
    """The points of all cells that have a height, window by window of the file's blocks.

    Raises InputError for values that are no heights, and for a raster that became unreadable.
    """
    with _opened(file) as (values, _):
        fills = Fills(values)
        for window in values.windows():
            heights = fills.add(*values.raw(window=window))
            row, col = np.nonzero(np.isfinite(heights))
            points = laspy.ScaleAwarePointRecord.zeros(row.size, header=header)
            points.array["X"] = (2 * (col + int(window.col_off)) + 1) * (PARTS // 2)
            up = values.dataset.height - 1 - (row + int(window.row_off))
            points.array["Y"] = (2 * up + 1) * (PARTS // 2)
            points.array["Z"] = np.rint(heights[row, col] / HEIGHT_STEP)
            points["return_number"] = points["number_of_returns"] = np.ones(row.size, np.uint8)
            points["classification"] = np.full(row.size, UNCLASSIFIED, np.uint8)
            if row.size:
                yield points
        fills.refuse()
