"""Days of acquisition: by the points where they tell, else by a catalogue."""

from __future__ import annotations

from datetime import UTC, datetime

import laspy
import numpy as np
import pytest

from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.lattice import Footprint
from stereotruth.lidar.point_fields import days_by_code, number_of, runs_of
from stereotruth.lidar.point_store import PointStore

from ...synthetic.las import adjusted, everything, write_las
from ...synthetic.stores import content_of, part_of

GPS_LESS_UTC_S = 18


def seconds(day: str) -> float:
    """Adjusted standard GPS time of noon of a day, by the difference of two calendars."""
    noon = datetime.fromisoformat(f"{day}T12:00:00+00:00")
    return (noon - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() + GPS_LESS_UTC_S - 1e9


@pytest.mark.parametrize(("name", "pdrf"), [("a.las", 1), ("a.laz", 6)])
@pytest.mark.parametrize("first", ["2007-03-01", "2019-05-04"])  # adjusted time of both signs
def test_days_follow_from_absolute_times(tmp_path, name, pdrf, first):
    times = np.linspace(seconds(first), seconds(first) + 5 * 86400, 3000)
    times[::7] = 0.0  # never filled in
    write_las(tmp_path / name, 3000, pdrf=pdrf, gps_time=times, absolute=True)
    catalogue = ("2001-01-01", "2001-01-02")
    found = ingest(tmp_path / name, tmp_path / "s.points", acquired=catalogue)["acquired"]
    last = f"{first[:8]}{int(first[8:]) + 5:02d}"
    assert found == {"start": first, "end": last, "by": "GPS time of the points"}


def test_las_1_5_counts_times_from_an_offset_of_its_own(tmp_path):
    times = np.linspace(seconds("2025-03-01"), seconds("2025-03-03"), 3000)
    write_las(tmp_path / "a.las", 3000, version="1.5", gps_time=times, absolute=True)
    las = laspy.read(tmp_path / "a.las")
    las.gps_time = times - 500e6
    las.header.global_encoding.gps_time_offset = True
    las.header.gps_time_offset = 1500
    las.write(tmp_path / "b.laz")
    found = [ingest(tmp_path / name, tmp_path / f"{name}.points") for name in ("a.las", "b.laz")]
    assert found[0]["acquired"]["start"] == "2025-03-01"
    assert found[1]["acquired"] == found[0]["acquired"]
    assert found[1]["strips"] == found[0]["strips"]


@pytest.mark.parametrize(("time", "absolute"), [(3e5, False), (0.0, True)])
def test_a_catalogue_tells_where_points_do_not(tmp_path, time, absolute):
    file = tmp_path / "a.laz"
    write_las(file, 3000, gps_time=np.full(3000, time), absolute=absolute)
    found = ingest(file, tmp_path / "s.points", acquired=("2020-01-01", "2020-02-01"))["acquired"]
    assert found == {"start": "2020-01-01", "end": "2020-02-01", "by": "catalogue"}
    assert ingest(file, tmp_path / "t.points")["acquired"] is None


def dated(folder, days, name="a", footprint=None) -> PointStore:
    """A store of points of classes 1 to 4 in turn, that were measured on ``days`` by class."""
    classes = (np.arange(4000) % 4 + 1).astype(np.uint8)
    times = np.array([0.0 if day is None else adjusted(day) for day in days])[classes - 1]
    file = folder / f"{name}.laz"
    write_las(file, 4000, gps_time=times, classification=classes, absolute=True)
    catalogue = ("2001-01-01", "2001-01-31")
    ingest(file, folder / f"{name}.points", acquired=catalogue, footprint=footprint)
    return PointStore(folder / f"{name}.points")


@pytest.mark.parametrize(
    ("days", "told"),
    [
        ((17_000, 17_001, 18_000, 49_000), (17_000, 17_001, 18_000, 49_000)),
        ((3_000, None, 3_000, 17_000), (0, 0, 0, 17_000)),  # 1978 is no time
        ((17_000, 17_255, 17_001, 17_001), (0, 0, 17_001, 17_001)),  # of one code each
        ((None, None, None, None), (11_338,) * 4),  # the middle of the catalogue's days
    ],
)
def test_each_point_has_its_day(tmp_path, days, told):
    store = dated(tmp_path, days)
    points = everything(store)
    assert len(points) == 4000
    assert (points.day == np.array(told)[points.classification - 1]).all()
    shared = any("cannot be told apart" in note for note in store.attrs["notes"])
    assert shared == (17_255 in days)


def test_days_of_a_part_are_those_of_the_whole(tmp_path):
    """A cell has the same bytes whatever other days the file has elsewhere."""
    days = 17_000, 17_001, 18_000, 49_000
    whole = dated(tmp_path, days)
    row, col = whole.cell_row[0], whole.cell_col[0]
    footprint = Footprint(int(row), int(col), np.ones((2, 2), np.bool_))
    part = dated(tmp_path, days, "part", footprint)
    assert 0 < part.count < whole.count
    assert content_of(part) == part_of(whole, footprint)
    assert (part.days == whole.days).all()


def test_days_without_end_are_none(tmp_path):
    """Times that are noise: first and last day are told, as of any file, and no day of a point."""
    times = np.random.default_rng(0).uniform(-9e8, 9e8, 3000)
    write_las(tmp_path / "a.laz", 3000, gps_time=times, absolute=True)
    found = ingest(tmp_path / "a.laz", tmp_path / "s.points")
    assert found["acquired"]["start"] < "1985" and found["days"] == []
    assert (everything(PointStore(tmp_path / "s.points")).day == 0).all()


@pytest.mark.parametrize("day", ["0001-01-01", "1970-01-01", "9999-12-31"])
def test_a_day_that_stands_for_none_is_none(day):
    """Catalogues write such ones where they know nothing."""
    assert number_of("2019-03-01") == 17_956
    assert not days_by_code([], {"start": day, "end": day, "by": "catalogue"}).any()


def test_runs_of_time_end_where_no_point_was_measured():
    assert runs_of([3, 4, 5, 8, 9, 20]).tolist() == [3, 3, 3, 8, 8, 20]
    assert runs_of([]).size == 0
