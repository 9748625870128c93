"""Ingest of LiDAR files into point stores, and queries on these."""

from __future__ import annotations

import importlib
import logging
import struct

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar import lattice
from stereotruth.lidar.frames import Epoch, Epochs
from stereotruth.lidar.ingest import ingest, survey
from stereotruth.lidar.point_store import PointStore
from stereotruth.lidar.to_wgs84 import to_wgs84

from ...synthetic.las import SOUTH, WEST, everything, refused, write_las
from ...synthetic.real_data import SHARED
from ...synthetic.stores import tree_digest


def by_position(lon: np.ndarray, lat: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Sorted lattice coordinates, int64[n, 3]."""
    q = np.column_stack([np.rint(lon * 1e9), np.rint(lat * 1e9), np.rint(height * 1e4)])
    return q[np.lexsort(q.T)].astype(np.int64)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    ("version", "pdrf"), [("1.2", 0), ("1.1", 1), ("1.3", 5), ("1.4", 6), ("1.4", 10)]
)
def test_points_keep_their_place_and_attributes(tmp_path, version, pdrf, suffix) -> None:
    """Against pyproj on the coordinates that laspy reads back: within one lattice step."""
    file = tmp_path / f"a.{suffix}"
    rng = np.random.default_rng(1)
    classes, most = rng.integers(0, 7, 3000), 15 if pdrf >= 6 else 7
    fields = {
        "return_number": rng.integers(0, most + 1, 3000),
        "number_of_returns": rng.integers(0, most + 1, 3000),
        "synthetic": rng.integers(0, 2, 3000),  # neighbours of the bits that are read
        "key_point": rng.integers(0, 2, 3000),
        "scan_direction_flag": rng.integers(0, 2, 3000),
        "user_data": rng.integers(0, 256, 3000),
    }
    if pdrf >= 6:
        classes = rng.integers(0, 256, 3000)
        fields |= {
            "overlap": rng.integers(0, 2, 3000),
            "scanner_channel": rng.integers(0, 4, 3000),
        }
    xyz = write_las(file, pdrf=pdrf, version=version, classification=classes, **fields)
    result = ingest(file, tmp_path / "a.points", lidar_crs="EPSG:32650", drop_classes=())
    assert result["points"]["header"] == result["points"]["read"] == 3000
    assert result["points"]["kept"] == 3000
    got = everything(PointStore(tmp_path / "a.points"))
    truth = pyproj.Transformer.from_crs("EPSG:32650", "EPSG:4326", always_xy=True)
    lon, lat = truth.transform(xyz[:, 0], xyz[:, 1])
    expected = by_position(lon, lat, xyz[:, 2])
    np.testing.assert_allclose(by_position(got.lon, got.lat, got.height), expected, atol=1)
    order = np.argsort(lon)
    assert np.array_equal(got.classification[np.argsort(got.lon_q)], classes[order])
    with laspy.open(file) as reader:
        las = reader.read()
    for name in ("return_number", "number_of_returns"):
        value = getattr(got, name)[np.argsort(got.lon_q)]
        assert np.array_equal(value, np.asarray(getattr(las, name))[order])


def test_store_is_the_same_to_the_byte_whatever_the_chunks(tmp_path, monkeypatch) -> None:
    module = importlib.import_module(ingest.__module__)
    write_las(tmp_path / "a.laz", 20_000)
    digests = set()
    for k, (chunk, kept_in_memory) in enumerate([(333, 1 << 20), (7000, 9000), (10**6, 1)]):
        monkeypatch.setattr(module, "SCRATCH_POINTS", kept_in_memory)
        store = tmp_path / f"{k}.points"
        ingest(tmp_path / "a.laz", store, chunk_points=chunk)
        digests.add(tree_digest(store))
        assert not list(store.rglob("*scratch*"))
    assert len(digests) == 1
    assert PointStore(tmp_path / "0.points").count == 20_000


def test_the_datum_operation_follows_from_the_points(tmp_path, caplog) -> None:
    """Not from the header's box: one 500 km too large moved every point by up to 1.1 m."""
    x, y = pyproj.Transformer.from_crs(4326, 23030, always_xy=True).transform(-2.7, 40.3)
    xyz = np.array([x, y, 600]) + np.random.default_rng(0).uniform(0, 300, (900, 3))
    write_las(tmp_path / "a.laz", xyz=xyz, system=pyproj.CRS("EPSG:23030"))
    with caplog.at_level(logging.INFO, "stereotruth"):
        good = ingest(tmp_path / "a.laz", tmp_path / "good.points")
    assert f"a.laz: brought to WGS 84 by '{good['crs']['operation']}'" in caplog.text
    data = bytearray((tmp_path / "a.laz").read_bytes())
    for k, sign in enumerate((1, -1, 1, -1)):
        at = 179 + 8 * k
        struct.pack_into("<d", data, at, struct.unpack_from("<d", data, at)[0] + sign * 5e5)
    (tmp_path / "a.laz").write_bytes(data)
    header = laspy.open(tmp_path / "a.laz").header
    assert to_wgs84(header, "a.laz").operation != good["crs"]["operation"]
    assert ingest(tmp_path / "a.laz", tmp_path / "bad.points") == good
    assert tree_digest(tmp_path / "bad.points") == tree_digest(tmp_path / "good.points")


def test_points_of_a_cell_keep_the_order_of_the_file(tmp_path) -> None:
    xyz = np.random.default_rng(0).uniform(0, 700, (5000, 3)) + np.array([WEST, SOUTH, 0])
    xyz[:, 2] = np.arange(5000) * 0.1  # the height tells the place in the file
    write_las(tmp_path / "a.laz", xyz=xyz)
    ingest(tmp_path / "a.laz", tmp_path / "a.points", chunk_points=700)
    got = everything(PointStore(tmp_path / "a.points"))
    cell = np.column_stack([got.lat_q >> lattice.CELL_BITS, got.lon_q >> lattice.CELL_BITS])
    changes = np.flatnonzero((np.diff(cell, axis=0) != 0).any(axis=1)) + 1
    visited = cell[np.r_[0, changes]]
    assert len(np.unique(visited, axis=0)) == len(visited) > 20  # each cell is one range
    assert np.array_equal(np.lexsort(visited.T[::-1]), np.arange(len(visited)))  # row-major
    for part in np.split(got.h_q, changes):
        assert (np.diff(part) > 0).all()


@pytest.mark.parametrize("pdrf", [1, 6])
def test_noise_and_withheld_points_are_dropped_and_counted(tmp_path, pdrf) -> None:
    classes = np.full(1000, 2, np.uint8)
    classes[:30], classes[30:50], classes[50:60] = 7, 18, 12
    withheld = np.zeros(1000, np.uint8)
    withheld[25:35], withheld[900:] = 1, 1
    synthetic = np.ones(1000, np.uint8)
    write_las(
        tmp_path / "a.laz",
        1000,
        pdrf=pdrf,
        version="1.2" if pdrf < 6 else "1.4",
        classification=classes,
        withheld=withheld,
        synthetic=synthetic,
    )
    result = ingest(tmp_path / "a.laz", tmp_path / "a.points")
    assert result["points"] == {
        "header": 1000,
        "read": 1000,
        "outside": 0,
        "kept": 850,
        "dropped": {"withheld": 110, "class 7": 25, "class 18": 15},
    }
    assert result["classes"] == {"2": 840, "12": 10}
    kept = ingest(tmp_path / "a.laz", tmp_path / "b.points", drop_classes=())
    assert kept["points"]["kept"] == 890


def test_coarse_and_quantised_coordinates(tmp_path) -> None:
    xyz = np.random.default_rng(0).uniform(0, 0.1, (2000, 3))
    xyz += [114, 30, 0]
    system = pyproj.CRS("EPSG:4979")
    write_las(tmp_path / "a.laz", xyz=xyz, system=system, scale=0.01)
    refused(tmp_path / "a.laz", "steps of 0.01, 1113 m on the ground")
    write_las(tmp_path / "b.laz", xyz=np.round(xyz, 2), system=system, scale=1e-7)
    refused(tmp_path / "b.laz", r"2000 points lie on \d+ positions")


def test_heights_with_a_geoid_and_survey_feet(tmp_path) -> None:
    head = struct.pack(">4d2i", 29.0, 116.0, 0.1, 0.1, 21, 21)
    (tmp_path / "n.gtx").write_bytes(head + np.full(441, -12.5, ">f4").tobytes())
    system = pyproj.CRS("EPSG:32650+6360")  # NAVD88 in survey feet, for the unit's sake
    noise = np.where(np.arange(3000) < 1000, 7, 2).astype(np.uint8)  # one whole chunk of it
    xyz = write_las(tmp_path / "a.laz", system=system, classification=noise)
    result = ingest(
        tmp_path / "a.laz", tmp_path / "a.points", geoid=tmp_path / "n.gtx", chunk_points=1000
    )
    got = everything(PointStore(tmp_path / "a.points"))
    expected = np.sort(xyz[1000:, 2]) * 1200 / 3937 - 12.5
    np.testing.assert_allclose(np.sort(got.height), expected, rtol=0, atol=6e-5)
    assert result["crs"]["geoid"] == "n.gtx"


# ------------------------------------------------------------------ real files

REAL = SHARED / "lidar"
FLAT_N = -22.5  # m, of the geoid grid made for these tests: everywhere the same

# file, arguments, and what is to come of them: the reason of refusal, or
# (points kept, EPSG code of the horizontal system, metres per unit of height)
REAL_FILES = [
    ("autzen_trim.laz", {}, (110_000, 2994, 0.3048)),
    ("autzen-bmx-2010.las", {}, "NAVD88"),
    ("autzen-bmx-2010.las", {"geoid": True}, (829, 2991, 1200 / 3937)),
    # with a page in its hierarchy
    ("simple_with_page.copc.laz", {"geoid": True}, (1_065, 2991, 1200 / 3937)),
    ("test_semis_2021_0382_6565_LA93_IGN69_cropped.laz", {}, "IGN69"),
    (
        "test_semis_2021_0382_6565_LA93_IGN69_cropped.laz",
        {"geoid": True, "lidar_crs": "EPSG:2154+5720", "drop_classes": (7, 18, 65, 67)},
        (218_731 - 96, 2154, 1.0),
    ),
    ("test_noepsg_043500_629205_IGN69.laz", {}, "lidar_crs"),
    ("test_noepsg_043500_629205_IGN69.laz", {"lidar_crs": "EPSG:2154"}, "IGN69"),
    ("32-1-472-150-76.laz", {}, "NN2000"),  # GeoTIFF key 4096 = 5941, which laspy passes over
    ("1.2-with-color-clipped.las", {"lidar_crs": "EPSG:2992"}, "1065 points, the file holds 1064"),
    ("lonlat_scale0.01deg.laz", {"lidar_crs": "EPSG:4979"}, "steps of 0.01"),
    ("lonlat_scale0.01deg.laz", {"lidar_crs": "EPSG:32636"}, "look like degrees"),
]


@pytest.mark.skipif(not REAL.is_dir(), reason="shared real files are absent")
@pytest.mark.parametrize(("name", "arguments", "expected"), REAL_FILES)
def test_real_files_are_read_right_or_refused_by_name(tmp_path, name, arguments, expected) -> None:
    arguments = dict(arguments)
    if arguments.get("geoid"):
        head = struct.pack(">4d2i", -90.0, -180.0, 1.0, 1.0, 181, 360)
        arguments["geoid"] = tmp_path / "flat.gtx"
        arguments["geoid"].write_bytes(head + np.full(181 * 360, FLAT_N, ">f4").tobytes())
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected) as error:
            ingest(REAL / name, tmp_path / "a.points", **arguments)
        assert name in str(error.value)
        assert not (tmp_path / "a.points").exists()
        return
    kept, epsg, unit = expected
    result = ingest(REAL / name, tmp_path / "a.points", **arguments)
    assert result["points"]["kept"] == kept
    with laspy.open(REAL / name) as reader:
        las = reader.read()
    assert result["points"]["read"] == result["points"]["header"] == len(las.points)
    good = ~np.isin(las.classification, arguments.get("drop_classes", (7, 18)))
    x, y, z = np.array(las.x)[good], np.array(las.y)[good], np.array(las.z)[good]
    system = pyproj.CRS(epsg).to_3d()
    truth = pyproj.Transformer.from_crs(system, "EPSG:4979", always_xy=True)
    lon, lat, height = truth.transform(x, y, z * unit)
    if arguments.get("geoid"):
        height += FLAT_N
    got = everything(PointStore(tmp_path / "a.points"))
    for ours, theirs in ((got.lon, lon), (got.lat, lat)):
        np.testing.assert_allclose(np.sort(ours), np.sort(theirs), rtol=0, atol=1.1e-9)
    np.testing.assert_allclose(np.sort(got.height), np.sort(height), rtol=0, atol=6e-5)
    pairs = [np.column_stack(q) for q in ((got.lon, got.lat, got.height), (lon, lat, height))]
    sums = [(p[:, 0] - lon.mean()) @ p[:, 2] for p in pairs]  # the heights are at their places
    assert sums[0] == pytest.approx(sums[1], abs=1e-6 * len(lon))


