"""Crops of the original images: their pixels, and where other programs project ground in them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer
from scipy.ndimage import generic_filter, map_coordinates
from scipy.spatial.transform import Rotation

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import Layer, atomic_store, create_grid
from stereotruth.tiles.cameras import Crop
from stereotruth.tiles.orientation import evaluate
from stereotruth.tiles.originals import HEIGHTS, visibility, write_originals
from stereotruth.tiles.verify import defects

from ...synthetic.images import write
from ...synthetic.real_data import SHARED
from ...synthetic.tiled_scene import (
    METRE_LAT,
    METRE_LON,
    PIXELS,
    SIZE,
    camera,
    make_scene,
    rows_of,
    run,
    surface,
    terrain,
    texture,
)

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
CAMERAS = {"left": camera(0.09, 0.02, 0.70), "right": camera(-0.48, -0.03, 0.75)}
TOLERANCE = 0.01  # px
META = {"units": "m", "long_name": "test"}


@pytest.fixture(scope="module")
def cropped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    run([make_scene(folder / "s1")], folder / "Town")
    row, col = np.indices((PIXELS, PIXELS)).astype(float)
    for view, sensor in CAMERAS.items():
        lon, lat, _ = surface(sensor, col, row)
        grey = np.rint(texture(lon, lat)).astype(np.uint16)
        bands = np.stack([grey, grey + 1, grey + 2, grey + 3], axis=-1)
        write(folder / f"{view}.tif", bands, nodata=0, photometric="RGB")
    images = {"s1": tuple(folder / f"{view}.tif" for view in CAMERAS)}
    assert write_originals(folder / "Town", folder / "out", images, workers=2) >= 12
    return folder


def ground_of(folder: Path, tile: str, n: int = 300) -> np.ndarray:
    """lon, lat, height [3, n] of what a tile shows, and 60 m above and below that."""
    record = json.loads((folder / "Town" / f"orientation/{tile}.json").read_text())
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, SIZE - 1, (2, n))
    d = rng.uniform(*record["ground"]["disparity_range_px"], n)
    return np.array([evaluate(record["ground"], x, y, d)[k] for k in ("lon", "lat", "height")])


def places(folder: Path):
    for row in rows_of(folder / "out")[::4]:
        for view, sensor in CAMERAS.items():
            ground = ground_of(folder, row["tile"])
            at = np.array(sensor.project(*ground))
            first = np.array([[int(row[f"{view}_col0"])], [int(row[f"{view}_row0"])]])
            yield folder / "out" / row[view], ground, at - first


def test_gdal_projects_into_the_crops_as_the_sensor_models_do(cropped) -> None:
    for path, ground, wanted in places(cropped):
        with rasterio.open(path) as crop, RPCTransformer(crop.rpcs) as transformer:
            row, col = transformer.rowcol(*ground, op=float)
        # GDAL counts from the corner of the upper-left pixel
        assert np.abs(np.array([col, row]) - 0.5 - wanted).max() < TOLERANCE


def test_shareloc_projects_by_the_text_alone(cropped, tmp_path) -> None:
    shareloc = pytest.importorskip("shareloc.geomodels")
    for path, ground, wanted in list(places(cropped))[:2]:
        text = path.with_name(f"{path.stem}_RPC.TXT")
        path = write(tmp_path / path.name, np.zeros((300, 300), np.uint16))  # without tags
        (tmp_path / text.name).write_bytes(text.read_bytes())
        model = shareloc.GeoModel(str(path), "RPC")
        row, col, _ = model.inverse_loc(*ground)
        assert np.abs(np.array([col, row]) - 0.5 - wanted).max() < TOLERANCE


def test_crops_hold_all_bands_as_they_are(cropped) -> None:
    for row in rows_of(cropped / "out")[::4]:
        for view in CAMERAS:
            with (
                rasterio.open(cropped / "out" / row[view]) as crop,
                rasterio.open(cropped / f"{view}.tif") as image,
            ):
                col, line, cols, rows = (
                    int(row[f"{view}_{k}"]) for k in ("col0", "row0", "cols", "rows")
                )
                window = rasterio.windows.Window(col, line, cols, rows)
                assert (crop.count, crop.nodata) == (4, 0)
                assert crop.colorinterp == image.colorinterp
                np.testing.assert_array_equal(crop.read(), image.read(window=window))
            # all that the tile shows
            record = json.loads((cropped / "Town/orientation" / f"{row['tile']}.json").read_text())
            x, y = np.meshgrid([0, SIZE - 1], [0, SIZE - 1])
            at = evaluate(record[view]["tile_to_sensor"], x, y)
            assert (at["col"] >= col).all() and (at["col"] <= col + cols - 1).all()
            assert (at["row"] >= line).all() and (at["row"] <= line + rows - 1).all()
    assert defects(cropped / "out") == []


def heights(path: Path, shape: tuple[int, int]) -> Path:
    """Heights of an image: 100 m, one metre more a column, rows 0 to 9 of it without points."""
    row, col = np.indices(shape)
    none = row < 10
    values = {
        "height": np.where(none, np.nan, 100.0 + col + row / 1024),
        "sigma": np.where(none, np.nan, 0.01 * row),
        "status": np.where(none, 0, 1),
    }
    layers = {name: Layer(HEIGHTS[name].dtype, 0, META) for name in HEIGHTS}
    with atomic_store(path) as scratch:
        arrays = create_grid(scratch, shape, layers, chunk=64, shard=128, attrs={})
        for name, array in values.items():
            arrays[name][:] = array.astype(HEIGHTS[name].dtype)
    return path


def numbers_of(rpc: RPC) -> list[float]:
    """All of an RPC's numbers."""
    values = {k: v for k, v in sorted(rpc.to_dict().items()) if not k.startswith("err")}
    return [number for value in values.values() for number in np.ravel(value)]


