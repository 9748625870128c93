"""What the delivery of an image says: which files are its own, when it was taken, under which sun.

A supplier's files are described by the tables here: names of what is read with an image
(:data:`AFTER_NAME`, :data:`AFTER_STEM`, :data:`ANYWHERE`), of views along the track
(:data:`VIEWS`) and of what is no image of a pair (:data:`OTHERS`); the files that tell of an image
(:data:`FORMS`), and the words of XML (:data:`TAGS`). RPCs, which have neither date nor sun, are
read by :mod:`.rpc_files`.
"""

from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta, timezone
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from ..core.numerics.arrays import Floats

Place = tuple[float, float]  # longitude, latitude, degrees
Sun = tuple[float, float]  # azimuth from north over east, elevation, degrees

# Files that are read with an image, by GDAL's names: after its whole name, after its stem; and of
# DIMAP deliveries RPC_*.XML, of both views.
AFTER_NAME = (".msk", ".aux.xml", ".ovr", ".msk.ovr", ".imd", ".rpb")
AFTER_STEM = tuple(
    ["_rpc.txt", ".rpb", ".imd", ".xml", ".rpc", ".aux", ".aux.xml", ".tab", ".wld", ".rrd"]
)
ANYWHERE = re.compile(r"rpc_.*\.xml", re.DOTALL)
# Names of suppliers for the views along the track (GaoFen-7, ZY-3; Cartosat-1 has BANDA aft, BANDF
# fore; ALOS PRISM has ALPSMB and ALPSMF), and the plain words.
VIEWS = (
    ("left", re.compile(r"(?<![A-Z])(BWD|BACKWARD|LEFT|BANDA|ALPSMB)(?![A-Z])", re.IGNORECASE)),
    ("right", re.compile(r"(?<![A-Z])(FWD|FORWARD|RIGHT|BANDF|ALPSMF)(?![A-Z])", re.IGNORECASE)),
)
# What lies beside the images that are wanted: bands of colour, browse images.
OTHERS = re.compile(
    r"(?<![A-Za-z])(MUX|MSS?|MULTI|BROWSE|THUMB\w*|QUICKLOOK|PREVIEW|ICON)(?![A-Za-z])",
    re.IGNORECASE,
)
IMD_TIME = ("firstLineTime", "TLCTime", "earliestAcqTime")
IMD_SUN = (("meanSunAz", "meanSunEl"), ("sunAz", "sunEl"))
TAGS = {  # of XML in lower case: DIMAP 1 to 3 (Airbus), GaoFen products, and IMD as XML (Vantor)
    "time": ("imaging_time", "centertime", "scenecentertime", "firstlinetime", "starttime",
             "tlctime"),
    "date": ("imaging_date",),
    "azimuth": ("sun_azimuth", "solarazimuth", "sunazimuth", "meansunaz", "sunaz"),
    "elevation": ("sun_elevation", "solarelevation", "sunelevation", "meansunel", "sunel"),
    "zenith": ("solarzenith", "sunzenith"),
}  # fmt: skip

MAX_BYTES = 5_000_000  # of a file beside an image
MOST_FILES = 200  # beside an image that are looked into
BEIJING = timezone(timedelta(hours=8))  # of GaoFen products, which do not say it
NOON = time(12, tzinfo=UTC)  # of an image whose date alone is known
DATES_APART = timedelta(days=1.5)  # between the sheet and the delivery: another time zone is less
J2000, DAY = datetime(2000, 1, 1, 12, tzinfo=UTC), timedelta(days=1)


@cache
def _names_in(folder: Path) -> dict[str, list[Path]]:
    """The files in a folder by their names in lower case; none if it cannot be listed."""
    found = defaultdict(list)
    if folder.is_dir():
        for path in sorted(folder.iterdir()):
            found[path.name.lower()].append(path)
    return found


def files_beside(image: str | Path) -> list[Path]:
    """What lies beside an image and is read with it, in any case of the letters, sorted.

    A plan asks once for each image; files that come later are seen by the next process.
    """
    image = Path(image)
    name, stem, suffix = image.name.lower(), image.stem.lower(), image.suffix.lower()
    world = {f"{stem}{suffix}w", f"{stem}.{suffix[1:2]}{suffix[-1:]}w"}
    names = {*(name + end for end in AFTER_NAME), *(stem + end for end in AFTER_STEM), *world}
    there = _names_in(image.parent)
    names |= set(filter(ANYWHERE.fullmatch, there))
    found = {path for other in names - {name} for path in there.get(other, ())}
    return sorted(path for path in found if path.is_file())


# ------------------------------------------------------------------ time and sun of an image


@dataclass(frozen=True)
class Acquisition:
    """``time`` (UTC) and ``sun`` (azimuth, elevation in degrees), None where nothing says it.

    ``source``: name of the file that says it.
    """

    time: datetime | None = None
    sun: Sun | None = None
    source: str = ""


