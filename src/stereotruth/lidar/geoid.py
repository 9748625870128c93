"""Geoids: grids of their heights from GTX or GeoTIFF files, and those that PROJ knows of a place.

Nothing is chosen here: names of grids are those of PROJ's register, which has for each the ground
that it is made for; a grid is looked at if it is on this machine, and is never fetched.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import rasterio
from pyproj import CRS
from rasterio.windows import Window

from ..core.errors import InputError
from ..core.numerics.geometry import metres_per_degree, turn
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
MOST = 4  # candidates beside the ellipsoid
QUERY = """
SELECT v.name, a.proj_grid_name,
       MIN((e.north_lat - e.south_lat)
           * (e.east_lon - e.west_lon + CASE WHEN e.west_lon > e.east_lon THEN 360 ELSE 0 END)),
       MIN(COALESCE(g.accuracy, 9))
FROM grid_transformation g
JOIN vertical_crs v ON v.auth_name = g.target_crs_auth_name AND v.code = g.target_crs_code
JOIN usage u ON u.object_table_name = 'grid_transformation'
            AND u.object_auth_name = g.auth_name AND u.object_code = g.code
JOIN extent e ON e.auth_name = u.extent_auth_name AND e.code = u.extent_code
JOIN grid_alternatives a ON a.original_grid_name = g.grid_name
WHERE g.auth_name IN ('EPSG', 'PROJ') AND NOT g.deprecated AND a.proj_method = 'geoid_like'
  AND g.method_name LIKE 'Geographic3D to GravityRelatedHeight%'
  AND :lat BETWEEN e.south_lat AND e.north_lat
  AND CASE WHEN e.west_lon <= e.east_lon THEN :lon BETWEEN e.west_lon AND e.east_lon
           ELSE :lon >= e.west_lon OR :lon <= e.east_lon END
GROUP BY v.name, a.proj_grid_name ORDER BY 3, 4, v.name, a.proj_grid_name DESC
"""


class GeoidGrid:
    """Undulations N (m above the GRS 80 or WGS 84 ellipsoid) of a GTX or GeoTIFF grid.

    The nodes are the pixel centres; between them N is bilinear, as in PROJ's ``vgridshift``.
    Longitudes may run from −180 or from 0; a grid around the whole Earth has no seam. Only the rows
    that a file needs are read. ``above_wgs84``: N counts from WGS 84 itself (EGM grids), not from a
    national datum on the same ellipsoid. Raises InputError if the file is no usable grid.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._first_row, self._rows = 0, None
        if not self.path.is_file():
            raise InputError(
                "no such geoid grid", file=self.path, remedy="give the path of a GTX or GeoTIFF"
            )
        self.unit_m, self.above_wgs84 = 1.0, "egm" in self.path.name.lower()
        try:
            with open_raster(self.path, formats=FORMATS) as grid:
                at, sample = grid.transform, self._sampled(grid)
        except rasterio.errors.RasterioError as error:
            raise self._unusable(f"GDAL cannot read it ({error})") from error
        if at.b or at.d or not (at.a > 0 > at.e):
            raise self._unusable("it is not a north-up grid of longitude and latitude")
        self.step_lon, self.step_lat = at.a, -at.e
        self.lon_first, self.lat_first = at.c + at.a / 2, at.f + at.e / 2
        self.is_constant = bool(sample.size) and float(np.ptp(sample)) == 0.0
        self._refuse_level(sample[np.isfinite(sample)])
        self.around = round(360 / self.step_lon)  # columns once around the Earth
        if self.width < self.around:
            self.around = 0

    def _sampled(self, grid: rasterio.DatasetReader) -> np.ndarray:
        """Values (m) all over a grid, none of a large one, after all that its tags say."""
        kind = grid.tags().get("TYPE", TYPE)
        if kind != TYPE:
            raise self._unusable(f"it is a grid of {kind.lower().replace('_', ' ')}")
        if "shift" in (grid.descriptions[0] or "") or "vertcon" in self.path.name.lower():
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
            f"cannot be used as a geoid grid: {reason}", file=self.path, remedy=REMEDY
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
            self._refuse_rough(rows, first)
            if self.around:
                rows = np.hstack([rows[:, : self.around], rows[:, :1]])
            self._first_row, self._rows = first, rows
        return rows

    def _refuse_rough(self, rows: np.ndarray, first: int) -> None:
        """Raise InputError for rows from the ``first`` on that are rougher than any geoid."""
        lat = self.lat_first - (first + len(rows) / 2) * self.step_lat
        east, north = metres_per_degree(lat) * (self.step_lon, self.step_lat)
        slopes = [np.diff(rows, axis=0) / north, np.diff(rows, axis=1) / max(east, 1.0)]
        steep = np.abs(np.concatenate([slope[np.isfinite(slope)] for slope in slopes]))
        if steep.size and (steep > STEEPEST).mean() > ROUGH:
            raise self._unusable("it is rougher than a geoid, as heights of ground are")

    def _refuse_level(self, known: np.ndarray) -> None:
        """Raise InputError if values of a whole grid are too alike, as shifts of datums are."""
        sides = self.height * self.step_lat, self.width * self.step_lon
        if self.is_constant or not known.size or min(sides) <= WIDE_DEG:
            return
        if np.abs(known).max() < LEAST_SPREAD_M:
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
        whole_turn = 360.0 / self.step_lon
        col = (lon - self.lon_first) / self.step_lon + SLACK
        col = col - np.floor(col / whole_turn) * whole_turn - SLACK
        row = (self.lat_first - lat) / self.step_lat
        inside = (row > -SLACK) & (row < self.height - 1 + SLACK)
        if not self.around:
            inside &= col < self.width - 1 + SLACK
        remedy = "give a geoid grid that covers the LiDAR"
        if not inside.all():
            west, south = self.lon_first, self.lat_first - (self.height - 1) * self.step_lat
            east = west + (self.width - 1) * self.step_lon
            raise InputError(
                f"{int((~inside).sum())} points lie outside the geoid grid {self.path.name} "
                f"(longitude {west:.4f} to {east:.4f}, latitude {south:.4f} to "
                f"{self.lat_first:.4f}), the first at {lon[~inside][0]:.5f}, {lat[~inside][0]:.5f}",
                remedy=remedy,
            )
        row = np.clip(row, 0.0, self.height - 1.0)
        top = int(min(row.min(), max(self.height - 2, 0)))
        rows = self._window(top, min(int(row.max()) + 1, self.height - 1))
        col = col % self.around if self.around else np.clip(col, 0.0, self.width - 1.0)
        undulation = bilinear(rows, col, row - self._first_row)
        if (bad := ~np.isfinite(undulation)).any():
            raise InputError(
                f"the geoid grid {self.path.name} has no value at {int(bad.sum())} points, "
                f"the first at {lon[bad][0]:.5f}, {lat[bad][0]:.5f}",
                remedy=remedy,
            )
        return undulation