def test_crops_of_heights_are_those_of_the_images(cropped, tmp_path) -> None:
    with rasterio.open(cropped / "left.tif") as image:
        store = heights(tmp_path / "A.zarr", image.shape)
    images = {"s1": (cropped / "left.tif", cropped / "right.tif")}
    out = tmp_path / "out"
    write_originals(few_tiles(cropped, tmp_path), out, images, {"s1": (store, None)})
    assert defects(out) == []
    for row, before in zip(rows_of(out), rows_of(cropped / "out")):
        assert row["left_sha256"] == before["left_sha256"]
        assert row["right_height"] == row["right_sigma"] == row["right_status"] == ""
        with rasterio.open(out / row["left"]) as crop:
            first = int(row["left_row0"]), int(row["left_col0"])
            line, col = (axis + start for axis, start in zip(np.indices(crop.shape), first))
            rpc = numbers_of(crop.rpcs)
        for name, wanted in (("height", 100.0 + col + line / 1024), ("sigma", 0.01 * line)):
            with rasterio.open(out / row[f"left_{name}"]) as found:
                assert found.dtypes == ("float32",) and found.nodata == -9999
                values = found.read(1)
                np.testing.assert_allclose(numbers_of(found.rpcs), rpc, rtol=1e-12)
            np.testing.assert_array_equal(values, np.where(line < 10, -9999, wanted).astype("f4"))
        with rasterio.open(out / row["left_status"]) as found:
            np.testing.assert_array_equal(found.read(1), line >= 10)


def test_heights_of_another_image_are_refused(cropped, tmp_path) -> None:
    store = heights(tmp_path / "A.zarr", (30, 30))
    images = {"s1": (cropped / "left.tif", cropped / "right.tif")}
    with pytest.raises(InputError):
        write_originals(cropped / "Town", tmp_path / "out", images, {"s1": (None, store)})
    assert not (tmp_path / "out").exists()


# Cameras of multi-view work.


def close_to(found: np.ndarray, wanted: np.ndarray, stated: str) -> None:
    """Places [2, n] are those of the RPC to 0.05 px, and to what the table states of the crop."""
    worst = np.abs(found - wanted).max()
    assert worst < 0.05 and worst < 1.2 * float(stated) + 1e-4


def crops_of(folder: Path) -> list[tuple[dict[str, str], str]]:
    return [(row, view) for row in rows_of(folder / "out")[::4] for view in CAMERAS]


