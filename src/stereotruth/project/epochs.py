"""The epoch of a city: that of all its places, in ITRF2020.

One for all scenes of a city, since they share points. It is told by column `epoch` of the cities
sheet, or else by the first scene of the sheet whose images tell their day: the mean of both. Scenes
that are appended change nothing. Plates move by 1 to 8 cm a year.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from datetime import date

from ..core import sheets
from ..core.dates import decimal_year, epoch_year
from ..lidar.frames import DEFAULT_EPOCH, Epoch
from ..sensor.deliveries import read_acquisition
from .project import is_synthetic, names_in_pair

LOOKED_AT = 10  # scenes of a city whose deliveries are looked into
ANYWHERE = (0.0, 0.0)  # degrees: a day does not depend on the place


def epoch_of_city(
    city: sheets.City, scenes: Mapping[str, sheets.Scene], images: Mapping[str, sheets.Image]
) -> Epoch:
    """The epoch of a city; the default where neither sheet nor image tells one.

    ``scenes``, ``images``: rows of the sheets, of this and of other cities.
    """
    if (year := epoch_year(city.epoch)) is not None:
        return Epoch(year, "the cities sheet")
    looked = 0
    for scene in scenes.values():
        if scene.city != city.city or is_synthetic(scene):
            continue
        days = []
        names = names_in_pair(scene, images)
        for name, file in zip(names, (scene.left_image, scene.right_image)):
            day = sheets.day_of(images[name].acquired) if name else None
            if day is None and looked < LOOKED_AT:
                day = _delivered(file)
            if day is not None:
                days.append(day)
        looked += 1
        if days:
            year = sum(map(decimal_year, days)) / len(days)
            return Epoch(round(year, 3), f"the images of scene {scene.scene}")
    return DEFAULT_EPOCH


def _delivered(image: str) -> date | None:
    with suppress(OSError, ValueError):
        time = read_acquisition(image, ANYWHERE).time
        return None if time is None else time.date()
    return None
