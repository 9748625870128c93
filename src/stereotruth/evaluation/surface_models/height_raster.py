"""A GeoTIFF of heights, and where its cells lie.

Places are metres east and north of the centre of the upper-left cell: (x, y) = (column · dx,
−row · dy), with the size of a cell in metres, so that any north-up grid serves, in degrees or feet
too. Heights are metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window as RasterWindow

from ...errors import InputError
from ...lidar.declared_crs import LidarCRS, interpret
from ...lidar.geoid import GeoidGrid
from ...numerics.bilinear import bilinear

Floats = NDArray[np.float64]
Heights = NDArray[np.float32]
WIDEST_M = 1e5  # metres east and north are those of the raster's middle


@dataclass(frozen=True)
class HeightRaster:
    """A surface model on disk. ``shape`` rows, columns; ``cell_m`` (dx, dy), positive.

    ``geoid``: a grid of undulations, where the heights count from the geoid and not from the
    WGS 84 ellipsoid. Raises InputError for a file that is no north-up raster with a coordinate
    system, and for declared orthometric heights without a geoid.
    """

    path: Path
    geoid: GeoidGrid | None
    system: LidarCRS
    transform: rasterio.Affine
    shape: tuple[int, int]

    @classmethod
    def open(cls, path: str | Path, geoid: str | Path | None = None) -> HeightRaster:
        """The raster of a file, looked at but not read."""
        path = Path(path)
        try:
            with rasterio.open(path) as source:
                crs, transform, shape = source.crs, source.transform, source.shape
        except RasterioError as error:
            raise InputError(
                f"no raster that can be read ({error})", file=path, remedy="give a GeoTIFF"
            ) from None
        if crs is None:
            raise InputError(
                "no coordinate system", file=path, remedy="set it by gdal_edit.py -a_srs"
            )
        if transform.b or transform.d or not transform.a > 0 > transform.e:
            raise InputError(
                "the grid is not north-up", file=path, remedy="bring it to one by gdalwarp"
            )
        try:
            system = interpret(pyproj.CRS.from_wkt(crs.to_wkt()))
        except ValueError as error:
            raise InputError(
                str(error), file=path, remedy="bring it to UTM by gdalwarp -t_srs"
            ) from None
        if system.vertical_datum and geoid is None:
            raise InputError(
                f"heights above {system.vertical_datum}",
                file=path,
                remedy="name the geoid's grid that they count from",
            )
        grid = None if geoid is None else GeoidGrid(Path(geoid))
        found = cls(path, grid, system, transform, shape)
        widest = max(n * step for n, step in zip(shape, found.cell_m[::-1]))
        if widest > WIDEST_M:
            raise InputError(
                f"{widest / 1000:.0f} km wide",
                file=path,
                remedy=f"cut it into parts of at most {WIDEST_M / 1000:.0f} km",
            )
        return found

    @cached_property
    def cell_m(self) -> tuple[float, float]:
        """Size of a cell in metres (east, north), in the middle of the raster."""
        a, e = self.transform.a, -self.transform.e
        if not self.system.horizontal.is_geographic:
            unit = self.system.horizontal_unit_m
            return a * unit, e * unit
        row, col = (n / 2 for n in self.shape)
        lon, lat = self.transform * (col, row)
        geod = pyproj.Geod(ellps="WGS84")
        east = geod.inv(lon - a / 2, lat, lon + a / 2, lat)[2]
        return east, geod.inv(lon, lat - e / 2, lon, lat + e / 2)[2]

    @cached_property
    def _from_wgs84(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs(4326, self.system.horizontal, always_xy=True)

    def places(self, lon: Floats, lat: Floats) -> tuple[Floats, Floats]:
        """(x, y) in metres of WGS 84 longitudes and latitudes, degrees [n]."""
        return self.places_of(*self._from_wgs84.transform(lon, lat))

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
        """West, south, east, north in degrees of a window; it may reach over the edges."""
        t = self.transform
        west, north = t * (cols.start, rows.start)
        east, south = t * (cols.stop, rows.stop)
        return self._from_wgs84.transform_bounds(west, south, east, north, direction="INVERSE")

    def undulation(self, lon: Floats, lat: Floats) -> Floats | float:
        """What an ellipsoidal height is above one of this raster, m."""
        return 0.0 if self.geoid is None else self.geoid(lon, lat)

    def window(self, rows: slice, cols: slice) -> Heights:
        """Heights in m of a window that may reach over the edges; NaN where there are none."""
        out = np.full((rows.stop - rows.start, cols.stop - cols.start), np.nan, np.float32)
        top, left = max(rows.start, 0), max(cols.start, 0)
        bottom, right = min(rows.stop, self.shape[0]), min(cols.stop, self.shape[1])
        if top >= bottom or left >= right:
            return out
        with rasterio.open(self.path) as source:
            window = RasterWindow(left, top, right - left, bottom - top)
            values = source.read(1, window=window, masked=True, out_dtype="float64").filled(np.nan)
            values = values * source.scales[0] + source.offsets[0]
        values[~(np.abs(values) < 9000.0)] = np.nan  # undeclared fill values
        unit = self.system.vertical_unit_m or 1.0
        inside = slice(top - rows.start, bottom - rows.start)
        out[inside, left - cols.start : right - cols.start] = unit * values
        return out


@dataclass(frozen=True)
class Window:
    """Heights of a part of a raster, and how they are taken at any place.

    ``heights`` [h, w] begin with the cell ``first`` (row, column).
    """

    heights: Heights
    first: tuple[int, int]
    cell_m: tuple[float, float]

    def cells(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """(column, row) in ``heights`` of places in m; whole numbers are centres of cells."""
        col = np.asarray(x) / self.cell_m[0] - self.first[1]
        return col, -np.asarray(y) / self.cell_m[1] - self.first[0]

    def at(self, x: Floats, y: Floats) -> Floats:
        """Heights at places, of any shape, bilinear; NaN where one of the four cells lacks."""
        return bilinear(self.heights, *self.cells(x, y))
