"""The coordinate system that a file declares, or that its user gives it: places, heights, units.

The one reader of systems: of LiDAR, surface models, control points and geoid grids. GDAL is asked
for what rasterio and laspy do not tell: GeoTIFF keys of a LAS file, and the epoch of a raster.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import numpy as np
import pyproj
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError

from ..core.errors import InputError
from ..core.numerics.geometry import DEGREE_M

if TYPE_CHECKING:
    import rasterio  # which few files need

VERTICAL_UNITS_KEY = 4099
PLAN_KEYS = (2048, 3072)  # of a geographic or a projected system
LINEAR_UNITS = {  # EPSG code: (name, metres)
    9001: ("metre", 1.0),
    9002: ("foot", 0.3048),
    9003: ("US survey foot", 1200 / 3937),
}
LENGTHS = {  # names of units in files: metres
    name: metres
    for metres, names in (
        (1.0, "m, metre, meter, metres, meters"),
        (0.1, "dm, decimetre, decimeter, decimetres, decimeters"),
        (0.01, "cm, centimetre, centimeter, centimetres, centimeters"),
        (0.001, "mm, millimetre, millimeter, millimetres, millimeters"),
        (0.3048, "ft, foot, feet, international foot, international feet"),
        (1200 / 3937, "us-ft, us_ft, ftus, us survey foot, us survey feet, foot_us, sft"),
    )
    for name in names.split(", ")
}
SAME_UNIT = 1e-5  # of a unit: feet and US survey feet of a band's name are often not told apart
DEPTHS = "they are depths"  # of a system whose vertical axis points down
_NO_DATUM = {"", "unknown", "unnamed", "not specified", "unspecified"}
_WITH_EPOCH = re.compile(  # WKT2:2019, clause 16, which PROJ reads as no system
    r"\s*COORDINATEMETADATA\s*\[(.*\])\s*,\s*EPOCH\s*\[\s*([0-9.]+)\s*\]\s*\]\s*",
    re.DOTALL | re.IGNORECASE,
)
# Names of vertical datums that producers put into file names; delimited, so that no word hides one.
DATUM_IN_NAME = re.compile(
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
    ``epoch`` of the coordinates in a dynamic frame, decimal year (None: not declared).
    ``notes`` are remarks for the user.
    """

    horizontal: CRS
    vertical_datum: str | None = None
    ellipsoidal: bool = False
    vertical_unit_m: float | None = None
    vertical_unit: str = ""
    epoch: float | None = None
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


def unbound(crs: CRS) -> CRS:
    """The system itself where it comes bound to a transformation (TOWGS84, grid files)."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def degrees_of(horizontal: CRS, x: Any, y: Any) -> tuple[Any, Any] | None:
    """Longitude and latitude of coordinates of a system on its own datum, inf where there is none.

    None of a system without a datum, or of a damaged one.
    """
    source = unbound(horizontal)
    if source.geodetic_crs is None:
        return None
    try:
        change = pyproj.Transformer.from_crs(source, source.geodetic_crs.to_2d(), always_xy=True)
    except ProjError:
        return None
    return change.transform(x, y)


def interpret(crs: CRS) -> LidarCRS:
    """Split a system into its horizontal and vertical meaning.

    Raises ValueError for systems that are not geographic or projected (local, geocentric) and for
    vertical axes that point down.
    """
    horizontal, *rest = crs.sub_crs_list if crs.is_compound else [crs]
    first = unbound(horizontal)
    if not (first.is_geographic or first.is_projected):
        raise ValueError(f"'{crs.name}' is a {first.type_name}, neither geographic nor projected")
    datum = None
    if rest:
        vertical = unbound(rest[0])
        axis = vertical.axis_info[0]
        name = vertical.datum.name if vertical.datum is not None else vertical.name
        if not {name.lower(), vertical.name.lower()} <= _NO_DATUM:
            datum = vertical.name or name
    elif len(first.axis_info) == 3:
        axis, horizontal = first.axis_info[2], crs.to_2d()
    else:
        return LidarCRS(crs)
    if axis.direction.lower() != "up":
        raise ValueError(f"the heights of '{crs.name}' point {axis.direction}: {DEPTHS}")
    return LidarCRS(horizontal, datum, not rest, axis.unit_conversion_factor, axis.unit_name)


def interpret_wkt(text: str) -> LidarCRS:
    """A system of WKT, with the epoch of the coordinates if the text states it.

    Raises CRSError and ValueError as :func:`interpret`.
    """
    if dated := _WITH_EPOCH.fullmatch(text):
        return replace(interpret(CRS.from_wkt(dated[1])), epoch=float(dated[2]))
    return interpret(CRS.from_wkt(text))


def parse_crs(text: str, name: str = "lidar_crs", file: str | Path | None = None) -> LidarCRS:
    """Read ``lidar_crs``: "2154", "EPSG:2154", "EPSG:2154+5720" or WKT.

    ``name``: what users call it, ``file``: where it stands. Raises InputError.
    """
    text = text.strip()
    user = f"EPSG:{text}" if re.fullmatch(r"\d+(\+\d+)?", text) else text
    try:
        if _WITH_EPOCH.fullmatch(user):
            return interpret_wkt(user)
        return interpret(CRS.from_user_input(user))
    except (CRSError, ValueError) as error:
        raise InputError(
            f"{name} '{text}' cannot be used: {error}",
            file=file,
            remedy="give an EPSG code such as EPSG:32650, a compound such as EPSG:2154+5720, "
            "or WKT of a geographic or projected system",
        ) from error


def of_raster(wkt: str, band_unit: str, file: str | Path) -> LidarCRS:
    """The system of a raster of heights, whose unit its band may tell.

    Raises InputError: no place on the ground, no known unit, or two that differ.
    """
    try:
        system = interpret(CRS.from_wkt(wkt))
    except (CRSError, ValueError) as error:
        raise InputError(
            str(error),
            file=file,
            remedy="set its coordinate system by gdal_edit.py -a_srs, or bring the raster to "
            "another by gdalwarp -t_srs",
        ) from None
    if not band_unit:
        return system
    metres = LENGTHS.get(band_unit.lower())
    if metres is None:
        raise InputError(
            f"its heights are in {band_unit!r}, which is no known unit",
            file=file,
            remedy="write the unit again: gdal_edit.py -units metre, or foot, or 'US survey foot'",
        )
    stated = system.vertical_unit_m
    if stated is None:
        return replace(system, vertical_unit_m=metres, vertical_unit=band_unit)
    if abs(stated / metres - 1) > SAME_UNIT:
        raise InputError(
            f"its band counts heights in {band_unit!r}, its coordinate system in "
            f"{system.vertical_unit}",
            file=file,
            remedy="correct the wrong one: gdal_edit.py -units, or -a_srs",
        )
    return system


def epoch_of(raster: rasterio.DatasetReader) -> float | None:
    """Epoch of an open raster's coordinates (decimal year), as GDAL writes it into a VRT of it."""
    import rasterio.shutil

    with rasterio.MemoryFile(ext=".vrt") as memory:
        rasterio.shutil.copy(raster, memory.name, driver="VRT")
        found = re.search(rb' coordinateEpoch="([0-9.]+)"', memory.read())
    return float(found[1]) if found else None


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


