"""A grid of geoid heights, from a GTX or GeoTIFF file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from pyproj import CRS
from rasterio.windows import Window

from ..core.errors import InputError
from ..core.numerics.geometry import metres_per_degree
from ..core.numerics.interpolation import bilinear
from ..core.products.rasters import MOST_CELLS, Fills, Quantity, Values, open_raster
from .declared_crs import of_raster

FORMATS = ("GTX", "GTiff")
REMEDY = "give a GTX or GeoTIFF grid of geoid undulations above WGS 84 or GRS 80"
UNDULATION = Quantity("undulation of a geoid", "geoid grid", -120.0, 120.0, REMEDY)  # −107 to +86 m
TYPE = "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL"  # of PROJ's grids that are geoids (key TYPE)
STEEPEST = 1e-3  # m per m of the geoid: deflections of the vertical are below 2 minutes of arc
ROUGH = 0.01  # share of neighbouring nodes that are steeper: heights of ground
SLACK = 1e-6  # of the step between nodes, against rounding at the outermost
LEAST_SPREAD_M, WIDE_DEG = 3.0, 5.0  # undulations of any part of the Earth so wide differ by more


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
        self.unit_m, self.above_wgs84 = 1.0, "egm" in self.path.name.lower()
        try:
            with open_raster(self.path, formats=FORMATS) as grid:
                transform, sample = grid.transform, self._looked_at(grid)
        except rasterio.errors.RasterioError as error:
            raise self._unusable(f"GDAL cannot read it ({error})") from error
        if transform.b or transform.d or not (transform.a > 0 > transform.e):
            raise self._unusable("it is not a north-up grid of longitude and latitude")
        self.step_lon, self.step_lat = transform.a, -transform.e
        self.lon_first = transform.c + self.step_lon / 2
        self.lat_first = transform.f - self.step_lat / 2
        self.is_constant = bool(sample.size) and float(np.ptp(sample)) == 0.0
        self._refuse_level(sample)
        self.around = round(360 / self.step_lon)  # columns once around the Earth
        if self.width < self.around:
            self.around = 0

    def _looked_at(self, grid: rasterio.DatasetReader) -> np.ndarray:
        """Values (m) all over a grid, none of a large one, after all that its tags say."""
        kind, name = grid.tags().get("TYPE", TYPE), self.path.name.lower()
        if kind != TYPE:
            raise self._unusable(f"it is a grid of {kind.lower().replace('_', ' ')}")
        if "shift" in (grid.descriptions[0] or "") or "vertcon" in name:
            raise self._unusable("it has shifts between two datums")
        self.height, self.width = grid.height, grid.width
        if grid.crs is not None:
            if not grid.crs.is_geographic:
                raise self._unusable("its nodes are not on a grid of longitude and latitude")
            system = CRS.from_wkt(grid.crs.to_wkt()).to_2d()
            unit = (grid.units[0] or "").strip()
            self.unit_m = of_raster(system.to_wkt(), unit, self.path).height_unit_m
            # GDAL says WGS 84 of every GTX, so that only a GeoTIFF's word counts.
            is_stated = grid.driver == "GTiff" and "World Geodetic" in system.datum.name
            self.above_wgs84 |= is_stated
            if abs(system.ellipsoid.semi_major_metre - 6378137) > 1:
                ellipsoid = system.ellipsoid.name
                raise self._unusable(f"its undulations are above the ellipsoid {ellipsoid}")
        values = Values(grid, self.path, UNDULATION, self.unit_m)
        if grid.height * grid.width > MOST_CELLS and grid.driver != "GTX":
            return np.empty(0)
        return self.unit_m * values.read(out_shape=(min(grid.height, 64), min(grid.width, 64)))

    def _unusable(self, reason: str) -> InputError:
        return InputError(
            f"cannot be used as a geoid grid: {reason}",
            file=self.path,
            remedy=REMEDY,
        )

    def _window(self, first: int, last: int) -> np.ndarray:
        """Rows first..last (inclusive) in metres, NaN where the grid has none.

        Of a grid around the Earth, the first column stands behind the last again.
        """
        rows = self._rows
        if rows is None or first < self._first_row or last >= self._first_row + len(rows):
            if rows is not None:  # keep what is there: chunks of one file overlap
                first = min(first, self._first_row)
                last = max(last, self._first_row + len(rows) - 1)
            with open_raster(self.path, formats=FORMATS) as grid:
                window = Window(0, first, self.width, last - first + 1)
                values = Values(grid, self.path, UNDULATION, self.unit_m)
                fills = Fills(values, may_be_constant=self.is_constant)
                rows = self.unit_m * fills.add(*fills.values.raw(window=window))
            fills.refuse()
            self._refuse_other(rows, first)
            if self.around:
                rows = np.hstack([rows[:, : self.around], rows[:, :1]])
            self._first_row, self._rows = first, rows
        return rows

    def _refuse_other(self, rows: np.ndarray, first: int) -> None:
        """Raise InputError for rows from the ``first`` on that are rougher than any geoid."""
        lat = self.lat_first - (first + len(rows) / 2) * self.step_lat
        east, north = metres_per_degree(lat) * (self.step_lon, self.step_lat)
        steps = [
            np.diff(rows, axis=axis) / step for axis, step in ((0, north), (1, max(east, 1.0)))
        ]
        slopes = np.abs(np.concatenate([step[np.isfinite(step)] for step in steps]))
        if slopes.size and (slopes > STEEPEST).mean() > ROUGH:
            raise self._unusable("it is rougher than a geoid, as heights of ground are")

    def _refuse_level(self, values: np.ndarray) -> None:
        """Raise InputError if values of a whole grid are too alike, as shifts of datums are."""
        sides = self.height * self.step_lat, self.width * self.step_lon
        known = values[np.isfinite(values)]
        if self.is_constant:
            return
        if min(sides) > WIDE_DEG and known.size and np.abs(known).max() < LEAST_SPREAD_M:
            raise self._unusable(
                f"its values are {known.min():.2f} to {known.max():.2f} m all over "
                f"{sides[0]:.0f} x {sides[1]:.0f} degrees: shifts between two datums"
            )

    def __call__(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        """N at lon, lat (degrees, [n]).

        Raises InputError for points outside the grid or beside nodes without a value.
        """
        if lon.size == 0:
            return np.empty(0)
        turn = 360.0 / self.step_lon
        col = (lon - self.lon_first) / self.step_lon + SLACK
        col = col - np.floor(col / turn) * turn - SLACK
        row = (self.lat_first - lat) / self.step_lat
        inside = (row > -SLACK) & (row < self.height - 1 + SLACK)
        if not self.around:
            inside &= col < self.width - 1 + SLACK
        if not inside.all():
            west, south = self.lon_first, self.lat_first - (self.height - 1) * self.step_lat
            east = west + (self.width - 1) * self.step_lon
            raise InputError(
                f"{int((~inside).sum())} points lie outside the geoid grid {self.path.name} "
                f"(longitude {west:.4f} to {east:.4f}, latitude {south:.4f} to "
                f"{self.lat_first:.4f}), the first at {lon[~inside][0]:.5f}, {lat[~inside][0]:.5f}",
                remedy="give a geoid grid that covers the LiDAR",
            )
        row = np.clip(row, 0.0, self.height - 1.0)
        top = int(min(row.min(), max(self.height - 2, 0)))
        rows = self._window(top, min(int(row.max()) + 1, self.height - 1))
        col = col % self.around if self.around else np.clip(col, 0.0, self.width - 1.0)
        undulation = bilinear(rows, col, row - self._first_row)
        if not np.isfinite(undulation).all():
            bad = ~np.isfinite(undulation)
            raise InputError(
                f"the geoid grid {self.path.name} has no value at {int(bad.sum())} points, "
                f"the first at {lon[bad][0]:.5f}, {lat[bad][0]:.5f}",
                remedy="give a geoid grid that covers the LiDAR",
            )
        return undulation
