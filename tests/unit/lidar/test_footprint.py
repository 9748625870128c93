"""Footprints as cells of the lattice, and stores of what files have there."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.numerics.degrees import metres_per_degree
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.lattice import CELL_DEG, Footprint
from stereotruth.lidar.point_statistics import points_per_m2
from stereotruth.lidar.point_store import PointStore, open_stores, query_points

from ...synthetic.copc_server import CORNER, make_copc
from ...synthetic.las import SOUTH, UTM, WEST, write_las
from ...synthetic.stores import content_of, part_of, tree_digest
from ...synthetic.surface_rasters import write_raster

LON, LAT = 117.0, 29.83  # of WEST, SOUTH


def square(lon: float, lat: float, side_m: float) -> np.ndarray:
    """The outline [2, 4] of a square around a place."""
    half = side_m / 2 / metres_per_degree(lat)
    return np.array([[lon], [lat]]) + half[:, None] * [[-1, 1, 1, -1], [-1, -1, 1, 1]]


def ingested(file: Path, footprint: Footprint | None, **how) -> PointStore:
    store = file.with_name("part.points" if footprint else "whole.points")
    ingest(file, store, footprint=footprint, **how)
    return PointStore(store)


# ------------------------------------------------------------------ cells


@pytest.mark.parametrize("seed", range(5))
def test_all_places_within_the_margin_are_in_it(seed):
    rng = np.random.default_rng(seed)
    corners = np.array([[114.0], [rng.uniform(-70, 70)]]) + rng.uniform(-0.02, 0.02, (2, 3))
    footprint = Footprint.around([corners], 150.0)
    shares = rng.dirichlet(np.ones(3), 4000).T
    angle = rng.uniform(0, 2 * np.pi, 4000)
    reach = 150.0 / metres_per_degree(corners[1].mean())[:, None] * [np.cos(angle), np.sin(angle)]
    places = np.rint((corners @ shares + 0.99 * reach) * 1e9).astype(np.int64)
    assert footprint.contains(places).all()
    # and no more than the margin and the cells at its rim
    metres = corners * metres_per_degree(corners[1].mean())[:, None]
    sides = np.roll(metres, -1, axis=1) - metres
    area = abs(np.linalg.det(sides[:, :2])) / 2
    wide = np.sqrt(2) * (150 + 117)
    around = area + np.hypot(*sides).sum() * wide + np.pi * wide**2
    assert area < footprint.area_m2 < around
    assert Footprint.of_runs(footprint.runs).runs == footprint.runs


def test_boxes_are_told_by_their_cells():
    rng = np.random.default_rng(2)
    held = rng.random((9, 7)) < 0.3
    footprint = Footprint(29_000, 109_000, held)
    first = rng.integers(-2, 10, (500, 2))
    size = rng.integers(0, 4, (500, 2))
    low = (np.array([29_000, 109_000]) + first + 0.5) * CELL_DEG
    boxes = np.hstack([low[:, ::-1], (low + size * CELL_DEG)[:, ::-1]])
    padded = np.pad(held, 20)
    windows = [
        padded[r + 20 : r + 21 + h, c + 20 : c + 21 + w] for (r, c), (h, w) in zip(first, size)
    ]
    assert footprint.touches(boxes).tolist() == [bool(w.any()) for w in windows]
    assert footprint.covers(boxes).tolist() == [bool(w.all()) for w in windows]


# ------------------------------------------------------------------ stores of a footprint


@pytest.mark.parametrize("kind", ["las", "laz", "copc", "tif"])
def test_a_store_is_that_of_the_whole_file_cropped(tmp_path, kind):
    footprint = Footprint.around([square(LON + 0.006, LAT + 0.006, 300)], 50.0)
    file = tmp_path / f"a.{kind}"
    if kind == "tif":
        heights = np.random.default_rng(0).uniform(20, 60, (300, 400)).astype(np.float32)
        footprint = Footprint.around([square(LON + 0.0011, LAT, 20)], 5.0)
        write_raster(file, heights, 2.0)
    elif kind == "copc":
        file = tmp_path / "a.copc.laz"
        file.write_bytes(make_copc(100_000).content)
    else:
        write_las(file, 30_000, side=2000.0)
    whole = ingested(file, None)
    part = ingested(file, footprint)
    assert content_of(part) == part_of(whole, footprint)
    points = part.attrs["points"]
    assert 0 < part.count < whole.count / 2
    assert points["kept"] + points["outside"] + sum(points["dropped"].values()) == points["read"]
    assert part.footprint.runs == footprint.runs
    if kind == "copc":
        assert points["read"] < 0.6 * points["header"]
        assert part.attrs["nodes"][0] < part.attrs["nodes"][1]
        assert part.attrs["bytes"][0] < 0.7 * part.attrs["bytes"][1]


def test_whole_files_are_the_same_by_any_footprint_around_them(tmp_path):
    write_las(tmp_path / "a.laz", 3000)
    whole = ingested(tmp_path / "a.laz", None)
    around = ingested(tmp_path / "a.laz", Footprint.around([square(LON, LAT, 9000)], 0.0))
    assert content_of(whole) == content_of(around)


def test_a_file_beside_the_footprint_is_not_decoded(tmp_path, monkeypatch):
    file = tmp_path / "a.laz"
    write_las(file)
    monkeypatch.setattr("stereotruth.lidar.las_files.read_chunks", None)
    store = ingested(file, Footprint.around([square(LON + 1, LAT, 500)], 100.0))
    assert store.count == 0 and store.attrs["bytes"][0] == 0
    west, south, east, north = store.bounds[:4]
    assert west < LON + 0.001 < east and south < LAT + 0.001 < north


@pytest.mark.parametrize("fault", ["elsewhere", "never filled in", "inverted"])
@pytest.mark.parametrize("kind", ["las", "laz"])
def test_a_header_with_wrong_bounds_loses_nothing(tmp_path, fault, kind):
    """Points inside of the footprint, and a header that says that they lie elsewhere."""
    file = tmp_path / f"a.{kind}"
    write_las(file, 5000)
    whole = ingested(file, None)
    content = bytearray(file.read_bytes())
    bounds = {  # max x, min x, max y, min y
        "elsewhere": (WEST + 9000, WEST + 8300, SOUTH + 700, SOUTH),
        "never filled in": (0.0, 0.0, 0.0, 0.0),
        "inverted": (WEST + 8300, WEST + 9000, SOUTH, SOUTH + 700),
    }[fault]
    struct.pack_into("<4d", content, 179, *bounds)
    if fault == "never filled in":
        struct.pack_into("<2d", content, 211, 0.0, 0.0)
    file.write_bytes(content)
    footprint = Footprint.around([square(LON + 0.003, LAT + 0.003, 2000)], 200.0)
    try:
        assert content_of(ingested(file, footprint)) == content_of(whole)
        assert fault != "elsewhere"
    except InputError as error:
        assert "the header says" in str(error) or "look like degrees" in str(error)


def test_bounds_that_are_a_little_wrong_are_caught_by_the_points_all_over_the_file(tmp_path):
    file = tmp_path / "a.las"
    xyz = write_las(file, 5000)
    header = laspy.open(file).header
    content = bytearray(file.read_bytes())
    struct.pack_into("<4d", content, 179, WEST + 700, WEST + 691, SOUTH + 700, SOUTH)
    file.write_bytes(content)
    assert header.point_count == len(xyz)
    from stereotruth.lidar.las_files import is_outside_sampled, read_header

    assert is_outside_sampled(file, read_header(file))


# ------------------------------------------------------------------ stores without a point


@pytest.fixture
def empty(tmp_path) -> PointStore:
    write_las(tmp_path / "e.laz", seed=9)
    beside = Footprint.around([square(LON + 0.1, LAT, 500)], 100.0)
    ingest(tmp_path / "e.laz", tmp_path / "e.points", footprint=beside)
    return PointStore(tmp_path / "e.points")


def test_a_store_without_points_opens_and_answers(empty):
    assert empty.count == 0 and empty.cell_counts.size == 0
    assert len(empty.query(*empty.bounds[:4])) == 0
    assert empty.height_range(*empty.bounds[:4]) is None
    assert len(query_points([empty], *empty.bounds[:4])) == 0


def test_stores_without_points_have_no_say(empty, tmp_path):
    write_las(tmp_path / "a.laz", 9000)
    full = ingested(tmp_path / "a.laz", None)
    assert [s.path for s in open_stores([empty.path, full.path])] == [full.path]
    assert [s.path for s in open_stores([empty.path])] == [empty.path]
    assert points_per_m2([full, empty]) == points_per_m2([full])


def test_a_file_whose_points_are_all_dropped_is_refused_still(tmp_path):
    write_las(tmp_path / "a.laz", 100, classification=np.full(100, 7, np.uint8))
    footprint = Footprint.around([square(LON, LAT, 9000)], 0.0)
    with pytest.raises(InputError, match="no point is left of 100"):
        ingested(tmp_path / "a.laz", footprint)


def test_chunks_leave_no_trace(tmp_path):
    (tmp_path / "a.copc.laz").write_bytes(make_copc(30_000).content)
    footprint = Footprint.around([square(LON + 0.006, LAT + 0.006, 300)], 50.0)
    digests = set()
    for k, how in enumerate(({}, {"chunk_points": 333})):
        ingest(tmp_path / "a.copc.laz", tmp_path / f"{k}.points", footprint=footprint, **how)
        digests.add(tree_digest(tmp_path / f"{k}.points"))
    assert len(digests) == 1


def test_degrees_of_boxes_lie_around_their_ground():
    """Boxes of some metres to 100 km against a fine grid of their places."""
    from stereotruth.lidar.to_wgs84 import to_wgs84

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", UTM.to_wkt().encode() + b"\0"))
    header.mins, header.maxs = CORNER, CORNER + 1000
    transform = to_wgs84(header, "a.las")
    for side in (10.0, 1000.0, 1e5):
        low = CORNER + side * np.array([[-2, 0, 0], [1, 3, 0]])
        boxes = transform.ground_boxes(low, low + side)
        for box, corner in zip(boxes, low):
            x, y = np.meshgrid(*(corner[k] + side * np.linspace(0, 1, 60) for k in (0, 1)))
            lon, lat, _ = transform(x.ravel(), y.ravel(), np.zeros(x.size))
            assert box[0] <= lon.min() and lon.max() <= box[2]
            assert box[1] <= lat.min() and lat.max() <= box[3]
            assert box[2] - box[0] < 1.2 * np.ptp(lon)
