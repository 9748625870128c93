"""What the coordinates of LiDAR files mean: units, vertical datums, geoid grids, precedence."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin

from stereotruth.errors import InputError
from stereotruth.lidar import declared_crs, geoid, to_wgs84
from stereotruth.lidar.las_files import read_header

SHARED = Path(__file__).parents[3] / "shared"
FT, US_FT = 0.3048, 1200 / 3937
UTM = pyproj.CRS("EPSG:32610")
UTM_WKT1 = UTM.to_wkt("WKT1_GDAL")
NAVD88_FTUS = (
    'VERT_CS["NAVD88 height (ftUS)",VERT_DATUM["North American Vertical Datum 1988",2005],'
    'UNIT["US survey foot",0.304800609601219],AXIS["Up",UP]]'
)


def header_of(
    wkt: str = "",
    keys: list[tuple[int, int, int, int]] | None = None,
    *,
    low: tuple[float, float, float] = (500000, 4800000, 0),
    wkt_bit: bool = True,
) -> laspy.LasHeader:
    """Header with a box of 100 units from ``low``, WKT and GeoKeys as given."""
    header = laspy.LasHeader(point_format=6 if wkt_bit else 1, version="1.4")
    header.global_encoding.wkt = wkt_bit
    header.mins, header.maxs = np.array(low, float), np.array(low, float) + 100
    if wkt:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt.encode() + b"\0"))
    if keys:
        shorts = [1, 1, 0, len(keys)] + [value for key in keys for value in key]
        data = struct.pack(f"<{len(shorts)}H", *shorts)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", data))
    return header


def write_gtx(
    path: Path, values: np.ndarray, west: float, south: float, step: float, nodata: float = -88.8888
) -> Path:
    """GTX grid (NOAA VDatum's format, big-endian) of [row, col] values, southernmost row first."""
    values = np.where(np.isfinite(values), values, nodata)
    head = struct.pack(">4d2i", south, west, step, step, *values.shape)
    path.write_bytes(head + values.astype(">f4").tobytes())
    return path


def undulations(west: float, south: float, step: float, shape: tuple[int, int]) -> np.ndarray:
    lat = south + step * np.arange(shape[0])[:, None]
    lon = west + step * np.arange(shape[1])
    return 20 + 8 * np.sin(np.radians(7 * lon)) * np.cos(np.radians(5 * lat))


# ------------------------------------------------------------------ systems


@pytest.mark.parametrize(
    ("text", "horizontal", "datum"),
    [
        ("2154", 2154, None),
        ("EPSG:2154", 2154, None),
        (" epsg:32650 ", 32650, None),
        ("EPSG:2154+5720", 2154, "NGF-IGN69 height"),
        ("2154+5720", 2154, "NGF-IGN69 height"),
        (UTM.to_wkt(), 32610, None),
    ],
)
def test_lidar_crs_is_epsg_compound_or_wkt(text, horizontal, datum) -> None:
    system = declared_crs.parse_crs(text)
    assert system.horizontal.to_epsg() == horizontal
    assert system.vertical_datum == datum
    assert not system.ellipsoidal


@pytest.mark.parametrize(
    "text", ["nonsense", "EPSG:1", "EPSG:4978", 'LOCAL_CS["a",UNIT["metre",1]]', "EPSG:5720"]
)
def test_unusable_lidar_crs_is_refused_by_name(text) -> None:
    with pytest.raises(InputError, match="lidar_crs"):
        declared_crs.parse_crs(text)


@pytest.mark.parametrize(
    ("wkt", "datum", "ellipsoidal", "height_unit"),
    [
        (UTM_WKT1, None, False, 1.0),
        (pyproj.CRS("EPSG:2992").to_wkt(), None, False, FT),
        (pyproj.CRS("EPSG:2225").to_wkt(), None, False, US_FT),
        (pyproj.CRS("EPSG:4326").to_wkt(), None, False, 1.0),
        (pyproj.CRS("EPSG:4979").to_wkt(), None, True, 1.0),
        (UTM.to_3d().to_wkt(), None, True, 1.0),
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


def test_depths_are_refused() -> None:
    vertical = 'VERT_CS["d",VERT_DATUM["Mean Sea Level",2005],UNIT["metre",1],AXIS["Depth",DOWN]]'
    system, problems = declared_crs.header_crs(header_of(f'COMPD_CS["c",{UTM_WKT1},{vertical}]'))
    assert system is None
    assert "point down" in problems[0]


METRE, FOOT, SURVEY_FOOT = 9001, 9002, 9003


@pytest.mark.parametrize(
    ("keys", "horizontal_unit", "datum", "ellipsoidal", "height_unit"),
    [
        ([(3072, 26910)], 1.0, None, False, 1.0),
        ([(3072, 2992)], FT, None, False, FT),
        ([(3072, 26910), (3076, SURVEY_FOOT)], US_FT, None, False, US_FT),
        ([(3072, 26910), (4096, 5703), (4099, METRE)], 1.0, "NAVD88 height", False, 1.0),
        # EPSG:5703 is in metres; LAStools writes survey feet by the key, which GDAL passes over
        ([(3072, 26910), (4096, 5703), (4099, SURVEY_FOOT)], 1.0, "NAVD88 height", False, US_FT),
        ([(3072, 26910), (4096, 5103), (4099, SURVEY_FOOT)], 1.0, "NAVD88 height", False, US_FT),
        ([(3072, 26910), (4099, SURVEY_FOOT)], 1.0, None, False, US_FT),
        ([(3072, 26910), (4096, 32767), (4099, FOOT)], 1.0, None, False, FT),
        ([(3072, 32610), (4096, 5030), (4099, METRE)], 1.0, None, True, 1.0),
        ([(1024, 2), (2048, 4269)], None, None, False, 1.0),
        ([(1024, 2), (2048, 4979)], None, None, True, 1.0),
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


@pytest.mark.parametrize(
    "keys", [[(1025, 0, 1, 1), (3076, 0, 1, 9001)], [(1024, 0, 1, 1), (3072, 0, 1, 2)]]
)
def test_geokeys_without_a_system_are_none(keys) -> None:
    with pytest.raises(InputError, match="lidar_crs") as refused:
        declared_crs.resolve(header_of(keys=keys, wkt_bit=False), None, "a.laz")
    assert "a.laz" in str(refused.value)


def test_the_header_bit_decides_between_wkt_and_geokeys() -> None:
    keys = [(1024, 0, 1, 1), (3072, 0, 1, 26911)]
    by_wkt, _ = declared_crs.header_crs(header_of(UTM_WKT1, keys, wkt_bit=True))
    by_keys, _ = declared_crs.header_crs(header_of(UTM_WKT1, keys, wkt_bit=False))
    assert (by_wkt.horizontal.to_epsg(), by_keys.horizontal.to_epsg()) == (32610, 26911)
    with_vertical, _ = declared_crs.header_crs(header_of(UTM_WKT1, [*keys, (4096, 0, 1, 5703)]))
    assert with_vertical.vertical_datum == "NAVD88 height"


def test_wkt_in_an_extended_record(tmp_path) -> None:
    las = laspy.LasData(header_of())
    las.x, las.y, las.z = [np.array([1.0])] * 3
    las.evlrs = laspy.vlrs.vlrlist.VLRList(
        [laspy.VLR("LASF_Projection", 2112, "", UTM_WKT1.encode() + b"\0")]
    )
    las.write(tmp_path / "a.laz")
    header = read_header(tmp_path / "a.laz")
    assert not any(record.user_id == "LASF_Projection" for record in header.vlrs)
    assert declared_crs.header_crs(header)[0].horizontal.to_epsg() == 32610


@pytest.mark.skipif(not SHARED.is_dir(), reason="shared real files are absent")
def test_user_defined_geokeys_agree_with_wkt_on_a_real_file() -> None:
    with laspy.open(SHARED / "lidar" / "autzen_trim.laz") as reader:
        header = reader.header
    transformers = []
    for wkt_bit in (False, True):
        header.global_encoding.wkt = wkt_bit
        system, _ = declared_crs.header_crs(header)
        assert system.horizontal_unit_m == pytest.approx(FT)
        transformers.append(
            pyproj.Transformer.from_crs(system.horizontal, "EPSG:4326", always_xy=True)
        )
    places = [t.transform(636001.76, 848935.20) for t in transformers]
    np.testing.assert_allclose(*places, rtol=0, atol=1e-9)  # 0.1 mm


# ------------------------------------------------------------------ precedence


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


def test_unreadable_wkt_falls_back_to_lidar_crs() -> None:
    system, notes = declared_crs.resolve(header_of("PROJCS[broken"), "EPSG:32610", "a.laz")
    assert system.horizontal.to_epsg() == 32610
    assert any("WKT" in note for note in notes)
    with pytest.raises(InputError, match="WKT cannot be used"):
        declared_crs.resolve(header_of("PROJCS[broken"), None, "a.laz")


# ------------------------------------------------------------------ geoid grids


@pytest.mark.parametrize("west", [-124.0, 236.0])
def test_geoid_is_bilinear_as_in_proj(tmp_path, west) -> None:
    """Against PROJ's own vgridshift; grids from −180 and from 0 (VDatum writes both)."""
    values = undulations(west, 43.0, 0.05, (41, 61))
    grid = write_gtx(tmp_path / "g.gtx", values, west, 43.0, 0.05)
    rng = np.random.default_rng(1)
    lon, lat = rng.uniform(-124, -121, 5000), rng.uniform(43, 45, 5000)
    lon[:4], lat[:4] = [-124, -121, -124, -121], [43, 43, 45, 45]  # the outermost nodes
    ours = geoid.GeoidGrid(grid)(lon, lat)
    proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=vgridshift +grids={grid} +multiplier=1 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    _, _, theirs = proj.transform(lon[4:], lat[4:], np.zeros(4996))
    np.testing.assert_allclose(ours[4:], theirs, rtol=0, atol=2e-6)
    corners = values[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(ours[:4], corners, rtol=0, atol=2e-6)


def test_global_geoid_has_no_seam(tmp_path) -> None:
    step = 0.5
    values = 30 * np.sin(np.radians(np.arange(720) * step)) * np.ones((361, 1))
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "g.gtx", values, 0.0, -90.0, step))
    lon = np.array([-0.25, 0.25, 359.75, 180.0, -180.0, 179.75, -179.75])
    expected = 30 * np.sin(np.radians(lon))
    np.testing.assert_allclose(grid(lon, np.zeros(7)), expected, atol=2e-3)  # chord of 0.5°
    assert np.isfinite(grid(np.array([10.0, 10.0]), np.array([-90.0, 90.0]))).all()


def test_geoid_reads_more_rows_as_chunks_ask(tmp_path) -> None:
    values = undulations(0.0, 40.0, 0.1, (101, 51))
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "g.gtx", values, 0.0, 40.0, 0.1))
    lon, lat = np.full(200, 1.23), np.linspace(40, 50, 200)
    order = np.random.default_rng(0).permutation(200)
    one_by_one = np.array([grid(lon[k : k + 1], lat[k : k + 1])[0] for k in order])
    at_once = geoid.GeoidGrid(grid.path)(lon, lat)
    np.testing.assert_array_equal(one_by_one, at_once[order])


@pytest.mark.parametrize("problem", ["outside", "nodata"])
def test_points_without_undulation_are_refused(tmp_path, problem) -> None:
    values = undulations(10.0, 40.0, 0.1, (11, 11))
    if problem == "nodata":
        values[5, 5] = np.nan
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "small.gtx", values, 10.0, 40.0, 0.1))
    lon = np.array([10.1, 10.51 if problem == "nodata" else 11.2])
    with pytest.raises(InputError, match=r"small\.gtx.* 1 points|1 points .*small\.gtx"):
        grid(lon, np.array([40.1, 40.51]))