def exact_points(folder: Path, row: dict[str, str], view: str) -> tuple[np.ndarray, np.ndarray]:
    """Ground [3, n] at the heights that the table names, and its place [2, n] in a crop."""
    rng = np.random.default_rng(5)
    col, line = (rng.uniform(0, int(row[f"{view}_{k}"]) - 1, 400) for k in ("cols", "rows"))
    height = rng.uniform(float(row["min_height_m"]), float(row["max_height_m"]), 400)
    first = int(row[f"{view}_col0"]), int(row[f"{view}_row0"])
    lon, lat = CAMERAS[view].localize(col + first[0], line + first[1], height)
    return np.array([lon, lat, height]), np.array([col, line])


def satnerf_projects(record: dict, ground: np.ndarray) -> np.ndarray:
    """Places [2, n] by the record's RPC as rpcm has it: (0, 0) is the centre of the first pixel."""
    rpc = record["rpc"]
    lat, lon, alt = ((ground[k] - rpc[f"{n}_offset"]) / rpc[f"{n}_scale"]
                     for k, n in ((1, "lat"), (0, "lon"), (2, "alt")))  # fmt: skip
    terms = [lat**0, lon, lat, alt, lon * lat, lon * alt, lat * alt, lon**2, lat**2, alt**2]
    terms += [lat * lon * alt, lon**3, lon * lat**2, lon * alt**2, lon**2 * lat, lat**3]
    terms += [lat * alt**2, lon**2 * alt, lat**2 * alt, alt**3]
    return np.array([
        np.dot(rpc[f"{n}_num"], terms) / np.dot(rpc[f"{n}_den"], terms) * rpc[f"{n}_scale"]
        + rpc[f"{n}_offset"] for n in ("col", "row")
    ])  # fmt: skip


def test_satnerf_records_project_as_the_sensor_does(cropped) -> None:
    places = np.load(cropped / "out/satnerf/pts3d.npy")
    lon, lat, height = to_lon_lat(places)
    for row, view in crops_of(cropped):
        record = json.loads((cropped / "out" / row[f"{view}_satnerf"]).read_text())
        ground, wanted = exact_points(cropped, row, view)
        close_to(satnerf_projects(record, ground), wanted, "0")
        with rasterio.open(cropped / "out" / record["img"]) as crop:
            assert (crop.width, crop.height) == (record["width"], record["height"])
        of, pixels = (np.array(record["keypoints"][k]) for k in ("pts3d_indices", "2d_coordinates"))
        assert len(of) > 500
        close_to(satnerf_projects(record, np.array([lon, lat, height])[:, of]), pixels.T, "0")
        np.testing.assert_allclose(height[of], terrain(lon[of], lat[of]), atol=0.3)  # of labels


def to_lon_lat(xyz: np.ndarray) -> np.ndarray:
    return np.array(Transformer.from_crs(4978, 4979, always_xy=True).transform(*xyz.T))


def test_satnerf_records_have_what_those_of_others_have(cropped) -> None:
    folder = SHARED / "real/jacksonville/rpc_ba"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    other = json.loads(next(folder.glob("*.json")).read_text())
    row, view = crops_of(cropped)[0]
    record = json.loads((cropped / "out" / row[f"{view}_satnerf"]).read_text())
    for mine, theirs in ((record, other), (record["rpc"], other["rpc"])):
        assert set(mine) == set(theirs)
    assert set(record["geojson"]) == set(other["geojson"])


def few_tiles(folder: Path, there: Path) -> Path:
    """The first two tiles alone."""
    town = there / "Town"
    shutil.copytree(folder / "Town", town)
    lines = (town / "manifest.csv").read_text().splitlines(keepends=True)
    (town / "manifest.csv").write_text("".join(lines[:3]))
    return town


def test_time_and_sun_are_those_of_the_sheet(cropped, tmp_path) -> None:
    images = {"s1": (cropped / "left.tif", cropped / "right.tif")}
    cells = {"s1": [("2024-02-09T03:13:53Z", 150.0, 40.0), ("", None, None)]}
    write_originals(few_tiles(cropped, tmp_path), tmp_path / "out", images, cells=cells)
    row = rows_of(tmp_path / "out")[0]
    left, right = (json.loads((tmp_path / "out" / row[f"{view}_satnerf"]).read_text())
                   for view in CAMERAS)  # fmt: skip
    assert left["acquisition_date"] == "20240209031353"
    assert (left["sun_azimuth"], left["sun_elevation"]) == (150.0, 40.0)
    assert right["acquisition_date"] is right["sun_azimuth"] is None
    model, _, _ = json.loads((tmp_path / "out" / row["eogs"]).read_text())
    sun = np.array([np.sin(np.radians(150)), np.cos(np.radians(150))]) * np.cos(np.radians(40))
    up = np.array([*sun, np.sin(np.radians(40))]) / np.sin(np.radians(40))
    coef = np.array(model["sun_model"]["coef_"]) / model["model"]["scale"]
    np.testing.assert_allclose(coef @ up, [0, 0, 1], atol=1e-9)  # along the sun's ray