def test_a_header_says_what_the_points_are(tmp_path):
    file = tmp_path / "a.laz"
    write_las(file, 5000)
    found, read = survey(file), ingest(file, tmp_path / "a.points")
    assert found.points == read["points"]["read"]
    box, points = np.array(found.box), np.array(read["bounds"])
    np.testing.assert_allclose(box, points[:4], atol=1e-6)  # corners of a box turned in degrees
    assert (box[:2] <= points[:2]).all() and (box[2:] >= points[2:4]).all()
    np.testing.assert_allclose(found.heights, points[4:], atol=1e-3)
    assert found.notes == tuple(read["notes"]) and found.surface == read["crs"]["heights"]
    assert found.area_m2 == pytest.approx(700 * 700, rel=0.01)
    write_las(file, 500, system=None)
    with pytest.raises(InputError):
        survey(file)
    assert survey(file, lidar_crs="EPSG:32650").system.startswith("WGS 84 / UTM zone 50N")


def test_points_are_brought_to_the_epoch_of_the_images(tmp_path):
    """As to_wgs84 does, against which test_frames holds PROJ's own pipelines."""
    epochs = Epochs(Epoch(2014.82, "the test"))
    system, file = pyproj.CRS("EPSG:6339").to_3d(), tmp_path / "a.las"  # NAD83(2011) / UTM 10N
    xyz = np.array([550_000, 5_272_000, 50]) + np.random.default_rng(1).uniform(0, 300, (40, 3))
    xyz = write_las(file, system=system, xyz=xyz)
    frame = ingest(file, tmp_path / "a.points", epochs=epochs)["crs"]["frame"]
    points = everything(PointStore(tmp_path / "a.points"))
    expected = to_wgs84(laspy.open(file).header, file, epochs=epochs)(*xyz.T)
    found = by_position(points.lon, points.lat, points.height)
    np.testing.assert_array_equal(found, by_position(*expected))
    assert (frame["frame"], frame["epoch"], frame["by"]) == ("ITRF2020", 2014.82, "the test")