def read_acquisition(image: str | Path, place: Place) -> Acquisition:
    """What the delivery of an image says, else its tags; ``place``: its longitude and latitude.

    Files that cannot be read, or are of another image, say nothing. Where the time is told and the
    sun is not, the sun is that over the place at the time.
    """
    image = Path(image)
    found = Acquisition()
    for file in _tellers(image):
        with suppress(OSError, ValueError, KeyError, TypeError, ElementTree.ParseError):
            said = _read(file, image, place)
            if said is not None and said != Acquisition():
                found = Acquisition(said.time, said.sun, file.name)
                break
    if found.time is None:
        from rasterio.errors import RasterioError  # who knows the time needs no GDAL

        with suppress(OSError, ValueError, RasterioError):
            tags = _of_tags(image)
            found = Acquisition(tags.time, found.sun or tags.sun, found.source or tags.source)
    if found.time is not None and found.sun is None:
        return Acquisition(found.time, sun_over(found.time, *place), found.source)
    return found


def by_sheet(
    delivery: Acquisition, acquired: date | datetime | None, sun: Sun | None, place: Place
) -> Acquisition:
    """The acquisition as the images sheet says it, and as the delivery does where it does not.

    ``acquired`` and ``sun`` are the sheet's; ``place`` is for the sun of a time. A date alone
    stands for noon and tells of no sun.
    """
    taken, told = delivery.time, delivery.sun
    if isinstance(acquired, datetime):
        taken, told = acquired, sun_over(acquired, *place)
        if delivery.time is not None and delivery.sun is not None and near(delivery.time, taken):
            told = delivery.sun
    elif acquired is not None:
        noon = datetime.combine(acquired, NOON)
        if delivery.time is None or not near(delivery.time, noon):
            taken, told = noon, None
    return Acquisition(taken, sun or told, delivery.source)


def near(one: datetime, other: datetime) -> bool:
    """Whether two times may be one, but for the time zone of a clock."""
    return abs(one - other) <= DATES_APART


def _tellers(image: Path) -> Iterator[Path]:
    """Files that may tell of an image: first those of its name, then the others of its folder."""
    endings = {form.ending for form in FORMS}
    files = [file for file in sorted(image.parent.iterdir()) if file.suffix.lower() in endings]
    own = [file for file in files if file.stem.lower() == image.stem.lower()]
    yield from (own + [file for file in files if file not in own])[:MOST_FILES]


def _read(file: Path, image: Path, place: Place) -> Acquisition | None:
    """What a file says of an image, None if it is of another one."""
    if file.stat().st_size > MAX_BYTES:
        return None
    form = next(form for form in FORMS if form.ending == file.suffix.lower())
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    names = file.stem.lower(), image.stem.lower()
    if names[0] != names[1] and image.name.lower() not in text.lower() and not form.is_of(*names):
        return None
    return form.read(text, place)


def _of_imd(text: str, place: Place) -> Acquisition:
    """DigitalGlobe's and Maxar's ``.IMD``."""
    values = dict(re.findall(r"\b(\w+)\s*=\s*\"?([^;\"\n]+)", text))
    time = next((utc(values[name]) for name in IMD_TIME if name in values), None)
    suns = (_sun(float(values[az]), float(values[el])) for az, el in IMD_SUN if az in values)
    return Acquisition(time, next(suns, None))


