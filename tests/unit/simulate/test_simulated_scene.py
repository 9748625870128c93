"""The synthetic cities: exact geometry, honest metadata, the same result every time."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import RPCTransformer
from scipy.ndimage import map_coordinates, uniform_filter

from stereotruth.errors import InputError
from stereotruth.products.provenance import source_modules
from stereotruth.simulate import layout, world
from stereotruth.simulate.camera import locate, project, rays
from stereotruth.simulate.cities import (
    CITIES,
    LEFT_GSD_M,
    RIGHT_GSD_M,
    Character,
    CitySpec,
    SceneSpec,
    lidar_files,
)
from stereotruth.simulate.control_points import make_points, simulate_points
from stereotruth.simulate.geodesy import LocalFrame
from stereotruth.simulate.lidar import simulate_lidar_tile, tile_box
from stereotruth.simulate.render import prepare, simulate_image
from stereotruth.simulate.surfaces import IN_IMAGES, IN_LIDAR, terrain_heights
from stereotruth.simulate.truth import open_truth, simulate_truth

ROOT = Path(__file__).parents[2]
NONE, GROUND, ROOF, WALL, TREE, WATER = range(6)

TOWN = CitySpec(
    "Town", 115.433, 30.232, 32650, 18.0, 21,
    Character(30, 0.3, 900, 20, 30, 0,
              {"slabs": 2, "lowrise": 2, "towers": 1.5, "fields": 1, "park": 1},
              (26, 55), 0.8, zone_m=200.0),
    (SceneSpec("Town-1", (0.0, 0.0), 620, 640, 301, ragged_m=(15.0, 15.0), gap_m=(90.0, 80.0)),),
)  # fmt: skip
ONE_BOX = CitySpec(
    "Box", 102.7, 25.04, 32648, 1860.0, 3,
    Character(0.0, 0.3, 900, 20, 0, 0, {"fields": 1}, (20, 40), 0.0),
    (SceneSpec("Box-1", (0.0, 0.0), 420, 400, 7, ragged_m=(0.0, 0.0)),),
    single_box=(6.0, -4.0, 40.0, 24.0, 50.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("Town-1")
    scene = TOWN.scenes[0]
    for view in ("left", "right"):
        simulate_image(TOWN, scene, view, folder / f"{view}.tif", seed=1)
    for name in lidar_files(TOWN, scene):
        simulate_lidar_tile(TOWN, scene, name, folder / "lidar" / name, seed=1)
    simulate_truth(TOWN, scene, folder / "truth.zarr")
    simulate_points(
        TOWN, scene, folder / "gcps.csv", folder / "exact.csv", folder / "checks.csv", seed=1
    )
    return folder


def read_points(path: Path) -> np.ndarray:
    """Columns lon, lat, height, left col, left row, right col, right row."""
    with path.open() as stream:
        return np.array([[float(v) for v in list(r.values())[1:]] for r in csv.DictReader(stream)])


def test_local_frame_agrees_with_pyproj() -> None:
    frame = LocalFrame(113.4, 24.2, 36.0)
    xyz = np.random.default_rng(0).uniform(-3000, 3000, (500, 3))
    lonlath = frame.to_geodetic(xyz)
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    np.testing.assert_allclose(
        np.array(to_ecef.transform(*lonlath.T)).T, frame.to_ecef(xyz), atol=1e-7
    )
    np.testing.assert_allclose(frame.from_geodetic(lonlath), xyz, atol=1e-7)


@pytest.mark.parametrize("ascending", [False, True])
def test_camera_round_trip_and_ground_sampling(ascending: bool) -> None:
    spec = replace(ONE_BOX, scenes=(replace(ONE_BOX.scenes[0], ascending=ascending),))
    ready = prepare(spec, spec.scenes[0])
    rng = np.random.default_rng(1)
    for camera, gsd in ((ready.left, LEFT_GSD_M), (ready.right, RIGHT_GSD_M)):
        colrow = rng.uniform(0, 1, (400, 2)) * [camera.cols, camera.rows]
        xyz = locate(camera.cam, ready.frame, colrow, 1860 + rng.uniform(0, 600, 400))
        assert np.abs(project(camera.cam, xyz) - colrow).max() < 1e-5
        middle = np.array([camera.cols / 2, camera.rows / 2])
        steps = locate(
            camera.cam, ready.frame, middle + np.array([[0, 0], [1, 0], [0, 1]]), np.full(3, 1864.0)
        )
        across, along = np.linalg.norm(steps[1:] - steps[0], axis=1)
        assert across == pytest.approx(gsd, rel=0.03)
        assert along == pytest.approx(gsd, rel=0.03)
        # not mirrored: columns to the right of falling rows, seen from above
        c, r = steps[1] - steps[0], steps[2] - steps[0]
        assert c[0] * r[1] - c[1] * r[0] < 0
    tilts = [
        math.degrees(math.acos(1 / np.linalg.norm(rays(c.cam, [[c.cols / 2, c.rows / 2]])[1])))
        for c in (ready.left, ready.right)
    ]
    # angles at the ground: those at the satellite times (R + h) / R, and the roll
    assert tilts[0] == pytest.approx(5.4, abs=1.3)
    assert tilts[1] == pytest.approx(28.2, abs=0.8)


def test_rpcs_are_the_camera_up_to_an_affine(town: Path) -> None:
    """Through GDAL's own RPC code: bias apart, below 0.01 px; bias of several px."""
    ready = prepare(TOWN, TOWN.scenes[0])
    for view, camera in (("left", ready.left), ("right", ready.right)):
        rng = np.random.default_rng(2)
        colrow = rng.uniform(0, 1, (300, 2)) * [camera.cols, camera.rows]
        xyz = locate(camera.cam, ready.frame, colrow, rng.uniform(-60, 160, 300))
        lon, lat, height = ready.frame.to_geodetic(xyz).T
        with rasterio.open(town / f"{view}.tif") as image:
            assert (image.width, image.height) == (camera.cols, camera.rows)
            assert image.nodata == 0 and image.dtypes == ("uint16",)
            row, col = RPCTransformer(image.rpcs).rowcol(lon, lat, height, op=lambda v: v)
        found = np.column_stack([col, row]) - 0.5  # GDAL counts from the pixel's corner
        biased = colrow @ camera.rpc.bias[:, :2].T + camera.rpc.bias[:, 2]
        assert np.abs(found - biased).max() < 0.01
        shift = np.abs((found - colrow).mean(axis=0))
        assert (shift > 3).all() and (shift < 13).all()


