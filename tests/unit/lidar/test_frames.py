"""Frames and epochs against PROJ's pipelines, written out from the parameters of EPSG's register.

The judge shares no table with the package: rates and epochs stand here as the operations have them.
"""

from __future__ import annotations

import re
import struct

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from pyproj import CRS
from rasterio.transform import from_origin

from stereotruth.core.errors import InputError
from stereotruth.lidar.frames import (
    DEFAULT_EPOCH,
    Epoch,
    Epochs,
    frame_change,
    plate_at,
)
from stereotruth.lidar.height_raster import raster_header
from stereotruth.lidar.to_wgs84 import to_wgs84

from ...synthetic.las import header_of

# x, y, z (m), rx, ry, rz ("), s (ppm), their rates a year, and the epoch of the parameters.
NAD83 = (  # EPSG:10334, ITRF2020 to NAD83(2011); EPSG:10415, to NAD83(CSRS)v8, is the same
    "+inv +proj=helmert +x=1.0039 +y=-1.90961 +z=-0.54117 +rx=0.02678138 +ry=-0.00042027 "
    "+rz=0.01093206 +s=-5.109e-05 +dx=0.00079 +dy=-0.0007 +dz=-0.00124 +drx=6.667e-05 "
    "+dry=-0.00075744 +drz=-5.133e-05 +ds=-7.201e-05 +t_epoch=2010 +convention=coordinate_frame"
)
GDA2020 = (  # EPSG:8049, ITRF2014 to GDA2020; EPSG:9991, ITRF2014 to ITRF2020
    "+inv +proj=helmert +drx=0.00150379 +dry=0.00118346 +drz=0.00120716 +t_epoch=2020 "
    "+convention=coordinate_frame +step +proj=helmert +x=0.0014 +y=0.0009 +z=-0.0014 +s=0.00042 "
    "+dy=0.0001 +dz=-0.0002 +t_epoch=2015 +convention=position_vector"
)
ETRF2020 = (  # EPSG:10573
    "+inv +proj=helmert +rx=0.002236 +ry=0.013494 +rz=-0.019578 +drx=8.6e-05 +dry=0.000519 "
    "+drz=-0.000753 +t_epoch=2015 +convention=position_vector"
)
ETRF2000 = (  # EPSG:10586
    "+inv +proj=helmert +x=0.0538 +y=0.0518 +z=-0.0822 +rx=0.002106 +ry=0.01274 +rz=-0.020592 "
    "+s=0.00225 +dx=0.0001 +dz=-0.0017 +drx=8.1e-05 +dry=0.00049 +drz=-0.000792 +ds=0.00011 "
    "+t_epoch=2015 +convention=position_vector"
)
# EPSG:9996, ITRF96 to ITRF2020, its parameters brought to 2000.0: x - 15 dx and so on.
ITRF96_AT_2000 = (
    "+proj=helmert +x=-0.005 +y=-0.0051 +z=0.0314 +rz=-0.00006 +s=-0.00218 "
    "+convention=position_vector"
)
PLATES = {  # file ITRF2020 of PROJ: plate motion model of Altamimi et al. (2023)
    "AUST": "+drx=0.001487 +dry=0.001175 +drz=0.001223",
    "PCFC": "+drx=-0.000404 +dry=0.001021 +drz=-0.002154",
}
BIAS = "+dx=0.00037 +dy=0.00035 +dz=0.00074"


def plate(name: str, since: float, bias: str = BIAS) -> str:
    return f"+proj=helmert {bias} {PLATES[name]} +t_epoch={since} +convention=position_vector"


def by_proj(steps: str, lon: float, lat: float, height: float, epoch: float) -> np.ndarray:
    """Longitude, latitude, height by geocentric steps of PROJ at an epoch."""
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        f"+ellps=GRS80 +step {steps} +step +inv +proj=cart +ellps=GRS80 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    return np.array(pyproj.Transformer.from_pipeline(pipeline).transform(lon, lat, height, epoch))[
        :3
    ]


def metres(found: np.ndarray, judge: np.ndarray) -> np.ndarray:
    """East, north and up of ``found`` less ``judge``."""
    east, north, up = np.subtract(found, judge)
    return np.array([east * 111320 * np.cos(np.radians(judge[1])), north * 111200, up])


def placed(code: int, lon: float, lat: float, height: float, epochs: Epochs, **how) -> np.ndarray:
    """A place of the horizontal system ``code``, on its own datum, as a LAS file has it."""
    return through(CRS.from_epsg(code).to_wkt(), code, lon, lat, height, epochs, **how)


