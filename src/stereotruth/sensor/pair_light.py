"""Whether the images of a pair share their light: by days, and by their suns where these are known.

A shadow whose edge has moved is a change of both images and none of the ground. So images count as
diachronic where the shadow of an ordinary building ends elsewhere in them, or where a season lies
between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

from .acquisition import Acquisition
from .sun import between_suns, shadow_shift

DIACHRONIC_DAYS = 30.0  # more than these, as in DiachronicStereo (2026)
BUILDING_M = 10.0  # height of three storeys
# Way of the end of that building's shadow between both images, px. In simulated cities of one day
# under two suns, unchanged pixels called `changed` by the evidence of one light rise by 0.2 % at
# 0.6 px, 0.7 % at 1.2 px, 1.9 % at 2.2 px, 6.7 % at 7 px where nothing has changed, and by 1.0,
# 2.1, 3.5 and 8.7 % at 0.8, 1.4, 2.6 and 8 px where much has; by that of two lights by 0.3 and
# 0.5 % at 8 px. It is also what one label may be off before its images stop to agree.
SHADOW_PX = 0.5


@dataclass(frozen=True)
class PairLight:
    """Whether a pair is ``diachronic``, and by what: ``decided_by`` is the scenes sheet, the
    suns, the days between the images, or the configuration.

    ``sun_angle_deg`` between the directions to both suns, ``shadow_px``: way of the end of the
    shadow of a building of BUILDING_M, in pixels; ``days`` between the images; None: not known.
    """

    diachronic: bool
    decided_by: str
    sun_angle_deg: float | None = None
    shadow_px: float | None = None
    days: float | None = None


def pair_light(
    left: Acquisition,
    right: Acquisition,
    pixel_m: float,
    told: bool | None = None,
    default: bool = False,
) -> PairLight:
    """The light of a pair, by the first that is known: what the scenes sheet has ``told``, more
    than DIACHRONIC_DAYS between the images, both suns, the ``default`` of the configuration.

    ``pixel_m``: side of a pixel on the ground, m.
    """
    suns = None if left.sun is None or right.sun is None else (left.sun, right.sun)
    angle = shadow = days = None
    if suns is not None:
        angle = round(between_suns(*suns), 2)
        shadow = round(shadow_shift(*suns) * BUILDING_M / pixel_m, 2)
    if left.time is not None and right.time is not None:
        days = round(abs((left.time - right.time) / timedelta(days=1)), 3)
    known = angle, shadow, days
    if told is not None:
        return PairLight(told, "scenes sheet", *known)
    if days is not None and days > DIACHRONIC_DAYS:
        return PairLight(True, "days", *known)
    if shadow is not None:
        return PairLight(shadow > SHADOW_PX, "suns", *known)
    return PairLight(default, "configuration", *known)