def test_eogs_models_project_as_the_sensor_does(cropped) -> None:
    for row, view in crops_of(cropped):
        models = json.loads((cropped / "out" / row["eogs"]).read_text())
        (entry,) = [m for m in models if m["img"] == row[view]]
        assert models[-1]["img"] == "Nadir" and entry["sun_model"] is None
        ground, wanted = exact_points(cropped, row, view)
        model, size = entry["model"], np.array([[entry["width"]], [entry["height"]]])
        utm = Transformer.from_crs(4326, 32600 + model["n"], always_xy=True)
        xyz = np.array([*utm.transform(*ground[:2]), ground[2]]) - np.c_[model["center"]]
        seen = np.array(model["coef_"]) @ (xyz / model["scale"]) + np.c_[model["intercept_"]]
        close_to(((seen[:2] + 1) * size - 1) / 2, wanted, row[f"{view}_eogs_max_error_px"])
        np.testing.assert_allclose(seen[2], ground[2], atol=1e-6)
        assert np.abs(xyz / model["scale"]).max() < 1.05


def colmap_model(folder: Path) -> dict[str, tuple[np.ndarray, ...]]:
    """By name: K, R, t of each image, read as COLMAP documents it; rows of its observations."""
    lines = [(folder / f"{k}.txt").read_text().splitlines() for k in ("cameras", "images")]
    inner = {}
    for number, model, *size, fx, fy, cx, cy in (v.split() for v in lines[0] if v[0] != "#"):
        assert model == "PINHOLE"
        inner[number] = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float), size
    found = {}
    for pose, seen in zip(lines[1][::2], lines[1][1::2]):
        _, w, x, y, z, *t, number, name = pose.split()
        turn = Rotation.from_quat(np.array([x, y, z, w], float)).as_matrix()
        seen = np.array(seen.split(), float).reshape(-1, 3)
        found[name] = *inner[number], turn, np.array(t, float), seen
    return found


def east_north_up(ground: np.ndarray, origin: dict) -> np.ndarray:
    """[3, n] m in the frame of a place, by its axes in space."""
    to = Transformer.from_crs(4979, 4978, always_xy=True)
    lon, lat = np.radians([origin["lon"], origin["lat"]])
    here = np.reshape(to.transform(origin["lon"], origin["lat"], 0), (3, 1))
    apart = np.array(to.transform(*ground)) - here
    east = [-np.sin(lon), np.cos(lon), 0]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return np.array([east, np.cross(up, east), up]) @ apart


def test_colmap_cameras_and_images_show_the_ground_where_the_sensor_does(cropped) -> None:
    out = cropped / "out"
    model = colmap_model(out / "colmap/sparse/0")
    origin = json.loads((out / "colmap/frame.json").read_text())
    for row, view in crops_of(cropped):
        inner, size, turn, t, _ = model[row[view]]
        ground, wanted = exact_points(cropped, row, view)
        seen = inner @ (turn @ east_north_up(ground, origin) + t[:, None])
        assert (seen[2] > 1e5).all()  # in front of the camera
        col, line = seen[:2] / seen[2] - 0.5
        skew = float(row[f"{view}_colmap_skew"])
        assert abs(skew) > 1e-4
        wider, middle = int(size[0]) - int(row[f"{view}_cols"]), (int(size[1]) - 1) / 2
        shown = np.array([wanted[0] - skew * (wanted[1] - middle) + wider / 2, wanted[1]])
        close_to(np.array([col, line]), shown, row[f"{view}_colmap_max_error_px"])
        # the image itself: the texture of terrain at the places where the camera has it
        with rasterio.open(out / row[f"{view}_colmap"]) as image:
            assert [str(image.width), str(image.height)] == size and image.count == 3
            grey = image.read(1).astype(float)
        first = int(row[f"{view}_col0"]), int(row[f"{view}_row0"])
        lon, lat, height = surface(CAMERAS[view], wanted[0] + first[0], wanted[1] + first[1])
        seen = inner @ (turn @ east_north_up(np.array([lon, lat, height]), origin) + t[:, None])
        col, line = seen[:2] / seen[2] - 0.5
        here = map_coordinates(grey, [line, col], order=3)
        kept = (col > 5) & (col < grey.shape[1] - 6) & (line > 3) & (line < grey.shape[0] - 4)
        difference = (here - texture(lon, lat))[kept]
        assert kept.sum() > 300 and np.sqrt(np.mean(difference**2)) < 4  # of waves of 120