def test_truth_is_on_the_rays_and_in_the_right_image(town: Path) -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    truth = open_truth(town / "truth.zarr")
    surface = truth.surface.values
    assert set(np.unique(surface)) >= {NONE, GROUND, ROOF, WALL, TREE}
    rows, cols = np.nonzero(surface)
    some = np.random.default_rng(3).choice(len(rows), 5000, replace=False)
    rows, cols = rows[some], cols[some]
    xyz = ready.frame.from_geodetic(
        np.column_stack([truth[n].values[rows, cols] for n in ("lon", "lat", "height")])
    )
    left = project(ready.left.cam, xyz)
    assert np.abs(left - np.column_stack([cols, rows])).max() < 1e-4
    right = np.column_stack(
        [truth.right_col.values[rows, cols], truth.right_row.values[rows, cols]]
    )
    assert np.abs(project(ready.right.cam, xyz) - right).max() < 1e-4
    ground = surface[rows, cols] == GROUND
    z = terrain_heights(ready.surfaces, xyz[ground, :2])[:, 0]
    assert np.abs(z - xyz[ground, 2]).max() < 1e-3
    collar = surface == NONE
    with rasterio.open(town / "left.tif") as image:
        assert ((image.read(1) == 0) == collar).all()
    assert np.isnan(truth.lon.values[collar]).all() and not truth.visible_right.values[collar].any()