def through(
    wkt: str, code: int, lon: float, lat: float, height: float, epochs: Epochs | None, **how
) -> np.ndarray:
    system = CRS.from_epsg(code)
    x, y = pyproj.Transformer.from_crs(
        system.geodetic_crs.to_2d(), system.to_2d(), always_xy=True
    ).transform(lon, lat)
    header = header_of(wkt, low=(x - 50, y - 50, height - 50))
    transform = to_wgs84(header, "a.las", epochs=epochs, **how)
    return np.array([v[0] for v in transform(*(np.array([v]) for v in (x, y, height)))])


def at(year: float) -> Epochs:
    return Epochs(Epoch(year, "the test"))


# ------------------------------------------------------------------ national frames

NEW_ZEALAND = [f"{ITRF96_AT_2000} +step {plate(name, 2000)}" for name in ("AUST", "PCFC")]
COUNTRIES = [  # system, place, epoch of the images, PROJ's steps, metres in plan and up
    ("Jacksonville", 6346, (-81.66, 30.33), 2020.0, NAD83, (0.95, -1.48)),
    ("Seattle", 6339, (-122.3, 47.6), 2020.0, NAD83, (1.51, -0.32)),
    ("Vancouver", 3157, (-123.1, 49.25), 2023.4, NAD83, None),  # NAD83(CSRS) without a version
    ("Toronto", 22817, (-79.4, 43.7), 2018.0, NAD83, None),  # NAD83(CSRS)v8
    ("Florida, NAD83", 26917, (-81.66, 30.33), 2020.0, NAD83, None),
    ("Sydney", 7856, (151.2, -33.9), 2026.0, GDA2020, (0.34, 0.0)),
    ("Paris, RGF93 v1", 2154, (2.35, 48.85), 2020.0, ETRF2020, (0.74, 0.0)),
    ("Paris, RGF93 v2b", 9794, (2.35, 48.85), 2020.0, ETRF2000, None),
    ("Auckland", 2193, (174.8, -36.9), 2020.0, NEW_ZEALAND[0], None),
    ("Dunedin", 2193, (170.5, -45.9), 2021.5, NEW_ZEALAND[1], None),
]  # fmt: skip


@pytest.mark.parametrize(("name", "code", "place", "year", "steps", "size"), COUNTRIES)
def test_national_frames_reach_itrf2020(name, code, place, year, steps, size) -> None:
    judge = by_proj(steps, *place, 30.0, year)
    if "+t_epoch=2000" in steps:  # the model's advice: no vertical motion
        judge[2] = by_proj(steps.replace(BIAS, ""), *place, 30.0, year)[2]
    found = placed(code, *place, 30.0, at(year))
    assert np.abs(metres(found, judge)).max() < 1e-3
    change = metres(found, np.array([*place, 30.0]))
    assert 0.2 < np.hypot(*change[:2]) < 2.0
    if size is not None:
        assert (np.hypot(*change[:2]), change[2]) == pytest.approx(size, abs=0.006)


@pytest.mark.parametrize("form", ["WKT1_ESRI", "TOWGS84"])
@pytest.mark.parametrize(("code", "place"), [(6346, (-81.66, 30.33)), (25831, (2.3, 48.8))])
def test_frames_are_known_by_their_names_alone(code, place, form) -> None:
    wkt = CRS.from_epsg(code).to_wkt("WKT1_GDAL" if form == "TOWGS84" else form)
    wkt = re.sub(r',\s*AUTHORITY\["[^\]]*\]', "", wkt)
    if form == "TOWGS84":
        wkt = re.sub(r"(SPHEROID\[[^\]]*\])", r"\1,TOWGS84[0,0,0,0,0,0,0]", wkt)
    found = through(wkt, code, *place, 30.0, at(2024.0))
    judge = placed(code, *place, 30.0, at(2024.0))
    assert np.abs(metres(found, judge)).max() < 1e-4


# ------------------------------------------------------------------ WGS 84 and dynamic frames


def test_wgs84_without_a_frame_is_taken_as_it_is() -> None:
    wkt = CRS.from_epsg(32650).to_wkt()
    before = through(wkt, 32650, 117.0, 31.0, 50.0, None)
    np.testing.assert_array_equal(before, through(wkt, 32650, 117.0, 31.0, 50.0, at(2020.0)))
    header = header_of(wkt)
    record = to_wgs84(header, "a.las", epochs=at(2020.8)).describe()["frame"]
    assert (record["frame"], record["epoch"]) == ("ITRF2020", 2020.8)
    assert record["source"]["epoch"] == 2020.8
    assert "WGS 84" in record["source"]["frame"]


