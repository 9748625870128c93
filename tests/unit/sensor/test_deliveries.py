"""What deliveries say of an image: its files, its time, its sun."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from stereocities.sites import sun_at
from stereotruth.sensor import deliveries
from stereotruth.sensor.deliveries import (
    Acquisition,
    Form,
    between_suns,
    files_beside,
    read_acquisition,
    shadow_shift,
    sun_over,
    toward_sun,
)

from ...synthetic.rpc_texts import vantor_text

PLACE = 115.4, 30.2
TIME = datetime(2020, 10, 25, 3, 12, 45, tzinfo=UTC)
SUN = sun_over(TIME, *PLACE)
IMD = "firstLineTime = 2020-10-25T03:12:45.000000Z;\nmeanSunAz = 161.5;\nmeanSunEl = 44.9;\n"
ANGLES = "<SUN_AZIMUTH>{}</SUN_AZIMUTH><SUN_ELEVATION>{}</SUN_ELEVATION>"
DIMAP = (
    "<Dimap_Document><Strip_Source><IMAGING_DATE>2020-10-25</IMAGING_DATE>"
    "<IMAGING_TIME>03:12:45.0Z</IMAGING_TIME></Strip_Source><Use_Area>"
    + "".join(ANGLES.format(*angles) for angles in ((161, 44.5), (161.5, 44.9), (162, 45.3)))
    + "</Use_Area></Dimap_Document>"
)
GF = (
    "<ProductMetaData><SatelliteID>GF7</SatelliteID><CenterTime>{time}</CenterTime>"
    "<SolarAzimuth>{azimuth}</SolarAzimuth><SolarZenith>{zenith}</SolarZenith></ProductMetaData>"
)
STAC = {
    "stac_version": "1.0.0",
    "properties": {
        "datetime": "2020-10-25T11:12:45+08:00",
        "view:sun_azimuth": 161.5,
        "view:sun_elevation": 44.9,
    },
    "assets": {"image": {"href": "./one.tif"}},
}


@pytest.fixture
def image(tmp_path):
    file = tmp_path / "one.tif"
    file.write_bytes(b"no image")
    return file


@pytest.mark.parametrize(
    ("name", "text"), [("one.IMD", IMD), ("one.xml", DIMAP), ("any.json", json.dumps(STAC))]
)
def test_what_deliveries_say(image, name, text):
    image.with_name(name).write_text(text)
    assert read_acquisition(image, PLACE) == Acquisition(TIME, (161.5, 44.9), name)


@pytest.mark.parametrize("namespace", ["", "urn:of:a:supplier"])
def test_vantor_says_it_in_xml(image, namespace):
    image.with_name("one.XML").write_text(vantor_text({}, namespace))
    assert read_acquisition(image, PLACE) == Acquisition(TIME, (161.5, 44.9), "one.XML")


def test_spot_5_says_it_in_dimap_1(tmp_path):
    image = tmp_path / "IMAGERY.TIF"
    image.write_bytes(b"")
    source = (
        "<IMAGING_DATE>2020-10-25</IMAGING_DATE><IMAGING_TIME>03:12:45</IMAGING_TIME>"
        + ANGLES.format(161.5, 44.9)
    )
    (tmp_path / "METADATA.DIM").write_text(
        f"<Dimap_Document><Scene_Source>{source}</Scene_Source>"
        '<DATA_FILE_PATH href="IMAGERY.TIF"/></Dimap_Document>'
    )
    assert read_acquisition(image, PLACE) == Acquisition(TIME, (161.5, 44.9), "METADATA.DIM")


@pytest.mark.parametrize(
    ("name", "view"),
    [
        ("GF7_DLC_E108_BWD", "left"),
        ("BANDA", "left"),
        ("BANDF", "right"),
        ("IMG-01-ALPSMB011112970", "left"),
        ("IMG-02-ALPSMF011112970", "right"),
        ("IMG-03-ALPSMN011112970", None),
        ("BANDAGE", None),
    ],
)
def test_names_of_views(name, view):
    assert next((view for view, words in deliveries.VIEWS if words.search(name)), None) == view


def test_airbus_names_its_files_by_the_product(tmp_path):
    image = tmp_path / "IMG_PHR1A_P_202010250312_R1C1.TIF"
    image.write_bytes(b"")
    (tmp_path / "DIM_PHR1A_P_202010250312.XML").write_text(DIMAP)
    (tmp_path / "DIM_PHR1B_P_201901010000.XML").write_text(DIMAP.replace("2020", "2019"))
    assert read_acquisition(image, PLACE).time == TIME


def test_a_new_form_of_delivery_is_a_line_of_a_table(image, monkeypatch):
    def read(text, place):
        return Acquisition(deliveries.utc(text.partition("=")[2], UTC), (161.5, 44.9))

    monkeypatch.setattr(deliveries, "FORMS", (*deliveries.FORMS, Form(".meta", read)))
    image.with_name("one.META").write_text("taken=2020-10-25T03:12:45")
    assert read_acquisition(image, PLACE) == Acquisition(TIME, (161.5, 44.9), "one.META")


@pytest.mark.parametrize("clock", ["2020-10-25 03:12:45", "2020-10-25 11:12:45"])
def test_the_sun_tells_the_zone_of_gaofen_times(image, clock):
    text = GF.format(time=clock, azimuth=SUN[0] + 0.2, zenith=90 - SUN[1] + 0.1)
    image.with_name("one.xml").write_text(text)
    said = read_acquisition(image, PLACE)
    assert said.time == TIME
    assert said.sun == pytest.approx((SUN[0] + 0.2, SUN[1] - 0.1))


def test_without_sun_it_is_that_over_the_place(image):
    properties = {"datetime": STAC["properties"]["datetime"]}
    image.with_name("one.json").write_text(json.dumps(STAC | {"properties": properties}))
    assert read_acquisition(image, PLACE).sun == pytest.approx(SUN)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("other.IMD", IMD),
        ("one.xml", "<ProductMetaData>"),
        ("one.xml", "<Meta><CenterTime>2020-10-25 03:12:45</CenterTime></Meta>"),  # of no zone
        ("one.json", "{"),
        ("one.IMD", "firstLineTime = yesterday;"),
    ],
)
def test_files_of_other_images_and_damaged_ones_say_nothing(image, name, text):
    image.with_name(name).write_text(text)
    assert read_acquisition(image, PLACE) == Acquisition()


@pytest.mark.parametrize(
    "name",
    ["Left.TIF.msk", "LEFT.AUX.XML", "left_Rpc.Txt", "left.RPB", "LEFT.TIFW", "RPC_PHR1A_P.XML"],
)
def test_files_that_readers_take_into_account_are_found_in_any_case(tmp_path, name):
    for one in ("Left.tif", name, "right.tif", "right_RPC.TXT", "left.txt", "left2.rpb", "a.xml"):
        (tmp_path / one).touch()
    assert files_beside(tmp_path / "Left.tif") == [tmp_path / name]
    assert files_beside(tmp_path / "nowhere/left.tif") == []


def test_nrel_s_example():
    """Reda and Andreas 2004, table A5.1, without the refraction of 0.016 degrees."""
    time = datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC)
    expected = 194.340, 90 - 50.112 - 0.016
    assert sun_over(time, -105.1786, 39.742476) == pytest.approx(expected, abs=0.02)


def test_it_agrees_with_the_simulator_s_own_formula():
    for k in range(40):
        time = datetime(2012, 1, 1, tzinfo=UTC) + timedelta(hours=3356.5 * k)
        for place in ((0.0, 0.0), (114.3, 30.6), (-70.6, -33.4)):
            cosine = toward_sun(*sun_over(time, *place)) @ toward_sun(*sun_at(time, *place))
            assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.03


def test_two_suns():
    assert between_suns((180, 40), (180, 60)) == pytest.approx(20)
    # shadows of one height: 1 / tan 45° north, and as far west
    assert shadow_shift((180, 45), (90, 45)) == pytest.approx(np.sqrt(2))
