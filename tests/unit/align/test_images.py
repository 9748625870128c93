"""The ground of a pair by its RPCs: points elsewhere change no label."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio

from stereotruth.align.images import choose_sites, footprint_of, pair_outlines
from stereotruth.core.products.grids import open_grid
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.lattice import CELL_DEG, Footprint
from stereotruth.lidar.point_store import PointStore

from ...synthetic.box_scene import HALF, ROOF, SIZE, UTM, project_with, surfaces_of
from ...synthetic.box_scene import Scene as BoxScene
from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES, camera, to_rasterio
from ...synthetic.las import write_las


def strewn(half_m: float, spacing: float = 1.2) -> np.ndarray:
    """UTM coordinates [n, 3] of the plane with the box, and of rough ground far around it."""
    rng = np.random.default_rng(4)
    n = int((2 * half_m / spacing) ** 2)
    east, north = rng.uniform(-half_m, half_m, (2, n))
    height = np.full(n, HEIGHT)
    height[(abs(east) < HALF[0]) & (abs(north) < HALF[1])] = ROOF
    far = np.hypot(east, north) > 300
    height[far] += 40 * np.sin(east[far] / 50) + rng.uniform(0, 20, far.sum())
    to_utm = pyproj.Transformer.from_crs("EPSG:4979", UTM, always_xy=True)
    places = LON + east / METRES[0], LAT + north / METRES[1], height
    return np.column_stack(to_utm.transform(*places))


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> tuple[Path, Path, Footprint]:
    """Of the whole file, and of the pair's ground."""
    folder = tmp_path_factory.mktemp("far")
    xyz = strewn(550.0)
    write_las(folder / "a.laz", xyz=xyz, return_number=np.ones(len(xyz), np.uint8))
    model = surfaces_of(True)[0]
    outlines = pair_outlines(model.left, model.right, (SIZE, SIZE))
    footprint = Footprint.around(outlines, 100.0)
    ingest(folder / "a.laz", folder / "whole.points")
    ingest(folder / "a.laz", folder / "part.points", footprint=footprint)
    return folder / "whole.points", folder / "part.points", footprint


@pytest.mark.slow
def test_points_elsewhere_change_no_label(stores, tmp_path):
    scene = BoxScene(tmp_path, box=True)
    whole, part, _ = stores
    assert PointStore(part).count < 0.8 * PointStore(whole).count
    grids = []
    for name, store in (("whole", whole), ("part", part)):
        out = tmp_path / f"{name}.zarr"
        project_with(*scene.images, [store], out, view="right")
        grids.append(open_grid(out))
    assert np.isfinite(grids[0]["disparity"].values).mean() > 0.2
    for name in grids[0].data_vars:
        one, other = (grid[name].values for grid in grids)
        assert one.tobytes() == other.tobytes(), name
    assert [grid.attrs["lidar"]["not_read_m2"] for grid in grids] == [0.0, 0.0]


@pytest.mark.slow
def test_points_elsewhere_choose_no_places_for_tie_points(stores):
    model = surfaces_of(True)[0]
    whole, part, _ = ([PointStore(path)] for path in (*stores[:2], stores[1]))
    sites = [
        choose_sites(model.left, model.right, (SIZE, SIZE), each, HEIGHT) for each in (whole, part)
    ]
    assert sites[0] == sites[1] and sites[0]


CAMERAS = [(35.0, 0.0), (200.0, 0.5)]


@pytest.mark.parametrize(("angle", "bend"), CAMERAS)
def test_the_outline_holds_what_the_epipolar_grid_shows(angle, bend):
    """At any height of the RPCs, and what lies on the rays above it."""
    sizes = (3000, 2500), (2800, 2600)
    left = camera(BACKWARD, angle=angle, size=sizes[0], bend=bend)
    right = camera(FORWARD, angle=angle + 7.0, gsd=0.7, size=sizes[1], bend=-bend)
    model = fit_epipolar(left, right, *sizes, HEIGHT)
    footprint = Footprint.around(pair_outlines(left, right, sizes), 0.0)
    rng = np.random.default_rng(3)
    rows, cols = model.shape
    x, y = rng.uniform(0, cols - 1, 3000), rng.uniform(0, rows - 1, 3000)
    low, high = HEIGHT - 400, HEIGHT + 400
    height = rng.uniform(low, high, 3000)
    lon, lat = model.epipolar_to_ground(x, y, height)
    above = height + rng.uniform(0, 1, 3000) * (high - height)
    places = [(lon, lat), left.localize(*left.project(lon, lat, height), above)]
    places.append(right.localize(*right.project(lon, lat, height), above))
    for sensor, size in zip((left, right), sizes):  # and all that either image shows
        col, row = (rng.uniform(0, side - 1, 3000) for side in size)
        places.append(sensor.localize(col, row, height))
    for place in places:
        lattice = np.rint(np.stack(place) * 1e9).astype(np.int64)
        assert footprint.contains(lattice).all()


def test_images_that_tell_no_ground_have_no_footprint(tmp_path):
    (tmp_path / "a.tif").write_bytes(b"no image")
    assert footprint_of([(tmp_path / "a.tif", tmp_path / "b.tif")], 100.0) is None


def test_a_site_has_the_ground_of_all_its_pairs(tmp_path):
    files = []
    for k, tilt in enumerate((BACKWARD, FORWARD, (0.05, 0.02))):
        sensor = camera(tilt, size=SIZE)
        file = tmp_path / f"{k}.tif"
        profile = {"driver": "GTiff", "width": SIZE[0], "height": SIZE[1], "count": 1}
        with rasterio.open(file, "w", dtype="uint16", **profile) as image:
            image.write(np.ones((1, *SIZE[::-1]), np.uint16))
            image.rpcs = to_rasterio(sensor.rpc)
        files.append(file)
    one, other = (files[0], files[1]), (files[1], files[2])
    both = footprint_of([one, other], 100.0)
    assert both.runs == footprint_of([other, one], 100.0).runs
    single = footprint_of([one], 100.0)
    for row, first, last in single.runs:
        assert both.held[row - both.row, first - both.col : last - both.col + 1].all()


@pytest.mark.slow
def test_ground_without_points_is_named_with_its_area(stores, tmp_path, caplog):
    """A gap of one cell of the stores in what both images show."""
    scene = BoxScene(tmp_path, box=True)
    whole = PointStore(stores[0])
    row, col = (int(np.floor(at / CELL_DEG)) for at in (LAT, LON))
    runs = [[r, c, c] for r, c in zip(whole.cell_row, whole.cell_col) if (r, c) != (row, col)]
    laz = stores[0].with_name("a.laz")
    ingest(laz, tmp_path / "gap.points", footprint=Footprint.of_runs(runs))
    project_with(*scene.images, [tmp_path / "gap.points"], tmp_path / "gap.zarr")
    lidar = open_grid(tmp_path / "gap.zarr").attrs["lidar"]
    cell = [(at + 0.5) * CELL_DEG for at in (col, row)]
    assert np.allclose(lidar["hole"], cell, atol=1e-5)
    assert abs(lidar["holes_m2"] / np.prod(CELL_DEG * METRES) - 1) < 0.01
    assert "have no LiDAR point, most of it around" in caplog.text
    assert lidar["files"] == [1, 1] and lidar["nodes"] is None