def geotiff(path: Path, values: np.ndarray, system: str, scale: float = 1.0) -> Path:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=values.shape[1],
        height=values.shape[0],
        count=1,
        dtype="int16" if scale != 1 else "float32",
        crs=system,
        transform=from_origin(9.95, 41.05, 0.1, 0.1),  # nodes from 10.0, 41.0
        nodata=-9999,
    ) as grid:
        grid.write((values / scale).astype(grid.dtypes[0]), 1)
        grid.scales = (scale,)
    return path


def test_geotiff_grid_with_scale(tmp_path) -> None:
    values = np.round(undulations(10.0, 40.0, 0.1, (11, 11))[::-1], 2)
    plain = geoid.GeoidGrid(geotiff(tmp_path / "a.tif", values, "EPSG:4326"))
    scaled = geoid.GeoidGrid(geotiff(tmp_path / "b.tif", values, "EPSG:4326", scale=0.01))
    lon, lat = np.array([10.0, 10.33, 11.0]), np.array([41.0, 40.77, 40.0])
    np.testing.assert_allclose(plain(lon[[0, 2]], lat[[0, 2]]), [values[0, 0], values[-1, -1]])
    np.testing.assert_allclose(plain(lon, lat), scaled(lon, lat), atol=0.011)


@pytest.mark.parametrize(
    ("system", "reason"), [("EPSG:32632", "longitude and latitude"), ("EPSG:4314", "Bessel")]
)
def test_grids_of_other_kinds_are_refused(tmp_path, system, reason) -> None:
    grid = geotiff(tmp_path / "a.tif", np.zeros((11, 11)), system)
    with pytest.raises(InputError, match=reason):
        geoid.GeoidGrid(grid)


