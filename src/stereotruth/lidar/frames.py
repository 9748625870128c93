"""From the terrestrial frame of coordinates to ITRF2020 at the date of the images.

Two legs: the frame to ITRF2020 at the epoch of the coordinates, by PROJ or that of the ITRF that
the frame is a realisation of (:data:`REALISATIONS`); and from that epoch to that of the target by
the motion of the plate. Why, and which epoch coordinates have: docs/explanation/frames.md.

Plates: ITRF2020 Plate Motion Model, Altamimi et al. (2023), doi 10.1029/2023GL106373, tables 1 and
2, with the bias of the origin's rate in the horizontal. Outlines are coarse: straight lines some
tens of km beside the boundaries of Bird (2003, doi 10.1029/2001GC000252). Zones of no rigid plate
(Japan, Anatolia, Iceland …) lie in none of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import pyproj
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.crs import Datum, GeographicCRS
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import turn

Place = tuple[Floats, Floats, Floats]

NAME = "ITRF2020"
ITRF2020 = 9989  # EPSG: longitude, latitude, ellipsoidal height
ETRS89 = 4937
ETRS89_ENSEMBLE = 6258  # EPSG code of the datum
WGS84_ENSEMBLE = 6326  # EPSG code of the datum
WGS84_NAME = f"{NAME} (WGS 84 names no realisation)"
SURE_M = 0.1  # accuracy of a transformation to ETRS89 that makes a frame one of its realisations
NEAR_DEG = 0.5  # around a place for which the transformation is chosen
UNKNOWN_M = 0.03  # a tenth of the finest pixel: places that may be farther off are refused
MOST_M_A = 0.08  # by which any place on Earth moves in a year
SETTLED_M = 1e-4  # motion that is left out: the step of heights in point stores
MAS = np.radians(1 / 3.6e6)  # a milliarcsecond
ORIGIN_RATE_BIAS = (0.37e-3, 0.35e-3, 0.74e-3)  # m a year, X, Y, Z

# Plates.
ROTATION = {  # mas a year about X, Y, Z
    "AMUR": (-0.131, -0.551, 0.837),
    "ANTA": (-0.269, -0.312, 0.678),
    "ARAB": (1.129, -0.146, 1.438),
    "AUST": (1.487, 1.175, 1.223),
    "CARB": (0.207, -1.422, 0.726),
    "EURA": (-0.085, -0.519, 0.753),
    "INDI": (1.137, 0.013, 1.444),
    "NAZC": (-0.327, -1.561, 1.605),
    "NOAM": (0.045, -0.666, -0.098),
    "NUBI": (0.090, -0.585, 0.717),
    "PCFC": (-0.404, 1.021, -2.154),
    "SOAM": (-0.261, -0.282, -0.157),
    "SOMA": (-0.081, -0.719, 0.864),
}

# From Fiordland along the Alpine and the Hope Fault to the Hikurangi Trough.
_NEW_ZEALAND = (
    "165.6 -46.8, 167.0 -45.2, 167.9 -44.55, 168.7 -44.1, 169.4 -43.8, 170.2 -43.4, 171.45 -42.75, "
    "172.9 -42.5, 173.9 -42.4, 175.3 -42.0, 177 -41, 178.5 -39.5, 179.4 -37.5"
)
_NEW_ZEALAND_BACK = ", ".join(reversed(_NEW_ZEALAND.split(", ")))
# The San Andreas Fault from Cape Mendocino to the Gulf of California.
_CALIFORNIA = (
    "-124.4 40.3, -123.7 38.9, -122.5 37.7, -121.2 36.6, -119.9 35.1, -118.5 34.7, -117.4 34.2, "
    "-116.2 33.6, -115.5 32.6, -114.5 31, -109 23.5"
)

# Longitude and latitude of the corners; the first outline that a place lies in counts.
OUTLINES = (
    ("AUST", f"110 -11, 120 -11, 128 -11, 142 -9.6, 146 -11, 156 -13, 165 -21.5, 171 -23, 179 -35, "
     f"{_NEW_ZEALAND_BACK}, 160 -50, 135 -48, 108 -42"),
    ("PCFC", f"{_NEW_ZEALAND}, 184 -37, 184 -53, 166 -53"),
    ("PCFC", f"-160 5, -160 45, -135 45, {_CALIFORNIA}, -120 10"),
    ("AMUR", "112 50, 118 42.5, 122 39, 125.5 33, 130 34.5, 131.5 42, 139 48, 139 53.5, 120 55.5"),
    ("EURA", "-24 37.5, -10 36.4, -5.5 36, 0 37.6, 8 38.8, 12.4 37.4, 15.4 37.6, 19 39.6, 20.5 42, "
     "28.5 41.8, 41 43.5, 50 42, 58 39, 68 38.5, 74 36.5, 80 35.5, 92 28.5, 99 25, 102 21.5, "
     "107 20.5, 112 17.5, 119.5 24, 123 29, 124 37, 122 39, 118 42.5, 112 50, 120 55.5, 131 62, "
     "138 68, 140 82, 0 84, 5 74, -8 70, -12 66.5, -13 63, -28 55, -28 40"),
    ("NOAM", f"-168 71, -166 64, -157 60.5, -145 61.5, -135 57.8, -131.5 53.5, -125 48.4, "
     f"-124.2 43, {_CALIFORNIA}, -105.3 20.3, -98 17, -93.5 16, -88.5 17.5, -86 21.3, -75 21.2, "
     "-66 21, -55 22, -46 25, -34 45, -33 57, -40 60, -28 67.5, -18 70.5, -8 82, -60 86, -168 80"),
    ("CARB", "-81 12.5, -75.5 17.3, -68 17.5, -64.5 17.6, -62 18.2, -60.2 15, -60.7 11.8, "
     "-66 12.2, -72 13.2, -79 10.5"),
    ("SOAM", "-76 -14.5, -79 -5, -77.5 -2, -76 1, -73.5 5, -71 8, -63 10.2, -59 12.5, -45 9, "
     "-32 0, -20 -15, -18 -45, -55 -53, -66 -54, -73 -50, -72.5 -40, -70.5 -33, -69 -20, -71 -16"),
    ("ARAB", "35.7 29, 36.3 33, 38 36.3, 42 36.8, 45.5 34, 48.5 30.2, 52 27, 56 26, 58 24.8, "
     "60 22.5, 58 17, 52 14.8, 45 13, 43 13.8, 40.5 19.5, 37 24.5"),
    ("SOMA", "43 10.8, 52 12.8, 60 2, 62 -22, 54 -32, 37 -33, 36 -20, 37 -6, 39.5 3, 41.5 8"),
    ("NUBI", "-28 37, -6 35.4, -1.5 35, 9 37, 12 33.5, 20 33.2, 31 32.2, 33.5 28.2, 36.5 22, "
     "39 16, 39.5 13.5, 38 8.5, 36 4.5, 31 3.5, 29 -2, 29 -7, 32 -11, 33.5 -19, 32 -27, 33 -36, "
     "20 -46, -8 -40, -12 0, -25 15, -28 30"),
    ("INDI", "67.5 24, 70.5 29.5, 74.5 32.2, 80 28.8, 88 26.6, 91.5 25.8, 91 21.5, 90 10, 86 2, "
     "72 2, 66 16"),
    ("ANTA", "-180 -90, -180 -64, 180 -64, 180 -90"),
)  # fmt: skip


class Epoch(NamedTuple):
    """Decimal year that places are brought to, and what tells it; empty: nothing does."""

    year: float
    by: str = ""


DEFAULT_EPOCH = Epoch(2020.0)


class Epochs(NamedTuple):
    """``images``: that coordinates are brought to; ``own``: theirs (decimal year), where stated."""

    images: Epoch
    own: float | None = None


DEFAULT_EPOCHS = Epochs(DEFAULT_EPOCH)


class Realisation(NamedTuple):
    """What a datum's coordinates are: those of an EPSG system, at an epoch (None: at any).

    ``spread_m``: among the realisations that the datum may stand for.
    """

    system: int
    epoch: float | None = None
    spread_m: float = 0.0
    remark: str = ""


_ETRS89 = Realisation(10570, spread_m=0.1)  # ETRF2020, which PROJ takes ETRS89 for, too
_ETRF2000 = Realisation(7931)
_NAD83 = Realisation(
    6319,
    spread_m=1.0,
    remark="names no realisation of NAD83, or an old one: taken as NAD83(2011); NAD83(HARN) and "
    "later ones lie within some 0.1 m of it, NAD83(1986) within 1 m",
)
_NZGD2000 = Realisation(
    7907,  # ITRF96
    2000.0,
    spread_m=0.5,
    remark="New Zealand deforms, by up to 4 cm a year between its coasts: NZGD2000 is brought to "
    "the date of the images as on a rigid plate, since LINZ's grid nz_linz_nzgd2000-20180701.json "
    "is not installed (projsync --file gets it)",
)
# By the EPSG code of the datum, with the definitions of EPSG's register (v11) where nothing else
# stands. No entry is made where PROJ knows the way itself.
REALISATIONS = {
    6167: _NZGD2000,
    1043: Realisation(7908, 2000.0, spread_m=0.2),  # China 2000 (CGCS2000): ITRF97
    6674: Realisation(7909, 2000.4),  # SIRGAS 2000: ITRF2000
    6170: Realisation(7906, 1995.4),  # SIRGAS 1995: ITRF94
    1062: Realisation(7910, 2006.632),  # POSGAR 2007: ITRF2005
    1068: Realisation(7906, 1995.4),  # SIRGAS-ROU98
    1120: Realisation(7911, 2010.0),  # Mexico ITRF2008
    6737: Realisation(7909, 2002.0),  # KGD2002 (Korea 2000): ITRF2000
    1209: Realisation(7907, 1998.121),  # Hong Kong Geodetic: ITRF96
    6148: Realisation(7903, 1994.0),  # Hartebeesthoek94: ITRF91
    1159: Realisation(7911, 2011.0),  # GSK-2011: ITRF2008
    ETRS89_ENSEMBLE: _ETRS89,
    6171: _ETRS89,  # RGF93 v1
    6140: Realisation(10413),  # NAD83(CSRS), of which versions 6 to 8 are the same
    6269: _NAD83,  # NAD83
    6152: _NAD83,  # NAD83(HARN)
    6759: _NAD83,  # NAD83(NSRS2007)
    1211: _NAD83,  # NAD83(FBN)
    1312: _ETRF2000,  # RGF93 v2, at 2009.0
    1313: _ETRF2000,  # RGF93 v2b, at 2019.0
    1132: _ETRF2000,  # RDN2008
    1305: _ETRF2000,  # ETRF2000-PL
    1214: _ETRF2000,  # SRB_ETRS89
    6619: Realisation(7929),  # SWEREF99: ETRF97
    # The frames of the IGS are those of the ITRF, to some mm of its stations.
    1333: Realisation(9989),  # IGS20
    1191: Realisation(7912),  # IGS14
    1272: Realisation(7912),  # IGb14
    1141: Realisation(7911),  # IGS08
    1248: Realisation(7911),  # IGb08
}


@dataclass(frozen=True)
class FrameChange:
    """From longitude, latitude, height of a frame to those in ITRF2020 at epoch ``target``.

    ``frame``: its name; ``epoch`` of the coordinates (decimal year), None where they hold at any
    (the frame moves with its plate); ``target``: epoch of the result; ``legs``: what is done, in
    words; ``accuracy_m``: of PROJ's transformation, None where it is not known; ``notes``: remarks
    for the user. ``geographic``: the system that it begins from, in degrees, three-dimensional.
    """

    frame: str
    epoch: float | None
    target: Epoch
    legs: tuple[str, ...]
    accuracy_m: float | None
    notes: tuple[str, ...]
    geographic: CRS
    _steps: tuple[Callable[[Floats, Floats, Floats], Place], ...] = field(repr=False)

    def __call__(self, lon: Floats, lat: Floats, height: Floats) -> Place:
        """Longitude, latitude (degrees), ellipsoidal height (m), each float64[n]."""
        for step in self._steps:
            lon, lat, height = step(lon, lat, height)
        return lon, lat, height

    def inverse(self, lon: Floats, lat: Floats, height: Floats) -> Place:
        """Of places in ITRF2020, those in the frame; to a micrometre.

        A change moves places of a region by metres that are the same to 1e-6, so that what it does
        to a place that is nearly right is known.
        """
        place = lon, lat, height
        for _ in range(3):
            off = [b - a for a, b in zip(self(*place), (lon, lat, height))]
            place = place[0] + turn(off[0]), place[1] + off[1], place[2] + off[2]
        return place

    def describe(self) -> dict[str, Any]:
        """Record for the attributes of a product."""
        return _record(self.target, self.frame, self.epoch, self.legs)


def _record(
    target: Epoch, frame: str, epoch: float | None, legs: tuple[str, ...]
) -> dict[str, Any]:
    """Of coordinates in ITRF2020 at ``target``, and the frame and epoch that they come from."""
    source = {"frame": frame, "epoch": epoch, "legs": list(legs)}
    return {"frame": NAME, "epoch": round(target.year, 4), "by": target.by, "source": source}


def taken_as_it_is(geodetic: CRS | None, target: Epoch) -> dict[str, Any]:
    """Record of coordinates that :func:`frame_change` leaves to PROJ's way to WGS 84."""
    if geodetic is not None and datum_code(geodetic) == WGS84_ENSEMBLE:
        return _record(target, WGS84_NAME, round(target.year, 4), ())
    name = "unknown" if geodetic is None else geodetic.name
    return _record(target, f"{name}, to WGS 84 by PROJ and that taken as {NAME}", None, ())