def _compound_in_plan(keys: np.ndarray) -> CRS | None:
    """The compound system whose code stands in a key for the system in plan; None without one.

    laspy 2.7 writes it there (``add_crs``). GDAL 3.10 and 3.12 take its feet for metres.
    """
    codes = [value for key, at, _, value in keys.tolist() if key in PLAN_KEYS and at == 0]
    with suppress(CRSError):  # no code of EPSG, or newer than PROJ's register
        if codes and (system := CRS.from_epsg(codes[-1])).is_compound:
            return system
    return None


def _from_geokeys(data: bytes, doubles: bytes, text: bytes) -> LidarCRS | None:
    """The system of GeoKeys (records 34735, 34736 and 34737), None if they name none.

    GDAL does the reading, user-defined projections included, but passes over the vertical unit (key
    4099) where the vertical system has a code of its own; LAStools and others write "NAVD88 in US
    survey feet" just so, hence the key is honoured here.

    Raises ValueError if GDAL cannot read them, or as :func:`interpret`.
    """
    if len(data) < 16:
        return None
    import rasterio
    from rasterio.errors import RasterioError

    shorts = np.frombuffer(data[: 8 + (len(data) - 8) // 8 * 8], "<u2")
    keys = shorts[4 : 4 + 4 * int(shorts[3])].reshape(-1, 4)
    keys = keys[keys[:, 0] != 0]  # some writers count a terminating zero key
    keys = keys[np.argsort(keys[:, 0], kind="stable")]
    shorts = np.concatenate([[1, 1, 0, len(keys)], keys.ravel()])
    try:
        with (
            rasterio.Env(GTIFF_REPORT_COMPD_CS="YES"),
            rasterio.MemoryFile(_geokeys_tiff(shorts, doubles, text)) as memory,
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")  # "not georeferenced"
            with memory.open() as tiff:
                if not tiff.crs:
                    return None
                wkt, epoch = tiff.crs.to_wkt(), epoch_of(tiff)
    except RasterioError as error:
        raise ValueError(str(error)) from error
    meaning = replace(interpret(_compound_in_plan(keys) or CRS.from_wkt(wkt)), epoch=epoch)
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


def _held_against_code(meaning: LidarCRS, x: float, y: float) -> LidarCRS:
    """With a note if a system is another than that of the EPSG code which it names for itself."""
    identity = unbound(meaning.horizontal).to_json_dict().get("id", {})
    if identity.get("authority") != "EPSG":
        return meaning
    try:
        registered = CRS.from_epsg(identity["code"])
    except CRSError:
        return meaning  # newer than PROJ's register
    if _same_horizontal(meaning.horizontal, registered.to_2d(), x, y):
        return meaning
    note = (
        f"its WKT names EPSG:{identity['code']}, but describes another system, which is used: "
        "check the file's coordinate system"
    )
    return replace(meaning, notes=(*meaning.notes, note))


def header_crs(header: laspy.LasHeader) -> tuple[LidarCRS | None, list[str]]:
    """What the header of a LAS file says about its coordinates, and why not, if nothing usable.

    WKT and GeoTIFF keys are both read. The one that the global encoding bit points to wins (LAS 1.4
    R16, table 4), unless only the other one declares a vertical part.
    """
    records: dict[int, bytes] = {}
    for record in [*header.vlrs, *(header.evlrs or [])]:
        if record.user_id == "LASF_Projection":
            records.setdefault(record.record_id, record.record_data_bytes())
    x, y = float(header.mins[0]), float(header.mins[1])
    wkt = records.get(2112, b"").split(b"\0")[0].decode("utf-8", errors="replace").strip()
    keys = [records.get(number, b"") for number in (34735, 34736, 34737)]
    readers: dict[str, Callable[[], LidarCRS | None]] = {
        "WKT": lambda: _held_against_code(interpret_wkt(wkt), x, y) if wkt else None,
        "GeoTIFF keys": lambda: _from_geokeys(*keys),
    }
    meanings: list[LidarCRS] = []
    problems: list[str] = []
    for what in readers if header.global_encoding.wkt else reversed(readers):
        try:
            meaning = readers[what]()
        except (ProjError, ValueError) as error:
            problems.append(f"its {what} cannot be used ({error})")
        else:
            meanings += [meaning] if meaning is not None else []
    if not meanings:
        return None, problems
    best = max(meanings, key=lambda meaning: meaning.has_vertical)  # max keeps the first
    if not _same_horizontal(meanings[0].horizontal, meanings[-1].horizontal, x, y):
        note = f"its WKT and its GeoTIFF keys describe different systems: '{best.name}' is used"
        best = replace(best, notes=(*best.notes, note))
    return best, problems


def _same_horizontal(one: CRS, other: CRS, x: float, y: float) -> bool:
    """Whether two systems put the same coordinates at the same place (to 1 mm) on their datum.

    Names and codes do not decide that: a WKT without authority is often the same system.
    """
    if one.equals(other, ignore_axis_order=True):
        return True
    places = [degrees_of(crs, x, y) for crs in (one, other)]
    if None in places:
        return False
    off_m = np.abs(np.subtract(*places)).max() * DEGREE_M
    axes = [unbound(crs).geodetic_crs.ellipsoid.semi_major_metre for crs in (one, other)]
    return bool(off_m < 1e-3 and abs(axes[0] - axes[1]) < 0.01)  # nor NaN


def resolve(
    header: laspy.LasHeader,
    lidar_crs: str | None,
    file: str | Path,
    declared: LidarCRS | None = None,
) -> tuple[LidarCRS, list[str]]:
    """The system that applies to a file, and remarks for the user.

    ``declared``: of formats whose system is not in the header. Raises InputError if the file
    declares none and ``lidar_crs`` is empty, and for depths.
    """
    own, problems = (declared, []) if declared is not None else header_crs(header)
    if depths := [text for text in problems if DEPTHS in text]:  # whatever the sheet says
        raise InputError(
            depths[0], file=file, remedy="write the file again with heights, which point up"
        )
    given = parse_crs(lidar_crs) if lidar_crs else None
    if own is None:
        if given is None:
            reason = "; ".join(problems) if problems else "the file declares none"
            raise InputError(
                f"no coordinate reference system: {reason}",
                file=file,
                remedy="set lidar_crs (EPSG code, compound EPSG code or WKT) for this scene",
            )
        return given, [f"lidar_crs is used, since {problem}" for problem in problems]
    notes = list(own.notes)
    if given is None:
        return own, notes
    x, y = float(header.mins[0]), float(header.mins[1])
    if not _same_horizontal(own.horizontal, given.horizontal, x, y):
        notes.append(
            f"the file's own system '{own.name}' is used, not lidar_crs '{given.name}', "
            "which serves files that declare none"
        )
    elif given.has_vertical and not own.has_vertical:
        own = replace(own, vertical_datum=given.vertical_datum, ellipsoidal=given.ellipsoidal)
        if own.vertical_unit_m is None:
            unit = {"vertical_unit_m": given.vertical_unit_m, "vertical_unit": given.vertical_unit}
            own = replace(own, **unit)
        notes.append(f"heights as lidar_crs says ('{own.name}'), the file declares none")
    elif given.has_vertical and (
        (own.ellipsoidal, own.vertical_datum) != (given.ellipsoidal, given.vertical_datum)
    ):
        notes.append(f"heights as the file declares ('{own.name}'), not as '{given.name}'")
    return own, notes
