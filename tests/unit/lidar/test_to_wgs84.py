"""From what a file declares to WGS 84."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar import declared_crs, to_wgs84

from ...synthetic.las import FT, UTM_10, header_of, write_gtx

X, Y, Z = np.array([400_000.0]), np.array([300_000.0]), np.array([120.0])  # Oregon, metres
LOW = (399_950, 299_950, 0)


def oregon_truth() -> tuple[float, float]:
    lon, lat = pyproj.Transformer.from_crs("EPSG:2991", "EPSG:4326", always_xy=True).transform(X, Y)
    return lon, lat


@pytest.mark.parametrize(("code", "unit"), [(2991, 1.0), (3644, FT)])
def test_feet_and_metres_are_the_same_place(code, unit) -> None:
    low = tuple(value / unit for value in LOW)
    transform = to_wgs84.to_wgs84(header_of(pyproj.CRS(code).to_wkt(), low=low), "a.las")
    lon, lat, height = transform(X / unit, Y / unit, Z / unit)
    np.testing.assert_allclose([lon, lat], oregon_truth(), rtol=0, atol=2e-9)
    np.testing.assert_allclose(height, Z, atol=1e-6)
    assert any("no vertical datum" in note for note in transform.notes)
    assert transform.describe()["height_unit_m"] == pytest.approx(unit)


def test_declared_ellipsoidal_heights_take_no_geoid(tmp_path) -> None:
    geoid = write_gtx(tmp_path / "g.gtx", np.full((31, 31), -22.5), -124.0, 43.0, 0.1)
    header = header_of(UTM_10.to_3d().to_wkt())
    transform = to_wgs84.to_wgs84(header, "a.laz", geoid=geoid)
    assert transform(np.array([5e5]), np.array([4.85e6]), Z)[2] == pytest.approx(Z)
    assert any("not applied" in note for note in transform.notes)


def test_a_datum_in_the_file_name_needs_the_geoid() -> None:
    header = header_of(UTM_10.to_wkt())
    with pytest.raises(InputError, match="IGN69"):
        to_wgs84.to_wgs84(header, "LHD_FXX_0382_6565_PTS_O_LAMB93_IGN69.copc.laz")
    to_wgs84.to_wgs84(header_of(UTM_10.to_3d().to_wkt()), "b_EGM96.laz")  # declared: no doubt
    to_wgs84.to_wgs84(header, "designavd88x.laz")  # part of a word


def test_degrees_in_a_projected_system_are_refused() -> None:
    header = header_of(UTM_10.to_wkt(), low=(-30, -40, 0))
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
    wgs84 = to_wgs84.to_wgs84(header_of(UTM_10.to_3d().to_wkt()), "a.laz")
    assert wgs84.accuracy_m in (0.0, None) and wgs84.notes == ()  # none is stated by PROJ 9.8


def test_points_far_from_the_area_of_their_system() -> None:
    system = declared_crs.parse_crs("EPSG:2154")
    assert to_wgs84.check_area(system, (2.0, 2.1), (47.0, 47.1), "a.laz") is None
    assert "Lambert-93" in to_wgs84.check_area(system, (2.0, 2.1), (38.0, 38.1), "a.laz")
    with pytest.raises(InputError, match="outside of the area"):
        to_wgs84.check_area(system, (114.0, 114.1), (30.0, 30.1), "a.laz")
    pacific = declared_crs.parse_crs("EPSG:3832")  # its area crosses the antimeridian
    assert to_wgs84.check_area(pacific, (179.0, 179.1), (-20.0, -19.9), "a.laz") is None
