"""A grid of geoid heights, from a GTX or GeoTIFF file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS
from rasterio.windows import Window

from ..errors import InputError
from ..kernels import kernel
from ..numerics.bilinear import between_four
from ..products.ungeoreferenced import open_raster

FORMATS = ("GTX", "GTiff")


@kernel
def _undulations(
    rows: np.ndarray,
    grid: tuple[float, float, float, float],
    first_row: int,
    height: int,
    around: int,
    lon: np.ndarray,
    lat: np.ndarray,
    out: np.ndarray,
    inside: np.ndarray,
) -> None:
    """Fill ``out`` [n] from a grid's rows [k, width], and ``inside`` [n]: whether a point is in it.

    ``grid``: longitude of the first node and step, latitude likewise (southwards). ``first_row`` of
    ``height`` is rows[0]; ``around``: columns once around the Earth, 0 if the grid covers less.
    """
    slack = 1e-6  # of a node's step, against rounding at the outermost nodes
    width = rows.shape[1]
    lon_first, step_lon, lat_first, step_lat = grid
    turn = 360.0 / step_lon
    for i in range(lon.size):
        col = (lon[i] - lon_first) / step_lon + slack
        col = col - np.floor(col / turn) * turn - slack
        row = (lat_first - lat[i]) / step_lat
        good = row > -slack and row < height - 1 + slack
        good = good and (around > 0 or col < width - 1 + slack)
        inside[i] = good
        if not good:
            out[i] = np.nan
            continue
        row = min(max(row, 0.0), height - 1.0)
        top = min(int(row), max(height - 2, 0))
        down = row - top
        below = min(top + 1, height - 1)
        if around > 0:
            left = int(np.floor(col))
            part = col - left
            left %= around
            right = (left + 1) % around
        else:
            col = min(max(col, 0.0), width - 1.0)
            left = min(int(col), max(width - 2, 0))
            part = col - left
            right = min(left + 1, width - 1)
        top, below = top - first_row, below - first_row
        out[i] = between_four(
            rows[top, left], rows[top, right], rows[below, left], rows[below, right], part, down
        )


@dataclass
class GeoidGrid:
    """Undulations N (m above the GRS 80 or WGS 84 ellipsoid) of a GTX or GeoTIFF grid.

    The nodes are the pixel centres; between them N is bilinear, as in PROJ's ``vgridshift``.
    Longitudes may run from −180 or from 0; a grid around the whole Earth has no seam. Only the rows
    that a file needs are read. ``above_wgs84``: N counts from WGS 84 itself (EGM grids), not from a
    national datum on the same ellipsoid. Raises InputError if the file is no usable grid.
    """

    path: Path
    _first_row: int = field(default=0, init=False, repr=False)
    _rows: np.ndarray | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        if not self.path.is_file():
            raise InputError(
                "no such geoid grid", file=self.path, remedy="give the path of a GTX or GeoTIFF"
            )
        try:
            with open_raster(self.path, formats=FORMATS) as grid:
                transform, crs, driver = grid.transform, grid.crs, grid.driver
                self.height, self.width = grid.height, grid.width
        except rasterio.errors.RasterioError as error:
            raise self._unusable(f"GDAL cannot read it ({error})") from error
        self.above_wgs84 = "egm" in self.path.name.lower()
        if transform.b or transform.d or not (transform.a > 0 > transform.e):
            raise self._unusable("it is not a north-up grid of longitude and latitude")
        if crs is not None:
            if not crs.is_geographic:
                raise self._unusable("its nodes are not on a grid of longitude and latitude")
            system = CRS.from_wkt(crs.to_wkt())
            ellipsoid = system.ellipsoid
            # GDAL says WGS 84 of every GTX, so that only a GeoTIFF's word counts.
            self.above_wgs84 |= driver == "GTiff" and "World Geodetic" in system.datum.name
            if ellipsoid is not None and abs(ellipsoid.semi_major_metre - 6378137) > 1:
                raise self._unusable(f"its undulations are above the ellipsoid {ellipsoid.name}")
        self.step_lon, self.step_lat = transform.a, -transform.e
        self.lon_first = transform.c + self.step_lon / 2
        self.lat_first = transform.f - self.step_lat / 2
        self.around = round(360 / self.step_lon)  # columns once around the Earth
        if self.width < self.around:
            self.around = 0

    def _unusable(self, reason: str) -> InputError:
        return InputError(
            f"cannot be used as a geoid grid: {reason}",
            file=self.path,
            remedy="give a GTX or GeoTIFF grid of geoid undulations in metres "
            "above WGS 84 or GRS 80",
        )

    def _window(self, first: int, last: int) -> np.ndarray:
        """Rows first..last (inclusive) in metres, NaN where the grid has none."""
        rows = self._rows
        if rows is None or first < self._first_row or last >= self._first_row + len(rows):
            if rows is not None:  # keep what is there: chunks of one file overlap
                first = min(first, self._first_row)
                last = max(last, self._first_row + len(rows) - 1)
            with open_raster(self.path, formats=FORMATS) as grid:
                window = Window(0, first, self.width, last - first + 1)
                masked = grid.read(1, window=window, masked=True, out_dtype="float64")
                rows = masked.filled(np.nan) * grid.scales[0] + grid.offsets[0]
            rows[~(np.abs(rows) < 1000)] = np.nan  # undeclared fill values; N is within ±110 m
            self._first_row, self._rows = first, rows
        return rows

    def __call__(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        """N at lon, lat (degrees, [n]).

        Raises InputError for points outside the grid or beside nodes without a value.
        """
        if lon.size == 0:
            return np.empty(0)
        ends = (self.lat_first - np.array([lat.max(), lat.min()])) / self.step_lat
        top, bottom = np.clip(np.floor(ends), 0, max(self.height - 2, 0)).astype(int)
        rows = self._window(int(top), int(min(bottom + 1, self.height - 1)))
        undulation, inside = np.empty(lon.size), np.empty(lon.size, np.bool_)
        grid = (self.lon_first, self.step_lon, self.lat_first, self.step_lat)
        _undulations(
            rows, grid, self._first_row, self.height, self.around, lon, lat, undulation, inside
        )
        if not inside.all():
            west, south = self.lon_first, self.lat_first - (self.height - 1) * self.step_lat
            east = west + (self.width - 1) * self.step_lon
            raise InputError(
                f"{int((~inside).sum())} points lie outside the geoid grid {self.path.name} "
                f"(longitude {west:.4f} to {east:.4f}, latitude {south:.4f} to "
                f"{self.lat_first:.4f}), the first at {lon[~inside][0]:.5f}, {lat[~inside][0]:.5f}",
                remedy="give a geoid grid that covers the LiDAR",
            )
        if not np.isfinite(undulation).all():
            bad = ~np.isfinite(undulation)
            raise InputError(
                f"the geoid grid {self.path.name} has no value at {int(bad.sum())} points, "
                f"the first at {lon[bad][0]:.5f}, {lat[bad][0]:.5f}",
                remedy="give a geoid grid that covers the LiDAR",
            )
        return undulation