def test_missing_or_broken_grid_is_named(tmp_path) -> None:
    with pytest.raises(InputError, match=r"none\.gtx"):
        geoid.GeoidGrid(tmp_path / "none.gtx")
    (tmp_path / "bad.gtx").write_bytes(b"not a grid")
    with pytest.raises(InputError, match=r"bad\.gtx"):
        geoid.GeoidGrid(tmp_path / "bad.gtx")


# ------------------------------------------------------------------ the transformation

X, Y, Z = np.array([400_000.0]), np.array([300_000.0]), np.array([120.0])  # Oregon, metres
LOW = (399_950, 299_950, 0)


def oregon_truth() -> tuple[float, float]:
    lon, lat = pyproj.Transformer.from_crs("EPSG:2991", "EPSG:4326", always_xy=True).transform(X, Y)
    return lon, lat


@pytest.mark.parametrize(("code", "unit"), [(2991, 1.0), (2992, FT), (3643, 1.0), (3644, FT)])
def test_feet_and_metres_are_the_same_place(code, unit) -> None:
    low = tuple(value / unit for value in LOW)
    transform = to_wgs84.to_wgs84(header_of(pyproj.CRS(code).to_wkt(), low=low), "a.las")
    lon, lat, height = transform(X / unit, Y / unit, Z / unit)
    np.testing.assert_allclose([lon, lat], oregon_truth(), rtol=0, atol=2e-9)
    np.testing.assert_allclose(height, Z, atol=1e-6)
    assert any("no vertical datum" in note for note in transform.notes)
    assert transform.describe()["height_unit_m"] == pytest.approx(unit)