def datum_code(geodetic: CRS) -> int | None:
    """EPSG code of a system's datum, by its code or its name; None where neither says it."""
    datum = geodetic.datum
    if datum is None or (datum.prime_meridian is not None and datum.prime_meridian.longitude):
        return None
    identity = datum.to_json_dict().get("id", {})
    if identity.get("authority") == "EPSG":
        return int(identity["code"])
    for name in (datum.name, f"{datum.name} ensemble"):
        try:
            identity = Datum.from_name(name, auth_name="EPSG").to_json_dict().get("id", {})
        except CRSError:
            continue
        if identity.get("authority") == "EPSG":
            return int(identity["code"])
    return None


@cache
def _geographic(datum: int) -> CRS:
    """Longitude, latitude and ellipsoidal height on a datum of EPSG."""
    found = Datum.from_epsg(datum)
    return GeographicCRS(name=found.name, datum=found).to_3d()


def _operation(source: CRS, target: int, place: tuple[float, float]) -> pyproj.Transformer | None:
    """PROJ's best transformation between two frames at a place, or None.

    What it calls a ballpark is none, nor is one that needs a grid which is not installed.
    """
    pyproj.network.set_network_enabled(False)
    lon, lat = float(turn(place[0])), place[1]
    west, east = max(lon - NEAR_DEG, -180.0), min(lon + NEAR_DEG, 180.0)
    south, north = max(lat - NEAR_DEG, -90.0), min(lat + NEAR_DEG, 90.0)
    around = AreaOfInterest(west, south, east, north)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of grids that are not installed
            group = TransformerGroup(
                source,
                f"EPSG:{target}",
                always_xy=True,
                area_of_interest=around,
                allow_ballpark=False,
            )
    except (ProjError, IndexError):  # pyproj 3.7: of a group without any operation
        return None
    good = (one for one in group.transformers if "ballpark" not in one.description.lower())
    return next(good, None)


