"""The images of a site, opened: sensor models, when they were taken and by which sun."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

from ..core.tables import acquisition_time
from ..sensor.deliveries import Acquisition, by_sheet, read_acquisition
from ..sensor.site_pairs import SiteImage
from .gcp_checks import open_view


@dataclass(frozen=True)
class GivenImage:
    """What the images sheet says: ``acquired`` and ``sun`` (azimuth, elevation) may be None."""

    name: str
    file: Path
    acquired: date | datetime | None
    sun: tuple[float, float] | None

    @classmethod
    def of(
        cls, name: str, file: Path, acquired: str, azimuth: float | None, elevation: float | None
    ) -> GivenImage:
        """From the cells of a row, which have been checked."""
        sun = None if azimuth is None or elevation is None else (float(azimuth), float(elevation))
        return cls(name, file, acquisition_time(acquired) if acquired else None, sun)


def open_image(given: GivenImage) -> tuple[SiteImage, Acquisition]:
    """An image and what its delivery says of it. InputError if it or its RPC cannot be used.

    What the sheet says goes before the delivery.
    """
    sensor, size = open_view(f"site's {given.name}", given.file, "")
    rpc = sensor.rpc
    place = float(rpc.long_off), float(rpc.lat_off)
    delivery = read_acquisition(given.file, place)
    taken = by_sheet(delivery, given.acquired, given.sun, place)
    return SiteImage(given.name, sensor, size, taken.time, taken.sun), delivery
