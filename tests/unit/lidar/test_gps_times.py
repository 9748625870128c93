"""Days of acquisition: by the points where they tell, else by a catalogue."""

from __future__ import annotations

from datetime import UTC, datetime

import laspy
import numpy as np
import pytest

from stereotruth.lidar.ingest import ingest

from ...synthetic.las import write_las

GPS_LESS_UTC_S = 18


def adjusted(day: str) -> float:
    """Adjusted standard GPS time of noon of a day, by the difference of two calendars."""
    noon = datetime.fromisoformat(f"{day}T12:00:00+00:00")
    return (noon - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + GPS_LESS_UTC_S - 1e9


def with_times(file, times, *, absolute: bool, pdrf: int = 6):
    write_las(file, len(times), pdrf=pdrf, gps_time=times)
    las = laspy.read(file)
    las.header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(absolute))
    las.write(file)
    return file


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
@pytest.mark.parametrize("pdrf", [1, 3, 6, 7])
def test_days_follow_from_absolute_times(tmp_path, name, pdrf):
    times = np.linspace(adjusted("2019-05-04"), adjusted("2019-05-09"), 3000)
    times[::7] = 0.0  # never filled in
    file = with_times(tmp_path / name, times, absolute=True, pdrf=pdrf)
    found = ingest(file, tmp_path / "s.points", acquired=("2001-01-01", "2001-01-02"))["acquired"]
    assert found == {"start": "2019-05-04", "end": "2019-05-09", "by": "GPS time of the points"}


def test_times_before_the_epoch_of_adjusted_time(tmp_path):
    file = with_times(tmp_path / "a.laz", np.full(3000, adjusted("2007-03-01")), absolute=True)
    assert ingest(file, tmp_path / "s.points")["acquired"]["start"] == "2007-03-01"


@pytest.mark.parametrize(
    ("times", "absolute"), [(np.full(3000, 3e5), False), (np.zeros(3000), True)]
)
def test_a_catalogue_tells_where_points_do_not(tmp_path, times, absolute):
    file = with_times(tmp_path / "a.laz", times, absolute=absolute)
    found = ingest(file, tmp_path / "s.points", acquired=("2020-01-01", "2020-02-01"))["acquired"]
    assert found == {"start": "2020-01-01", "end": "2020-02-01", "by": "catalogue"}
    assert ingest(file, tmp_path / "t.points")["acquired"] is None