class _Way(NamedTuple):
    """From a frame to ITRF2020 by PROJ: operations, one after the other, and what they mean."""

    operations: tuple[pyproj.Transformer, ...]
    epoch: float | None
    dynamic: bool
    spread_m: float = 0.0
    notes: tuple[str, ...] = ()


def _way(datum: int, place: tuple[float, float]) -> _Way | None:
    """How a datum gets to ITRF2020; None where nothing better than WGS 84 is known."""
    own, known = _geographic(datum), REALISATIONS.get(datum)
    dynamic = Datum.from_epsg(datum).type_name.startswith("Dynamic")
    direct = None
    if known is None or known.epoch is not None:  # PROJ may have a grid of deformations
        direct = _operation(own, ITRF2020, place)
    if direct is not None:
        return _Way((direct,), None, dynamic)
    before: tuple[pyproj.Transformer, ...] = ()
    if known is None:
        to_etrs89 = _operation(own, ETRS89, place)
        if to_etrs89 is None or not 0 <= to_etrs89.accuracy <= SURE_M:
            return None
        before, known = (to_etrs89,), REALISATIONS[ETRS89_ENSEMBLE]
    best = _operation(CRS.from_epsg(known.system), ITRF2020, place)
    if best is None:
        return None
    notes = (known.remark,) if known.remark else ()
    return _Way((*before, best), known.epoch, dynamic, known.spread_m, notes)


