"""The images of a site, opened: sensor models, when they were taken and by which sun."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path

from ..epipolar.acquisition import Acquisition, read_acquisition
from ..epipolar.site_pairs import SiteImage
from ..epipolar.sun import sun_over
from ..settings import acquisition_time
from .gcp_checks import open_view

NOON = time(12, tzinfo=UTC)  # of an image whose date alone is known
DATES_APART = timedelta(days=1.5)  # between the sheet and the delivery: another time zone is less


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
    taken, sun = delivery.time, delivery.sun
    if isinstance(given.acquired, datetime):
        taken, sun = given.acquired, sun_over(given.acquired, *place)
        if delivery.time is not None and delivery.sun is not None and near(delivery.time, taken):
            sun = delivery.sun
    elif given.acquired is not None:
        noon = datetime.combine(given.acquired, NOON)
        if delivery.time is None or not near(delivery.time, noon):
            taken, sun = noon, None
    return SiteImage(given.name, sensor, size, taken, given.sun or sun), delivery


def near(one: datetime, other: datetime) -> bool:
    """Whether two times may be one, but for the time zone of a clock."""
    return abs(one - other) <= DATES_APART
