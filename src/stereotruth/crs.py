"""From the coordinates of a LiDAR file to WGS 84 longitude, latitude and ellipsoidal height.

Three things decide what a LAS coordinate means, and each is settled here or refused by name:
the horizontal system with its unit, the unit of the heights, and the surface that the heights
count from. Sources: LAS 1.4 R16 (ASPRS), section "Coordinate Reference System"; OGC GeoTIFF 1.1;
PROJ's promotion of 2-D systems to 3-D.

Rules
- The file's own declaration wins over ``lidar_crs``, which serves files that declare none, or
  supplies the vertical part where a file declares the same horizontal system only.
- Heights without a unit of their own are in the unit of a projected horizontal system (the custom
  of LAS), in metres in a geographic one.
- Orthometric heights H need a geoid grid: h = H + N. Grids give N above the GRS 80 or WGS 84
  ellipsoid. Nothing is ever downloaded.
- Map projections are undone by polynomials that are checked against PROJ at run time, see
  :mod:`stereotruth.crs_patches`; a coordinate may come out one step of 1e-9 degree beside PROJ's.
- Heights whose surface is declared nowhere are orthometric if a geoid is given, else ellipsoidal;
  but a file whose name carries the name of a vertical datum (``..._IGN69.laz``) needs the geoid.
"""

from __future__ import annotations

import logging
import re
import struct
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import laspy
import numpy as np
import pyproj
import rasterio
from numba import njit
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup
from rasterio.io import MemoryFile
from rasterio.windows import Window

from .crs_patches import PatchedTransform
from .errors import InputError

log = logging.getLogger("stereotruth")

