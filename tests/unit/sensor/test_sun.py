from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from stereocities.sites import sun_at
from stereotruth.sensor.sun import between_suns, shadow_shift, sun_over, toward_sun


def test_nrel_s_example():
    """Reda and Andreas 2004, table A5.1, without the refraction of 0.016 degrees."""
    time = datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC)
    azimuth, elevation = sun_over(time, -105.1786, 39.742476)
    assert azimuth == pytest.approx(194.340, abs=0.02)
    assert elevation == pytest.approx(90 - 50.112 - 0.016, abs=0.02)


def test_it_agrees_with_the_simulator_s_own_formula():
    for k in range(200):
        time = datetime(2012, 1, 1, tzinfo=UTC) + timedelta(hours=671.3 * k)
        for place in ((0.0, 0.0), (114.3, 30.6), (-70.6, -33.4)):
            cosine = toward_sun(*sun_over(time, *place)) @ toward_sun(*sun_at(time, *place))
            assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.03


def test_time_zones_are_one_time():
    utc = datetime.fromisoformat("2020-10-25T03:12:45Z")
    here = datetime.fromisoformat("2020-10-25T11:12:45+08:00")
    assert sun_over(utc, 115.0, 30.0) == sun_over(here, 115.0, 30.0)


def test_suns():
    assert between_suns((180, 40), (180, 60)) == pytest.approx(20)
    # shadows of one height: 1 / tan 45° north, and as far west
    assert shadow_shift((180, 45), (90, 45)) == pytest.approx(np.sqrt(2))
