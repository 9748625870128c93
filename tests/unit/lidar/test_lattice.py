"""Footprints as cells of the lattice, and stores of what files have there."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.numerics.geometry import metres_per_degree
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.las_files import is_outside_sampled, read_header
from stereotruth.lidar.lattice import CELL_DEG, Footprint, refuse_apart
from stereotruth.lidar.point_statistics import points_per_m2
from stereotruth.lidar.point_store import PointStore, open_stores, query_points

from ...synthetic.las import SOUTH, WEST, write_las
from ...synthetic.stores import content_of, part_of
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


@pytest.mark.parametrize("seed", range(3))
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
    first, size = rng.integers(-2, 10, (500, 2)), rng.integers(0, 4, (500, 2))
    low = (np.array([29_000, 109_000]) + first + 0.5) * CELL_DEG
    boxes = np.hstack([low[:, ::-1], (low + size * CELL_DEG)[:, ::-1]])
    padded = np.pad(held, 20)
    windows = [
        padded[r + 20 : r + 21 + h, c + 20 : c + 21 + w] for (r, c), (h, w) in zip(first, size)
    ]
    assert footprint.touches(boxes).tolist() == [bool(w.any()) for w in windows]
    missing = np.array([(~w).sum() for w in windows])
    cell_m2 = footprint.cell_m2[0]
    assert np.isclose(footprint.beyond_m2(boxes), missing.sum() * cell_m2, rtol=1e-3)


@pytest.mark.parametrize("kind", ["las", "laz", "tif"])
def test_a_store_is_that_of_the_whole_file_cropped(tmp_path, kind):
    """That of COPC: test_octree."""
    footprint = Footprint.around([square(LON + 0.006, LAT + 0.006, 300)], 50.0)
    file = tmp_path / f"a.{kind}"
    if kind == "tif":
        heights = np.random.default_rng(0).uniform(20, 60, (300, 400)).astype(np.float32)
        footprint = Footprint.around([square(LON + 0.0011, LAT, 20)], 5.0)
        write_raster(file, heights, 2.0)
    else:
        write_las(file, 30_000, side=2000.0)
    whole, part = ingested(file, None), ingested(file, footprint)
    assert content_of(part) == part_of(whole, footprint)
    points = part.attrs["points"]
    assert 0 < part.count < whole.count / 2
    assert points["kept"] + points["outside"] + sum(points["dropped"].values()) == points["read"]
    assert part.footprint.runs == footprint.runs


@pytest.mark.parametrize("fault", ["elsewhere", "never filled in", "inverted"])
def test_a_header_with_wrong_bounds_loses_nothing(tmp_path, fault):
    """Points inside of the footprint, and a header that says that they lie elsewhere."""
    file = tmp_path / "a.laz"
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
    write_las(file, 5000)
    content = bytearray(file.read_bytes())
    struct.pack_into("<4d", content, 179, WEST + 700, WEST + 691, SOUTH + 700, SOUTH)
    file.write_bytes(content)
    assert is_outside_sampled(file, read_header(file))


def test_a_store_without_points_opens_answers_and_has_no_say(tmp_path, monkeypatch):
    write_las(tmp_path / "a.laz", 9000)
    full = ingested(tmp_path / "a.laz", None)
    monkeypatch.setattr("stereotruth.lidar.las_files.read_chunks", None)  # nothing is decoded
    empty = ingested(
        tmp_path / "a.laz", Footprint.around([square(LON + 0.1, LAT, 500)], 100.0)
    )  # fmt: skip
    assert empty.count == 0 and empty.attrs["bytes"][0] == 0
    west, south, east, north = empty.bounds[:4]
    assert west < LON + 0.001 < east and south < LAT + 0.001 < north
    assert len(query_points([empty], *empty.bounds[:4])) == 0
    assert empty.height_range(*empty.bounds[:4]) is None
    assert [s.path for s in open_stores([empty.path, full.path])] == [full.path]
    assert [s.path for s in open_stores([empty.path])] == [empty.path]
    assert points_per_m2([full, empty]) == points_per_m2([full])


@pytest.mark.parametrize(
    ("lidar", "words"),
    [
        ((29.9, 116.9, 30.1, 117.1), "swapped"),
        ((127.0, 30.0, 127.1, 30.1), "9.9 degrees away"),
        ((117.2, 30.0, 117.3, 30.1), "no overlap"),
    ],
)
def test_points_elsewhere_are_refused_by_what_is_wrong(lidar, words):
    with pytest.raises(InputError, match=words):
        refuse_apart(lidar, (117.0, 30.0, 117.1, 30.1), (0.0, 9.0), Path("a.las"))
