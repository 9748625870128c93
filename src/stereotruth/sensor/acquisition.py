"""When an image was taken and where the sun stood, as its delivery says it.

Read are, of the files beside an image: DigitalGlobe's and Maxar's ``.IMD``, DIMAP (Pléiades, SPOT,
versions 1 and 2), the XML of GaoFen products, STAC items (``datetime``, ``view:sun_azimuth``,
``view:sun_elevation``); else the tags of the image itself as GDAL tells them (NITF's ``IDATIM`` and
``USE00A``, what GDAL finds of a sensor's metadata). RPC files have neither date nor sun.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta, timezone
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from .sun import sun_over, toward_sun

MAX_BYTES = 5_000_000  # of a file beside an image
MOST_FILES = 200  # beside an image that are looked into
BEIJING = timezone(timedelta(hours=8))  # of GaoFen products, which do not say it
WORDS = {  # tags of XML in lower case
    "time": ("imaging_time", "centertime", "scenecentertime", "starttime"),
    "azimuth": ("sun_azimuth", "solarazimuth", "sunazimuth"),
    "elevation": ("sun_elevation", "solarelevation", "sunelevation"),
    "zenith": ("solarzenith", "sunzenith"),
}
IMD_TIME = ("firstLineTime", "TLCTime", "earliestAcqTime")
NOON = time(12, tzinfo=UTC)  # of an image whose date alone is known
DATES_APART = timedelta(days=1.5)  # between the sheet and the delivery: another time zone is less


@dataclass(frozen=True)
class Acquisition:
    """``time`` (UTC) and ``sun`` (azimuth, elevation in degrees), None where nothing says it.

    ``source``: names of the files that say it.
    """

    time: datetime | None = None
    sun: tuple[float, float] | None = None
    source: str = ""


def read_acquisition(image: str | Path, place: tuple[float, float]) -> Acquisition:
    """What the delivery of an image says; ``place``: its longitude and latitude.

    Files that cannot be read, or are of another image, say nothing. Where the time is told and the
    sun is not, the sun is that over the place at the time.
    """
    image = Path(image)
    found = Acquisition()
    for file in _files_beside(image):
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
    delivery: Acquisition,
    acquired: date | datetime | None,
    sun: tuple[float, float] | None,
    place: tuple[float, float],
) -> Acquisition:
    """The acquisition as the images sheet says it, and as the delivery does where it does not.

    ``acquired`` and ``sun`` (azimuth, elevation, degrees) of the sheet; ``place``: longitude and
    latitude, degrees, for the sun of a time. A date alone stands for noon and tells of no sun.
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


def _files_beside(image: Path) -> Iterator[Path]:
    """Files that may tell of an image: first those of its name, then the others of its folder."""
    endings = (".imd", ".xml", ".json", ".geojson")
    files = [file for file in sorted(image.parent.iterdir()) if file.suffix.lower() in endings]
    stem = image.stem.lower()
    own = [file for file in files if file.stem.lower() == stem]
    yield from (own + [file for file in files if file not in own])[:MOST_FILES]


def _read(file: Path, image: Path, place: tuple[float, float]) -> Acquisition | None:
    """What a file says of an image, None if it is of another one."""
    if file.stat().st_size > MAX_BYTES:
        return None
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    own = file.stem.lower() == image.stem.lower() or image.name.lower() in text.lower()
    kind = file.suffix.lower()
    if not own and not (kind == ".xml" and _same_product(file.stem, image.stem)):
        return None
    if kind == ".imd":
        return _of_imd(text)
    if kind == ".xml":
        return _of_xml(text, place)
    return _of_stac(json.loads(text))


def _same_product(xml: str, image: str) -> bool:
    """Whether DIM_X.XML is of IMG_X_R1C1.TIF, as Airbus names its files."""
    xml, image = xml.upper(), image.upper()
    return xml.startswith("DIM_") and image.startswith(f"IMG_{xml[4:]}")


def _of_imd(text: str) -> Acquisition:
    values = dict(re.findall(r"\b(\w+)\s*=\s*\"?([^;\"\n]+)", text))
    time = next((utc(values[name]) for name in IMD_TIME if name in values), None)
    pairs = (("meanSunAz", "meanSunEl"), ("sunAz", "sunEl"))
    sun = next(
        (_sun(float(values[az]), float(values[el])) for az, el in pairs if az in values), None
    )
    return Acquisition(time, sun)


def _of_xml(text: str, place: tuple[float, float]) -> Acquisition | None:
    """DIMAP and GaoFen products. The middle of three incidences (top, centre, bottom) counts."""
    values: dict[str, list[str]] = {}
    for element in ElementTree.fromstring(text).iter():
        if element.text and element.text.strip():
            name = element.tag.rpartition("}")[2].lower()
            values.setdefault(name, []).append(element.text.strip())

    def first(names: tuple[str, ...]) -> str | None:
        listed = next((values[name] for name in names if name in values), None)
        return listed[len(listed) // 2] if listed else None

    azimuth, elevation = first(WORDS["azimuth"]), first(WORDS["elevation"])
    if elevation is None and (zenith := first(WORDS["zenith"])) is not None:
        elevation = str(90.0 - float(zenith))
    sun = _sun(float(azimuth), float(elevation)) if azimuth and elevation else None
    clock, day = first(WORDS["time"]), first(("imaging_date",))
    if clock is None:
        return Acquisition(None, sun)
    if day is not None and re.match(r"\d{1,2}:", clock):  # DIMAP: date and time, UTC
        return Acquisition(utc(f"{day}T{clock}", UTC), sun)
    return Acquisition(_in_its_zone(clock, sun, place), sun)


def _in_its_zone(
    clock: str, sun: tuple[float, float] | None, place: tuple[float, float]
) -> datetime | None:
    """A time without a zone: UTC or that of Beijing, whichever has the sun where it is told."""
    with suppress(ValueError):
        return utc(clock)
    if sun is None:
        return None
    told = toward_sun(*sun)

    def apart(time: datetime) -> float:
        return -float(told @ toward_sun(*sun_over(time, *place)))

    return min((utc(clock, zone) for zone in (UTC, BEIJING)), key=apart)


def _of_stac(item: Mapping[str, Any]) -> Acquisition | None:
    if "stac_version" not in item:
        return None
    said = item["properties"]
    time = utc(said["datetime"]) if said.get("datetime") else None
    if time is None and said.get("start_datetime"):
        time = utc(said["start_datetime"])
    angles = said.get("view:sun_azimuth"), said.get("view:sun_elevation")
    return Acquisition(time, None if None in angles else _sun(*map(float, angles)))


def _of_tags(image: Path) -> Acquisition:
    """The tags of NITF files, and what GDAL finds of a sensor's metadata (domain IMAGERY)."""
    from ..core.products.rasters import open_raster

    with open_raster(image) as dataset:
        tags, imagery = dataset.tags(), dataset.tags(ns="IMAGERY")
    sun = None
    if "NITF_USE00A_SUN_AZ" in tags and "NITF_USE00A_SUN_EL" in tags:
        sun = _sun(float(tags["NITF_USE00A_SUN_AZ"]), float(tags["NITF_USE00A_SUN_EL"]))
    if digits := re.fullmatch(r"(\d{14})", tags.get("NITF_IDATIM", "")):
        time = datetime.strptime(digits[1], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    elif told := imagery.get("ACQUISITIONDATETIME"):
        time = utc(told, UTC)
    else:
        time = None
    return Acquisition(time, sun, image.name if time or sun else "")


def _sun(azimuth: float, elevation: float) -> tuple[float, float] | None:
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
