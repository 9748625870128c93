"""Files of control points."""

from __future__ import annotations

import time

import numpy as np
import pyproj
import pytest

from stereotruth.align.alignment import Alignment
from stereotruth.align.control_points import COLUMNS, images_measured, read_gcps
from stereotruth.core.errors import InputError
from stereotruth.lidar.frames import Epoch

# -------------------------------------------------------------------------------------- files


def test_files_of_spreadsheets_are_read(tmp_path):
    file = tmp_path / "gcps.csv"
    text = (
        "id, lon ,lat,height,left_col,left_row,right_col,right_row\r\n"
        ' B , 115.1,30.2, 5e1 ,"1.5", 2.5,,\r\n\r\n'
        "A,115.3,30.4,70,,,10,-0.25\r\n,,,,,,,\r\n"
    )
    file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    points = read_gcps(file)
    assert points.ids == ("A", "B")
    assert points.line == (4, 2)
    assert points.lon.tolist() == [115.3, 115.1]
    assert points.height.tolist() == [70.0, 50.0]
    assert points.left[1].tolist() == [1.5, 2.5]
    assert points.in_left.tolist() == [False, True]
    assert points.in_right.tolist() == [True, False]


ROW = "115.1,30.2,50,1.5,2.5,3.5,4.5"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["A,1_15.1,30.2,50,1,2,3,4"], "line 2, point A: lon '1_15.1' is no number"),
        (["A,１１５,30.2,50,1,2,3,4"], "point A: lon '１１５' is no number"),
        (["A,115.1,30.2,50,nan,2,3,4"], "left_col 'nan' is no number"),
        (["x" * 100_000 + "," + ROW], "line 2: the id 'x+' … of 100000 characters is no name"),
        (["A\x1b[31m," + ROW], "of 6 characters is no name"),
        (["A," + ROW, "B," + ROW], "lines 2 and 3 are one point under two ids, A and B"),
        (
            ["A," + ROW, "B,115.1,30.2,50.0,1.50,2.5,,"],
            "lines 2 and 3 are one point under two ids, A and B",
        ),
    ],
)
def test_rows_that_are_not_what_they_seem_are_refused(tmp_path, rows, message):
    file = tmp_path / "gcps.csv"
    file.write_text("\n".join([",".join(COLUMNS), *rows]), encoding="utf-8")
    with pytest.raises(InputError, match=message) as error:
        read_gcps(file)
    assert len(str(error.value)) < 1000


def test_a_point_measured_twice_is_two_points(tmp_path):
    """The same ground at other places of the images: each measurement counts."""
    file = tmp_path / "gcps.csv"
    rows = ["A," + ROW, "B,115.1,30.2,50,1.6,2.4,3.6,4.4", r"$\frac$,115.2,30.2,50,1,2,,"]
    file.write_text("\n".join([",".join(COLUMNS), *rows]))
    assert read_gcps(file).ids == (r"$\frac$", "A", "B")


def test_columns_are_those_of_either_form(tmp_path):
    for columns in (COLUMNS[:-1], (*COLUMNS, "note"), ("id", "lon", "lat", "height", "image")):
        (tmp_path / "gcps.csv").write_text(",".join(columns) + "\n")
        with pytest.raises(InputError, match=r"\(scene Test-1\)") as error:
            read_gcps(tmp_path / "gcps.csv", "Test-1")
        assert ",".join(COLUMNS) in error.value.remedy


def test_alignments_that_are_none_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such alignment"):
        Alignment.read(tmp_path / "none.json")
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(InputError, match=r"x\.json: no alignment"):
        Alignment.read(tmp_path / "x.json")


def test_more_points_than_anybody_measures_are_refused_by_number_at_once(tmp_path):
    """1.5 million rows, as of LiDAR, took 69 s and 2.2 GB."""
    file, head = tmp_path / "gcps.csv", ",".join(COLUMNS) + "\n"
    line = "{},115.1,30.2,50,{},2.5,,\n"
    for count in (30_000, 1_500_000):
        file.write_text(head + "".join(line.format(k, k) for k in range(count)))
        begun = time.process_time()
        with pytest.raises(InputError, match=r"gcps\.csv: (more than 20000 points|\d+ MB are no)"):
            read_gcps(file)
        assert time.process_time() - begun < 5


def test_ids_that_were_written_as_text_for_spreadsheets_come_back(tmp_path):
    file = tmp_path / "gcps.csv"
    file.write_text(",".join(COLUMNS) + "\n'=1+2,115.1,30.2,50,1.5,2.5,,\n")
    assert read_gcps(file).ids == ("=1+2",)


LONG_FORM = """id,lon,lat,height,image,col,row
A,115.1,30.2,50,one,1.5,2.5
A,115.1,30.2,50,two,3.5,4.5
B,115.2,30.2,60,two,7,8
C,115.3,30.2,70,three,5,6
"""