WGS84_3D = "EPSG:4979"
DEGREE_M = 111_320.0  # one degree of latitude, for judging resolutions only
VERTICAL_UNITS_KEY = 4099
LINEAR_UNITS = {  # EPSG code: (name, metres)
    9001: ("metre", 1.0),
    9002: ("foot", 0.3048),
    9003: ("US survey foot", 1200 / 3937),
}
_NO_DATUM = {"", "unknown", "unnamed", "not specified", "unspecified"}
# Names of vertical datums that producers put into file names; delimited, so that no word hides one.
_DATUM_IN_NAME = re.compile(
    r"(?<![A-Za-z0-9])(IGN69|IGN78|NAVD88|NGVD29|EGM84|EGM96|EGM08|EGM2008|DHHN92|DHHN2016|NN2000"
    r"|RH2000|EVRF2000|EVRF2007|EVRF2019|LN02)(?![A-Za-z0-9])",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class LidarCRS:
    """What the coordinates of a LiDAR file mean.

    ``horizontal`` is a 2-D geographic or projected system; ``vertical_datum`` names the orthometric
    datum (None: none declared); ``ellipsoidal`` says that heights are declared ellipsoidal;
    ``vertical_unit_m`` is the length of the height unit in metres (None: not declared).
    ``notes`` are remarks for the user.
    """

    horizontal: CRS
    vertical_datum: str | None = None
    ellipsoidal: bool = False
    vertical_unit_m: float | None = None
    vertical_unit: str = ""
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name with EPSG codes where they are known."""
        code = self.horizontal.to_epsg()
        text = self.horizontal.name + (f" (EPSG:{code})" if code else "")
        if self.vertical_datum:
            text += f" + {self.vertical_datum}"
        elif self.ellipsoidal:
            text += " + ellipsoidal height"
        return text

    @property
    def horizontal_unit_m(self) -> float:
        """Metres per horizontal unit; for degrees those along a meridian."""
        axis = self.horizontal.axis_info[0]
        if self.horizontal.is_geographic:
            return float(np.degrees(axis.unit_conversion_factor)) * DEGREE_M
        return axis.unit_conversion_factor

    @property
    def height_unit_m(self) -> float:
        """Metres per unit of height: declared, else as LAS has it by custom."""
        if self.vertical_unit_m is not None:
            return self.vertical_unit_m
        return 1.0 if self.horizontal.is_geographic else self.horizontal_unit_m

    @property
    def has_vertical(self) -> bool:
        """Whether the surface of the heights is declared."""
        return self.ellipsoidal or self.vertical_datum is not None


def _source(crs: CRS) -> CRS:
    """The system itself where it comes bound to a transformation (TOWGS84, grid files)."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def interpret(crs: CRS) -> LidarCRS:
    """Split a system into its horizontal and vertical meaning.

    Raises ValueError for systems that are not geographic or projected (local, geocentric) and for
    vertical axes that point down.
    """
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    first = _source(parts[0])
    if not (first.is_geographic or first.is_projected):
        raise ValueError(f"'{crs.name}' is a {first.type_name}, neither geographic nor projected")
    if crs.is_compound:
        vertical = _source(parts[1])
        axis = vertical.axis_info[0]
        if axis.direction.lower() != "up":
            raise ValueError(f"the heights of '{crs.name}' point {axis.direction}")
        datum = vertical.datum.name if vertical.datum is not None else vertical.name
        unnamed = {datum.lower(), vertical.name.lower()} <= _NO_DATUM
        return LidarCRS(
            parts[0],
            vertical_datum=None if unnamed else (vertical.name or datum),
            vertical_unit_m=axis.unit_conversion_factor,
            vertical_unit=axis.unit_name,
        )
    if len(first.axis_info) == 3:
        axis = first.axis_info[2]
        return LidarCRS(
            crs.to_2d(),
            ellipsoidal=True,
            vertical_unit_m=axis.unit_conversion_factor,
            vertical_unit=axis.unit_name,
        )
    return LidarCRS(crs)


def parse_crs(text: str) -> LidarCRS:
    """Read ``lidar_crs``: "2154", "EPSG:2154", "EPSG:2154+5720" or WKT.

    Raises InputError.
    """
    text = text.strip()
    user = f"EPSG:{text}" if re.fullmatch(r"\d+(\+\d+)?", text) else text
    try:
        return interpret(CRS.from_user_input(user))
    except (CRSError, ValueError) as error:
        raise InputError(
            f"lidar_crs '{text}' cannot be used: {error}",
            remedy="give an EPSG code such as EPSG:32650, a compound such as EPSG:2154+5720, "
            "or WKT of a geographic or projected system",
        ) from error


# ------------------------------------------------------------------ what the header says


def _geokeys_tiff(shorts: np.ndarray, doubles: bytes, text: bytes) -> bytes:
    """A TIFF of one pixel that carries the GeoKeys of a LAS file, for GDAL to interpret."""
    blobs = {
        33550: (12, 3, struct.pack("<3d", 1, 1, 0)),
        33922: (12, 6, struct.pack("<6d", 0, 0, 0, 0, 0, 0)),
        34735: (3, shorts.size, shorts.astype("<u2").tobytes()),
        34736: (12, len(doubles) // 8, doubles[: len(doubles) // 8 * 8]),
        34737: (2, len(text), text),
    }
    blobs = {tag: blob for tag, blob in blobs.items() if blob[1]}
    plain = {256: 1, 257: 1, 258: 8, 259: 1, 262: 1, 277: 1, 278: 1, 279: 1}
    end = 8 + 2 + 12 * (len(plain) + 1 + len(blobs)) + 4
    entries = [(tag, 4, 1, value) for tag, value in plain.items()] + [(273, 4, 1, end)]
    data = bytes(8)
    for tag, (kind, count, blob) in blobs.items():
        entries.append((tag, kind, count, end + len(data)))
        data += blob + bytes(8 - len(blob) % 8)
    directory = b"".join(struct.pack("<HHII", *entry) for entry in sorted(entries))
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4) + data


def _from_geokeys(shorts: np.ndarray, doubles: bytes, text: bytes) -> LidarCRS | None:
    """The system of GeoKeys, user-defined projections and vertical keys included.

    GDAL does the reading, but passes over the vertical unit (key 4099) where the vertical system
    has a code of its own; LAStools and others write "NAVD88 in US survey feet" just so, hence the
    key is honoured here.
    """
    keys = shorts[4:].reshape(-1, 4)
    keys = keys[keys[:, 0] != 0]  # some writers count a terminating zero key
    keys = keys[np.argsort(keys[:, 0], kind="stable")]
    shorts = np.concatenate([[1, 1, 0, len(keys)], keys.ravel()])
    with (
        rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"),
        MemoryFile(_geokeys_tiff(shorts, doubles, text)) as memory,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # "not georeferenced"
        with memory.open() as tiff:
            wkt = tiff.crs.to_wkt() if tiff.crs else ""
    if not wkt:
        return None
    meaning = interpret(CRS.from_wkt(wkt))
    for key, location, _, value in keys.tolist():
        if key == VERTICAL_UNITS_KEY and location == 0 and value in LINEAR_UNITS:
            name, metres = LINEAR_UNITS[value]
            if abs(meaning.height_unit_m - metres) > 1e-9:
                note = (
                    f"GeoTIFF key 4099 gives heights in {name}, unlike '{meaning.name}': "
                    "the key is believed"
                )
                meaning = replace(meaning, notes=(note,))
            meaning = replace(meaning, vertical_unit_m=metres, vertical_unit=name)
    return meaning


def _wkt_text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("utf-8", errors="replace").strip()


def header_crs(header: laspy.LasHeader) -> tuple[LidarCRS | None, list[str]]:
    """What the header of a LAS file says about its coordinates, and why not, if nothing usable.

    WKT and GeoTIFF keys are both read. The one that the global encoding bit points to wins (LAS 1.4
    R16, table 4), unless only the other one declares a vertical part.
    """
    records: dict[int, bytes] = {}
    for record in [*header.vlrs, *(header.evlrs or [])]:
        if record.user_id == "LASF_Projection":
            records.setdefault(record.record_id, record.record_data_bytes())
    found: list[LidarCRS] = []
    problems: list[str] = []

    def attempt(what: str, read) -> None:
        try:
            meaning = read()
        except (CRSError, ValueError, rasterio.errors.RasterioError) as error:
            problems.append(f"its {what} cannot be used ({error})")
        else:
            if meaning is not None:
                found.append(meaning)

    def wkt() -> None:
        if text := _wkt_text(records.get(2112, b"")):
            attempt("WKT", lambda: interpret(CRS.from_wkt(text)))

    def geokeys() -> None:
        data = records.get(34735, b"")
        if len(data) >= 16:
            shorts = np.frombuffer(data[: 8 + (len(data) - 8) // 8 * 8], "<u2")
            shorts = shorts[: 4 + 4 * int(shorts[3])]
            attempt(
                "GeoTIFF keys",
                lambda: _from_geokeys(shorts, records.get(34736, b""), records.get(34737, b"")),
            )

    order = (wkt, geokeys) if header.global_encoding.wkt else (geokeys, wkt)
    for read in order:
        read()
    if not found:
        return None, problems
    return max(found, key=lambda meaning: meaning.has_vertical), problems  # max keeps the first


def _same_horizontal(one: CRS, other: CRS, x: float, y: float) -> bool:
    """Whether two systems put the same coordinates at the same place (to 1 mm) on their datum.

    Names and codes do not decide that: a WKT without authority is often the same system.
    """
    if one.equals(other, ignore_axis_order=True):
        return True
    places = []
    for crs in (one, other):
        crs = _source(crs)
        geographic = crs.geodetic_crs
        if geographic is None:
            return False
        lon, lat = pyproj.Transformer.from_crs(crs, geographic, always_xy=True).transform(x, y)
        places.append((lon, lat, geographic.ellipsoid.semi_major_metre))
    difference = np.abs(np.subtract(*places))
    same_datum = np.isfinite(difference).all() and difference[2] < 0.01
    return bool(same_datum and max(difference[:2]) * DEGREE_M < 1e-3)


def resolve(
    header: laspy.LasHeader, lidar_crs: str | None, file: str | Path
) -> tuple[LidarCRS, list[str]]:
    """The system that applies to a file, and remarks for the user.

    Raises InputError if the file declares none and ``lidar_crs`` is empty.
    """
    own, problems = header_crs(header)
    given = parse_crs(lidar_crs) if lidar_crs else None
    notes: list[str] = []
    if own is None:
        if given is None:
            reason = "; ".join(problems) if problems else "the file declares none"
            raise InputError(
                f"no coordinate reference system: {reason}",
                file=file,
                remedy="set lidar_crs (EPSG code, compound EPSG code or WKT) for this scene",
            )
        notes += [f"lidar_crs is used, since {problem}" for problem in problems]
        return given, notes
    notes += own.notes
    if given is None:
        return own, notes
    x, y = header.mins[0], header.mins[1]
    if not _same_horizontal(own.horizontal, given.horizontal, float(x), float(y)):
        notes.append(
            f"the file's own system '{own.name}' is used, not lidar_crs '{given.name}', "
            "which serves files that declare none"
        )
    elif given.has_vertical and not own.has_vertical:
        unit_m, unit = own.vertical_unit_m, own.vertical_unit
        own = replace(
            own,
            vertical_datum=given.vertical_datum,
            ellipsoidal=given.ellipsoidal,
            vertical_unit_m=given.vertical_unit_m if unit_m is None else unit_m,
            vertical_unit=given.vertical_unit if unit_m is None else unit,
        )
        notes.append(f"heights as lidar_crs says ('{own.name}'), the file declares none")
    elif given.has_vertical and (
        (own.ellipsoidal, own.vertical_datum) != (given.ellipsoidal, given.vertical_datum)
    ):
        notes.append(f"heights as the file declares ('{own.name}'), not as '{given.name}'")
    return own, notes


# ------------------------------------------------------------------ geoid grids


@njit(cache=True, nogil=True, error_model="numpy")
def _bilinear(
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
        out[i] = (1 - down) * ((1 - part) * rows[top, left] + part * rows[top, right]) + down * (
            (1 - part) * rows[below, left] + part * rows[below, right]
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
            with rasterio.open(self.path) as grid:
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
            with rasterio.open(self.path) as grid:
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
        _bilinear(
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


# ------------------------------------------------------------------ the transformation


@dataclass(frozen=True)
class ToWGS84:
    """Maps coordinates of one LiDAR file to WGS 84; made by :func:`to_wgs84`.

    ``operation`` and ``accuracy_m`` (None: unknown) describe PROJ's datum transformation,
    ``heights`` what was done with the heights, ``notes`` are remarks for the user.
    """

    system: LidarCRS
    operation: str
    accuracy_m: float | None
    heights: str
    notes: tuple[str, ...]
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
        if self._geoid is not None:
            good = np.isfinite(lon) & np.isfinite(lat)
            base = height if self._heights_follow_datum else metres
            height = np.full(metres.shape, np.inf)
            height[good] = base[good] + self._geoid(lon[good], lat[good])
        return lon, lat, height

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
    if not group.transformers:
        raise ProjError("PROJ knows no transformation to WGS 84 that needs no grid")
    best = group.transformers[0]
    notes = []
    accuracy = f"{best.accuracy:g} m" if best.accuracy >= 0 else "unknown"
    if not group.best_available and group.unavailable_operations:
        grids = sorted(
            {g.short_name for o in group.unavailable_operations for g in o.grids if g.short_name}
        )
        notes.append(
            f"better datum transformations need grids that are not installed ({', '.join(grids)}); "
            f"used: {best.description} (accuracy {accuracy})"
        )
    if "ballpark" in best.description.lower():
        notes.append(
            f"no datum transformation to WGS 84 is known for '{source.name}': "
            "its geodetic coordinates are taken as WGS 84 (accuracy unknown)"
        )
    return best, notes


def _area(horizontal: CRS, header: laspy.LasHeader) -> tuple[float, float, float, float] | None:
    """Longitude and latitude box of the header's bounds, padded; None where it makes no sense."""
    geographic = _source(horizontal).geodetic_crs
    if geographic is None:
        return None
    x = np.array([header.mins[0], header.maxs[0]])[[0, 0, 1, 1]]
    y = np.array([header.mins[1], header.maxs[1]])[[0, 1, 0, 1]]
    degrees = pyproj.Transformer.from_crs(_source(horizontal), geographic.to_2d(), always_xy=True)
    lon, lat = degrees.transform(x, y)
    box = (lon.min() - 0.01, lat.min() - 0.01, lon.max() + 0.01, lat.max() + 0.01)
    sensible = np.isfinite(box).all() and np.abs(lon).max() < 179.9 and np.abs(lat).max() < 89.9
    return tuple(map(float, box)) if sensible else None


def _refuse_degrees_as_metres(system: LidarCRS, header: laspy.LasHeader, file: str | Path) -> None:
    corners = np.abs([header.mins[:2], header.maxs[:2]]).max(axis=0)
    if system.horizontal.is_projected and corners[0] <= 360 and corners[1] <= 90:
        raise InputError(
            f"coordinates up to ({corners[0]:g}, {corners[1]:g}) are no coordinates of "
            f"'{system.name}'; they look like degrees",
            file=file,
            remedy="correct lidar_crs or the file's header (longitude/latitude is EPSG:4979)",
        )


def to_wgs84(
    header: laspy.LasHeader,
    file: str | Path,
    *,
    lidar_crs: str | None = None,
    geoid: str | Path | None = None,
) -> ToWGS84:
    """The transformation that a LiDAR file needs.

    ``lidar_crs``: see :func:`parse_crs`; ``geoid``: path of a grid for orthometric heights.
    Raises InputError: no or unusable coordinate system, orthometric heights without a geoid.
    """
    system, notes = resolve(header, lidar_crs or None, file)
    _refuse_degrees_as_metres(system, header, file)
    hint = _DATUM_IN_NAME.search(Path(file).stem)
    remedy = "set geoid to a grid (GTX or GeoTIFF) of that datum for this scene"
    if system.vertical_datum and not geoid:
        raise InputError(
            f"heights are orthometric ('{system.vertical_datum}'), not ellipsoidal",
            file=file,
            remedy=remedy,
        )
    if not system.has_vertical and hint and not geoid:
        raise InputError(
            f"declares no vertical datum, but its name says orthometric heights ({hint[1]})",
            file=file,
            remedy=f"{remedy}, or name the file otherwise if its heights are ellipsoidal",
        )
    if system.ellipsoidal and geoid:
        notes.append("the file declares ellipsoidal heights: the geoid is not applied to it")
        geoid = None
    unit = system.vertical_unit or (
        "metre" if system.horizontal.is_geographic else system.horizontal.axis_info[0].unit_name
    )
    if not system.has_vertical:
        taken = "orthometric, as a geoid is given" if geoid else "ellipsoidal, as no geoid is given"
        notes.append(f"declares no vertical datum: heights are taken as {taken}, in {unit}")
    try:
        transformer, remarks = _best_operation(system.horizontal, _area(system.horizontal, header))
    except ProjError as error:
        raise InputError(
            f"'{system.name}' cannot be transformed to WGS 84: {error}",
            file=file,
            remedy="set lidar_crs to a system that PROJ can transform, or transform the file",
        ) from error
    transform = transformer.transform
    if system.horizontal.is_projected:
        transform = PatchedTransform(transform, system.horizontal_unit_m)
    grid = GeoidGrid(Path(geoid)) if geoid else None
    ellipsoid = system.horizontal.ellipsoid
    modern = ellipsoid is not None and abs(ellipsoid.semi_major_metre - 6378137) < 1
    if geoid:
        heights = f"orthometric ({system.vertical_datum or 'datum not declared'}), in {unit}"
    else:
        heights = f"ellipsoidal ({'declared' if system.ellipsoidal else 'assumed'}), in {unit}"
    return ToWGS84(
        system=system,
        operation=transformer.description,
        accuracy_m=float(transformer.accuracy) if transformer.accuracy >= 0 else None,
        heights=heights,
        notes=tuple(notes + remarks),
        _transform=transform,
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
    beyond = max(area.south - lat[0], lat[1] - area.north)
    if area.west <= area.east:
        beyond = max(beyond, area.west - lon[0], lon[1] - area.east)
    if beyond <= 0.5:
        return None
    where = (
        f"points lie at longitude {lon[0]:.4f} to {lon[1]:.4f}, latitude {lat[0]:.4f} to "
        f"{lat[1]:.4f}, outside of the area of '{system.name}' ({area.name})"
    )
    if beyond > 8:
        raise InputError(
            where, file=file, remedy="correct lidar_crs or the file's coordinate system"
        )
    return where
