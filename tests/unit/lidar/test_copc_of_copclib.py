"""COPC that other software has written: what of it is read is what laspy has of the whole."""

from __future__ import annotations

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.lidar.footprint import Footprint
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.octree import open_octree
from stereotruth.lidar.point_store import PointStore

from ...synthetic.copc_of_copclib import page_count, write_copc
from ...synthetic.copc_server import points_of, serving
from ...synthetic.stores import content_of, part_of

pytest.importorskip("copclib")
LOW = np.array([500_000.0, 3_300_000.0, 30.0])
SYSTEM = pyproj.CRS("EPSG:32650").to_3d()


def las_of(form: int, points: int = 12_000, relief: float = 60.0, seed: int = 0) -> laspy.LasData:
    """Strewn points of a surface, some far above it, of a point format."""
    rng = np.random.default_rng(seed)
    header = laspy.LasHeader(point_format=form, version="1.4")
    header.scales, header.offsets = [0.01] * 3, LOW
    header.add_crs(SYSTEM)
    las = laspy.LasData(header)
    xyz = rng.uniform(0, 1500, (points, 3))
    xyz[:, 2] = relief * np.sin(xyz[:, 0] / 90) + np.where(rng.random(points) < 0.01, 900, 0)
    las.x, las.y, las.z = (xyz + LOW).T
    las.classification = rng.integers(1, 7, points).astype(np.uint8)
    las.number_of_returns = rng.integers(1, 5, points).astype(np.uint8)
    las.return_number = np.minimum(las.number_of_returns, rng.integers(1, 5, points)).astype("u1")
    las.gps_time = rng.uniform(1e8, 2e8, points)
    return las


@pytest.mark.parametrize("form", [6, 7, 8])
def test_all_points_are_those_of_laspy(tmp_path, form):
    file = write_copc(tmp_path / "tile.copc.laz", las_of(form, 9000))
    octree = open_octree(file)
    whole = laspy.read(file)
    got = points_of(list(octree.read(octree.plan(None))))
    assert np.array_equal(got, points_of([whole.points]))
    assert octree.points == 9000


@pytest.mark.parametrize("page_levels", [(), (2,), (1, 2, 3)])
def test_stores_of_footprints_are_those_of_the_whole_cropped(tmp_path, page_levels):
    """With nested pages, and nodes without points above others."""
    file = write_copc(tmp_path / "tile.copc.laz", las_of(6), page_levels=page_levels)
    assert page_count(file) > 10 * len(page_levels)
    ingest(file, tmp_path / "whole.points")
    whole = PointStore(tmp_path / "whole.points")
    west, south, east, north = whole.bounds[:4]
    rng = np.random.default_rng(len(page_levels))
    counts = []
    for k in range(6):
        corners = rng.uniform([[west], [south]], [[east], [north]], (2, 3))
        footprint = Footprint.around([corners], 20.0)
        store = tmp_path / f"{k}.points"
        ingest(file, store, footprint=footprint)
        assert content_of(PointStore(store)) == part_of(whole, footprint)
        counts.append(PointStore(store).count)
    assert min(counts) > 0 and max(counts) < whole.count


def test_bytes_of_a_server_are_those_of_the_touched_nodes(tmp_path):
    file = write_copc(tmp_path / "tile.copc.laz", las_of(6, 200_000), levels=3, page_levels=(1,))
    with serving(file.read_bytes()) as server:
        octree = open_octree(server.url)
        plan = octree.plan(
            lambda low, high: (low[:, 0] < LOW[0] + 400) & (low[:, 1] < LOW[1] + 400)
        )
        points = sum(map(len, octree.read(plan)))
    assert 0 < points == plan.points < 0.5 * octree.points
    assert server.sent <= 1.2 * plan.bytes