def test_views_look_alike_where_both_see_the_surface(town: Path) -> None:
    """9 x 9 correlation of left and right at the true correspondences, as the paper's filter."""
    truth = open_truth(town / "truth.zarr")
    with rasterio.open(town / "left.tif") as image:
        left = image.read(1).astype(float)
    with rasterio.open(town / "right.tif") as image:
        right = image.read(1).astype(float)
    assert 150 < np.median(left) < 600 and left.max() <= 2047
    seen = truth.visible_right.values == 1
    at = np.stack([truth.right_row.values, truth.right_col.values])
    warped = map_coordinates(right, np.nan_to_num(at, nan=-99), order=3)

    def mean(a: np.ndarray) -> np.ndarray:
        return uniform_filter(a, 9)

    spread_left = mean(left**2) - mean(left) ** 2
    spread = spread_left * (mean(warped**2) - mean(warped) ** 2)
    covariance = mean(left * warped) - mean(left) * mean(warped)
    correlation = covariance / np.sqrt(np.maximum(spread, 1e-6))
    whole = mean(seen.astype(float)) > 0.999
    surface = truth.surface.values
    for kind in (GROUND, ROOF):
        values = correlation[whole & (surface == kind)]
        assert len(values) > 1000
        assert np.median(values) > 0.9 and np.mean(values > 0.5) > 0.97
    hidden = (surface > 0) & ~seen
    assert 0.005 < hidden.mean() < 0.3
    assert np.median(correlation[hidden]) < 0.6


def test_right_view_hides_what_a_box_covers(tmp_path: Path) -> None:
    """Ground hidden behind one box: the box's shadow along the right rays, its area by hand."""
    scene = ONE_BOX.scenes[0]
    simulate_truth(ONE_BOX, scene, tmp_path / "truth.zarr")
    truth = open_truth(tmp_path / "truth.zarr")
    surface, seen = truth.surface.values, truth.visible_right.values == 1
    ready = prepare(ONE_BOX, scene)
    length, width, height = ONE_BOX.single_box[2:]
    pixel = np.linalg.det(
        np.diff(locate(ready.left.cam, ready.frame, [[210, 200], [211, 200], [210, 201]],
                       np.full(3, 1864.0))[[0, 1, 0, 2], :2], axis=0)[::2]
    )  # fmt: skip
    _, toward = rays(ready.right.cam, [[ready.right.cols / 2, ready.right.rows / 2]])
    hidden = ((surface == GROUND) & ~seen).sum() * abs(pixel)
    expected = height * (abs(toward[0, 0]) * width + abs(toward[0, 1]) * length)
    assert hidden == pytest.approx(expected, rel=0.03)
    roof = surface == ROOF
    # the roof is nearer to the camera than the ground, by 50 m of 505 km
    assert roof.sum() * abs(pixel) == pytest.approx(length * width, rel=0.02)
    assert seen[roof].all()
    assert np.ptp(truth.height.values[roof]) < 1e-3  # level, but for the Earth's curvature
    assert not truth.changed.values.any()


