"""What the coordinates of LiDAR files mean: units, vertical datums, geoid grids, precedence."""

from __future__ import annotations

import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar import declared_crs

from ...synthetic.las import FT, NAVD88_FTUS, US_FT, UTM_10, UTM_WKT1, header_of


@pytest.mark.parametrize(
    ("text", "horizontal", "datum"),
    [
        (" epsg:32650 ", 32650, None),
        ("2154+5720", 2154, "NGF-IGN69 height"),
        (UTM_10.to_wkt(), 32610, None),
    ],
)
def test_lidar_crs_is_epsg_compound_or_wkt(text, horizontal, datum) -> None:
    system = declared_crs.parse_crs(text)
    assert system.horizontal.to_epsg() == horizontal
    assert system.vertical_datum == datum
    assert not system.ellipsoidal


@pytest.mark.parametrize("text", ["nonsense", "EPSG:4978", "EPSG:5720"])
def test_unusable_lidar_crs_is_refused_by_name(text) -> None:
    with pytest.raises(InputError, match="lidar_crs"):
        declared_crs.parse_crs(text)


@pytest.mark.parametrize(
    ("wkt", "datum", "ellipsoidal", "height_unit"),
    [
        (pyproj.CRS("EPSG:2225").to_wkt(), None, False, US_FT),
        (pyproj.CRS("EPSG:4326").to_wkt(), None, False, 1.0),
        (UTM_10.to_3d().to_wkt(), None, True, 1.0),
        (f'COMPD_CS["c",{UTM_WKT1},{NAVD88_FTUS}]', "NAVD88 height (ftUS)", False, US_FT),
        (
            f'COMPD_CS["c",{UTM_WKT1},VERT_CS["Ellipsoid",VERT_DATUM["Ellipsoid",2002],'
            'UNIT["US survey foot",0.304800609601219],AXIS["Up",UP]]]',
            None,
            True,
            US_FT,
        ),
        (
            f'COMPD_CS["c",{UTM_WKT1},VERT_CS["unknown",VERT_DATUM["unknown",2005],'
            'UNIT["foot",0.3048],AXIS["Up",UP]]]',
            None,
            False,
            FT,
        ),
        (  # bound to a grid, as GDAL and PDAL write it
            f'COMPD_CS["c",{UTM_WKT1},VERT_CS["NAVD88 height",VERT_DATUM["NAVD88",2005,'
            'EXTENSION["PROJ4_GRIDS","g2012a.gtx"]],UNIT["metre",1],AXIS["Up",UP]]]',
            "NAVD88 height",
            False,
            1.0,
        ),
    ],
)
def test_wkt_says_unit_and_surface_of_heights(wkt, datum, ellipsoidal, height_unit) -> None:
    system, problems = declared_crs.header_crs(header_of(wkt))
    assert not problems
    assert system.vertical_datum == datum
    assert system.ellipsoidal == ellipsoidal
    assert system.height_unit_m == pytest.approx(height_unit, rel=1e-12)
    assert len(system.horizontal.axis_info) == 2


@pytest.mark.parametrize("datum", ['VDATUM["EGM96_Geoid"]', 'DATUM["D_WGS_1984",{}]'])
def test_depths_are_refused(datum) -> None:
    """As ESRI writes them, above a geoid and an ellipsoid, whatever the sheet says."""
    datum = datum.format('SPHEROID["WGS_1984",6378137.0,298.257223563]')
    vertical = f'VERTCS["d",{datum},PARAMETER["Vertical_Shift",0.0],PARAMETER["Direction",-1.0],'
    header = header_of(f'{UTM_10.to_wkt("WKT1_ESRI")},{vertical}UNIT["Meter",1.0]]')
    with pytest.raises(InputError, match="point down"):
        declared_crs.resolve(header, "EPSG:32610", "a.laz")


METRE, FOOT, SURVEY_FOOT = 9001, 9002, 9003