def test_a_stated_epoch_is_taken_in_wgs84_and_dynamic_frames() -> None:
    place = (151.2, -33.9)
    judge = by_proj(plate("AUST", 2010.25), *place, 30.0, 2020.0)
    judge[2] = by_proj(plate("AUST", 2010.25, bias=""), *place, 30.0, 2020.0)[2]
    epochs = at(2020.0)._replace(own=2010.25)
    assert np.abs(metres(placed(32756, *place, 30.0, epochs), judge)).max() < 1e-3
    wkt = CRS.from_epsg(9000).to_wkt()  # ITRF2014
    with pytest.raises(InputError, match=r"a\.las.*ITRF2014 move by 57 mm.*lidar_epoch"):
        through(wkt, 9000, *place, 30.0, at(2020.0))
    by_column = through(wkt, 9000, *place, 30.0, epochs)
    to_2020 = GDA2020.split("+step ")[1]
    steps = to_2020.replace("+dy=0.0001 +dz=-0.0002 +t_epoch=2015", "")
    steps = steps.replace("+y=0.0009 +z=-0.0014", "+y=0.000425 +z=-0.00045")  # at 2010.25
    judge = by_proj(f"{steps} +step {plate('AUST', 2010.25)}", *place, 30.0, 2020.0)
    steps += f" +step {plate('AUST', 2010.25, bias='')}"
    judge[2] = by_proj(steps, *place, 30.0, 2020.0)[2]
    assert np.abs(metres(by_column, judge)).max() < 1e-3
    stated = f"COORDINATEMETADATA[{wkt}, EPOCH[2010.25]]"
    by_file = through(stated, 9000, *place, 30.0, at(2020.0)._replace(own=2016.0))
    np.testing.assert_array_equal(by_file, by_column)


def test_the_geokey_of_the_epoch_is_read() -> None:
    keys = [(1024, 0, 1, 2), (2048, 0, 1, 9000), (5120, 34736, 1, 0)]
    header = header_of("", keys, low=(151.1, -34.0, 0), wkt_bit=False)
    header.maxs = header.mins + np.array([0.2, 0.2, 100])
    header.vlrs.append(laspy.VLR("LASF_Projection", 34736, "", np.float64(2010.25).tobytes()))
    record = to_wgs84(header, "a.las", epochs=at(2020.0)).frame
    assert record["source"]["epoch"] == 2010.25


def test_the_epoch_of_a_geotiff_is_read(tmp_path) -> None:
    """rasterio does not write it: a key that GDAL can do without is made one."""
    file = tmp_path / "a.tif"
    with rasterio.open(
        file, "w", driver="GTiff", width=40, height=40, count=1, dtype="float32", crs="EPSG:9000",
        transform=from_origin(151.2, -33.9, 1e-5, 1e-5),
    ) as raster:  # fmt: skip
        raster.write(np.full((1, 40, 40), 20, np.float32))
    data = file.read_bytes()
    before = struct.pack("<3H", 2057, 34736, 1)  # semi-major axis
    assert before in data
    data = data.replace(before, struct.pack("<3H", 5120, 34736, 1))
    file.write_bytes(data.replace(struct.pack("<d", 6378137.0), struct.pack("<d", 2010.25)))
    header, system = raster_header(file)
    record = to_wgs84(header, file, epochs=at(2020.0), declared=system).frame
    assert record["source"]["epoch"] == 2010.25


@pytest.mark.parametrize(
    ("code", "place"),
    [(4326, (7.4, 46.9)), (4214, (110.0, 30.0))],
)  # WGS 84, Beijing 1954
def test_other_frames_are_left_to_proj(code, place) -> None:
    assert frame_change(CRS.from_epsg(code), place, DEFAULT_EPOCH) is None


# ------------------------------------------------------------------ plates


@pytest.mark.parametrize(
    ("place", "name"),
    [((170.97, -42.72), "AUST"), ((172.6, -43.5), "PCFC"), ((-176.5, -44.0), "PCFC"),
     ((-118.2, 34.0), "PCFC"), ((-122.3, 47.6), "NOAM"), ((114.3, 30.6), "EURA"),
     ((127.0, 37.6), "AMUR"), ((77.2, 28.6), "INDI"), ((28.0, -26.2), "NUBI"),
     ((139.7, 35.7), None), ((29.0, 40.0), None)],
)  # fmt: skip
def test_plates_of_places(place, name) -> None:
    assert plate_at(*place) == name
    assert plate_at(place[0] + 360.0, place[1]) == name
