from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest

from stereotruth.sensor.acquisition import Acquisition, by_sheet
from stereotruth.sensor.pair_light import PairLight, pair_light
from stereotruth.sensor.sun import sun_over

DAY = datetime(2020, 6, 1, 3, tzinfo=UTC)
PLACE = (114.0, 30.0)


def taken(after: timedelta) -> Acquisition:
    return Acquisition(DAY + after, sun_over(DAY + after, *PLACE))


def light(other: Acquisition, **told: bool) -> PairLight:
    return pair_light(taken(timedelta()), other, 0.7, **told)


@pytest.mark.parametrize(
    ("after", "diachronic", "by"),
    [
        (timedelta(seconds=40), False, "suns"),  # one pass
        (timedelta(days=1), False, "suns"),  # the same time of the next day
        (timedelta(minutes=90), True, "suns"),  # one day, two satellites
        (timedelta(days=20, minutes=30), True, "suns"),
        (timedelta(days=40), True, "days"),
    ],
)
def test_suns_decide_within_a_month(after: timedelta, diachronic: bool, by: str) -> None:
    found = light(taken(after))
    assert (found.diachronic, found.decided_by) == (diachronic, by)
    other = light(taken(after), told=not diachronic)
    assert (other.diachronic, other.decided_by) == (not diachronic, "scenes sheet")


def test_a_shadow_of_ten_metres_moves_by_its_pixels() -> None:
    suns = Acquisition(None, (180.0, 45.0)), Acquisition(None, (180.0, 40.0))
    found = pair_light(*suns, 0.5)
    assert found.shadow_px == pytest.approx(10 * (1.1918 - 1) / 0.5, abs=0.01)
    assert (found.sun_angle_deg, found.days, found.diachronic) == (5.0, None, True)
    assert not pair_light(*suns, 5.0).diachronic  # large pixels


@pytest.mark.parametrize("default", [False, True])
def test_without_a_sun_days_alone_tell(default: bool) -> None:
    unknown = Acquisition()

    def dated(day: int) -> Acquisition:
        return by_sheet(unknown, (DAY + timedelta(days=day)).date(), None, PLACE)

    assert dated(0).sun is None
    near, far = (light(dated(day), default=default) for day in (5, 31))
    assert (near.diachronic, near.decided_by) == (default, "configuration")
    assert (far.diachronic, far.decided_by) == (True, "days")
    assert light(unknown, default=default).diachronic == default