def _at(operation: pyproj.Transformer, epoch: float) -> Callable[[Floats, Floats, Floats], Place]:
    def transform(lon: Floats, lat: Floats, height: Floats) -> Place:
        return operation.transform(lon, lat, height, np.full(np.shape(lon), epoch))[:3]

    return transform


def _words(operation: pyproj.Transformer) -> str:
    """What an operation does, without what is no more than another form of coordinates."""
    parts = operation.description.split(" + ")
    forms = ("axis order change", "Conversion from", "Null geographic offset")
    return " + ".join(part for part in parts if not part.startswith(forms)) or "nothing"


def frame_change(
    geodetic: CRS,
    place: tuple[float, float],
    target: Epoch,
    epoch: float | None = None,
) -> FrameChange | None:
    """How coordinates on a datum get to ITRF2020 at an epoch.

    ``geodetic``: geographic system of the datum; ``place``: longitude and latitude in degrees of
    the coordinates, for the plate and PROJ's choice; ``epoch``: of the coordinates as stated, which
    dynamic frames need and WGS 84 may have. None: the frame is WGS 84 without a stated epoch, or
    nothing better is known of it than PROJ's way to WGS 84.

    Raises InputError: a dynamic frame without an epoch, or an epoch that differs from the target's
    where no plate's motion is known.
    """
    datum = datum_code(geodetic)
    if datum is None or (datum == WGS84_ENSEMBLE and epoch is None):
        return None
    is_wgs84 = datum == WGS84_ENSEMBLE
    way = _Way((), epoch, True) if is_wgs84 else _way(datum, place)
    if way is None:
        return None
    name, goal = WGS84_NAME if is_wgs84 else geodetic.name, target.year
    plate = plate_at(*place)
    m_a = None if plate is None else speed(*place, plate)
    own = way.epoch if way.epoch is not None else epoch if way.dynamic else None
    if way.dynamic and own is None:
        since = Datum.from_epsg(datum).to_json_dict().get("frame_reference_epoch", goal)
        fastest = MOST_M_A if m_a is None else m_a
        if fastest * abs(goal - since) > UNKNOWN_M:
            raise InputError(
                f"coordinates in {name} move by {1000 * fastest:.0f} mm a year here, and nothing "
                "states their epoch",
                remedy="state it, as 2016.4 or 2016-05-27: lidar_epoch of the scene, '# epoch:' "
                "above control points (gcps import: --epoch), gdal_edit.py -a_coord_epoch of a "
                "raster",
            )
        own = goal
    years = 0.0 if own is None else goal - own
    if plate is None and abs(years) * MOST_M_A > UNKNOWN_M:
        if way.epoch is not None:
            return None
        raise InputError(
            f"coordinates in {name} at {own:g}, where no plate's motion is known that would bring "
            f"them to {goal:.2f}, the date of the images",
            remedy="transform the points to ITRF2020 at that date by the country's own service, "
            "and state that date as their epoch",
        )
    at = goal if own is None else own
    steps = [_at(operation, at) for operation in way.operations]
    legs = [f"{_words(operation)}, at {at:.3f}" for operation in way.operations]
    notes = list(way.notes)
    if plate is not None and abs(years) * m_a > SETTLED_M:
        steps.append(partial(moved, plate=plate, years=years))
        legs.append(f"ITRF2020 from {own:.3f} to {goal:.3f} with the plate {plate}")
    if not target.by and plate is not None:
        notes.append(
            f"the date of the images is not known, it is taken as {goal:g}: places in ITRF2020 "
            f"move by {1000 * m_a:.0f} mm a year here"
        )
    known = [operation.accuracy for operation in way.operations]
    accuracy = None if any(value < 0 for value in known) else float(sum(known)) + way.spread_m
    how = tuple(legs), accuracy, tuple(notes), _geographic(datum), tuple(steps)
    return FrameChange(name, own, target, *how)