def test_the_long_form_gives_a_pair_the_points_that_it_shows(tmp_path):
    file = tmp_path / "gcps.csv"
    file.write_text(LONG_FORM)
    points = read_gcps(file, "Test-1", ("two", "one"))
    assert points.ids == ("A", "B")
    assert points.left.tolist() == [[3.5, 4.5], [7.0, 8.0]]
    assert points.right[0].tolist() == [1.5, 2.5]
    assert points.in_right.tolist() == [True, False]
    assert points.line == (2, 4)
    assert images_measured(file) == {"one": 2, "two": 3, "three": 5}


@pytest.mark.parametrize(
    ("images", "line", "message"),
    [
        (None, "", "scene's images have no names"),
        (("one", ""), "", "scene's images have no names"),
        (("four", "five"), "", "no point is measured in four or five"),
        (("one", "two"), "A,115.1,30.2,51,three,1,2", "lines 2 and 6: point A has two places"),
        (("one", "two"), "A,115.1,30.2,50,one,1,2", "point A is measured twice in image one"),
        (("one", "two"), "D,115.1,30.2,50,one,1,", "line 6, point D: row is empty"),
        (("one", "two"), "D,115.1,30.2,50,one,1,x", "line 6, point D: .*'x' is no number"),
    ],
)
def test_faults_of_the_long_form_are_named(tmp_path, images, line, message):
    file = tmp_path / "gcps.csv"
    file.write_text(f"{LONG_FORM}{line}\n")
    with pytest.raises(InputError, match=message):
        read_gcps(file, "Test-1", images)


def test_a_pair_s_file_names_no_images(tmp_path):
    file = tmp_path / "gcps.csv"
    file.write_text(",".join(COLUMNS) + "\nA,115.1,30.2,50,1.5,2.5,3.5,4.5\n")
    assert images_measured(file) == {}
    assert read_gcps(file, "", ("one", "two")).ids == ("A",)


# ------------------------------------------------------------------------------ frame and epoch

PLACES = "A,-81.66,30.33,20,1,2,3,4\nB,-81.65,30.34,25,5,6,7,8\n"


def declared(tmp_path, head: str, places: str = PLACES, year: float = 2020.0):
    file = tmp_path / "gcps.csv"
    file.write_text(f"{head}{','.join(COLUMNS)}\n{places}")
    return read_gcps(file, epoch=Epoch(year, "the test"))


def test_points_of_a_national_frame_are_brought_to_the_images(tmp_path):
    plain = declared(tmp_path, "")
    assert plain.lon.tolist() == [-81.66, -81.65] and plain.frame["epoch"] == 2020.0
    found = declared(tmp_path, '"# surveyed in May",,\n# Frame: EPSG:6318,,,,\n')
    east, north = 111320 * np.cos(np.radians(30.33)), 111200
    shift = np.hypot((found.lon - plain.lon) * east, (found.lat - plain.lat) * north)
    np.testing.assert_allclose(shift, 0.947, atol=0.002)  # as PROJ has it, see test_frames.py
    np.testing.assert_allclose(found.height - plain.height, -1.481, atol=0.002)
    assert found.line == (4, 5)
    assert found.frame["source"]["frame"] == "NAD83(2011)"


def test_an_epoch_moves_points_with_their_plate(tmp_path):
    places = "A,151.2,-33.9,20,1,2,3,4\nB,151.21,-33.91,25,5,6,7,8\n"
    found = declared(tmp_path, "# epoch: 2010-07-02\n", places)
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        "+ellps=GRS80 +step +proj=helmert +dx=0.00037 +dy=0.00035 +dz=0.00074 +drx=0.001487 "
        "+dry=0.001175 +drz=0.001223 +t_epoch=2010.5 +convention=position_vector "
        "+step +inv +proj=cart +ellps=GRS80 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    judge = pyproj.Transformer.from_pipeline(pipeline).transform(151.2, -33.9, 20, 2020.0)
    np.testing.assert_allclose([found.lon[0], found.lat[0]], judge[:2], rtol=0, atol=2e-8)
    assert np.hypot(found.lon[0] - 151.2, found.lat[0] + 33.9) > 4e-6  # 0.5 m


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("# frame: EPSG:6339\n", "UTM zone 10N' is no geographic system"),
        ("# frame: nonsense\n", "'nonsense' cannot be used"),
        ("# frame: EPSG:4149\n", "'CH1903' gets to ITRF2020 is not known"),
        ("# frame: EPSG:9000\n", "ITRF2014 move by 13 mm a year.*'# epoch:'"),
        ("# epoch: today\n", "'today' is neither a decimal year nor a date"),
    ],
)
def test_frames_that_cannot_be_used_are_refused(tmp_path, head, message):
    with pytest.raises(InputError, match=message) as error:
        declared(tmp_path, head)
    assert "gcps.csv" in str(error.value)
