"""What heights without a declared surface may count from, at a place: the geoids that PROJ knows.

Nothing is chosen here. Names of grids are those of PROJ's register, which has for each the ground
that it is made for; a grid is looked at if it is on this machine, and is never fetched.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj

from ..core.errors import InputError
from ..core.numerics.geometry import turn

MOST = 4  # candidates beside the ellipsoid
ASSUMED = "ellipsoidal (assumed)"  # how stores say that nothing is declared
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


@dataclass(frozen=True)
class Candidate:
    """A surface that heights may count from: its name, its geoid grid, where that lies if here."""

    surface: str
    grid: str
    path: Path | None

    def undulation_m(self, lon: float, lat: float) -> float | None:
        """Height of the surface over the ellipsoid; None where the grid is not here or has none."""
        if self.path is None:
            return None
        from .geoid import GeoidGrid  # GDAL, which few scenes need

        try:
            return float(GeoidGrid(self.path)(np.array([lon]), np.array([lat]))[0])
        except InputError:
            return None


def candidates_at(lon: float, lat: float) -> list[Candidate]:
    """The geoids of a place (degrees), one grid of each surface, those of least ground first."""
    found = _every(lon, lat)
    if len(found) > MOST:  # those of the whole Earth come last, and are worth a look
        found = [*found[: MOST - 1], found[-2]]
    return found


def grid_of(datum: str, lon: float, lat: float) -> Candidate | None:
    """The geoid of a place whose heights are called so; None if the register names none."""
    wanted = _plain(datum)
    named_so = (one for one in _every(lon, lat) if wanted and wanted in _plain(one.surface))
    return next(named_so, None)


def _plain(surface: str) -> str:
    """A name of heights without what does not tell them from others."""
    return re.sub(r"\bheights?\b|\(.*?\)|[\s_-]", "", surface.casefold())


def _every(lon: float, lat: float) -> list[Candidate]:
    file = Path(pyproj.datadir.get_data_dir().split(os.pathsep)[0]) / "proj.db"
    try:
        with closing(sqlite3.connect(f"{file.absolute().as_uri()}?mode=ro", uri=True)) as register:
            rows = register.execute(QUERY, {"lon": float(turn(lon)), "lat": lat}).fetchall()
    except sqlite3.Error:  # of another layout: then there are no names to give
        return []
    surfaces: dict[str, list[tuple[float, str]]] = {}
    for surface, grid, _, accuracy_m in rows:
        surfaces.setdefault(surface, []).append((accuracy_m, grid))
    found = []
    for surface, ranked in surfaces.items():
        grids = [grid for _, grid in sorted(ranked, key=lambda one: one[0])]
        here = [(grid, place) for grid in grids if (place := _installed(grid)) is not None]
        grid, place = here[0] if here else (grids[0], None)
        found.append(Candidate(surface, grid, place))
    return found


def _installed(grid: str) -> Path | None:
    """Where a grid lies among PROJ's data."""
    folders = [*pyproj.datadir.get_data_dir().split(os.pathsep), pyproj.datadir.get_user_data_dir()]
    return next((p for folder in folders if (p := Path(folder) / grid).is_file()), None)


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
    parts = [f"ellipsoidal {abs(shift_m):.1f} m"]
    for one in candidates:
        if (undulation := one.undulation_m(lon, lat)) is not None:
            parts.append(f"{one.surface} ({one.grid}) {abs(shift_m + undulation):.1f} m")
    text = f"no surface is declared for its heights; off by, if they are {'; '.join(parts)}"
    if missing := [one for one in candidates if one.path is None]:
        text += f"; of the place as well: {named(missing)}"
    return text
