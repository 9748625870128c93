"""Crops of the original images: their pixels, and where other programs project ground in them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import Layer, atomic_store, create_grid
from stereotruth.tiles.orientation import evaluate
from stereotruth.tiles.originals import HEIGHTS, write_originals
from stereotruth.tiles.verify import defects

from ...synthetic.images import write
from ...synthetic.tiled_scene import PIXELS, SIZE, camera, rows_of, surface, texture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
CAMERAS = {"left": camera(0.09, 0.02, 0.70), "right": camera(-0.48, -0.03, 0.75)}
TOLERANCE = 0.01  # px
META = {"units": "m", "long_name": "test"}


@pytest.fixture(scope="module")
def cropped(exported: tuple[Path, dict], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("originals")
    shutil.copytree(exported[0], folder / "Town")
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
    write_originals(cropped / "Town", out, images, {"s1": (store, None)})
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
