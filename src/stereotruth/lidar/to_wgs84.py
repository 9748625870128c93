"""From the coordinates of a LiDAR file to WGS 84 longitude, latitude and ellipsoidal height.

The horizontal system with its unit, the unit of the heights, and the surface that they count from
are settled here or refused by name (LAS 1.4 R16, "Coordinate Reference System"; OGC GeoTIFF 1.1).

- Orthometric heights H need a geoid grid, h = H + N, before the change of frame. Nothing is ever
  downloaded. Heights of no declared surface are orthometric if a geoid is given, else ellipsoidal;
  but a file whose name carries that of a vertical datum (``..._IGN69.laz``) needs the geoid.
- Map projections are undone by polynomials that are checked against PROJ (:mod:`.smooth_maps`).
- Which datum transformation is best is asked for the whole degrees of longitude and latitude that
  the points' own extent touches, whatever box the header states.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import laspy
import numpy as np
import pyproj
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from ..core.errors import InputError
from ..core.numerics.geometry import continuous, turn
from .declared_crs import DATUM_IN_NAME, LidarCRS, degrees_of, resolve, unbound
from .frames import Epochs, FrameChange, frame_change, taken_as_it_is
from .smooth_maps import PatchedTransform

if TYPE_CHECKING:
    from .geoid import GeoidGrid

WGS84_3D = "EPSG:4979"
BOX_SAMPLES = 3  # along each side of a box
BOX_SLACK = 0.05  # of the sides of a box in degrees


@dataclass(frozen=True)
class ToWGS84:
    """Maps coordinates of one LiDAR file to WGS 84; made by :func:`to_wgs84`.

    ``operation`` and ``accuracy_m`` (None: unknown) describe PROJ's datum transformation,
    ``heights`` what was done with the heights, ``notes`` are remarks for the user. ``area``: box of
    longitude and latitude that the operation was chosen for. ``frame``: record of the frame and the
    epoch of the result and of the file, None if no epoch is wanted. ``change``: from the file's
    frame to ITRF2020, None where PROJ's way to WGS 84 is taken. ``exact``: lon, lat (degrees) and
    height (m) of coordinates x, y and heights in m above the ellipsoid, without polynomials.
    """

    system: LidarCRS
    operation: str
    accuracy_m: float | None
    heights: str
    notes: tuple[str, ...]
    area: tuple[float, float, float, float] | None
    frame: dict[str, object] | None
    change: FrameChange | None = field(repr=False)
    exact: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]] = field(repr=False)
    _to_geodetic: pyproj.Transformer = field(repr=False)
    _transform: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]] = field(repr=False)
    _geoid: GeoidGrid | None = field(repr=False)
    _heights_follow_datum: bool = field(repr=False)

    def __call__(
        self, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lon, lat (degrees) and ellipsoidal height (m) of file coordinates, each float64[n].

        Coordinates that PROJ cannot transform come out as inf. Raises InputError if the geoid grid
        does not cover them.
        """
        metres = np.asarray(z, np.float64) * self.system.height_unit_m
        lon, lat, height = self._transform(x, y, metres)
        lon = continuous(lon)
        if self._geoid is not None:
            good = np.isfinite(lon) & np.isfinite(lat)
            base = height if self._heights_follow_datum else metres
            height = np.full(metres.shape, np.inf)
            height[good] = base[good] + self._geoid(lon[good], lat[good])
        return lon, lat, height

    def inverse(self, lon: np.ndarray, lat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates x, y of the file at places of the ellipsoid, degrees; inf where none."""
        height = np.zeros(np.shape(lon))
        if self.change is not None:
            lon, lat, height = self.change.inverse(lon, lat, height)
        return self._to_geodetic.transform(lon, lat, height, direction="INVERSE")[:2]

    def height_shift_m(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        """What an ellipsoidal height of the result is above the file's, m [n], at places [n].

        The undulation of the geoid, and what the change of frame or datum lifts.
        """
        shift = np.zeros(np.shape(lon))
        if self._geoid is None or self._heights_follow_datum:
            shift = self.exact(*self.inverse(lon, lat), shift)[2]
        return shift if self._geoid is None else shift + self._geoid(lon, lat)

    def ground_boxes(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """West, south, east, north (degrees) [n, 4] around boxes of corners [n, 2 or more].

        They lie around the ground of the boxes: the sides of a box of 100 km bend by less than
        BOX_SLACK of it. NaN where PROJ cannot transform a box.
        """
        share = np.linspace(0.0, 1.0, BOX_SAMPLES)
        across, up = (low[:, k, None] + (high - low)[:, k, None] * share for k in (0, 1))
        nodes = np.broadcast_arrays(across[:, :, None], up[:, None, :])
        x, y = (np.ascontiguousarray(v).reshape(-1) for v in nodes)
        lon, lat, _ = self.exact(x, y, np.zeros(x.size))
        lon = continuous(lon)
        places = np.stack([lon, lat], axis=-1).reshape(len(low), -1, 2)
        places[~np.isfinite(places)] = np.nan
        first, last = places.min(axis=1), places.max(axis=1)
        slack = BOX_SLACK * (last - first)
        return np.hstack([first - slack, last + slack])

    def describe(self) -> dict[str, object]:
        """Record for the attributes of a product."""
        horizontal = self.system.horizontal
        return {
            "name": self.system.name,
            "wkt": horizontal.to_wkt("WKT2_2019"),
            "height_unit_m": self.system.height_unit_m,
            "heights": self.heights,
            "operation": self.operation,
            "accuracy_m": self.accuracy_m,
            "frame": self.frame,
            "geoid": None if self._geoid is None else self._geoid.path.name,
        }


def _best_operation(
    source: CRS, area: Sequence[float] | None
) -> tuple[pyproj.Transformer, list[str]]:
    """One fixed operation for a whole file (PROJ would choose anew for each point), and remarks."""
    pyproj.network.set_network_enabled(False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is missing is said below, by name
        group = TransformerGroup(
            source.to_3d(),
            WGS84_3D,
            always_xy=True,
            area_of_interest=None if area is None else AreaOfInterest(*area),
        )
    if not group.transformers and area is not None:  # a box that the system does not know
        return _best_operation(source, None)
    if not group.transformers:
        raise ProjError("PROJ knows no transformation to WGS 84 that needs no grid")
    best = group.transformers[0]
    notes = []
    if not group.best_available and group.unavailable_operations:
        grids = {g.short_name for o in group.unavailable_operations for g in o.grids}
        accuracy = f"{best.accuracy:g} m" if best.accuracy >= 0 else "unknown"
        notes.append(
            "better datum transformations need grids that are not installed "
            f"({', '.join(sorted(filter(None, grids)))}); used: {best.description} (accuracy "
            f"{accuracy})"
        )
    if "ballpark" in best.description.lower():
        notes.append(
            f"no datum transformation to WGS 84 is known for '{source.name}': "
            "its geodetic coordinates are taken as WGS 84 (accuracy unknown)"
        )
    return best, notes


def _change_of_frame(
    horizontal: CRS, extent: np.ndarray, epochs: Epochs | None
) -> FrameChange | None:
    """How coordinates in an extent [2, 2 or more] get to ITRF2020 at the epoch of the images.

    None: they are left to PROJ's way to WGS 84. Raises InputError: as
    :func:`.frames.frame_change`.
    """
    geographic = unbound(horizontal).geodetic_crs
    if epochs is None or geographic is None or not np.isfinite(extent[:, :2]).all():
        return None
    if (area := area_of(horizontal, extent)) is not None:
        place = (area[0] + area[2]) / 2, (area[1] + area[3]) / 2
    else:
        place = degrees_of(horizontal, *extent[:, :2].mean(axis=0))
        if place is None or not np.isfinite(place).all():
            return None
    return frame_change(geographic, place, *epochs)


def area_of(horizontal: CRS, extent: np.ndarray) -> tuple[float, float, float, float] | None:
    """Whole degrees around an extent [2, 2 or more] in a system; None where it makes no sense.

    Whole ones, so that files of one scene have the same.
    """
    corners = degrees_of(horizontal, extent[[0, 0, 1, 1], 0], extent[[0, 1, 0, 1], 1])
    if corners is None:
        return None
    lon, lat = corners
    if not (np.abs(lon).max() < 179 and np.abs(lat).max() < 89):  # no inf, no NaN either
        return None
    low, high = ([math.floor(f(of)) for of in corners] for f in (np.min, np.max))
    return low[0], low[1], high[0] + 1, high[1] + 1


def to_wgs84(
    header: laspy.LasHeader,
    file: str | Path,
    *,
    lidar_crs: str | None = None,
    geoid: str | Path | None = None,
    extent: np.ndarray | None = None,
    epochs: Epochs | None = None,
    declared: LidarCRS | None = None,
) -> ToWGS84:
    """The transformation that a LiDAR file needs.

    ``lidar_crs``, ``declared``: see :func:`.declared_crs.resolve`; ``extent``: lowest and
    highest coordinates of the points [2, 3], those that the header states if it is not given.
    Others, errors: see :func:`transformation`.
    """
    system, notes = resolve(header, lidar_crs or None, file, declared)
    stated = np.array([header.mins, header.maxs], np.float64)
    x, y = np.abs(stated[:, :2]).max(axis=0)
    if system.horizontal.is_projected and x <= 360 and y <= 90:
        raise InputError(
            f"coordinates up to ({x:g}, {y:g}) are no coordinates of '{system.name}'; they look "
            "like degrees",
            file=file,
            remedy="correct the system that is given (lidar_crs, --crs) or that the file declares "
            "(longitude/latitude is EPSG:4979)",
        )
    extent = stated if extent is None else extent
    return transformation(system, file, extent, geoid=geoid, epochs=epochs, notes=notes)


def _surface_of_heights(
    system: LidarCRS, file: str | Path, extent: np.ndarray, geoid: str | Path | None, unit: str
) -> tuple[str | Path | None, list[str]]:
    """The geoid that heights of a file count from, None for the ellipsoid; and remarks."""
    hint = DATUM_IN_NAME.search(Path(file).stem) if not system.has_vertical else None
    if not geoid and (datum := system.vertical_datum or (hint and hint[1])):
        from .geoid import grid_of  # for refusals alone

        remedy = "set geoid (--geoid) to a grid (GTX or GeoTIFF) of that datum"
        place = degrees_of(system.horizontal, *extent[:, :2].mean(axis=0))
        if place is not None and (grid := grid_of(datum, *map(float, place))) is not None:
            fetched = f"{grid.grid}, which projsync --file {grid.grid} downloads"
            remedy += f": {grid.path or fetched}"
        problem = f"heights are orthometric ('{datum}'), not ellipsoidal"
        if hint:
            problem = f"declares no vertical datum, but its name says orthometric heights ({datum})"
            remedy += ", or name the file otherwise if its heights are ellipsoidal"
        raise InputError(problem, file=file, remedy=remedy)
    if system.ellipsoidal and geoid:
        return None, ["the file declares ellipsoidal heights: the geoid is not applied to it"]
    if system.has_vertical:
        return geoid, []
    taken = "orthometric, as a geoid is given" if geoid else "ellipsoidal, as no geoid is given"
    return geoid, [f"declares no vertical datum: heights are taken as {taken}, in {unit}"]


def transformation(
    system: LidarCRS,
    file: str | Path,
    extent: np.ndarray,
    *,
    geoid: str | Path | None = None,
    epochs: Epochs | None = None,
    notes: Sequence[str] = (),
) -> ToWGS84:
    """The transformation of coordinates of a system, as LiDAR, rasters and control points need it.

    ``extent``: lowest and highest coordinates [2, 2 or more]; ``geoid``: path of a grid for
    orthometric heights; ``epochs``: that of the images, at which coordinates are brought to
    ITRF2020, and that of the coordinates for files that state none; None: frames are what PROJ
    takes them for, most of them WGS 84; ``notes``: remarks that go before others.

    Raises InputError: a system that PROJ cannot transform, orthometric heights without a geoid, a
    dynamic frame without an epoch.
    """
    horizontal = system.horizontal
    unit = system.vertical_unit or (
        "metre" if horizontal.is_geographic else horizontal.axis_info[0].unit_name
    )
    geoid, more = _surface_of_heights(system, file, extent, geoid, unit)
    if epochs is not None and system.epoch is not None:
        epochs = epochs._replace(own=system.epoch)
    try:
        area = area_of(horizontal, extent)
        change = _change_of_frame(horizontal, extent, epochs)
        if change is None:
            transformer, remarks = _best_operation(horizontal, area)
        else:
            source = unbound(horizontal).to_3d()
            transformer = pyproj.Transformer.from_crs(source, change.geographic, always_xy=True)
            remarks = list(change.notes)
    except InputError as error:
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    except ProjError as error:
        raise InputError(
            f"'{system.name}' cannot be transformed to WGS 84: {error}",
            file=file,
            remedy="name a system that PROJ can transform (lidar_crs, --crs), or transform the "
            "file",
        ) from error

    def exact(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
        place = transformer.transform(x, y, z)
        return place if change is None else change(*place)

    if change is not None:
        operation, accuracy, frame = "; ".join(change.legs), change.accuracy_m, change.describe()
    else:
        operation, frame = transformer.description, None
        accuracy = float(transformer.accuracy) if transformer.accuracy >= 0 else None
        if epochs is not None:
            frame = taken_as_it_is(unbound(horizontal).geodetic_crs, epochs.images)
    grid = None
    if geoid:
        from .geoid import GeoidGrid  # GDAL, which few scenes need

        grid = GeoidGrid(Path(geoid))
        heights = f"orthometric ({system.vertical_datum or 'datum not declared'}), in {unit}"
    else:
        heights = f"ellipsoidal ({'declared' if system.ellipsoidal else 'assumed'}), in {unit}"
    ellipsoid = horizontal.ellipsoid
    modern = ellipsoid is not None and abs(ellipsoid.semi_major_metre - 6378137) < 1
    smooth = PatchedTransform(exact, system.horizontal_unit_m) if horizontal.is_projected else exact
    return ToWGS84(
        system=system,
        operation=operation,
        accuracy_m=accuracy,
        heights=heights,
        notes=(*notes, *more, *remarks),
        area=area,
        frame=frame,
        change=change,
        exact=exact,
        _to_geodetic=transformer,
        _transform=smooth,
        _geoid=grid,
        # H + N of a national geoid is in the file's datum, if that is on GRS 80 as all geoids are,
        # and goes through the datum transformation; above WGS 84 it is final.
        _heights_follow_datum=modern and not (grid and grid.above_wgs84),
    )


def check_area(
    system: LidarCRS, lon: tuple[float, float], lat: tuple[float, float], file: str | Path
) -> str | None:
    """Compare where the points of a file have landed with where its system is used.

    Returns a remark if they lie more than 0.5° outside of that area. Raises InputError if they lie
    more than 8° outside: neighbouring UTM zones (6°) are still in use, another system is not.
    """
    area = system.horizontal.area_of_use
    if area is None and (code := system.horizontal.to_epsg()):
        area = CRS.from_epsg(code).area_of_use
    if area is None:
        return None
    wide = (area.east - area.west) % 360.0 or 360.0
    off = turn(np.array(lon) - (area.west + wide / 2))
    beyond = max(area.south - lat[0], lat[1] - area.north, float(np.abs(off).max()) - wide / 2)
    if beyond <= 0.5:
        return None
    where = (
        f"points lie at longitude {lon[0]:.4f} to {lon[1]:.4f}, latitude {lat[0]:.4f} to "
        f"{lat[1]:.4f}, outside of the area of '{system.name}' ({area.name})"
    )
    if beyond <= 8:
        return where
    raise InputError(
        where,
        file=file,
        remedy="correct the coordinate system that is given (lidar_crs, --crs) or that the file "
        "declares",
    )