def _of_xml(text: str, place: Place) -> Acquisition:
    """DIMAP, GaoFen, Vantor. The middle of three incidences (top, centre, bottom) counts."""
    values: dict[str, list[str]] = {}
    for element in ElementTree.fromstring(text).iter():
        if element.text and element.text.strip():
            name = element.tag.rpartition("}")[2].lower()
            values.setdefault(name, []).append(element.text.strip())

    def first(what: str) -> str | None:
        listed = next((values[name] for name in TAGS[what] if name in values), None)
        return listed[len(listed) // 2] if listed else None

    azimuth, elevation = first("azimuth"), first("elevation")
    if elevation is None and (zenith := first("zenith")) is not None:
        elevation = str(90.0 - float(zenith))
    sun = _sun(float(azimuth), float(elevation)) if azimuth and elevation else None
    clock, day = first("time"), first("date")
    if clock is None:
        return Acquisition(None, sun)
    if day is not None and re.match(r"\d{1,2}:", clock):  # DIMAP: date and time, UTC
        return Acquisition(utc(f"{day}T{clock}", UTC), sun)
    return Acquisition(_in_its_zone(clock, sun, place), sun)


def _in_its_zone(clock: str, sun: Sun | None, place: Place) -> datetime | None:
    """A time without a zone: UTC or that of Beijing, whichever has the sun where it is told."""
    with suppress(ValueError):
        return utc(clock)
    if sun is None:
        return None
    times = [utc(clock, zone) for zone in (UTC, BEIJING)]
    return min(times, key=lambda time: between_suns(sun, sun_over(time, *place)))


def _of_stac(text: str, place: Place) -> Acquisition | None:
    """STAC items."""
    item: Mapping[str, Any] = json.loads(text)
    if "stac_version" not in item:
        return None
    said = item["properties"]
    told = said.get("datetime") or said.get("start_datetime")
    angles = said.get("view:sun_azimuth"), said.get("view:sun_elevation")
    sun = None if None in angles else _sun(*map(float, angles))
    return Acquisition(utc(told) if told else None, sun)


class Form(NamedTuple):
    """A kind of file that tells of an image: the ``ending`` of its name; how its text is read, at
    the image's place; and whether it ``is_of`` an image of another name (stems, in lower case)."""

    ending: str
    read: Callable[[str, Place], Acquisition | None]
    is_of: Callable[[str, str], bool] = lambda file, image: False


FORMS = (
    Form(".imd", _of_imd),
    # Airbus: DIM_X.XML is of IMG_X_R1C1.TIF
    Form(
        ".xml",
        _of_xml,
        lambda file, image: file.startswith("dim_") and image.startswith(f"img_{file[4:]}"),
    ),
    Form(".dim", _of_xml),  # DIMAP 1 (SPOT 5): METADATA.DIM names its image
    Form(".json", _of_stac),
    Form(".geojson", _of_stac),
)


def _of_tags(image: Path) -> Acquisition:
    """The tags of NITF files, and what GDAL finds of a sensor's metadata (domain IMAGERY)."""
    from ..core.products.rasters import open_raster

    with open_raster(image) as dataset:
        tags, imagery = dataset.tags(), dataset.tags(ns="IMAGERY")
    sun, time = None, None
    if "NITF_USE00A_SUN_AZ" in tags and "NITF_USE00A_SUN_EL" in tags:
        sun = _sun(float(tags["NITF_USE00A_SUN_AZ"]), float(tags["NITF_USE00A_SUN_EL"]))
    if digits := re.fullmatch(r"(\d{14})", tags.get("NITF_IDATIM", "")):
        time = datetime.strptime(digits[1], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    elif told := imagery.get("ACQUISITIONDATETIME"):
        time = utc(told, UTC)
    return Acquisition(time, sun, image.name if time or sun else "")


def _sun(azimuth: float, elevation: float) -> Sun | None:
    """The sun's angles, None if they are none: suppliers write 0 or -9999 for not known."""
    good = math.isfinite(azimuth) and 0 <= azimuth <= 360 and 0 < elevation <= 90
    return (azimuth, elevation) if good else None


def utc(text: str, zone: timezone | None = None) -> datetime:
    """A time of metadata in UTC. ValueError if it has no zone and none is given."""
    time = datetime.fromisoformat(text.strip().rstrip(";").replace(" ", "T", 1))
    if time.tzinfo is None:
        if zone is None:
            raise ValueError(f"{text!r} has no time zone")
        time = time.replace(tzinfo=zone)
    return time.astimezone(UTC)


# ------------------------------------------------------------------ the sun over a place


def sun_over(time: datetime, lon: float, lat: float) -> Sun:
    """Azimuth (from north over east) and elevation of the sun, degrees; ``time`` has a zone.

    The Astronomical Almanac's low-precision formulas (page C5), good to 0.01 degrees between 1950
    and 2050. Refraction, 0.02 degrees at most while shadows are short enough to match images, is
    left out.
    """
    days = (time - J2000) / DAY
    mean_longitude = 280.460 + 0.9856474 * days
    anomaly = math.radians(357.528 + 0.9856003 * days)
    longitude = math.radians(
        mean_longitude + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly)
    )
    obliquity = math.radians(23.439 - 4e-7 * days)
    right_ascension = math.degrees(
        math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    )
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    sidereal = 15.0 * (6.697375 + 0.0657098242 * days + (days + 0.5) % 1.0 * 24.0)
    hour_angle = math.radians(sidereal + lon - right_ascension)
    phi = math.radians(lat)
    elevation = math.asin(
        math.sin(declination) * math.sin(phi)
        + math.cos(declination) * math.cos(phi) * math.cos(hour_angle)
    )
    azimuth = math.atan2(
        -math.cos(declination) * math.sin(hour_angle),
        math.sin(declination) * math.cos(phi)
        - math.cos(declination) * math.sin(phi) * math.cos(hour_angle),
    )
    return math.degrees(azimuth) % 360.0, math.degrees(elevation)


def toward_sun(azimuth_deg: float, elevation_deg: float) -> Floats:
    """Unit vector [3] (east, north, up) toward the sun."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([level * math.sin(azimuth), level * math.cos(azimuth), math.sin(elevation)])


def shadow_shift(one: Sun, other: Sun) -> float:
    """Way of a shadow's end between two suns, in heights of what casts it."""
    ends = [-direction[:2] / direction[2] for direction in (toward_sun(*one), toward_sun(*other))]
    return float(np.linalg.norm(ends[0] - ends[1]))


def between_suns(one: Sun, other: Sun) -> float:
    """Angle between the directions to two suns, degrees."""
    cosine = float(toward_sun(*one) @ toward_sun(*other))
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
