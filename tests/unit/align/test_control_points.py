"""Files of control points."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from stereotruth.align.control_points import COLUMNS, MOST_POINTS, images_measured, read_gcps
from stereotruth.core.errors import InputError
from stereotruth.lidar.frames import Epoch

HEAD = ",".join(COLUMNS)
LONG_FORM = """id,lon,lat,height,image,col,row
A,115.1,30.2,50,one,1.5,2.5
A,115.1,30.2,50,two,3.5,4.5
B,115.2,30.2,60,two,7,8
C,115.3,30.2,70,three,5,6
"""


def test_files_of_spreadsheets_are_read(tmp_path):
    file = tmp_path / "gcps.csv"
    text = (
        "id, lon ,lat,height,left_col,left_row,right_col,right_row\r\n"
        ' B , 115.1,30.2, 5e1 ,"1.5", 2.5,,\r\n\r\n'
        "'=1+2,115.3,30.4,70,,,10,-0.25\r\n,,,,,,,\r\n"
    )
    file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    points = read_gcps(file)
    assert points.ids == ("=1+2", "B")
    assert points.line == (4, 2)
    assert points.lon.tolist() == [115.3, 115.1]
    assert points.height.tolist() == [70.0, 50.0]
    assert points.left[1].tolist() == [1.5, 2.5]
    assert points.seen[0].tolist() == [False, True]
    assert points.seen[1].tolist() == [True, False]


PAIR = ("one", "two")
ROW = "115.1,30.2,50,1.5,2.5,3.5,4.5"


@pytest.mark.parametrize(
    ("text", "images", "told"),
    [
        (f"{HEAD}\nA,1_15.1,30.2,50,1,2,3,4", None, "line 2, point A: lon"),
        (f"{HEAD}\nA,115.1,30.2,50,nan,2,3,4", None, "left_col"),
        (f"{HEAD}\nA,115.1,30.2,,1,2,3,4", None, "height"),
        (f"{HEAD}\nA,30.2,115.1,50,1,2,3,4", None, "swapped"),
        (f"{HEAD}\nA,512345,30.2,50,1,2,3,4", None, "projected"),
        (f"{HEAD}\nA,115.1,30.2,123456,1,2,3,4", None, "123456 m"),
        (f"{HEAD}\nA,115.1,30.2,50,1,2,3,", None, "right_row"),
        (f"{HEAD}\nA,115.1,30.2,50,,,,", None, "point A"),
        (f"{HEAD}\n,{ROW}", None, "line 2"),
        (f"{HEAD}\nA,{ROW}\nA,{ROW}", None, "lines 2 and 3"),
        (f"{HEAD}\nA,{ROW}\nB,115.1,30.2,50.0,1.50,2.5,,", None, "lines 2 and 3"),
        (f"{HEAD}\nA\x1b[31m,{ROW}", None, "of 6 characters"),
        (HEAD, None, "no points"),
        (f"{HEAD},note", None, "note"),
        (LONG_FORM, None, "no names"),
        (LONG_FORM, ("four", "five"), "four or five"),
        (f"{LONG_FORM}A,115.1,30.2,51,three,1,2", PAIR, "lines 2 and 6"),
        (f"{LONG_FORM}A,115.1,30.2,50,one,1,2", PAIR, "image one"),
        (f"{LONG_FORM}D,115.1,30.2,50,one,1,", PAIR, "line 6, point D: row"),
        (f"# frame: EPSG:6339\n{HEAD}\nA,{ROW}", None, "UTM zone 10N"),
        (f"# frame: nonsense\n{HEAD}\nA,{ROW}", None, "'nonsense'"),
        (f"# frame: EPSG:4149\n{HEAD}\nA,{ROW}", None, "CH1903"),
        (f"# frame: EPSG:9000\n{HEAD}\nA,{ROW}", None, "# epoch:"),
        (f"# epoch: today\n{HEAD}\nA,{ROW}", None, "'today'"),
        (HEAD + "\n" + f"A,{ROW}\n" * (MOST_POINTS + 1), None, f"{MOST_POINTS} points"),
    ],
)
def test_refusals_name_file_and_remedy(tmp_path, text, images, told):
    file = tmp_path / "gcps.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_gcps(file, "Test-1", images)
    assert told in str(caught.value) and str(file) in str(caught.value)
    assert "Remedy: " in str(caught.value) and "(scene Test-1)" in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_a_point_measured_twice_is_two_points(tmp_path):
    """The same ground at other places of the images: each measurement counts."""
    file = tmp_path / "gcps.csv"
    rows = ["A," + ROW, "B,115.1,30.2,50,1.6,2.4,3.6,4.4", r"$\frac$,115.2,30.2,50,1,2,,"]
    file.write_text("\n".join([HEAD, *rows]))
    assert read_gcps(file).ids == (r"$\frac$", "A", "B")


def test_the_long_form_gives_a_pair_the_points_that_it_shows(tmp_path):
    file = tmp_path / "gcps.csv"
    file.write_text(LONG_FORM)
    points = read_gcps(file, "Test-1", ("two", "one"))
    assert points.ids == ("A", "B")
    assert points.left.tolist() == [[3.5, 4.5], [7.0, 8.0]]
    assert points.right[0].tolist() == [1.5, 2.5]
    assert points.seen[1].tolist() == [True, False]
    assert points.line == (2, 4)
    assert images_measured(file) == {"one": 2, "two": 3, "three": 5}
    file.write_text(f"{HEAD}\nA,{ROW}\n")
    assert images_measured(file) == {}


PLACES = "A,-81.66,30.33,20,1,2,3,4\nB,-81.65,30.34,25,5,6,7,8\n"


def declared(tmp_path, head: str, places: str = PLACES):
    file = tmp_path / "gcps.csv"
    file.write_text(f"{head}{HEAD}\n{places}")
    return read_gcps(file, epoch=Epoch(2020.0, "the test"))


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