def test_lidar_lies_on_the_surfaces_that_the_truth_shows(town: Path) -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    truth = open_truth(town / "truth.zarr")
    height, surface = truth.height.values, truth.surface.values
    usable = (truth.changed.values == 0) & (truth.covered.values == 1)
    to_wgs = pyproj.Transformer.from_crs(32650, 4326, always_xy=True)
    count = np.zeros(height.shape, int)
    misses = {2: [], 6: []}
    classes: set[int] = set()
    for name in lidar_files(TOWN, TOWN.scenes[0]):
        las = laspy.read(town / "lidar" / name)
        assert (str(las.header.version), las.header.point_format.id) == ("1.4", 6)
        crs = las.header.parse_crs()
        assert crs.to_2d().to_epsg() == 32650 and len(crs.axis_info) == 3
        assert (np.asarray(las.number_of_returns) >= np.asarray(las.return_number)).all()
        label = np.asarray(las.classification)
        classes |= set(np.unique(label).tolist())
        lon, lat = to_wgs.transform(las.x, las.y)
        xyz = ready.frame.from_geodetic(np.column_stack([lon, lat, las.z]))
        col, row = np.rint(project(ready.left.cam, xyz)).astype(int).T
        inside = (col > 0) & (row > 0) & (col < 619) & (row < 639)
        for value in (2, 6):
            use = inside & (label == value)
            c, r, z = col[use], row[use], np.asarray(las.z)[use]
            flat = np.ptp(
                [height[r + i, c + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0
            ) < (0.3 if value == 2 else 0.001)
            flat &= usable[r, c] & (surface[r, c] == (GROUND if value == 2 else ROOF))
            misses[value].append((z - height[r, c])[flat])
        np.add.at(count, (row[inside], col[inside]), 1)
    assert classes == {2, 5, 6, 7, 9, 18}
    roof, ground = np.concatenate(misses[6]), np.concatenate(misses[2])
    # points below a roof's rim are on its walls: take the upper side of the distribution
    on_top = roof[roof > -0.5]
    assert len(on_top) > 2000 and np.median(on_top) == pytest.approx(0, abs=0.005)
    assert np.std(on_top) == pytest.approx(0.03, abs=0.008)
    assert abs(np.median(ground)) < 0.01 and np.quantile(np.abs(ground), 0.95) < 0.2
    covered = (truth.covered.values == 1) & (surface == GROUND)
    assert (count[covered] > 0).mean() > 0.97
    assert (count[(truth.covered.values == 0) & (surface == GROUND)] > 0).mean() < 0.02
    # a ragged edge along the first rows and last columns, and a gap in the corner between them
    uncovered = truth.covered.values == 0
    assert uncovered[:105, -120:].all() and not uncovered[150:, :450].any()
    assert 0.06 < uncovered.mean() < 0.25


def test_second_returns_are_ground_below_crowns(town: Path) -> None:
    las = laspy.read(town / "lidar" / lidar_files(TOWN, TOWN.scenes[0])[0])
    second = np.asarray(las.return_number) == 2
    assert second.sum() > 50
    assert (np.asarray(las.classification)[second] == 2).mean() > 0.7


def test_points_are_exact_and_measured_with_a_quarter_of_a_pixel(town: Path) -> None:
    ready = prepare(TOWN, TOWN.scenes[0])
    measured, exact, checks = (read_points(town / f"{n}.csv") for n in ("gcps", "exact", "checks"))
    assert len(exact) >= 18 and len(checks) >= 50
    for table in (exact, checks):
        xyz = ready.frame.from_geodetic(table[:, :3])
        assert np.abs(project(ready.left.cam, xyz) - table[:, 3:5]).max() < 5e-4
        assert np.abs(project(ready.right.cam, xyz) - table[:, 5:7]).max() < 5e-4
    assert (measured[:, :3] == exact[:, :3]).all()
    assert np.std(measured[:, 3:] - exact[:, 3:]) == pytest.approx(0.25, abs=0.07)
    distance = np.linalg.norm(exact[:, None, :3] - checks[None, :, :3], axis=2)
    assert distance.min() > 1e-6


def test_same_spec_gives_the_same_files(town: Path, tmp_path: Path) -> None:
    world._build.cache_clear()
    prepare.__globals__["_prepare"].cache_clear()
    scene = TOWN.scenes[0]
    name = lidar_files(TOWN, scene)[1]
    simulate_image(TOWN, scene, "right", tmp_path / "right.tif", seed=1)
    simulate_lidar_tile(TOWN, scene, name, tmp_path / name, seed=1)
    assert (tmp_path / "right.tif").read_bytes() == (town / "right.tif").read_bytes()
    assert (tmp_path / name).read_bytes() == (town / "lidar" / name).read_bytes()
    simulate_image(TOWN, scene, "right", tmp_path / "other.tif", seed=2)
    with rasterio.open(tmp_path / "other.tif") as a, rasterio.open(town / "right.tif") as b:
        difference = a.read(1).astype(float) - b.read(1)
    assert 2 < difference.std() < 12  # only the sensor's noise is drawn again


def test_old_las_format_and_refusals(tmp_path: Path) -> None:
    city = replace(TOWN, las_format="las-1.2-1")
    scene = city.scenes[0]
    name = lidar_files(city, scene)[0]
    assert name.endswith(".las")
    simulate_lidar_tile(city, scene, name, tmp_path / name, spacing_m=2.0, seed=1)
    las = laspy.read(tmp_path / name)
    assert (str(las.header.version), las.header.point_format.id) == ("1.2", 1)
    assert las.header.parse_crs().to_epsg() == 32650
    with pytest.raises(InputError, match="has no LiDAR file"):
        simulate_lidar_tile(city, scene, "nowhere.las", tmp_path / "x.las", seed=1)
    with pytest.raises(InputError, match="no view"):
        simulate_image(city, scene, "nadir", tmp_path / "x.tif", seed=1)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("city", CITIES.values(), ids=list(CITIES))
def test_committed_gcps_and_what_each_city_must_have(city: CitySpec) -> None:
    surfaces = world.build_surfaces(city)
    slope = np.hypot(*np.gradient(surfaces.terrain, surfaces.step))
    assert math.degrees(math.atan(slope.max())) < 51
    relief = np.ptp(surfaces.terrain)
    if city.name in ("Shaoguan", "Yingde"):
        assert 250 < relief < 600
    for scene in city.scenes:
        names = lidar_files(city, scene)
        assert 4 <= len(names) <= 9 and len(set(names)) == len(names)
        local = np.abs(layout.scene_coordinates(city, scene, surfaces.boxes[:, :2]))
        inside = (local < layout.half_size(scene)).all(axis=1)
        for view in (IN_IMAGES, IN_LIDAR):
            assert ((surfaces.box_view == view) & inside).sum() >= 3
        measured, exact, checks = make_points(city, scene, seed=1)
        assert 18 <= len(measured) <= 20 and len(checks) >= 50
        committed = read_points(ROOT / "config" / "gcps" / f"{scene.name}.csv")
        made = np.array([[float(v) for v in list(row.values())[1:]] for row in measured])
        np.testing.assert_allclose(committed[:, :2], made[:, :2], atol=5e-10, rtol=0)
        np.testing.assert_allclose(committed[:, 2:], made[:, 2:], atol=0.005, rtol=0)
        at = np.array([[float(row["left_col"]), float(row["left_row"])] for row in exact])
        at /= [scene.cols, scene.rows]
        # spread over the scene: a point in each quarter, and none bunched
        assert len({(c > 0.5, r > 0.5) for c, r in at}) == 4
        assert np.linalg.norm(np.ptp(at, axis=0)) > 1.1


def test_shares_no_code_with_the_pipeline() -> None:
    modules = source_modules(
        "simulate.render", "simulate.lidar", "simulate.truth", "simulate.control_points"
    )
    others = {m for m in modules if not m.startswith("simulate")}
    assert others <= {
        "",
        "errors",
        "job",
        "products",
        "products.files",
        "products.grids",
        "products.locks",
        "products.provenance",
    }


def test_lidar_tiles_part_the_scene() -> None:
    city = CITIES["Qichun"]
    scene = city.scenes[1]
    boxes = np.array([tile_box(city, scene, (i, j)) for j in range(2) for i in range(3)])
    assert np.allclose(boxes[:-1, 2][[0, 1, 3, 4]], boxes[1:, 0][[0, 1, 3, 4]])
    assert np.allclose(boxes[:3, 3], boxes[3:, 1])