@pytest.mark.parametrize(
    ("keys", "horizontal_unit", "datum", "ellipsoidal", "height_unit"),
    [
        ([(3072, 2992)], FT, None, False, FT),
        ([(3072, 26910), (3076, SURVEY_FOOT)], US_FT, None, False, US_FT),
        # EPSG:5703 is in metres; LAStools writes survey feet by the key, which GDAL passes over
        ([(3072, 26910), (4096, 5703), (4099, SURVEY_FOOT)], 1.0, "NAVD88 height", False, US_FT),
        ([(3072, 26910), (4096, 32767), (4099, FOOT)], 1.0, None, False, FT),
        ([(3072, 32610), (4096, 5030), (4099, METRE)], 1.0, None, True, 1.0),
        ([(1024, 2), (2048, 4979)], None, None, True, 1.0),
        # compound systems as laspy writes them, of which GDAL takes feet for metres
        ([(3072, 8729)], US_FT, "NAVD88 height (ftUS)", False, US_FT),
        ([(1024, 2), (2048, 9518)], None, "EGM2008 height", False, 1.0),
    ],
)
def test_geokeys_say_the_same(keys, horizontal_unit, datum, ellipsoidal, height_unit) -> None:
    keys = dict(keys)
    keys.setdefault(1024, 1)
    header = header_of(keys=[(key, 0, 1, value) for key, value in keys.items()], wkt_bit=False)
    system, problems = declared_crs.header_crs(header)
    assert not problems
    if horizontal_unit is not None:
        assert system.horizontal_unit_m == pytest.approx(horizontal_unit, rel=1e-12)
    assert system.vertical_datum == datum
    assert system.ellipsoidal == ellipsoidal
    assert system.height_unit_m == pytest.approx(height_unit, rel=1e-12)


def test_geokeys_without_a_system_are_none() -> None:
    keys = [(1025, 0, 1, 1), (3076, 0, 1, 9001)]
    with pytest.raises(InputError) as refused:
        declared_crs.resolve(header_of(keys=keys, wkt_bit=False), None, "a.laz")
    assert refused.value.file == "a.laz" and "lidar_crs" in refused.value.remedy


def test_the_header_bit_decides_between_wkt_and_geokeys() -> None:
    keys = [(1024, 0, 1, 1), (3072, 0, 1, 26911)]
    by_wkt, _ = declared_crs.header_crs(header_of(UTM_WKT1, keys, wkt_bit=True))
    by_keys, _ = declared_crs.header_crs(header_of(UTM_WKT1, keys, wkt_bit=False))
    assert (by_wkt.horizontal.to_epsg(), by_keys.horizontal.to_epsg()) == (32610, 26911)
    with_vertical, _ = declared_crs.header_crs(header_of(UTM_WKT1, [*keys, (4096, 0, 1, 5703)]))
    assert with_vertical.vertical_datum == "NAVD88 height"


def test_the_file_wins_over_lidar_crs_and_says_so() -> None:
    system, notes = declared_crs.resolve(header_of(UTM_WKT1), "EPSG:32611", "a.laz")
    assert system.horizontal.to_epsg() == 32610
    assert any("lidar_crs" in note and "WGS 84 / UTM zone 11N" in note for note in notes)
    _, notes = declared_crs.resolve(header_of(UTM_WKT1), "EPSG:32610", "a.laz")
    assert notes == []


def test_lidar_crs_supplies_the_vertical_part_that_a_file_lacks() -> None:
    without_codes = pyproj.CRS("EPSG:2154").to_wkt("WKT1_GDAL").replace('"2154"', '"0"')
    header = header_of(without_codes, low=(700000, 6600000, 0))
    system, notes = declared_crs.resolve(header, "EPSG:2154+5720", "a.laz")
    assert system.vertical_datum == "NGF-IGN69 height"
    assert any("NGF-IGN69" in note for note in notes)