def camera_of(row: dict[str, str], view: str) -> tuple:
    """RPC, size and heights of a crop."""
    rpc, _ = CAMERAS[view].corrected_rpc()
    col0, row0, *size = (int(row[f"{view}_{k}"]) for k in ("col0", "row0", "cols", "rows"))
    rpc = replace(rpc, samp_off=rpc.samp_off - col0, line_off=rpc.line_off - row0)
    return rpc, tuple(size), (float(row["min_height_m"]), float(row["max_height_m"]))


def test_colmap_points_are_seen_by_their_cameras(cropped) -> None:
    folder = cropped / "out/colmap/sparse/0"
    model = colmap_model(folder)
    lines = [line.split() for line in (folder / "points3D.txt").read_text().splitlines()]
    xyz = {int(line[0]): np.array(line[1:4], float) for line in lines}
    assert len(xyz) == len(lines) > 3000
    count = 0
    for inner, _, turn, t, seen in model.values():
        points = np.array([xyz[int(k)] for k in seen[:, 2]])
        at = inner @ (turn @ points.T + t[:, None])
        assert np.abs(at[:2] / at[2] - seen[:, :2].T).max() < 0.05
        count += len(seen)
    assert count == 2 * len(xyz)
    number, index = int(lines[0][8]), int(lines[0][9])
    assert int(list(model.values())[number - 1][4][index, 2]) == int(lines[0][0])


def test_colmap_itself_reads_the_model(cropped) -> None:
    colmap = pytest.importorskip("pycolmap")
    model = colmap.Reconstruction(str(cropped / "out/colmap/sparse/0"))
    assert model.num_images() == 2 * len(rows_of(cropped / "out"))
    image = model.images[1]
    for point in list(image.points2D)[:50]:
        at = image.project_point(model.points3D[point.point3D_id].xyz)
        assert np.abs(np.array(at) - point.xy).max() < 0.05


def test_what_hides_a_place_is_told_from_what_shows_it(cropped) -> None:
    """A slab 30 m above a plane: of what the left image shows beside it, the right one has some
    behind it, which follows from where the right rays pass through the slab's height."""
    row = rows_of(cropped / "out")[0]
    crops = [Crop(view, *camera_of(row, view)) for view in CAMERAS]
    metre = (METRE_LON, METRE_LAT)
    middle = crops[0].rpc.localize(crops[0].size[0] / 2, crops[0].size[1] / 2, 40.0)

    def on_slab(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        return np.maximum(*(abs(v - m) / s for v, m, s in zip((lon, lat), middle, metre))) < 9

    def shown(crop: Crop) -> np.ndarray:
        line, col = np.indices(crop.size[::-1]).astype(float)
        return np.where(on_slab(*crop.rpc.localize(col, line, 70.0)), 70.0, 40.0)

    heights = [shown(crop) for crop in crops]
    found = visibility(*crops, *heights)
    line, col = np.indices(found.shape).astype(float)
    lon, lat = crops[0].rpc.localize(col, line, heights[0])
    at = crops[1].rpc.project(lon, lat, heights[0])
    hidden = (heights[0] == 40) & on_slab(*crops[1].rpc.localize(*at, 70.0))
    inside = np.all([(v > 1) & (v < n - 2) for v, n in zip(at, crops[1].size)], axis=0)
    edge = generic_filter(hidden.astype(float), np.ptp, 5) > 0
    sure = inside & ~edge
    assert (hidden & sure).sum() > 50
    assert (found[hidden & sure] == 2).mean() > 0.98
    assert (found[~hidden & sure] == 1).mean() > 0.98