# ------------------------------------------------------------------ plates


def plate_at(lon: float, lat: float) -> str | None:
    """The plate (ITRF2020's abbreviation) of a place in degrees; None where none of them is."""
    for plate, outline in OUTLINES:
        corners = np.array([corner.split() for corner in outline.split(", ")], float)
        turns = np.round((corners[:, 0].mean() - lon) / 360.0) * 360.0
        x, y = corners[:, 0] - (lon + turns), corners[:, 1] - lat
        x_after, y_after = np.roll(x, -1), np.roll(y, -1)
        crosses = (y > 0) != (y_after > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = x - y * (x_after - x) / (y_after - y)
        if np.count_nonzero(crosses & (at > 0)) % 2:
            return plate
    return None


@cache
def _to_geocentric() -> pyproj.Transformer:
    return pyproj.Transformer.from_pipeline("+proj=pipeline +step +proj=cart +ellps=GRS80")


def _velocity(lon: Floats, lat: Floats, xyz: Floats, plate: str) -> Floats:
    """Geocentric velocity [3, n], m a year: the rotation's, and the bias' horizontal part."""
    spin = np.array(ROTATION[plate])[:, None] * MAS
    bias = np.array(ORIGIN_RATE_BIAS)[:, None]
    lon, lat = np.radians(lon), np.radians(lat)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.cross(spin, xyz, axis=0) + bias - (bias * up).sum(axis=0) * up


def speed(lon: float, lat: float, plate: str) -> float:
    """Of a place on a plate, m a year."""
    place = np.array([[lon], [lat], [0.0]])
    xyz = np.stack(_to_geocentric().transform(*place))
    return float(np.linalg.norm(_velocity(place[0], place[1], xyz, plate)))


def moved(
    lon: Floats, lat: Floats, height: Floats, plate: str, years: float
) -> tuple[Floats, Floats, Floats]:
    """Longitude, latitude (degrees) and ellipsoidal height (m) after some years, each float64[n].

    In ITRF2020, GRS 80. Places that are not finite stay so.
    """
    xyz = np.stack(_to_geocentric().transform(lon, lat, height))
    there = xyz + years * _velocity(lon, lat, xyz, plate)
    east, north, up = _to_geocentric().transform(*there, direction="INVERSE")
    return east, north, up