def test_compound_of_metres_and_survey_feet_with_a_geoid(tmp_path) -> None:
    geoid = write_gtx(tmp_path / "g.gtx", np.full((31, 31), -22.5), -122.0, 43.0, 0.1)
    horizontal = pyproj.CRS("EPSG:2991").to_wkt("WKT1_GDAL")
    header = header_of(f'COMPD_CS["c",{horizontal},{NAVD88_FTUS}]', low=LOW)
    with pytest.raises(InputError, match=r"NAVD88.*geoid") as refused:
        to_wgs84.to_wgs84(header, "bmx.las")
    assert "bmx.las" in str(refused.value)
    transform = to_wgs84.to_wgs84(header, "bmx.las", geoid=geoid)
    lon, lat, height = transform(X, Y, Z / US_FT)
    np.testing.assert_allclose([lon, lat], oregon_truth(), rtol=0, atol=2e-9)
    np.testing.assert_allclose(height, Z - 22.5, atol=1e-5)
    assert transform.describe()["geoid"] == "g.gtx"


def test_declared_ellipsoidal_heights_take_no_geoid(tmp_path) -> None:
    geoid = write_gtx(tmp_path / "g.gtx", np.full((31, 31), -22.5), -124.0, 43.0, 0.1)
    header = header_of(UTM.to_3d().to_wkt())
    transform = to_wgs84.to_wgs84(header, "a.laz", geoid=geoid)
    assert transform(np.array([5e5]), np.array([4.85e6]), Z)[2] == pytest.approx(Z)
    assert any("not applied" in note for note in transform.notes)


def test_geoid_makes_undeclared_heights_orthometric(tmp_path) -> None:
    geoid = write_gtx(tmp_path / "g.gtx", np.full((31, 31), -22.5), -124.0, 43.0, 0.1)
    header = header_of(UTM.to_wkt())
    assert to_wgs84.to_wgs84(header, "a.laz", geoid=geoid)(np.array([5e5]), np.array([4.85e6]), Z)[
        2
    ] == pytest.approx(Z - 22.5)


def test_a_datum_in_the_file_name_needs_the_geoid() -> None:
    header = header_of(UTM.to_wkt())
    with pytest.raises(InputError, match="IGN69"):
        to_wgs84.to_wgs84(header, "LHD_FXX_0382_6565_PTS_O_LAMB93_IGN69.copc.laz")
    to_wgs84.to_wgs84(header_of(UTM.to_3d().to_wkt()), "b_EGM96.laz")  # declared: no doubt
    to_wgs84.to_wgs84(header, "designavd88x.laz")  # part of a word


def test_longitude_latitude_files() -> None:
    header = header_of(pyproj.CRS("EPSG:4979").to_wkt(), low=(114, 30, 0))
    lon, lat, height = to_wgs84.to_wgs84(header, "a.laz")(
        np.array([114.1234567]), np.array([30.7654321]), Z
    )
    assert (lon[0], lat[0], height[0]) == pytest.approx((114.1234567, 30.7654321, 120), abs=1e-12)


def test_degrees_in_a_projected_system_are_refused() -> None:
    header = header_of(UTM.to_wkt(), low=(-30, -40, 0))
    with pytest.raises(InputError, match="look like degrees"):
        to_wgs84.to_wgs84(header, "a.laz")