@dataclass(frozen=True)
class Candidate:
    """A surface that heights may count from: its name, its geoid grid, where that lies if here."""

    surface: str
    grid: str
    path: Path | None


def _every_candidate(lon: float, lat: float) -> list[Candidate]:
    """The geoids of a place, those of least ground first, each with a grid that is here if any."""
    file = Path(pyproj.datadir.get_data_dir().split(os.pathsep)[0]) / "proj.db"
    try:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as register:
            rows = register.execute(QUERY, {"lon": float(turn(lon)), "lat": lat}).fetchall()
    except sqlite3.Error:  # of another layout: then there are no names to give
        return []
    surfaces: dict[str, list[tuple[float, str]]] = {}
    for surface, grid, _, accuracy_m in rows:
        surfaces.setdefault(surface, []).append((accuracy_m, grid))
    candidates = []
    for surface, ranked in surfaces.items():
        grids = [grid for _, grid in sorted(ranked, key=lambda one: one[0])]
        here = ((grid, path) for grid in grids if (path := _installed(grid)) is not None)
        candidates.append(Candidate(surface, *next(here, (grids[0], None))))
    return candidates


def _installed(grid: str) -> Path | None:
    """Where a grid lies among PROJ's data."""
    folders = [*pyproj.datadir.get_data_dir().split(os.pathsep), pyproj.datadir.get_user_data_dir()]
    return next((p for folder in folders if (p := Path(folder) / grid).is_file()), None)


def candidates_at(lon: float, lat: float) -> list[Candidate]:
    """The geoids of a place (degrees), one grid of each surface, those of least ground first."""
    every = _every_candidate(lon, lat)
    # those of the whole Earth come last, and are worth a look
    return every if len(every) <= MOST else [*every[: MOST - 1], every[-2]]


def grid_of(datum: str, lon: float, lat: float) -> Candidate | None:
    """The geoid of a place whose heights are called so; None if the register names none."""

    def plain(surface: str) -> str:  # without what does not tell heights from others
        return re.sub(r"\bheights?\b|\(.*?\)|[\s_-]", "", surface.casefold())

    wanted = plain(datum)
    every = _every_candidate(lon, lat) if wanted else ()
    return next((one for one in every if wanted in plain(one.surface)), None)


def named(candidates: Sequence[Candidate]) -> str:
    """Candidates as a message names them."""
    return ", ".join(
        f"{one.surface} ({one.grid}{'' if one.path else ', not on this machine'})"
        for one in candidates
    )


def fits(shift_m: float, lon: float, lat: float) -> str:
    """How well each candidate explains that undeclared heights, taken as ellipsoidal, are off.

    ``shift_m``: LiDAR less truth, m. Empty where the register has no geoid of the place.
    """
    candidates = candidates_at(lon, lat)
    if not candidates:
        return ""
    parts = [f"by {abs(shift_m):.1f} m if they are ellipsoidal"]
    for one in candidates:
        if one.path is None:
            continue
        with suppress(InputError):  # of a grid that has no value there
            undulation_m = float(GeoidGrid(one.path)(np.array([lon]), np.array([lat]))[0])
            off_m = abs(shift_m + undulation_m)
            parts.append(f"by {off_m:.1f} m if they are above {one.surface} ({one.grid})")
    text = f"no surface is declared for its heights: the LiDAR is off {', '.join(parts)}"
    if missing := [one for one in candidates if one.path is None]:
        text += f"; of the place as well: {named(missing)}"
    return text