def test_heights_follow_a_datum_shift() -> None:
    """3-D where both are 3-D: swisstopo's shift from CH1903 (Bessel) moves heights by 49.6 m."""
    header = header_of(pyproj.CRS("EPSG:21781").to_wkt(), low=(600000, 200000, 0))
    transform = to_wgs84.to_wgs84(header, "a.laz")
    x, y = np.array([600000.0]), np.array([200000.0])
    lon, lat, height = transform(x, y, np.array([100.0]))
    # Bern: the translation (674.374, 15.056, 405.346), done by hand in geocentric coordinates
    geodetic = pyproj.Transformer.from_crs("EPSG:21781", "EPSG:4149", always_xy=True)
    to_xyz = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg "
        "+xy_out=rad +step +proj=cart +ellps=bessel"
    )
    to_geodetic = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    xyz = np.array(to_xyz.transform(*geodetic.transform(x, y), np.array([100.0])))
    expected = to_geodetic.transform(*(xyz + np.array([[674.374], [15.056], [405.346]])))
    np.testing.assert_allclose([lon, lat], expected[:2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(height, expected[2], rtol=0, atol=1e-4)
    assert transform.accuracy_m == pytest.approx(1.5)


def test_geoid_heights_ignore_the_shift_of_an_old_datum(tmp_path) -> None:
    """N is above WGS 84: H + N is final, whatever ellipsoid the map coordinates are on."""
    geoid = write_gtx(tmp_path / "g.gtx", np.full((31, 31), 49.5), 6.0, 45.0, 0.1)
    header = header_of(pyproj.CRS("EPSG:21781").to_wkt(), low=(600000, 200000, 0))
    height = to_wgs84.to_wgs84(header, "a.laz", geoid=geoid)(
        np.array([600000.0]), np.array([200000.0]), np.array([540.0])
    )[2]
    assert height == pytest.approx(589.5, abs=1e-5)


@pytest.mark.parametrize("name", ["national", "egm96"])
def test_the_datum_of_the_geoid_decides_about_the_shift(tmp_path, name) -> None:
    """NAD83(HARN) is 0.4 m off WGS 84 in height: GEOID grids count from NAD83, EGM from WGS 84."""
    values = np.full((31, 31), -22.5)
    geoid = write_gtx(tmp_path / f"{name}.gtx", values, -124.0, 43.0, 0.1)
    header = header_of(pyproj.CRS("EPSG:2993").to_wkt(), low=(200_000, 300_000, 0))
    x, y, z = np.array([200_000.0]), np.array([300_000.0]), np.array([100.0])
    bare = to_wgs84.to_wgs84(header, "a.laz")(x, y, z)[2]
    assert 0.1 < abs(bare[0] - 100) < 1
    base = 100 if name == "egm96" else bare[0]
    height = to_wgs84.to_wgs84(header, "a.laz", geoid=geoid)(x, y, z)[2]
    assert height[0] == pytest.approx(base - 22.5, abs=1e-6)


def test_ballpark_and_missing_grids_are_named() -> None:
    beijing = to_wgs84.to_wgs84(
        header_of(pyproj.CRS("EPSG:2436").to_wkt(), low=(500000, 3400000, 0)), "a.laz"
    )
    assert beijing.accuracy_m is None
    assert any("Beijing 1954" in note for note in beijing.notes)
    british = to_wgs84.to_wgs84(
        header_of(pyproj.CRS("EPSG:27700").to_wkt(), low=(400000, 300000, 0)), "a.laz"
    )
    assert any("OSTN15" in note for note in british.notes) or british.accuracy_m < 1.5
    wgs84 = to_wgs84.to_wgs84(header_of(UTM.to_3d().to_wkt()), "a.laz")
    assert (wgs84.accuracy_m, wgs84.notes) == (0.0, ())


def test_points_far_from_the_area_of_their_system() -> None:
    system = declared_crs.parse_crs("EPSG:2154")
    assert to_wgs84.check_area(system, (2.0, 2.1), (47.0, 47.1), "a.laz") is None
    assert "Lambert-93" in to_wgs84.check_area(system, (2.0, 2.1), (38.0, 38.1), "a.laz")
    with pytest.raises(InputError, match="outside of the area"):
        to_wgs84.check_area(system, (114.0, 114.1), (30.0, 30.1), "a.laz")
    pacific = declared_crs.parse_crs("EPSG:3832")  # its area crosses the antimeridian
    assert to_wgs84.check_area(pacific, (179.0, 179.1), (-20.0, -19.9), "a.laz") is None
